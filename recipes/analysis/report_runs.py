"""What finished runs left behind, read and checked as one study."""

from __future__ import annotations

import glob
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from training.config import Settings, missingness_name, read_settings
from training.errors import UserError
from training.methods import further_choices, method_name, read_cell
from training.run_folder import read_config

from analysis.report_evaluations import Row, evaluations, mean_of_known, read_csv
from analysis.report_variants import variant_order

# What may differ between the runs of one mean: it changes no number that is reported.
_NOT_COMPARED = ("seed", "threads", "resume", "logger", "checkpoint", "evaluation")


@dataclass(frozen=True)
class StudyRun:
    """One run folder, read.

    Attributes:
        name: of the folder, as short as tells it from the others of the study.
        config: its configuration, plain containers.
        settings: the same, checked.
        versions: what it was made with.
        training: rows of metrics.csv, numbers; None where a cell is empty.
        episodes: rows of episodes.csv; none where it is not there.
        evaluations: rows of :func:`analysis.report_evaluations.evaluations`.
        study: the study of recipes/study.py that it is a cell of; None: it was run by itself.
        method: see :func:`training.methods.method_name`.
        axes: its choices on axes of the study beside task, method and seed.
    """

    name: str
    config: Mapping[str, Any]
    settings: Settings
    versions: Mapping[str, str]
    training: list[Row]
    episodes: list[Row]
    evaluations: list[Row]
    study: str | None
    method: str
    axes: Mapping[str, str] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """Return the environment steps that the run has taken."""
        return int(self.training[-1]["frames"])

    @property
    def finished(self) -> bool:
        """Return whether it has taken all its steps and made its final evaluation."""
        s = self.settings
        evaluated = any(row["source"] == "final" for row in self.evaluations)
        return self.frames >= s.total_frames and (evaluated or not s.evaluation.final_episodes)

    @property
    def group(self) -> Row:
        """Return what the runs of one mean have in common."""
        s = self.settings
        return {
            "task": s.env.env_id,
            "method": self.method,
            "trained_on": _corruption(s),
            "noise_sigma": s.noise.sigma,
            "variant": ", ".join(self.axes.values()),
        }

    @property
    def missing_ratio(self) -> float:
        """Return the share of entries that did not arrive in training."""
        return mean_of_known(row["missing_ratio"] for row in self.training)


# Reading --------------------------------------------------------------------------------------


def find_folders(wanted: str | Sequence[str]) -> list[Path]:
    """Return run folders in a fixed order.

    Args:
        wanted: folders or patterns.

    Returns:
        Folders, each once, sorted. A pattern gives the folders with a config.yaml.

    Raises:
        UserError: if there is none, or one that is named does not exist.
    """
    found: set[Path] = set()
    for text in [wanted] if isinstance(wanted, str) else wanted:
        if glob.has_magic(str(text)):
            matches = [Path(p) for p in glob.glob(str(text), recursive=True)]
            runs = [path for path in matches if (path / "config.yaml").is_file()]
            if not runs:
                raise UserError(f"`run` must name run folders, {text} matches none.")
            found.update(runs)
        elif not Path(text).is_dir():
            raise UserError(
                f"`run` must name run folders, there is no folder {text}: give the one that "
                "ppo_drbpn.py printed."
            )
        else:
            found.add(Path(text))
    if not found:
        raise UserError("`run` must name run folders: 'run=[runs/a,runs/b]' or 'run=runs/*'.")
    # One folder given twice, by a name and by a pattern, is one run.
    unique = {path.resolve(): path for path in sorted(found)}
    return sorted(unique.values())


def without_rollout(folders: Sequence[Path]) -> list[Path]:
    """Return the runs that have been started and have finished no rollout yet.

    Args:
        folders: run folders.

    Returns:
        Those without a row in metrics.csv; a folder that holds checkpoints, or can't be read, is
        not among them: :func:`read_study` says what it lacks.
    """
    return [
        folder
        for folder in folders
        if (folder / "config.yaml").is_file()
        and not any(folder.glob("checkpoints/*.pt"))
        and not _has_row(folder / "metrics.csv")
    ]


def _has_row(path: Path) -> bool:
    return path.is_file() and len(path.read_bytes().splitlines()) > 1


