"""Checkpoints: everything a run needs to go on as if it had never stopped."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch

from training.errors import UserError

_FORMAT = "torchrl_drbpn recipe checkpoint 1"
_PATTERN = "frames_*.pt"


def save_checkpoint(folder: Path, frames: int, state: dict[str, Any], *, keep: int) -> Path:
    """Write a checkpoint whole or not at all, and drop the oldest ones.

    Args:
        folder: the run folder.
        frames: environment steps so far; names the file.
        state: tensors, numbers, texts, and containers of them.
        keep: how many of the latest checkpoints stay.

    Returns:
        The file.
    """
    directory = folder / "checkpoints"
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"frames_{frames:012d}.pt"
    temporary = directory / f".{path.name}.{os.getpid()}.tmp"
    with temporary.open("wb") as file:
        torch.save({"format": _FORMAT, **state}, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
    for old in sorted(directory.glob(_PATTERN))[:-keep]:
        old.unlink()
    return path


def last_checkpoint(folder: Path) -> Path:
    """Return the latest checkpoint of a run.

    Args:
        folder: the run folder.

    Returns:
        The file.

    Raises:
        UserError: if there is none.
    """
    if not folder.is_dir():
        raise UserError(f"`{folder}` must be a run folder; there is no such folder.")
    found = sorted((folder / "checkpoints").glob(_PATTERN))
    if not found:
        raise UserError(
            f"`{folder}` holds no checkpoint: it is not a run folder, or the run ended before "
            "its first one, or none was kept. Start it anew."
        )
    return found[-1]


def checkpoint_frames(folder: Path) -> int | None:
    """Return the environment steps of the latest checkpoint of a run.

    Args:
        folder: the run folder.

    Returns:
        Steps, or None where there is no checkpoint.
    """
    found = sorted((folder / "checkpoints").glob(_PATTERN))
    return int(found[-1].stem.removeprefix("frames_")) if found else None


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint.

    Args:
        path: the file.

    Returns:
        What was given to :func:`save_checkpoint`.

    Raises:
        UserError: if the file is damaged, or of another kind.
    """
    try:
        state = torch.load(path, weights_only=True, map_location="cpu")
    except FileNotFoundError as error:
        raise UserError(f"`{path}` must be a checkpoint; there is no such file.") from error
    # torch raises what the damaged byte happens to hit: any exception here means the same.
    except Exception as error:
        raise UserError(
            f"`{path}` can't be read: it is truncated or no checkpoint "
            f"({type(error).__name__}). Remove it to go on from the one before."
        ) from error
    if not isinstance(state, dict) or state.get("format") != _FORMAT:
        raise UserError(f"`{path}` is not a checkpoint of this recipe.")
    return state
