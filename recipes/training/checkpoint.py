"""Checkpoints: everything a run needs to go on as if it had never stopped."""

import hashlib
import os
import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector

from training.config import one_line
from training.errors import UserError
from training.run_folder import whole

_FORMAT = "torchrl_drbpn recipe checkpoint 2"
_NAME = re.compile(r"frames_\d{12}\.pt")


def save_checkpoint(folder: Path, frames: int, state: dict[str, Any], *, keep: int) -> Path:
    """Write a checkpoint whole or not at all, with its SHA-256 beside it; keep the latest few."""
    path = folder / "checkpoints" / f"frames_{frames:012d}.pt"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole(path) as temporary:
            with temporary.open("wb") as file:
                torch.save({"format": _FORMAT, **state}, file)
                file.flush()
                os.fsync(file.fileno())
            _sum_file(path).write_text(f"{_digest(temporary)}  {path.name}\n", encoding="utf-8")
        for old in _checkpoints(folder)[:-keep]:
            old.unlink()
            _sum_file(old).unlink(missing_ok=True)
    # torch.save answers a full disk with a RuntimeError of its archive writer.
    except (OSError, RuntimeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "is the disk full?"
        raise UserError(
            f"`{path}` can't be written: {reason or error}. Checkpoints before it are kept."
        ) from error
    return path


def _checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints of a run, oldest first; other files are nobody's business."""
    found = (folder / "checkpoints").glob("*.pt") if (folder / "checkpoints").is_dir() else ()
    return sorted(path for path in found if _NAME.fullmatch(path.name))


def _sum_file(path: Path) -> Path:
    return path.with_name(path.name + ".sha256")


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def last_checkpoint(folder: Path) -> Path:
    """Return the latest checkpoint of a run."""
    if not folder.is_dir():
        raise UserError(f"`{folder}` must be a run folder; there is no such folder.")
    found = _checkpoints(folder)
    if not found:
        raise UserError(
            f"`{folder}` holds no checkpoint: it is not a run folder, or the run ended before "
            "its first one, or none was kept. Start it anew."
        )
    return found[-1]


def checkpoint_frames(folder: Path) -> int | None:
    """Return the environment steps of the latest checkpoint of a run; None where there is none."""
    found = _checkpoints(folder)
    return int(found[-1].stem.removeprefix("frames_")) if found else None


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint, its sums checked first; a damaged one names the one before it."""
    try:
        _check_sums(path)
        state: Any = torch.load(path, weights_only=True, map_location="cpu")
    # zipfile and torch raise what the damaged byte happens to hit: any of it means the same.
    except Exception as error:
        reason = str(error) if isinstance(error, _WrongSum) else type(error).__name__
        earlier = [other for other in _checkpoints(path.parents[1]) if other.name < path.name]
        before = f" Remove it to go on from `{earlier[-1].name}`." if earlier else ""
        raise UserError(
            f"`{path}` can't be read: it is damaged, truncated or no checkpoint ({reason}).{before}"
        ) from error
    if not isinstance(state, dict) or state.get("format") != _FORMAT:
        raise UserError(f"`{path}` is not a checkpoint of this recipe.")
    return state


class _WrongSum(Exception):
    """Say which sum is wrong."""


def _check_sums(path: Path) -> None:
    """Check the sums of a checkpoint's entries, then the sum of the whole beside it, if there."""
    with zipfile.ZipFile(path) as archive:
        if entry := archive.testzip():
            raise _WrongSum(f"wrong CRC of {entry}")
    sums = _sum_file(path)
    if sums.is_file() and sums.read_text(encoding="utf-8").split()[:1] != [_digest(path)]:
        raise _WrongSum(f"not as {sums.name} says")


@contextmanager
def fitting(source: str) -> Iterator[None]:
    """Turn what a state of another task, belief or size raises into one line."""
    try:
        yield
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
        raise UserError(
            f"`{source}` does not fit the settings of this run (another task, belief or size?): "
            f"{one_line(error)}"
        ) from error


# Collector has no public way to its carry-over, the root step from which the next rollout goes on:
# its own state_dict leaves it out and starts new episodes. These two are the only place that knows.


def carry_over(collector: Collector) -> dict[str, Any]:
    """Return the step from which the next rollout goes on."""
    return collector._carrier.to_dict()


def set_carry_over(collector: Collector, state: dict[str, Any]) -> None:
    """Let the next rollout go on from a saved step of simulators in the same state."""
    batch_size = collector._carrier.batch_size
    collector._carrier = TensorDict.from_dict(state, batch_size=batch_size)
