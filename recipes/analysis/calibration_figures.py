"""Figures of a diagnosis, drawn from its tables; None where there is nothing to draw."""

from collections.abc import Callable, Sequence
from typing import Any

import matplotlib as mpl
import matplotlib.ticker
import pandas as pd
from matplotlib.figure import Figure
from rendering.style import STYLE, colours, legend_below, panel_grid

_PANEL = (4.4, 3.0)  # inches
_FEWEST = 30  # entries of a class that is drawn
# Column of calibration.csv, what it is of a right belief, axis, scale.
_STATISTICS: tuple[tuple[str, float | None, str, str], ...] = (
    ("nis_per_dof", 1.0, "NIS / entries", "log"),
    ("coverage_95", 0.95, "share inside 95 % intervals", "linear"),
    ("crps", None, "CRPS, normalised units", "log"),
)
_ESTIMATES = {"filtered": ("o-", 2.0), "predicted": ("s--", 1.6), "last value": (":", 1.1)}

# Draw the rows of one kind of belief into the panel of a column: axis, rows, label, colour, column.
_Draw = Callable[[Any, pd.DataFrame, str, str, int], None]


def precision_figure(table: pd.DataFrame) -> Figure | None:
    """Draw precision.csv: the error of every estimate over the steps since last seen."""
    rows = table[(table["steps_since_seen"] != "all") & (table["count"] >= _FEWEST)]

    def draw(axis: Any, own: pd.DataFrame, label: str, colour: str, _: int) -> None:
        for estimate, (style, width) in _ESTIMATES.items():
            points = own[own["estimate"] == estimate]
            name = f"{label}: {estimate}"
            _curve(axis, table, points, "rmse", style, lw=width, color=colour, label=name)
        axis.set_yscale("log")

    return _by_task(rows, table, draw, "steps since last seen", "RMSE, normalised units")


def outage_figure(table: pd.DataFrame) -> Figure | None:
    """Draw calibration.csv: forecasts of what arrives, by the steps since it was last seen."""
    wanted = (table["held_against"] == "reading") & (table["steps_since_seen"] != "all")
    rows = table[wanted & (table["count"] >= _FEWEST)]
    cells = [[own] * len(_STATISTICS) for _, own in rows.groupby(["task", "point"], sort=False)]

    def draw(axis: Any, own: pd.DataFrame, label: str, colour: str, column: int) -> None:
        name, right, text, scale = _STATISTICS[column]
        _curve(axis, table, own, name, "o-", lw=2.0, color=colour, label=label)
        axis.set(yscale=scale, ylabel=text)
        if right is not None:
            axis.axhline(right, color="#444444", lw=0.8)

    return _figure(cells, table, draw, "steps since last seen, when it arrives", 0.8)


def reliability_figure(table: pd.DataFrame) -> Figure | None:
    """Draw reliability.csv: how often values lay under their quantiles."""
    arrived = (table["held_against"] == "reading") & (table["entries"] == "arrived")
    missing = (table["held_against"] == "truth") & (table["entries"] == "missing")
    missing &= (table["sensor_noise"] == "out") | (table["estimate"] == "predicted")
    quantiles = [name for name in table if name.startswith("under_")]
    levels = [float(name.removeprefix("under_")) / 100 for name in quantiles]

    def draw(axis: Any, own: pd.DataFrame, label: str, colour: str, _: int) -> None:
        for target, style, text in (("reading", "-", "what arrives"),
                                    ("truth", "--", "what is missing")):  # fmt: skip
            # Of what is missing a belief knows most after the observation: "filtered" goes first.
            chosen = own[own["held_against"] == target].sort_values("estimate")
            for _, row in chosen.head(1).iterrows():
                name = f"{label}: {text}, {row['estimate']}"
                axis.plot(levels, row[quantiles], style, color=colour, lw=1.8, label=name)
        axis.plot([0, 1], [0, 1], color="#444444", lw=0.8)
        axis.set(xlim=(0, 1), ylim=(0, 1))

    return _by_task(table[arrived | missing], table, draw, "quantile", "share of values under it")


