"""Draw what a robot sensed, missed and believed during part of an episode."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray
from PIL import Image
from training.errors import UserError

from rendering.trajectory import INTERVAL_95, Recording

TRUTH, ARRIVED, BELIEF, MISSING = "#222222", "#111111", "#1f77c4", "#f8ddd2"
ABSENT = "#e3997f"  # an entry of a mask that did not arrive
DASHES = (0, (3, 1.5))
_WIDTH_INCHES, _PANEL_INCHES, _STRIP_INCHES, _MASK_INCHES = 10.0, 1.05, 1.55, 0.75
STYLE: Any = {
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}


def most_missing(recording: Recording, count: int) -> list[int]:
    """Return the sensors that missed most, in the order of the observation.

    Args:
        recording: of an episode.
        count: how many sensors, at most.

    Returns:
        Their indices.
    """
    missed = (~recording.observed).sum(0)
    ranked = np.argsort(-missed, kind="stable")[:count]
    return sorted(int(i) for i in ranked)


def chosen_sensors(recording: Recording, wanted: int | str | Sequence[int | str]) -> list[int]:
    """Return the sensors to draw.

    Args:
        recording: of an episode.
        wanted: how many of those that miss most, or names or numbers of components.

    Returns:
        Indices of components.

    Raises:
        UserError: if there is no such sensor.
    """
    names = recording.names
    if isinstance(wanted, int):
        if wanted < 1:
            raise UserError(f"`sensors` must be 1 or more, or a list, got {wanted}.")
        return most_missing(recording, wanted)
    indices = []
    for item in [wanted] if isinstance(wanted, str) else wanted:
        index = names.index(item) if item in names else item
        if not isinstance(index, int) or not 0 <= index < len(names):
            shown = ", ".join(f"{i} {name}" for i, name in enumerate(names[:20]))
            more = ", ..." if len(names) > 20 else ""
            raise UserError(f"`sensors` must be among {shown}{more}; got {item!r}.")
        indices.append(index)
    return indices


def draw_belief(
    recording: Recording,
    sensors: Sequence[int],
    frames: Sequence[NDArray[np.uint8]],
    *,
    title: str,
) -> Figure:
    """Draw a strip of pictures, the mask of all sensors, and a panel a sensor.

    Args:
        recording: of an episode.
        sensors: indices of the sensors drawn.
        frames: pictures of the robot at :func:`frame_steps`; empty for none.
        title: above everything.

    Returns:
        The figure.
    """
    heights = [_MASK_INCHES, *[_PANEL_INCHES] * len(sensors)]
    if frames:
        heights.insert(0, _STRIP_INCHES)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(_WIDTH_INCHES, sum(heights) + 1.15), layout="constrained")
        axes = figure.subplots(
            len(heights), 1, sharex=True, height_ratios=heights, squeeze=False
        ).ravel()
        figure.suptitle(title, x=0.012, ha="left", fontsize=11.5, fontweight="bold")
        rest = list(axes)
        if frames:
            _draw_frames(rest.pop(0), recording, frames)
        _draw_mask(rest.pop(0), recording)
        for axis, sensor in zip(rest, sensors, strict=True):
            _draw_sensor(axis, recording, sensor)
        axes[-1].set_xlabel("step of the episode")
        time = _time(recording)
        axes[-1].set_xlim(time[0] - 0.5, time[-1] + 0.5)
        figure.supylabel("sensor value in running standard deviations", fontsize=9.5)
        figure.legend(
            handles=_legend(),
            loc="outside lower center",
            ncols=4,
            frameon=False,
            fontsize=9.5,
        )
    return figure


def frame_steps(count: int, steps: int) -> list[int]:
    """Return the steps in the middle of ``count`` equal parts of ``steps``.

    Args:
        count: number of pictures.
        steps: number of steps.

    Returns:
        Indices from 0.
    """
    return [int((i + 0.5) * steps / count) for i in range(count)]


def save_figure(figure: Figure, path: Path, *, dpi: int, palette: bool = False) -> None:
    """Write a figure whole or not at all.

    Args:
        figure: the figure.
        path: the PNG file.
        dpi: dots per inch.
        palette: whether 256 colours are enough: a third of the size.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        # No date and no version: the same figure gives the same bytes.
        figure.savefig(temporary, format="png", dpi=dpi, metadata={"Software": None})
        if palette:
            with Image.open(temporary) as picture:
                few = picture.convert("RGB").quantize(256, kmeans=1)
            few.save(temporary, format="png", optimize=True)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _time(recording: Recording) -> NDArray[np.int64]:
    return recording.first_step + np.arange(len(recording.poses))


