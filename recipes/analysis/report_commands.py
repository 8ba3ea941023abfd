"""The commands that make a study's runs again, from the configurations that the runs left."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from evaluation.grid import Grid, grid_points, parse_points
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from training.composition import composed_config
from training.errors import UserError

from analysis.report_evaluations import GRID_TABLE, Row, point_order
from analysis.report_runs import StudyRun, flat

# Always written out: a reader looks for them.
_SHOWN = ("env.version", "seed", "total_frames")
# Where a run was made and what it printed does not belong to what it computed.
_LEFT_OUT = ("resume", "logger", "checkpoint", "threads")


def training_command(run: StudyRun) -> str:
    """Return a command line that gives a run's configuration in this checkout.

    Args:
        run: the run.

    Returns:
        ``python recipes/ppo_drbpn.py`` with groups, what is always shown, and every setting that
        differs from the defaults of conf/.

    Raises:
        UserError: if conf/ has no such group any more.
    """
    config, s = run.config, run.settings
    groups = [f"env={s.env.name}"]
    choices = {
        "belief": str(s.belief.get("name", "")),
        "algo": str(s.algo.get("name", "")),
        "missingness": s.missingness.mechanism,
        "noise": "gaussian" if s.noise.sigma > 0 else "none",
    }
    try:
        defaults = _composed()
        chosen = {
            "belief": defaults["belief"].get("name"),
            "algo": defaults["algo"].get("name"),
            "missingness": defaults["missingness"]["mechanism"],
            "noise": "gaussian" if defaults["noise"]["sigma"] > 0 else "none",
        }
        groups += [f"{group}={name}" for group, name in choices.items() if name != chosen[group]]
        base = flat(_composed(*groups))
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(
            f"`{run.name}` can't be put into a command, conf/ lacks a group of "
            f"{' '.join(groups)}: {' '.join(str(error).split())[:200]}"
        ) from error
    own = flat(config)
    words = list(groups)
    words += [f"{key}={_value(own[key])}" for key in _SHOWN]
    for key in sorted(own):
        if key in _SHOWN or key.split(".")[0] in _LEFT_OUT:
            continue
        if key not in base or base[key] != own[key]:
            words.append(f"{'' if key in base else '+'}{key}={_value(own[key])}")
    words.append(f"hydra.run.dir=runs/{run.name}")
    return " ".join(["python recipes/ppo_drbpn.py", *(shlex.quote(word) for word in words)])


def evaluation_commands(runs: Sequence[StudyRun]) -> list[str]:
    """Return the commands that evaluated the last checkpoints at several points.

    Args:
        runs: of a report.

    Returns:
        Calls of ``recipes/evaluate.py``: of the grid where the points are its own, else with the
        points of each run. Cells of a study that were evaluated alike are one loop, as each has its
        table in its own run folder; of several runs at once evaluate.py makes one beside them.
    """
    commands: list[str] = []
    loops: dict[tuple[str, str], list[StudyRun]] = {}
    for run in runs:
        for table in dict.fromkeys(row["table"] for row in run.evaluations):
            rows = [r for r in run.evaluations if (r["source"], r["table"]) == ("points", table)]
            if not rows:
                continue
            options = _evaluation_options(run, table, rows)
            if run.study is None:
                words = ["python recipes/evaluate.py", shlex.quote(f"run=runs/{run.name}"), options]
                commands.append(" ".join(words).strip())
            else:
                loops.setdefault((run.study, options), []).append(run)
    for (study, options), evaluated in loops.items():
        cells = [run for run in runs if run.study == study]
        if len(evaluated) == len(cells):
            folders = f"$(dirname runs/{study}/*/config.yaml)"
        else:
            folders = " ".join(f"runs/{study}/{Path(run.name).name}" for run in evaluated)
        call = f"python recipes/evaluate.py run=$run {options}".strip()
        commands.append(f"for run in {folders}; do {call}; done")
    return commands


def _evaluation_options(run: StudyRun, table: str, rows: Sequence[Row]) -> str:
    """Return the arguments that give the rows of one table of a run."""
    defaults = _evaluation_defaults()
    points = sorted({row["point"] for row in rows}, key=point_order)
    present = {row["mode"] for row in rows}
    modes = [mode for mode in ("sampled", "mean") if mode in present]
    episodes = max(int(row["episodes"]) for row in rows)
    words = []
    # evaluate.py leaves out by itself what an agent without a model can't be asked.
    on_grid = table == GRID_TABLE
    default = on_grid and set(points) <= _grid_names(run, full=False)
    full = on_grid and set(points) <= _grid_names(run, full=True)
    if not default:
        words.append("full=true" if full else f"points=[{','.join(points)}]")
    if episodes != defaults["episodes"] or not (default or full):
        words.append(f"episodes={episodes}")
    if len(modes) < 2:
        words.append(f"modes=[{','.join(modes)}]")
    seeds = {row["episode_seed"] for row in rows} - {None, defaults["seed"]}
    words += [f"seed={seed}" for seed in sorted(seeds)]
    return " ".join(shlex.quote(word) for word in words)


def _grid_names(run: StudyRun, *, full: bool) -> set[str]:
    defaults = _evaluation_defaults()
    texts = grid_points(Grid(**defaults["grid"]), full=full, model=True)
    points = parse_points(texts, run.settings, float(defaults["spike_std"]))
    return {point.name for point in points}


@functools.cache
def _evaluation_defaults() -> dict[str, Any]:
    """Return conf/evaluate.yaml; to be read only."""
    path = Path(__file__).parents[2] / "conf" / "evaluate.yaml"
    config = OmegaConf.to_container(OmegaConf.load(path))
    return {str(key): value for key, value in config.items()} if isinstance(config, dict) else {}


def commands_from_nothing(
    runs: Sequence[StudyRun], name: str, options: Sequence[str] = ()
) -> list[str]:
    """Return the commands that train, evaluate and report, from the repository's root.

    Args:
        runs: of the study.
        name: of the folder of the report.
        options: further arguments of ``recipes/report.py``.

    Returns:
        Commands. Cells of a study are trained by the study's own.
    """
    alone = [run for run in runs if run.study is None]
    studies = list(dict.fromkeys(run.study for run in runs if run.study is not None))
    commands = [f"python recipes/study.py study={study}" for study in studies]
    commands += [training_command(run) for run in alone]
    commands += evaluation_commands(runs)
    folders = [f"runs/{study}/*" for study in studies]
    folders += sorted(f"runs/{run.name}" for run in alone)
    listed = folders[0] if len(folders) == 1 else f"[{','.join(folders)}]"
    words = [f"run={listed}", f"out=results/{name}", *options]
    return [*commands, " ".join(["python recipes/report.py", *(shlex.quote(w) for w in words)])]


def rebuild_command(name: str) -> str:
    """Return the command that makes the tables again from the run folders beside them.

    Args:
        name: of the folder of the report.

    Returns:
        The command.
    """
    return f"python recipes/report.py out=results/{name}"


@functools.cache
def _composed(*groups: str) -> dict[str, Any]:
    """Compose once what all seeds of a task and method share; to be read only."""
    return composed_config(groups)


def _value(value: Any) -> str:
    """Write a value in Hydra's grammar."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return f"[{','.join(_value(item) for item in value)}]"
    return str(value)
