"""Figures of a diagnosis: precision and honesty over outages, and a reliability plot."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import matplotlib.ticker
from matplotlib.figure import Figure

from assembly.belief_figure import STYLE
from assembly.diagnosis import (
    ARRIVED,
    FILTERED,
    LAST_VALUE,
    LEVELS,
    MISSING,
    PREDICTED,
    READING,
    TRUTH,
    Forecast,
    Tally,
)
from assembly.diagnosis_tables import nis_curve, precision_rows

_COLOURS = ("#1f6fb4", "#d1622b", "#3a923a", "#8d5aa8", "#7f6a4f", "#c44e7f", "#5f6b73")
_PANEL = (4.4, 3.0)  # inches
_FEWEST = 30  # entries of a class that is drawn
_OF_READINGS = Forecast(PREDICTED, True, READING, ARRIVED)
# What a belief says of the missing sensors, the first that it has.
_OF_MISSING = (Forecast(FILTERED, False, TRUTH, MISSING), Forecast(PREDICTED, True, TRUTH, MISSING))


@dataclass(frozen=True)
class Series:
    """Episodes of the runs of one kind at one point.

    Attributes:
        task: Gymnasium id.
        point: what did not arrive.
        belief: which kind.
        trained_on: what did not arrive in training.
        runs: how many.
        tally: of all their episodes.
    """

    task: str
    point: str
    belief: str
    trained_on: str
    runs: int
    tally: Tally


_Draw = Callable[[Any, Series, str], None]


def precision_figure(series: Sequence[Series], *, resamples: int, seed: int) -> Figure | None:
    """Draw the error of every estimate over the steps since a sensor was last seen.

    Args:
        series: one a kind of belief, task and point.
        resamples: for the intervals.
        seed: of them.

    Returns:
        The figure, one column a task and one row a point; None without series.
    """

    def draw(axis: Any, one: Series, colour: str) -> None:
        rows = list(precision_rows(one.tally, resamples=resamples, seed=seed))
        styles = {FILTERED: ("o-", 2.0), PREDICTED: ("s--", 1.6), LAST_VALUE: (":", 1.1)}
        for estimate, (style, width) in styles.items():
            own = [r for r in rows if r["estimate"] == estimate and r["steps_since_seen"] != "all"]
            points = [
                (r["steps_since_seen"], r["rmse"], r["rmse_low"], r["rmse_high"])
                for r in own
                if r["count"] >= _FEWEST
            ]
            if points:
                label = f"{one.belief}: {estimate}"
                _curve(axis, ["0", *one.tally.classes], points, style, width, colour, label)
        axis.set_yscale("log")

    return _grid(series, draw, across="steps since last seen", up="RMSE, normalised units")


def outage_figure(series: Sequence[Series], *, resamples: int, seed: int) -> Figure | None:
    """Draw NIS over degrees of freedom over the steps since a sensor was last seen.

    Args:
        series: one a kind of belief, task and point.
        resamples: for the intervals.
        seed: of them.

    Returns:
        The figure; None where no belief forecasts what arrives.
    """

    def draw(axis: Any, one: Series, colour: str) -> None:
        points = nis_curve(one.tally, _OF_READINGS, fewest=_FEWEST, resamples=resamples, seed=seed)
        _curve(axis, one.tally.classes, points, "o-", 2.0, colour, one.belief)
        axis.axhline(1.0, color="#444444", lw=0.8)
        axis.set_yscale("log")

    return _grid(
        series,
        draw,
        lambda one: _OF_READINGS in one.tally.honesty,
        across="steps since last seen, when it arrives",
        up="NIS / entries",
    )


def reliability_figure(series: Sequence[Series]) -> Figure | None:
    """Draw how often values came under their quantiles.

    Args:
        series: one a kind of belief, task and point.

    Returns:
        The figure; None where no belief has a spread.
    """

    def draw(axis: Any, one: Series, colour: str) -> None:
        of_missing = next((f for f in _OF_MISSING if f in one.tally.reliability), None)
        kinds = {_OF_READINGS: ("-", "what arrives"), of_missing: ("--", "what is missing")}
        for forecast, (style, text) in kinds.items():
            if forecast is None or forecast not in one.tally.reliability:
                continue
            total = one.tally.honesty[forecast]["count"].sum()
            if total > 0:
                shares = one.tally.reliability[forecast].sum(0) / total
                label = f"{one.belief}: {text}, {forecast.estimate}"
                axis.plot(LEVELS, shares, style, color=colour, lw=1.8, label=label)
        axis.plot([0, 1], [0, 1], color="#444444", lw=0.8)
        axis.set_xlim(0, 1)
        axis.set_ylim(0, 1)

    return _grid(
        series,
        draw,
        lambda one: bool(one.tally.reliability),
        across="quantile",
        up="share of values under it",
    )


def _grid(
    series: Sequence[Series],
    draw: _Draw,
    has: Callable[[Series], bool] = lambda _: True,
    *,
    across: str,
    up: str,
) -> Figure | None:
    """Draw a panel for each task and point with series that have something to draw."""
    # A belief has one colour in every figure of a diagnosis.
    kinds = list(dict.fromkeys((s.belief, s.trained_on) for s in series))
    colours = {kind: _COLOURS[i % len(_COLOURS)] for i, kind in enumerate(kinds)}
    shown = [s for s in series if has(s)]
    if not shown:
        return None
    tasks = list(dict.fromkeys(s.task for s in shown))
    points = list(dict.fromkeys(s.point for s in shown))
    handles: dict[str, Any] = {}
    with mpl.rc_context(STYLE):
        size = (_PANEL[0] * len(tasks), _PANEL[1] * len(points))
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(len(points), len(tasks), squeeze=False)
        for row, point in enumerate(points):
            for column, task in enumerate(tasks):
                axis = axes[row][column]
                own = [s for s in shown if (s.task, s.point) == (task, point)]
                if not own:
                    axis.axis("off")
                    continue
                for one in own:
                    draw(axis, _named(one, kinds), colours[one.belief, one.trained_on])
                missing = sum(s.tally.missing_ratio for s in own) / len(own)
                runs = sum(s.runs for s in own)
                axis.set_title(
                    f"{task}, {point}, {100 * missing:.0f} % missing, "
                    f"{runs} run{'s' if runs > 1 else ''}",
                    fontsize=8.5,
                )
                if axis.get_yscale() == "log":
                    axis.yaxis.set_major_locator(mpl.ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
                    axis.yaxis.set_major_formatter("{x:g}")
                    axis.yaxis.set_minor_formatter(mpl.ticker.NullFormatter())
                handles |= dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
                if row == len(points) - 1:
                    axis.set_xlabel(across)
                if column == 0:
                    axis.set_ylabel(up)
        figure.legend(
            handles.values(),
            handles.keys(),
            loc="outside lower center",
            ncols=min(3, len(tasks) + 1),
            frameon=False,
            fontsize=8,
        )
    return figure


def _named(one: Series, kinds: Sequence[tuple[str, str]]) -> Series:
    """Tell what was trained on where the same belief was trained on several things."""
    if len({trained for belief, trained in kinds if belief == one.belief}) < 2:
        return one
    return dataclasses.replace(one, belief=f"{one.belief}, trained on {one.trained_on}")


def _curve(
    axis: Any,
    classes: Sequence[str],
    points: Sequence[tuple[str, float, float | None, float | None]],
    style: str,
    width: float,
    colour: str,
    label: str,
) -> None:
    """Draw numbers over classes, with their intervals where there are any."""
    places = [classes.index(name) for name, *_ in points]
    values = [value for _, value, _, _ in points]
    # A line joins what follows in time; "never" stands by itself.
    ordered = [i for i, place in enumerate(places) if place < len(classes) - 1]
    alone = [i for i in range(len(places)) if i not in ordered]
    marker = style[0] if style[0] in "os" else "."
    axis.plot(
        [places[i] for i in ordered],
        [values[i] for i in ordered],
        style,
        color=colour,
        lw=width,
        ms=4,
        label=label,
    )
    axis.plot([places[i] for i in alone], [values[i] for i in alone], marker, color=colour, ms=4)
    for place, (_, _, low, high) in zip(places, points, strict=True):
        if low is not None and high is not None:
            axis.plot([place, place], [low, high], color=colour, lw=0.8, alpha=0.7)
    axis.set_xticks(range(len(classes)), classes, rotation=40, fontsize=8)
