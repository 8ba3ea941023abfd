"""Run folders as three tables: one row a run, a point of its learning curve, an evaluation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd
from evaluation.episodes import over_episodes
from evaluation.points import faults_name, method_name, missingness_name
from scipy.stats import hmean
from training.envs import env_name
from training.errors import UserError
from training.run_folder import read_config, read_table, read_versions, write_table

# A mean is taken over the seeds of one of these.
GROUP = ["task", "method", "settings", "trained_on", "noise_sigma"]
RUN = [*GROUP, "seed"]
# Returns on complete, exact observations that the DRBPN paper asks for within 2M steps, v4.
THRESHOLDS = {
    "HalfCheetah": 2100.0,
    "Hopper": 2000.0,
    "Ant": 2500.0,
    "Walker2d": 3000.0,
    "InvertedDoublePendulum": 9100.0,
    "InvertedPendulum": 950.0,
    "Swimmer": 90.0,
    "Reacher": -7.0,
}
WITHIN = 2_000_000  # environment steps
EPISODE_TABLES = ("robustness.csv", "points.csv")  # of recipes/evaluate.py, in order of precedence
_CURVE = ["frames", "episodes", "return", "missing_ratio", "log_likelihood", "steps_per_second"]
_EVALUATION = [
    *("source", "point", "frames", "mode", "episodes", "return_mean", "return_std"),
    *("length_mean", "missing_ratio", "log_likelihood", "diverged", "table"),
]
_EPISODE = ["frames", "point", "mode", "return", "length", "missing_ratio"]
# Settings that change no number that is reported, or are columns of their own.
_NOT_COMPARED = (
    *("threads", "optim.compile", "resume", "logger.", "checkpoint.", "evaluation.", "method"),
    *("transforms.noise.", "transforms.missingness."),  # again what noise and missingness say
)
_VERSIONS = ("torch", "torchrl", "gymnasium", "mujoco", "git_commit")


@dataclass(frozen=True)
class Study:
    """What is known of a study; each table is a CSV file beside its page."""

    runs: pd.DataFrame
    training: pd.DataFrame
    evaluation: pd.DataFrame

    def write(self, folder: Path) -> None:
        """Write the tables."""
        for field in fields(self):
            write_table(folder / f"{field.name}.csv", getattr(self, field.name))

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read the tables that :meth:`write` has written."""
        tables = [read_table(folder / f"{field.name}.csv", RUN) for field in fields(cls)]
        for table in tables:
            for name in {"settings", "overrides"} & {*table}:  # empty: a column without a text
                table[name] = table[name].astype(str).fillna("")
        return cls(*tables)


def read_runs(
    folders: Sequence[Path],
    further: str | None = None,
    *,
    rows: int = 100,
    unfinished: bool = False,
) -> Study:
    """Read run folders, and a ``further`` table of recipes/evaluate.py over several runs.

    Learning curves have so many ``rows``. ``settings`` of what comes back lists what differs
    between runs of one task, method and corruption beside the seed: such runs are never averaged.
    """
    configs = [read_config(folder) for folder in folders]
    needed = ["frames", "return", "missing_ratio"]
    curves = [read_table(f / "metrics.csv", needed).reindex(columns=_CURVE) for f in folders]
    shared = read_table(Path(further), ["run", *_EPISODE]) if further else None
    tested = [_evaluations(*pair, shared) for pair in zip(folders, configs, strict=True)]
    runs = pd.DataFrame(map(_run, folders, configs, curves, tested))
    late = runs[~runs.finished]
    if len(late) and not (unfinished and runs.frames.all()):
        first = late.sort_values("frames").iloc[0]
        raise UserError(
            f"`{first.run}` has {first.frames:,} of {first.total_frames:,} steps or lacks its "
            "final evaluation: finish it with resume=<folder>, or pass unfinished=true (which "
            "needs a rollout of each)."
        )
    _name_settings(runs, configs)
    twins = runs[runs.duplicated(RUN, keep=False)].run.tolist()
    if twins:
        raise UserError(
            f"`{twins[0]}` and `{twins[1]}` are the same task, method, settings and corruption "
            "with the same seed: report them apart."
        )
    keys = [runs.loc[[i], RUN] for i in runs.index]
    curves = [_thinned(curve, rows) for curve in curves]
    joined = [
        pd.concat(key.merge(part, how="cross") for key, part in zip(keys, parts, strict=True))
        for parts in (curves, tested)
    ]
    return Study(*(table.sort_values(RUN, kind="stable") for table in (runs, *joined)))


