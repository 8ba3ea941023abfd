"""Figures of a study: learning curves, and return against what is missing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from rendering.belief_figure import STYLE

from analysis.report_evaluations import point_kind, point_order
from analysis.report_runs import StudyRun, grouped
from analysis.report_statistics import Array, interquartile_mean, interval
from analysis.report_tables import final_evaluation, training_rows

_COLOURS = (
    *("#1f6fb4", "#d1622b", "#3a923a", "#8d5aa8", "#7f6a4f", "#c44e7f", "#5f6b73"),
    *("#b59b00", "#17a2a2", "#222222"),
)
_PANEL = (4.3, 3.1)  # inches
_COLUMNS = 3
_GRID = 200  # points of a curve
_NOTHING = "none"
_RATIO = "realised missing ratio"
# What else than the missing ratio the points of a family differ in.
_AXES = {
    "outages": "mean length of an outage, steps",
    "noise": "sigma of the noise",
    "spikes": "probability of a spike",
}
_NAMES = {"mcar": "MCAR", "mar": "MAR", "nmar": "NMAR"}

_Group = Sequence[StudyRun]


def learning_curves(runs: Sequence[StudyRun], rows: int) -> Figure:
    """Draw training return over environment steps, one panel a task.

    Args:
        runs: of a study.
        rows: points of a curve.

    Returns:
        The figure: interquartile mean over seeds and its 95 % interval for each method. Where a
        panel holds one method only, also every seed, and the evaluations as markers.
    """
    with mpl.rc_context(STYLE):
        tasks = list(dict.fromkeys(_panel(run) for run in runs))
        lines = -(-len(tasks) // _COLUMNS)
        figure, axes = _panels(lines, min(len(tasks), _COLUMNS))
        colours = _colours(runs)
        for axis, task in zip(axes.ravel(), tasks, strict=False):
            groups = [g for g in grouped(runs) if _panel(g[0]) == task]
            for members in groups:
                label = _label(members, runs)
                _draw_curves(axis, members, rows, colours[label], label, alone=len(groups) == 1)
            missing = np.mean([run.missing_ratio for group in groups for run in group])
            axis.set_title(f"{task}: {100 * missing:.0f} % of the entries missing")
            axis.set_xlabel("environment steps, millions")
        for axis in axes.ravel()[len(tasks) :]:
            axis.axis("off")
        for axis in axes[:, 0]:
            axis.set_ylabel("raw return, training")
        _legend(figure, axes)
    return figure


def robustness(runs: Sequence[StudyRun], mode: str = "sampled") -> Figure | None:
    """Draw the return of the last checkpoints over the realised missing ratio.

    Args:
        runs: of a study.
        mode: kind of action.

    Returns:
        The figure, a column a task and a row a kind of missingness: interquartile mean over seeds
        and its 95 % interval for each method. None where no task was evaluated at two points.
    """
    with mpl.rc_context(STYLE):
        series = {
            (_panel(members[0]), kind, _label(members, runs)): (members, points)
            for members in grouped(runs)
            for kind, points in _series(members, mode)
        }
        if not series:
            return None
        tasks = list(dict.fromkeys(task for task, _, _ in series))
        kinds = sorted({kind for _, kind, _ in series})
        figure, axes = _panels(len(kinds), len(tasks))
        colours = _colours(runs)
        for line, kind in enumerate(kinds):
            for column, task in enumerate(tasks):
                axis = axes[line, column]
                own = {k[2]: s for k, s in series.items() if k[:2] == (task, kind)}
                if not own:
                    axis.axis("off")
                    continue
                nominal = True
                for label, (members, points) in own.items():
                    _draw_points(axis, members, points, mode, colours[label], label, nominal)
                    nominal = False  # once a panel is enough
                axis.set_title(f"{task}, {_NAMES.get(kind, kind)}")
                axis.set_xlim(left=-0.02)
                axis.set_xlabel(_AXES.get(kind.split(" ")[0], _RATIO))
                low, high = min(0.0, axis.dataLim.ymin), max(0.0, axis.dataLim.ymax)
                room = 0.12 * (high - low or 1.0)
                axis.set_ylim(low - (room if low < 0 else 0), high + room)
        for axis in axes[:, 0]:
            axis.set_ylabel(f"raw return, {mode} actions")
        _legend(figure, axes)
    return figure


def _panel(run: StudyRun) -> str:
    """Return what a panel shows: a task, and a choice where the study has a further axis."""
    group = run.group
    return f"{group['task']}, {group['variant']}" if group["variant"] else group["task"]


def _panels(lines: int, columns: int) -> tuple[Figure, Any]:
    size = (max(_PANEL[0] * columns, 5.0), _PANEL[1] * lines + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(lines, columns, squeeze=False)


def _legend(figure: Figure, axes: Any) -> None:
    """Put one legend below all panels, each label once."""
    found: dict[str, Any] = {}
    for axis in axes.ravel():
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            found.setdefault(label, handle)
    figure.legend(
        list(found.values()),
        list(found),
        loc="outside lower center",
        ncol=min(len(found), 6 if axes.shape[1] > 1 else 3),
        frameon=False,
    )


def _colours(runs: Sequence[StudyRun]) -> dict[str, str]:
    """Return a colour a label, the same in every panel and figure of a study."""
    labels = dict.fromkeys(_label(members, runs) for members in grouped(runs))
    return {label: _COLOURS[i % len(_COLOURS)] for i, label in enumerate(labels)}


def _label(members: _Group, runs: Sequence[StudyRun]) -> str:
    """Name what tells a group from the others of the study, its task left out."""
    group = members[0].group
    parts = [group["method"]]
    if len({run.group["trained_on"] for run in runs}) > 1:
        parts.append(group["trained_on"])
    if len({run.group["noise_sigma"] for run in runs}) > 1:
        parts.append(f"sigma {group['noise_sigma']:g}")
    return ", ".join(parts)


def _draw_curves(
    axis: Any, members: _Group, rows: int, colour: str, label: str, *, alone: bool
) -> None:
    curves = []
    for run in members:
        known = [row for row in training_rows(run, rows) if row["return"] is not None]
        if known:
            curves.append(
                (np.array([r["frames"] for r in known]), np.array([r["return"] for r in known]))
            )
    if not curves:
        return
    # Where every seed has a value: a mean over fewer would jump.
    low, high = max(c[0][0] for c in curves), min(c[0][-1] for c in curves)
    grid = np.linspace(low, high, _GRID)
    _draw_band(axis, grid / 1e6, [np.interp(grid, *curve) for curve in curves], colour, label)
    if not alone:
        return
    for frames, returns in curves:
        axis.plot(frames / 1e6, returns, color=colour, lw=0.8, alpha=0.5)
    for mode, marker, face in (("sampled", "o", colour), ("mean", "D", "white")):
        points: dict[float, list[float]] = {}
        for run in members:
            for row in run.evaluations:
                if row["source"] in ("training", "final") and row["mode"] == mode:
                    points.setdefault(row["frames"], []).append(row["return_mean"])
        whole = sorted(frames for frames, found in points.items() if len(found) == len(members))
        axis.plot(
            [frames / 1e6 for frames in whole],
            [np.mean(points[frames]) for frames in whole],
            marker,
            color=colour,
            mfc=face,
            ms=5,
            label=f"{label}, evaluation, {mode} actions",
        )


def _draw_band(
    axis: Any, x: Array, values: Sequence[Array], colour: str, label: str, style: str = "-"
) -> Array:
    """Draw the interquartile mean over seeds and its 95 % interval; return the mean."""
    mean = interquartile_mean(np.stack(values, axis=-1))
    seeds = f"{len(values)} seed{'s' if len(values) > 1 else ''}"
    axis.plot(x, mean, style, color=colour, lw=2.0, ms=4.5, label=f"{label}, {seeds}")
    ends = interval([np.stack(values)])
    if ends is not None:
        axis.fill_between(x, *ends, color=colour, alpha=0.15, lw=0)
    return mean


def _series(members: _Group, mode: str) -> list[tuple[str, list[str]]]:
    """Return the points of each kind of missingness that all seeds have, two or more.

    The point with nothing missing belongs to every kind, as its first.
    """
    points = {
        row["point"]
        for run in members
        for row in run.evaluations
        if row["source"] != "training" and final_evaluation(run, row["point"], mode)
    }
    whole = [p for p in points if all(final_evaluation(run, p, mode) for run in members)]
    clean = [p for p in whole if p.startswith(_NOTHING)]
    out = []
    for kind in sorted({point_kind(p) for p in whole} - {_NOTHING}):
        own = [p for p in whole if point_kind(p) == kind]
        ordered = sorted(own if kind.split(" ")[0] in _AXES else [*clean, *own], key=point_order)
        if len(ordered) > 1:
            out.append((kind, ordered))
    return out


def _draw_points(
    axis: Any,
    members: _Group,
    points: Sequence[str],
    mode: str,
    colour: str,
    label: str,
    nominal: bool,
) -> None:
    found = [[final_evaluation(run, point, mode) for point in points] for run in members]
    # shape: (seeds, points)
    ratios = np.array([[row["missing_ratio"] for row in line if row] for line in found])
    returns = [np.array([row["return_mean"] for row in line if row]) for line in found]
    other = point_kind(points[-1]).split(" ")[0] in _AXES
    x = np.array([point_order(point)[1] for point in points]) if other else ratios.mean(0)
    mean = _draw_band(axis, x, returns, colour, label, style="o-")
    if other or not nominal:
        return
    for point, at, height in zip(points, x, mean, strict=True):
        if not point.startswith(_NOTHING):
            axis.annotate(
                f"{point_order(point)[1]:g}",
                (at, height),
                textcoords="offset points",
                xytext=(0, 7),
                ha="center",
                fontsize=7.5,
                color="#666666",
            )
