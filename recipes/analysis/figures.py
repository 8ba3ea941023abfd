"""Figures of a report and of an evaluation: learning curves, return under every condition."""

from typing import Any

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rendering.style import STYLE, colours, legend_below, panel_grid

from analysis.runs import GROUP, THRESHOLDS
from analysis.statistics import interquartile_mean, interval
from analysis.tables import family, point_kind

_PANEL = (4.3, 3.1)  # inches
_COLUMNS = 3
# What else than the missing ratio the points of a family differ in.
_LEVELS = {
    "outages": "mean length of an outage, steps",
    "noise": "sigma of the noise",
    "spikes": "probability of a spike",
    "delay": "least delay of a reading, steps",
    "multi_rate": "steps from one reading to the next",
    "stuck": "probability of getting stuck, a step",
    "drift": "standard deviation of a step of the drift, raw units",
}
_TITLES = {"mcar": "MCAR", "mar": "MAR", "nmar": "NMAR"}


def learning_curves(training: pd.DataFrame) -> Figure | None:
    """Draw training return over environment steps, one panel a task; None without episodes.

    Interquartile mean over seeds and its 95 % interval; on complete, exact observations also the
    paper's threshold.
    """
    training = training.assign(label=_labels(training)).dropna(subset="return")
    panels = list(training.groupby("task"))
    if not panels:
        return None
    with mpl.rc_context(STYLE):
        columns = min(len(panels), _COLUMNS)
        figure, axes = panel_grid(-(-len(panels) // columns), columns, _PANEL)
        colour = colours(sorted(training.label.unique()))
        for axis, (task, rows) in zip(axes.ravel(), panels, strict=False):
            for label, runs in rows.groupby("label"):
                curves = [
                    (c.frames.to_numpy(), c["return"].to_numpy()) for _, c in runs.groupby("seed")
                ]
                # Where every seed has a value: a mean over fewer would jump.
                first, last = max(c[0][0] for c in curves), min(c[0][-1] for c in curves)
                steps = np.linspace(first, last, 200)
                values = np.stack([np.interp(steps, *curve) for curve in curves], axis=-1)
                ends = interval(values)
                _band(axis, steps / 1e6, interquartile_mean(values), *ends, colour[label], label)
            threshold = THRESHOLDS.get(family(rows.task).iloc[0])
            clean = (rows.trained_on == "none:0").all() and not rows.noise_sigma.any()
            if clean and threshold is not None:
                axis.axhline(threshold, color="#999999", lw=0.8, ls=":", label="the paper asks for")
            axis.set(title=task, xlabel="environment steps, millions")
        _finish(figure, axes, "raw return, training")
    return figure


def robustness(summary: pd.DataFrame, *, rows: str, columns: str) -> Figure | None:
    """Draw return under every condition, a panel a pair of values of two columns of a summary.

    The realised missing ratio is on the axis, nominal levels in grey; outages, noise and spikes are
    by their level. None where no kind has two levels.
    """
    table = summary[summary.point != "training"]
    table = table.assign(label=_labels(table), kind=[point_kind(p)[0] for p in table.point])
    table["level"] = [point_kind(point)[1] for point in table.point]
    clean = table[table.kind == "none"]
    ratios = sorted(k for k in set(table.kind) - {"none"} if k.split(" ")[0] not in _LEVELS)
    # With nothing missing every family of ratios is the same.
    table = pd.concat([table[table.kind != "none"], *(clean.assign(kind=kind) for kind in ratios)])
    line = ["task", "mode", "kind", "label"]
    table = table[table.groupby(line)["level"].transform("nunique") > 1]
    if table.empty:
        return None
    lines, across = (sorted(table[name].unique()) for name in (rows, columns))
    with mpl.rc_context(STYLE):
        figure, axes = panel_grid(len(lines), len(across), _PANEL)
        colour = colours(sorted(table.label.unique()))
        for place, axis in np.ndenumerate(axes):
            row, column = lines[place[0]], across[place[1]]
            own = table[(table[rows] == row) & (table[columns] == column)]
            for index, (label, points) in enumerate(own.groupby("label")):
                points = points.sort_values("level")
                _points(axis, points, colour[label], str(label), nominal=index == 0)
            axis.set_title(", ".join(_TITLES.get(str(name), str(name)) for name in (column, row)))
        _finish(figure, axes, "raw return")
    return figure


def _points(axis: Any, points: pd.DataFrame, colour: str, label: str, *, nominal: bool) -> None:
    words = _LEVELS.get(points.kind.iloc[0].split(" ")[0])
    x = points.level if words else points.missing_ratio
    _band(axis, x, points["return"], points.low, points.high, colour, label, "o-")
    axis.set_xlabel(words or "realised missing ratio")
    if words or not nominal:
        return
    look: Any = {"textcoords": "offset points", "xytext": (0, 7), "ha": "center"}
    for at, height, level in zip(x, points["return"], points.level, strict=True):
        if level:
            axis.annotate(f"{level:g}", (at, height), fontsize=7.5, color="#666666", **look)


def episode_summary(episodes: pd.DataFrame) -> pd.DataFrame:
    """Sum up the table of recipes/evaluate.py, one row an episode, for :func:`robustness`.

    The mean return and its 95 % bootstrap interval are over runs where there are several, else over
    the episodes of the one. Runs that share method, task and training seed are distinguished by
    their names.
    """
    # The noise of the condition stands in its name.
    episodes = episodes.drop(columns="noise_sigma", errors="ignore")
    episodes = episodes.rename(columns={"env": "task", "trained_noise_sigma": "noise_sigma"})
    agent = ["task", "method", "trained_on", "noise_sigma"]
    twins = episodes.groupby([*agent, "training_seed"]).run.transform("nunique") > 1
    twins = twins.groupby([episodes[name] for name in agent]).transform("any")
    episodes = episodes.assign(settings=episodes.run.where(twins, ""))
    out = []
    for key, rows in episodes.groupby([*GROUP, "point", "mode"], sort=False):
        runs = rows.groupby("run")["return"].mean()
        values = (runs if len(runs) > 1 else rows["return"]).to_numpy(float)
        missing = np.average(rows.missing_ratio, weights=rows.length)
        out.append([*key, values.mean(), *interval(values, statistic=np.mean), missing])
    columns = [*GROUP, "point", "mode", "return", "low", "high", "missing_ratio"]
    return pd.DataFrame(out, columns=columns)


def draw_evaluation(episodes: pd.DataFrame) -> dict[str, Figure]:
    """Draw the table of recipes/evaluate.py: by task a figure, a row of panels a kind of action."""
    drawn = {
        str(task): robustness(rows, rows="mode", columns="kind")
        for task, rows in episode_summary(episodes).groupby("task")
    }
    return {task: figure for task, figure in drawn.items() if figure is not None}


def _labels(table: pd.DataFrame) -> pd.Series:
    """Return labels that distinguish the groups of a table, their task left out."""
    varying = [name for name in GROUP[2:] if table.groupby("task")[name].nunique().gt(1).any()]
    parts = table[["method", *varying]].map(lambda v: v if isinstance(v, str) else f"sigma {v:g}")
    return parts.agg(lambda row: ", ".join(part for part in row if part), axis=1)


def _band(
    axis: Any, x: Any, y: Any, low: Any, high: Any, colour: str, label: Any, style: str = "-"
) -> None:
    axis.plot(x, y, style, color=colour, lw=1.8, ms=4, label=str(label))
    axis.fill_between(x, low, high, color=colour, alpha=0.15, lw=0)


def _finish(figure: Figure, axes: Any, label: str) -> None:
    for axis in axes[:, 0]:
        axis.set_ylabel(label)
    legend_below(figure, 6 if axes.shape[1] > 1 else 3)
