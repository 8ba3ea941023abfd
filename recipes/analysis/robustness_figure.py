"""Figures of an evaluation: return over what is missing or wrong, with 95 % intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rendering.belief_figure import STYLE
from training.methods import training_labels

_COLOURS = ("#1f6fb4", "#d1622b", "#3a923a", "#8d5aa8", "#7f6a4f", "#c44e7f", "#5f6b73")
_LINES = ("-", "--", ":", "-.")
_PANEL = (3.4, 3.1)  # inches
_RESAMPLES = 2000
_NUMBERS = (
    "trained_noise_sigma",
    "eta",
    "mean_length",
    "removed_ratio",
    "noise_sigma",
    "spike_probability",
    "spike_std",
    "return",
    "length",
    "missing_ratio",
)

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Curve:
    """One line of one panel: a method under one family of corruption, by level.

    Attributes:
        panel: title of the panel.
        axis: what the level is, for its axis.
        method: name, and what it was trained on where that differs within the task.
        variant: what tells curves of one method in one panel apart; may be empty.
        rows: the episodes of each level.
    """

    panel: str
    axis: str
    method: str
    variant: str
    rows: dict[float, list[Row]]


def read_rows(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Turn the cells of the table into numbers.

    Args:
        rows: of the table, as written or as read back.

    Returns:
        The rows; None in empty cells of numbers.
    """
    return [
        dict(row)
        | {name: None if row[name] in ("", None) else float(row[name]) for name in _NUMBERS}
        for row in rows
    ]


def draw_robustness(rows: Sequence[Row]) -> dict[str, Figure]:
    """Draw return over level, one figure a task, one row of panels a kind of action.

    The mean of all episodes, and the 95 % interval of that mean by the hierarchical bootstrap: runs
    drawn anew, then episodes within each. With one run it is that of its episodes alone; with a
    few it says little about runs that were not made. The level, nominal, is on the lower axis, the
    realised missing ratio at each level (mean of all that is drawn there) on the upper one.

    Args:
        rows: from :func:`read_rows`.

    Returns:
        Figures by task; none for a task without two levels of anything.
    """
    figures = {}
    for task in dict.fromkeys(row["env"] for row in rows):
        own = [row for row in rows if row["env"] == task]
        modes = list(dict.fromkeys(row["mode"] for row in own))
        labels = training_labels(map(_kind, own))
        curves = {
            mode: _curves([row for row in own if row["mode"] == mode], labels) for mode in modes
        }
        panels = list(dict.fromkeys(c.panel for found in curves.values() for c in found))
        if panels:
            figures[str(task)] = _draw(str(task), modes, panels, curves)
    return figures


def mean_interval(
    values: Sequence[Sequence[float]], seed: int = 0, *, shared: bool = False
) -> tuple[float, float, float]:
    """Return the mean over all values and its 95 % interval by the hierarchical bootstrap.

    Args:
        values: of each run, at least one each.
        seed: of the resampling.

    Keyword Args:
        shared: whether the n-th values of all runs have something in common that was drawn, such as
            which sensors are gone: they are then drawn anew together, as many for each run.

    Returns:
        Mean, lower end, upper end.
    """
    generator = np.random.default_rng(seed)
    runs = [np.asarray(value, dtype=np.float64) for value in values]
    together = generator.integers(len(runs[0]), size=(_RESAMPLES, 1, len(runs[0])))
    means = np.stack(
        [
            run[
                np.broadcast_to(together, (_RESAMPLES, len(runs), len(run)))
                if shared
                else generator.integers(len(run), size=(_RESAMPLES, len(runs), len(run)))
            ].mean(-1)
            for run in runs
        ]
    )  # (run, resample, place): a run may be drawn into several places, with other episodes in each
    chosen = generator.integers(len(runs), size=(_RESAMPLES, len(runs)))
    drawn = means[chosen, np.arange(_RESAMPLES)[:, None], np.arange(len(runs))].mean(-1)
    low, high = np.quantile(drawn, (0.025, 0.975))
    return float(np.mean([run.mean() for run in runs])), float(low), float(high)


def _kind(row: Row) -> tuple[str, str, float]:
    return row["method"], row["trained_on"], row["trained_noise_sigma"]


def _curves(rows: Sequence[Row], labels: Mapping[tuple[str, str, float], str]) -> list[Curve]:
    """Sort the episodes of a kind of action into curves of two levels or more."""
    curves: dict[tuple[str, str, str], Curve] = {}
    clean: dict[str, list[Row]] = {}
    for row in rows:
        method = labels[_kind(row)]
        if row["family"] == "none":
            clean.setdefault(method, []).append(row)
            continue
        panel, axis, variant, level = _place(row)
        curve = curves.setdefault((panel, method, variant), Curve(panel, axis, method, variant, {}))
        curve.rows.setdefault(level, []).append(row)
    for curve in curves.values():
        # With nothing missing every family of ratios is the same.
        if curve.axis == "nominal missing ratio" and curve.method in clean:
            curve.rows.setdefault(0.0, clean[curve.method])
    return [curve for curve in curves.values() if len(curve.rows) > 1]