def read_study(folders: Sequence[Path], *, unfinished: bool = False) -> list[StudyRun]:
    """Read runs, and check that they make a study.

    Args:
        folders: run folders.
        unfinished: whether runs that have not come to their end are taken.

    Returns:
        The runs, sorted by task, method, training corruption, other choices, seed.

    Raises:
        UserError: if a folder can't be read, a run is not finished, or runs of one mean differ
            in more than their seed or share it.
    """
    common = Path(os.path.commonpath([folder.resolve().parent for folder in folders]))
    runs = [_read_run(f, f.resolve().relative_to(common).as_posix()) for f in folders]
    for run in runs:
        if not run.finished and not unfinished:
            raise UserError(
                f"`{run.name}` has {run.frames:,} of {run.settings.total_frames:,} steps or lacks "
                "its final evaluation: finish it with resume=<folder>, or pass unfinished=true."
            )
    runs.sort(key=_order)
    for members in grouped(runs):
        _check_group(members)
    return runs


def _corruption(settings: Settings) -> str:
    """Name what did not arrive in training and what was wrong, Gaussian noise left out."""
    missing, noise = missingness_name(settings.missingness), settings.noise
    if not noise.spike_probability:
        return missing
    return f"{missing} spikes:{noise.spike_probability:g}:{noise.spike_std:g}"


def _order(run: StudyRun) -> tuple[Any, ...]:
    *others, variant = run.group.values()
    return (*others, variant_order(variant), run.settings.seed, run.name)


def grouped(runs: Sequence[StudyRun]) -> list[list[StudyRun]]:
    """Return the runs that one mean is taken over, one list each.

    Args:
        runs: of a study.

    Returns:
        Groups, in the order of the runs.
    """
    groups: dict[tuple[Any, ...], list[StudyRun]] = {}
    for run in runs:
        groups.setdefault(tuple(run.group.values()), []).append(run)
    return list(groups.values())


def trained_on(row: Row) -> str:
    """Say in words what the runs of a mean were trained on, and by which other choices.

    Args:
        row: with the columns of :attr:`StudyRun.group`.

    Returns:
        Such as ``mar:0.5, sigma 1`` or ``mar:0.5, sigma 1, lr1e-3``.
    """
    text = f"{row['trained_on']}, sigma {row['noise_sigma']:g}"
    return f"{text}, {row['variant']}" if row["variant"] else text


def _check_group(members: Sequence[StudyRun]) -> None:
    first = members[0]
    seeds: dict[int, StudyRun] = {}
    for run in members:
        twin = seeds.setdefault(run.settings.seed, run)
        if twin is not run:
            raise UserError(
                f"`{twin.name}` and `{run.name}` are the same task, method and corruption with the "
                f"same seed {run.settings.seed}: report them apart."
            )
        differing = _differing(first.config, run.config)
        if differing:
            raise UserError(
                f"`{first.name}` and `{run.name}` differ in {', '.join(differing[:5])}: one mean "
                "over both would say nothing. Report them apart."
            )


def _differing(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[str]:
    one, other = flat(first), flat(second)
    keys = sorted(one.keys() | other.keys())
    compared = [key for key in keys if key.split(".")[0] not in _NOT_COMPARED]
    return [key for key in compared if one.get(key) != other.get(key)]


def flat(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a configuration as one level of dotted keys.

    Args:
        config: nested mappings.
        prefix: put before every key.

    Returns:
        Values by dotted key.
    """
    out: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping):
            out |= flat(value, f"{prefix}{key}.")
        else:
            out[f"{prefix}{key}"] = value
    return out


def _read_run(folder: Path, name: str) -> StudyRun:
    config = read_config(folder)
    try:
        settings = read_settings(config)
    except UserError as error:
        raise UserError(f"`{folder / 'config.yaml'}`: {error}") from error
    training = read_csv(folder / "metrics.csv", {"frames", "return", "missing_ratio"})
    if not training:
        raise UserError(f"`{folder}` holds no finished rollout: metrics.csv is empty.")
    path = folder / "episodes.csv"
    study, choices = read_cell(folder)
    return StudyRun(
        name,
        config,
        settings,
        _read_versions(folder),
        training,
        read_csv(path, {"frames", "return"}) if path.is_file() else [],
        evaluations(folder, settings),
        study,
        method_name(settings, choices),
        further_choices(choices),
    )


def _read_versions(folder: Path) -> dict[str, str]:
    path = folder / "versions.json"
    try:
        versions = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"`{path}` can't be read: is {folder} a whole run folder?") from error
    if not isinstance(versions, dict):
        raise UserError(f"`{path}` must hold versions by name, got {type(versions).__name__}.")
    return {str(key): str(value) for key, value in versions.items()}