def _draw_frames(axis: Any, recording: Recording, frames: Sequence[NDArray[np.uint8]]) -> None:
    """Put each picture above the steps around the one it shows."""
    time = _time(recording)
    part = len(time) / len(frames)
    for index, frame in enumerate(frames):
        left = time[0] - 0.5 + index * part
        axis.imshow(
            frame,
            extent=(left + 0.02 * part, left + 0.98 * part, 0, 1),
            aspect="auto",
            interpolation="lanczos",
        )
    axis.set_ylim(0, 1)
    axis.axis("off")


def _draw_mask(axis: Any, recording: Recording) -> None:
    """Shade every entry of every sensor that did not arrive."""
    time = _time(recording)
    count = recording.observed.shape[1]
    axis.imshow(
        ~recording.observed.T,
        extent=(time[0] - 0.5, time[-1] + 0.5, count, 0),
        aspect="auto",
        interpolation="nearest",
        cmap=mpl.colors.ListedColormap(["white", ABSENT]),
        vmin=0,
        vmax=1,
    )
    axis.set_yticks([])
    axis.set_title(
        f"all {count} sensors, one row each: {100 * recording.missing_ratio:.0f} % of the entries "
        "did not arrive"
    )
    axis.spines[["top", "right"]].set_visible(True)


def _draw_sensor(axis: Any, recording: Recording, sensor: int) -> None:
    """Draw truth, arrivals, gaps and belief of one sensor."""
    time = _time(recording)
    seen = recording.observed[:, sensor]
    for start, stop in _runs(~seen):
        axis.axvspan(time[start] - 0.5, time[stop - 1] + 0.5, color=MISSING, lw=0, zorder=0)
    mean, band = recording.estimate[:, sensor], INTERVAL_95 * recording.std[:, sensor]
    axis.fill_between(time, mean - band, mean + band, color=BELIEF, alpha=0.3, lw=0, zorder=2)
    axis.plot(time, mean, color=BELIEF, lw=2.2, alpha=0.75, zorder=3)
    axis.plot(time, recording.complete[:, sensor], color=TRUTH, lw=0.9, ls=DASHES, zorder=4)
    axis.plot(
        time[seen], recording.arrived[seen, sensor], ".", color=ARRIVED, ms=4.5, mew=0, zorder=5
    )
    missing = 100 * (1 - seen.mean())
    axis.set_title(f"{recording.names[sensor]}  ({missing:.0f} % missing)")
    axis.margins(y=0.12)
    axis.locator_params(axis="y", nbins=4)


def _runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the stretches (start, stop) in which flags hold."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _legend() -> list[Any]:
    line = mpl.lines.Line2D
    return [
        line([], [], color=TRUTH, lw=0.9, ls=DASHES, label="true value, unknown to the agent"),
        line([], [], color=ARRIVED, marker=".", ls="", ms=7, mew=0, label="what arrived"),
        Patch(color=MISSING, label="nothing arrived"),
        Patch(
            facecolor=(*mpl.colors.to_rgb(BELIEF), 0.3),
            edgecolor=BELIEF,
            label="belief and its 95 % interval",
        ),
    ]
