"""Draw what a robot sensed, missed and believed during part of an episode."""

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from training.errors import UserError

from rendering.style import STYLE
from rendering.trajectory import INTERVAL_95, Recording

TRUTH, ARRIVED, BELIEF, MISSING = "#222222", "#111111", "#1f77c4", "#f8ddd2"
ABSENT = "#e3997f"  # an entry of a mask that did not arrive
_DASHES: Any = (0, (3, 1.5))
_WIDTH_INCHES, _PANEL_INCHES, _STRIP_INCHES, _MASK_INCHES = 10.0, 1.05, 1.55, 0.75


def chosen_sensors(recording: Recording, wanted: int | str | Sequence[int | str]) -> list[int]:
    """Return the sensors to draw: ``wanted`` of those that miss most, or by names or numbers."""
    names = recording.names
    if isinstance(wanted, int):
        if wanted < 1:
            raise UserError(f"`sensors` must be 1 or more, or a list, got {wanted}.")
        missed = (~recording.observed).sum(0)
        return sorted(np.argsort(-missed, kind="stable")[:wanted].tolist())
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
    recording: Recording, sensors: Sequence[int], *, pictures: int, title: str
) -> Figure:
    """Draw a strip of at most so many pictures, the mask of all sensors, and a panel a sensor."""
    shown = min(pictures, len(recording.pictures))
    heights = [_STRIP_INCHES] * bool(shown) + [_MASK_INCHES, *[_PANEL_INCHES] * len(sensors)]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(_WIDTH_INCHES, sum(heights) + 1.15), layout="constrained")
        rows = figure.subplots(len(heights), sharex=True, height_ratios=heights, squeeze=False)
        axes = list(rows.ravel())
        figure.suptitle(title, x=0.012, ha="left", fontsize=11.5, fontweight="bold")
        if shown:
            _draw_strip(axes.pop(0), recording, shown)
        draw_panels(axes, recording, sensors)
        axes[-1].set_xlim(recording.steps[0] - 0.5, recording.steps[-1] + 0.5)
        figure.supylabel("sensor value in running standard deviations", fontsize=9.5)
        place: Any = {"loc": "outside lower center", "ncols": 4, "frameon": False}
        figure.legend(handles=legend_of(recording), **place)
    return figure


def draw_panels(axes: Sequence[Any], recording: Recording, sensors: Sequence[int]) -> None:
    """Draw the mask of all sensors, then a panel a sensor: truth, readings, gaps and belief."""
    count, steps = len(recording.names), recording.steps
    edges = (steps[0] - 0.5, steps[-1] + 0.5)
    cells: Any = {"aspect": "auto", "interpolation": "nearest"}
    absent = mpl.colors.ListedColormap(["white", ABSENT])
    missed = ~recording.observed.T
    axes[0].imshow(missed, extent=(*edges, count, 0), cmap=absent, vmin=0, vmax=1, **cells)
    axes[0].set_yticks([])
    axes[0].spines[["top", "right"]].set_visible(True)
    missing = 100 * recording.missing_ratio
    axes[0].set_title(f"all {count} sensors, a row each: {missing:.0f} % of the entries missing")
    for axis, sensor in zip(axes[1:], sensors, strict=True):
        seen = recording.observed[:, sensor]
        truth, mean = recording.complete[:, sensor], recording.estimate[:, sensor]
        arrived = np.where(seen, recording.arrived[:, sensor], np.nan)
        half = INTERVAL_95 * recording.std[:, sensor]
        # By what there is to know: a wide interval may leave the panel, a far estimate may not.
        known = np.concatenate([truth, arrived, mean])
        room = 0.12 * np.ptp(known[np.isfinite(known)]) + 0.05
        low, high = np.nanmin(known) - room, np.nanmax(known) + room
        gaps, shade = np.where(seen, np.nan, 1)[None], mpl.colors.ListedColormap([MISSING])
        axis.imshow(gaps, extent=(*edges, low, high), cmap=shade, zorder=0, **cells)
        axis.fill_between(steps, mean - half, mean + half, color=BELIEF, alpha=0.3, lw=0, zorder=2)
        axis.plot(steps, mean, color=BELIEF, lw=2.2, alpha=0.75, zorder=3)
        axis.plot(steps, truth, color=TRUTH, lw=0.9, ls=_DASHES, zorder=4)
        axis.plot(steps, arrived, ".", color=ARRIVED, ms=4.5, mew=0, zorder=5)
        axis.set_ylim(low, high)
        axis.set_title(f"{recording.names[sensor]}  ({100 * (1 - seen.mean()):.0f} % missing)")
        axis.locator_params(axis="y", nbins=4)
    axes[-1].xaxis.get_major_locator().set_params(integer=True)
    axes[-1].set_xlabel("step of the episode")


def legend_of(recording: Recording) -> list[Any]:
    """Return what explains the panels of a recording."""
    line = mpl.lines.Line2D
    handles: list[Any] = [
        line([], [], color=TRUTH, lw=0.9, ls=_DASHES, label="true value, unknown to the agent"),
        line([], [], color=ARRIVED, marker=".", ls="", ms=7, mew=0, label="what arrived"),
        Patch(color=MISSING, label="nothing arrived"),
    ]
    name = "belief" if recording.kind == "estimate" else "forecast"
    if recording.kind != "nothing" and np.isnan(recording.std).all():
        handles.append(line([], [], color=BELIEF, lw=2.2, label=name))
    elif recording.kind != "nothing":
        light = (*mpl.colors.to_rgb(BELIEF), 0.3)
        label = f"{name} and its 95 % interval"
        handles.append(Patch(facecolor=light, edgecolor=BELIEF, label=label))
    return handles


def _draw_strip(axis: Any, recording: Recording, count: int) -> None:
    """Put pictures above the steps around those they show: the middle of equal parts."""
    part = len(recording.steps) / count
    for index in range(count):
        left = recording.steps[0] - 0.5 + index * part
        place = (left + 0.02 * part, left + 0.98 * part, 0, 1)
        picture = recording.pictures[int((index + 0.5) * part)]
        axis.imshow(picture, extent=place, aspect="auto", interpolation="lanczos")
    axis.set_ylim(0, 1)
    axis.axis("off")
