"""What a run leaves on disk: configuration, versions, tables."""

from __future__ import annotations

import csv
import io
import json
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from training.errors import UserError

_PACKAGES = (
    "torch",
    "torchrl",
    "tensordict",
    "gymnasium",
    "mujoco",
    "envpool",
    "numpy",
    "hydra-core",
)

# Of a run that recipes/study.py started: which cell of which study it is.
CELL_FILE = "cell.json"

# Of evaluation.csv: one row an evaluation and kind of action.
EVALUATION_COLUMNS = (
    "frames",
    "kind",
    "mode",
    "episodes",
    "return_mean",
    "return_std",
    "length_mean",
    "missing_ratio",
    "log_likelihood",
)

# Settings that came after the first run folders, with the value that says what a run without them
# did: a folder stays readable when a setting is added. "group.key": value
_LATER_SETTINGS: dict[str, Any] = {
    "algo": {"_target_": "algorithms.ppo.build", "name": "ppo"},
    "heads.critic_input": "features",
    "optim.recompute_advantages": False,
    "missingness.mean_length": 1.0,
    "missingness.group_by": "sensor",
    "noise.spike_probability": 0.0,
    "noise.spike_std": 0.0,
    "method": None,
}


def write_config(folder: Path, config: Mapping[str, Any]) -> None:
    """Write the resolved configuration of a run.

    Args:
        folder: the run folder.
        config: the configuration as plain containers.
    """
    write_whole(folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(dict(config))))


def read_config(folder: Path) -> dict[str, Any]:
    """Read the configuration of a run.

    Args:
        folder: the run folder.

    Returns:
        The configuration as plain containers; settings that came after it was written are added
        with the value that describes it.

    Raises:
        UserError: if there is none, or it can't be read.
    """
    path = folder / "config.yaml"
    if not path.is_file():
        raise UserError(f"`{folder}` must be a run folder with config.yaml; there is none.")
    try:
        config = OmegaConf.to_container(OmegaConf.load(path))
    except (YAMLError, OmegaConfBaseException, UnicodeDecodeError) as error:
        raise UserError(f"`{path}` can't be read as a configuration: is it damaged?") from error
    if not isinstance(config, dict):
        raise UserError(f"`{path}` must hold the settings of a run, got {type(config).__name__}.")
    return _with_later_settings({str(key): value for key, value in config.items()})


def _with_later_settings(config: dict[str, Any]) -> dict[str, Any]:
    """Give an older configuration the settings that came later, at the value it had acted on."""
    for name, value in _LATER_SETTINGS.items():
        *path, last = name.split(".")
        group: Any = config
        for part in path:
            group = group.setdefault(part, {}) if isinstance(group, dict) else None
        if isinstance(group, dict):
            group.setdefault(last, value)
    return config


def write_versions(folder: Path) -> None:
    """Write the versions of what a run depends on, and the commit of its code.

    Args:
        folder: the run folder.
    """
    system = f"{platform.system()} {platform.machine()}"
    versions = {"python": platform.python_version(), "platform": system}
    for name in (*_PACKAGES, "torchrl_drbpn"):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed as a package"
    versions["git_commit"] = _git("rev-parse", "HEAD") or "unknown"
    versions["git_uncommitted_changes"] = str(bool(_git("status", "--porcelain")))
    write_whole(folder / "versions.json", json.dumps(versions, indent=2) + "\n")


def _git(*arguments: str) -> str:
    """Return what git says about this checkout, or nothing."""
    try:
        answer = subprocess.run(
            ["git", *arguments],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
            timeout=10,
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return answer.stdout.strip()


def write_whole(path: Path, text: str) -> None:
    """Write a text file whole or not at all.

    Args:
        path: the file.
        text: its content.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    temporary.write_text(text, encoding="utf-8")
    os.replace(temporary, path)


class Table:
    """Append rows to a CSV file; a resumed run goes on where its checkpoint was.

    Args:
        path: the file.
        columns: its columns; the first is ``frames``.
        up_to_frames: rows after this many frames are dropped; None: nothing is there yet.
    """

    def __init__(self, path: Path, columns: Sequence[str], up_to_frames: int | None = None) -> None:
        self.path, self.columns = path, list(columns)
        kept: list[dict[str, str]] = []
        if up_to_frames is not None and path.is_file():
            with path.open(newline="", encoding="utf-8") as file:
                for row in csv.DictReader(file):
                    try:
                        # A row that was being written when the machine stopped has no end.
                        whole = None not in row.values() and int(row["frames"]) <= up_to_frames
                    except (KeyError, ValueError):
                        whole = False
                    if whole:
                        kept.append({c: row.get(c, "") for c in self.columns})
        write_whole(path, _csv_text(self.columns, kept))

    def append(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Append rows.

        Args:
            rows: values by column; an absent one or None is an empty cell, others are left out.
        """
        with self.path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self.columns, lineterminator="\n")
            writer.writerows({c: row.get(c) for c in self.columns} for row in rows)


def _csv_text(columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> str:
    file = io.StringIO()
    writer = csv.DictWriter(file, columns, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return file.getvalue()


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a CSV file whole or not at all.

    Args:
        path: the file.
        rows: its rows, at least one, all with the same keys.
    """
    write_whole(path, _csv_text(list(rows[0]), rows))