def _place(row: Row) -> tuple[str, str, str, float]:
    """Return panel, axis, variant and level of an episode."""
    family = row["family"]
    if family == "reduction":
        how = f"chosen by the {row['removed_by']}" if row["removed_by"] == "model" else "at random"
        return "sensor reduction", "nominal missing ratio", how, row["removed_ratio"]
    if family == "outages":
        panel = f"outages, ratio {row['eta']:g}"
        return panel, "mean outage length, steps", f"per {row['group_by']}", row["mean_length"]
    if family == "noise":
        return "noise", "sigma", "", row["noise_sigma"]
    if family == "spikes":
        variant = f"std {row['spike_std']:g}"
        return "spikes", "probability", variant, row["spike_probability"]
    return str(family).upper(), "nominal missing ratio", "", row["eta"]


def _draw(
    task: str, modes: Sequence[str], panels: Sequence[str], curves: Mapping[str, Sequence[Curve]]
) -> Figure:
    methods = list(dict.fromkeys(c.method for found in curves.values() for c in found))
    with mpl.rc_context(STYLE):
        size = (_PANEL[0] * len(panels), _PANEL[1] * len(modes) + 0.4)
        figure = Figure(figsize=size, layout="constrained")
        grid = figure.subplots(len(modes), len(panels), squeeze=False, sharey="row")
        for line, mode in zip(grid, modes, strict=True):
            for axis, panel in zip(line, panels, strict=True):
                found = [curve for curve in curves[mode] if curve.panel == panel]
                if found:
                    _draw_panel(axis, found, methods)
                axis.set_title(panel)
            line[0].set_ylabel(f"raw return, {mode} actions")
        figure.suptitle(
            f"{task}: mean and 95 % interval of the mean", x=0.012, ha="left", fontweight="bold"
        )
    return figure


def _draw_panel(axis: Any, curves: Sequence[Curve], methods: Sequence[str]) -> None:
    variants = list(dict.fromkeys(curve.variant for curve in curves))
    for curve in curves:
        levels = sorted(curve.rows)
        ends = np.array([_interval(curve.rows[level]) for level in levels])
        colour = _COLOURS[methods.index(curve.method) % len(_COLOURS)]
        runs = len({row["run"] for found in curve.rows.values() for row in found})
        label = ", ".join(part for part in (curve.method, curve.variant) if part)
        axis.plot(
            levels,
            ends[:, 0],
            "o" + _LINES[variants.index(curve.variant) % len(_LINES)],
            color=colour,
            lw=1.8,
            ms=4,
            label=f"{label} ({runs} run{'s' if runs > 1 else ''})",
        )
        axis.fill_between(levels, ends[:, 1], ends[:, 2], color=colour, alpha=0.18, lw=0)
    _realised_axis(axis, curves)
    axis.set_xlabel(curves[0].axis)
    axis.legend(frameon=False, fontsize=8)


def _interval(rows: Sequence[Row]) -> tuple[float, float, float]:
    # The n-th episode of every run lacks the same sensors.
    shared = all(row.get("removed_by") == "random" for row in rows)
    return mean_interval(_by_run(rows), shared=shared)


def _by_run(rows: Sequence[Row]) -> list[list[float]]:
    runs: dict[str, list[float]] = {}
    for row in rows:
        runs.setdefault(row["run"], []).append(row["return"])
    return list(runs.values())


def _realised_axis(axis: Any, curves: Sequence[Curve]) -> None:
    """Write the realised ratio above each nominal level."""
    realised: dict[float, list[Row]] = {}
    for curve in curves:
        for level, rows in curve.rows.items():
            realised.setdefault(level, []).extend(rows)
    levels = sorted(realised)
    if curves[0].axis.startswith("mean outage") and levels[0] > 0:
        axis.set_xscale("log")
    elif curves[0].axis == "sigma":
        axis.set_xscale("symlog", linthresh=1.0)
    axis.minorticks_off()
    axis.set_xticks(levels, [f"{level:g}" for level in levels])
    above = axis.secondary_xaxis("top")
    above.set_xticks(
        levels, [f"{_ratio(realised[level]):.2f}".removeprefix("0") for level in levels]
    )
    above.minorticks_off()
    above.tick_params(labelsize=8, colors="#5f6b73")
    above.set_xlabel("realised missing ratio", fontsize=8, color="#5f6b73")


def _ratio(rows: Sequence[Row]) -> float:
    steps: NDArray[np.float64] = np.array([row["length"] for row in rows])
    missing = np.array([row["missing_ratio"] for row in rows])
    return float((missing * steps).sum() / steps.sum())