def _run(
    folder: Path, config: Mapping[str, Any], curve: pd.DataFrame, tested: pd.DataFrame
) -> dict[str, Any]:
    frames = int(curve.frames.max()) if len(curve) else 0
    task, noise = config["env"]["id"], config["noise"]
    own = config["transforms"].get("own") or []
    both = [config["missingness"], *(own if isinstance(own, list) else [own])]
    early = curve[(curve.frames <= WITHIN) & (curve.episodes >= 100)]
    path = folder / "episodes.csv"
    episodes = read_table(path, ["frames", "return"]) if path.is_file() else curve.head(0)
    best = episodes[episodes.frames <= WITHIN]["return"].nlargest(10)
    versions = read_versions(folder)
    final = bool((tested.source == "final").any() or not config["evaluation"]["final_episodes"])
    return {
        "run": folder.name,
        "task": env_name(config),
        "method": method_name(config),
        "settings": "",
        "trained_on": " ".join(map(missingness_name, both)) + faults_name(noise),
        "noise_sigma": float(noise["sigma"]),
        "seed": config["seed"],
        "frames": frames,
        "total_frames": config["total_frames"],
        "finished": frames >= config["total_frames"] and final,
        "return": curve["return"].iloc[-1] if len(curve) else None,
        "missing_ratio": curve.missing_ratio.mean(),
        "log_likelihood": curve.log_likelihood.iloc[-max(1, len(curve) // 10) :].mean(),
        "steps_per_second": hmean(curve.steps_per_second),  # every row holds as many frames
        "top_10_return": best.mean() if len(best) == 10 else None,
        "steps_to_threshold": early[early["return"] >= THRESHOLDS.get(task, np.inf)].frames.min(),
        **{name: versions.get(name) for name in _VERSIONS},
    }


def _evaluations(
    folder: Path, config: Mapping[str, Any], shared: pd.DataFrame | None
) -> pd.DataFrame:
    """Return the evaluations of the run itself, then those of recipes/evaluate.py."""
    path = folder / "evaluation.csv"
    needed = ["frames", "kind", "mode", "episodes", "return_mean"]
    own = read_table(path, needed) if path.is_file() else pd.DataFrame(columns=needed)
    own = own.rename(columns={"kind": "source"})
    tables = [own.assign(point=missingness_name(config["missingness"]), table=path.name)]
    paths = [folder / name for name in EPISODE_TABLES if (folder / name).is_file()]
    given = {path.name: read_table(path, _EPISODE) for path in paths}
    if shared is not None:
        given = {"over several runs": shared[shared.run == folder.name]} | given
    by = ["frames", "point", "mode"]
    tables += [over_episodes(e, by).assign(source="points", table=n) for n, e in given.items()]
    rows = pd.concat([table for table in tables if len(table)] or tables)
    return rows.reindex(columns=_EVALUATION).drop_duplicates(["source", "frames", "point", "mode"])


def _thinned(curve: pd.DataFrame, rows: int) -> pd.DataFrame:
    """Return a learning curve of at most ``rows`` rows; the return is a mean over 100 episodes."""
    part = np.arange(len(curve)) * min(rows, len(curve)) // max(1, len(curve))
    columns: dict[str, Any] = {"frames": "last", "return": lambda values: values.iloc[-1]}
    columns |= {"missing_ratio": "mean", "log_likelihood": "mean", "steps_per_second": hmean}
    return curve.groupby(part).agg(columns)


def _name_settings(runs: pd.DataFrame, configs: Sequence[Mapping[str, Any]]) -> None:
    """Fill ``settings`` (differing within a method) and ``overrides`` (within the study)."""
    flat = pd.json_normalize(list(configs)).map(lambda v: "null" if v is None else str(v))
    flat = flat[[name for name in flat if not name.startswith(_NOT_COMPARED)]]
    flat = flat.loc[:, flat.ne(runs.seed.astype(str), axis=0).any()]  # what follows the seed
    for _, members in runs.groupby(["task", "method", "trained_on", "noise_sigma"]):
        runs.loc[members.index, "settings"] = _differing(flat.loc[members.index])
    shared = [n for n in flat if n.split(".")[0] not in ("env", "belief", "missingness", "noise")]
    runs["overrides"] = _differing(flat[shared])


def _differing(flat: pd.DataFrame) -> list[str]:
    differing = flat[flat.columns[flat.nunique() > 1]].to_dict("records")
    return [", ".join(f"{key}={value}" for key, value in row.items()) for row in differing]