def _by_task(
    rows: pd.DataFrame, table: pd.DataFrame, draw: _Draw, across: str, up: str
) -> Figure | None:
    """Draw a column a task and a row a point."""
    tasks, points = rows["task"].unique(), rows["point"].unique()
    cells = [
        [rows[(rows["task"] == task) & (rows["point"] == point)] for task in tasks]
        for point in points
    ]
    figure = _figure(cells, table, draw, across, 1.0)
    for axis in figure.axes[:: len(tasks)] if figure else ():
        axis.set_ylabel(up)
    return figure


def _figure(
    cells: Sequence[Sequence[pd.DataFrame]],
    table: pd.DataFrame,
    draw: _Draw,
    across: str,
    height: float,
) -> Figure | None:
    """Draw a panel a cell, with a colour a kind of belief that is its own in every figure."""
    if not cells:
        return None
    kinds = _labels(table)
    colour = colours(kinds)
    with mpl.rc_context(STYLE):
        columns = len(cells[0])
        figure, axes = panel_grid(len(cells), columns, (_PANEL[0], height * _PANEL[1]))
        for line, drawn in zip(axes, cells, strict=True):
            for column, (axis, cell) in enumerate(zip(line, drawn, strict=True)):
                if cell.empty:
                    continue
                for label, own in cell.groupby(kinds[cell.index], sort=False):
                    pooled = own[own["runs"] == own["runs"].max()]
                    draw(axis, pooled, str(label), colour[label], column)
                if column == 0 or not drawn[0].equals(cell):
                    axis.set_title(_title(cell), fontsize=8.5, loc="left")
                if axis.get_yscale() == "log":
                    axis.yaxis.set_major_locator(mpl.ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
                    axis.yaxis.set_major_formatter("{x:g}")
                    axis.yaxis.set_minor_formatter(mpl.ticker.NullFormatter())
        for axis in axes[-1]:
            axis.set_xlabel(across)
        legend_below(figure, min(3, columns + 1), fontsize=8)
    return figure


def _labels(table: pd.DataFrame) -> pd.Series:
    """Name the kind of each row: its method, and what it was trained on where that differs."""
    label = table["method"].astype(str)
    for column, text in (("trained_on", "trained on {}"), ("noise_sigma", "sigma {:g}")):
        several = table.groupby("method")[column].transform("nunique") > 1
        label = label.where(~several, label + ", " + table[column].map(text.format))
    return label


def _title(cell: pd.DataFrame) -> str:
    kinds = cell.groupby(["method", "trained_on", "noise_sigma"])
    runs, share = int(kinds["runs"].max().sum()), 100 * kinds["missing_ratio"].mean().mean()
    task, point = cell.iloc[0][["task", "point"]]
    return f"{task}, {point}, {share:.0f} % missing, {runs} run{'s' if runs > 1 else ''}"


def _curve(
    axis: Any, table: pd.DataFrame, rows: pd.DataFrame, value: str, style: str, **look: Any
) -> None:
    """Draw numbers over the classes of steps since last seen, with their intervals."""
    classes = sorted(set(table["steps_since_seen"]) - {"all"}, key=_first_step)
    places = rows["steps_since_seen"].map(classes.index)
    # A line joins what follows in time; "never" stands by itself.
    never = rows["steps_since_seen"] == "never"
    marker, colour = style[0] if style[0] in "os" else ".", look["color"]
    if len(rows):
        axis.plot(places[~never], rows[value][~never], style, ms=4, **look)
        axis.plot(places[never], rows[value][never], marker, color=colour, ms=4)
        ends = rows[f"{value}_low"].astype(float), rows[f"{value}_high"].astype(float)
        axis.vlines(places, *ends, color=colour, lw=0.8, alpha=0.7)
    axis.set_xticks(range(len(classes)), classes, rotation=40, fontsize=8)
    axis.set_xlim(-0.5, len(classes) - 0.5)


def _first_step(name: str) -> float:
    """Return where a class of steps since last seen begins; "never" is after all others."""
    return float("inf") if name == "never" else int(name.rstrip("+").split("-")[0])
