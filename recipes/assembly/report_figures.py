"""Figures of a study: learning curves, and return against what is missing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from assembly.belief_figure import STYLE
from assembly.report_runs import StudyRun, grouped, point_order
from assembly.report_tables import final_evaluation, training_rows

_COLOURS = ("#1f6fb4", "#d1622b", "#3a923a", "#8d5aa8", "#7f6a4f", "#c44e7f", "#5f6b73")
_PANEL = (4.3, 3.3)  # inches
_COLUMNS = 3


def learning_curves(runs: Sequence[StudyRun], rows: int) -> Figure:
    """Draw training return over environment steps, one panel a task.

    Args:
        runs: of a study.
        rows: points of a curve.

    Returns:
        The figure: each seed thin, their mean thick, evaluations with sampled and mean actions
        as markers.
    """
    with mpl.rc_context(STYLE):
        figure, panels = _panels(runs)
        for task, axis in panels.items():
            groups = [g for g in grouped(runs) if g[0].group["task"] == task]
            for colour, members in zip(_cycle(len(groups)), groups, strict=True):
                _draw_curves(axis, members, rows, colour, _label(members, groups))
            missing = np.mean([run.missing_ratio for group in groups for run in group])
            axis.set_title(f"{task}: {100 * missing:.0f} % of the entries missing")
            axis.set_xlabel("environment steps, millions")
            axis.legend(frameon=False, fontsize=8.5)
        _first(panels).set_ylabel("raw return")
    return figure


def robustness(runs: Sequence[StudyRun]) -> Figure | None:
    """Draw the return of the last checkpoints over the realised missing ratio.

    Args:
        runs: of a study.

    Returns:
        The figure, sampled actions; None where no task was evaluated at two points.
    """
    with mpl.rc_context(STYLE):
        series = [s for members in grouped(runs) for s in _series(members)]
        if not series:
            return None
        tasks = {members[0].group["task"] for members, _, _ in series}
        figure, panels = _panels([run for run in runs if run.group["task"] in tasks])
        for task, axis in panels.items():
            own = [s for s in series if s[0][0].group["task"] == task]
            groups = [g for g in grouped(runs) if g[0].group["task"] == task]
            for colour, (members, mechanism, points) in zip(_cycle(len(own)), own, strict=True):
                label = f"{_label(members, groups)}, evaluated on {mechanism}"
                _draw_points(axis, members, points, colour, label)
            axis.set_title(task)
            axis.set_xlabel("realised missing ratio")
            axis.set_xlim(left=-0.02)
            low, high = (min(0.0, axis.dataLim.ymin), max(0.0, axis.dataLim.ymax))
            room = 0.16 * (high - low or 1.0)
            axis.set_ylim(low - (room if low < 0 else 0), high + room)
            axis.legend(frameon=False, fontsize=8.5, loc="lower left")
        _first(panels).set_ylabel("raw return, sampled actions")
    return figure


def _panels(runs: Sequence[StudyRun]) -> tuple[Figure, dict[str, Any]]:
    tasks = list(dict.fromkeys(run.group["task"] for run in runs))
    columns = min(len(tasks), _COLUMNS)
    lines = -(-len(tasks) // columns)
    figure = Figure(figsize=(_PANEL[0] * columns, _PANEL[1] * lines), layout="constrained")
    axes = figure.subplots(lines, columns, squeeze=False).ravel()
    for axis in axes[len(tasks) :]:
        axis.axis("off")
    return figure, dict(zip(tasks, axes, strict=False))


def _first(panels: dict[str, Any]) -> Any:
    return next(iter(panels.values()))


def _cycle(count: int) -> list[str]:
    return [_COLOURS[i % len(_COLOURS)] for i in range(count)]


def _label(members: Sequence[StudyRun], groups: Sequence[Sequence[StudyRun]]) -> str:
    """Name what tells a group from the others of its panel."""
    group = members[0].group
    others = [g[0].group for g in groups]
    parts = [group["belief"]]
    if len({g["trained_on"] for g in others}) > 1:
        parts.append(group["trained_on"])
    if len({g["noise_sigma"] for g in others}) > 1:
        parts.append(f"sigma {group['noise_sigma']:g}")
    return ", ".join(parts)


def _draw_curves(
    axis: Any, members: Sequence[StudyRun], rows: int, colour: str, label: str
) -> None:
    curves = []
    for run in members:
        known = [row for row in training_rows(run, rows) if row["return"] is not None]
        if known:
            curves.append(
                (np.array([r["frames"] for r in known]), np.array([r["return"] for r in known]))
            )
    for frames, returns in curves:
        axis.plot(frames / 1e6, returns, color=colour, lw=0.8, alpha=0.5)
    if curves:
        # Where every seed has a value: a mean over fewer would jump.
        low, high = max(c[0][0] for c in curves), min(c[0][-1] for c in curves)
        grid = np.linspace(low, high, 200)
        mean = np.mean([np.interp(grid, *curve) for curve in curves], axis=0)
        seeds = f"{len(curves)} seed{'s' if len(curves) > 1 else ''}"
        axis.plot(grid / 1e6, mean, color=colour, lw=2.2, label=f"{label}, training, {seeds}")
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
            label=f"evaluation, {mode} actions",
        )


_Series = tuple[Sequence[StudyRun], str, list[str]]


def _series(members: Sequence[StudyRun]) -> list[_Series]:
    """Return the points of each mechanism, nothing missing first, where there are two or more."""
    points = {
        row["point"]
        for run in members
        for row in run.evaluations
        if row["source"] != "training" and final_evaluation(run, row["point"], "sampled")
    }
    whole = [p for p in points if all(final_evaluation(run, p, "sampled") for run in members)]
    clean = [p for p in whole if p.startswith("none")]
    mechanisms = sorted({p.partition(":")[0] for p in whole} - {"none"})
    out = []
    for mechanism in mechanisms:
        own = [p for p in whole if p.partition(":")[0] == mechanism]
        ordered = sorted([*clean, *own], key=point_order)
        if len(ordered) > 1:
            out.append((members, mechanism.upper(), ordered))
    return out


def _draw_points(
    axis: Any, members: Sequence[StudyRun], points: Sequence[str], colour: str, label: str
) -> None:
    table = []
    for run in members:
        found = [final_evaluation(run, point, "sampled") for point in points]
        table.append([(row["missing_ratio"], row["return_mean"]) for row in found if row])
    values = np.array(table)  # seeds, points, (missing ratio, return)
    for line in values:
        axis.plot(line[:, 0], line[:, 1], color=colour, lw=0.8, alpha=0.5)
    mean = values.mean(0)
    axis.plot(mean[:, 0], mean[:, 1], "o-", color=colour, lw=2.2, ms=5, label=label)
    for point, (x, y) in zip(points, mean, strict=True):
        if not point.startswith("none"):
            axis.annotate(
                f"nominal {point.partition(':')[2]}",
                (x, y),
                textcoords="offset points",
                xytext=(0, 8),
                ha="center",
                fontsize=8,
                color=colour,
            )
