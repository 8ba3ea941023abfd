"""Videos from frames: GIF by Pillow, MP4 by the ffmpeg of imageio-ffmpeg.

TorchRL's VideoRecorder hands its frames to a logger, none of which serves here: CSVLogger writes
tensors and MP4 (by torchcodec and the system's FFmpeg libraries) but no GIF, under a name of its
own, and holds every frame in memory.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from training.errors import UserError

FASTEST = 50  # frames a second; a GIF counts in hundredths of a second
_PALETTE_FRAMES = 8  # from as many frames the colours of a GIF are taken
_FORMATS = (".gif", ".mp4")


def check_video(path: Path, fps: float) -> None:
    """Refuse a video that could not be written, before any work is done for it.

    Args:
        path: where it is to be.
        fps: frames a second.

    Raises:
        UserError: if the folder is missing, the format unknown or its writer not installed, or
            ``fps`` out of range.
    """
    if not path.parent.is_dir():
        raise UserError(f"`out` must lie in an existing folder, got {path}.")
    if path.suffix not in _FORMATS:
        raise UserError(f"`out` must end in .gif or .mp4, got {path.name}.")
    if path.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise UserError(
            "`out` as .mp4 needs imageio-ffmpeg: pip install imageio-ffmpeg, or take "
            f"{path.with_suffix('.gif').name}."
        )
    if not 1 <= fps <= FASTEST:
        raise UserError(f"`fps` must be in [1, {FASTEST}], got {fps}.")


def write_video(
    path: Path, frames: Sequence[NDArray[np.uint8]], *, fps: float, colours: int
) -> None:
    """Write a video whole or not at all; its suffix says which.

    Args:
        path: the GIF or MP4 file.
        frames: pictures ``(height, width, 3)``, taken one at a time.
        fps: frames a second, of a GIF to the next hundredth of a second a frame.
        colours: of a GIF; fewer make a smaller file.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.tmp{path.suffix}")
    try:
        if path.suffix == ".mp4":
            _write_mp4(temporary, frames, fps)
        else:
            _write_gif(temporary, frames, fps, colours)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _write_gif(path: Path, frames: Sequence[NDArray[np.uint8]], fps: float, colours: int) -> None:
    """Write all frames in the same colours, without dithering: what stands still costs nothing."""
    count = min(_PALETTE_FRAMES, len(frames))
    some = [frames[round(i)] for i in np.linspace(0, len(frames) - 1, count)]
    palette = Image.fromarray(np.concatenate(some)).quantize(colours, kmeans=1)
    pictures = (
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    )
    next(pictures).save(
        path,
        format="GIF",
        save_all=True,
        append_images=pictures,
        duration=10 * round(100 / fps),  # milliseconds
        loop=0,
        optimize=True,  # only what changes is written: a tenth less
    )


def _write_mp4(path: Path, frames: Sequence[NDArray[np.uint8]], fps: float) -> None:
    """Hand the frames to ffmpeg, one at a time."""
    writers: Any = importlib.import_module("imageio_ffmpeg")
    height, width = frames[0].shape[:2]
    # H.264 works in blocks of 16 pixels, but asks for even sides only.
    writer = writers.write_frames(str(path), (width, height), fps=fps, macro_block_size=2)
    try:
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame))
    finally:
        writer.close()
