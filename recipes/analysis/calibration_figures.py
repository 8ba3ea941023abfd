"""Figures of a diagnosis: precision and honesty over outages, and a reliability plot."""

from __future__ import annotations

import csv
import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.ticker
from matplotlib.figure import Figure
from rendering.belief_figure import STYLE

from analysis.calibration import (
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
from analysis.calibration_tables import ALL, calibration_rows, precision_rows

_COLOURS = ("#1f6fb4", "#d1622b", "#3a923a", "#8d5aa8", "#7f6a4f", "#c44e7f", "#5f6b73")
_PANEL = (4.4, 3.0)  # inches
_FEWEST = 30  # entries of a class that is drawn
# Column of calibration.csv, what it is of a right belief, axis, scale.
_STATISTICS: tuple[tuple[str, float | None, str, str], ...] = (
    ("nis_per_dof", 1.0, "NIS / entries", "log"),
    ("coverage_95", 0.95, "share inside 95 % intervals", "linear"),
    ("crps", None, "CRPS, normalised units", "log"),
)
_OF_READINGS = Forecast(PREDICTED, True, READING, ARRIVED)
# What a belief says of the missing sensors, the first that it has.
_OF_MISSING = (Forecast(FILTERED, False, TRUTH, MISSING), Forecast(PREDICTED, True, TRUTH, MISSING))


@dataclass(frozen=True)
class Runs:
    """The runs of one kind at one point.

    Attributes:
        task: Gymnasium id.
        point: what did not arrive.
        method: which kind.
        trained_on: what did not arrive in training.
        runs: how many.
    """

    task: str
    point: str
    method: str
    trained_on: str
    runs: int


@dataclass(frozen=True)
class Series(Runs):
    """Their episodes.

    Attributes:
        tally: of all of them.
    """

    tally: Tally


@dataclass(frozen=True)
class Outages(Runs):
    """Their forecasts of what arrived.

    Attributes:
        missing_ratio: share of the entries that did not arrive.
        classes: of steps since last seen, the last is ``never``.
        rows: of calibration.csv, one a class that has entries enough.
    """

    missing_ratio: float
    classes: tuple[str, ...]
    rows: Sequence[Mapping[str, Any]]


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
                label = f"{one.method}: {estimate}"
                _curve(axis, ["0", *one.tally.classes], points, style, width, colour, label)
        axis.set_yscale("log")

    return _grid(series, draw, across="steps since last seen", up="RMSE, normalised units")


def outage_figure(series: Sequence[Series], *, resamples: int, seed: int) -> Figure | None:
    """Draw how honest forecasts of what arrives are, over the steps since it was last seen.

    Args:
        series: one a kind of belief, task and point.
        resamples: for the intervals.
        seed: of them.

    Returns:
        See `draw_outages`.
    """
    return draw_outages(
        [
            Outages(
                one.task,
                one.point,
                one.method,
                one.trained_on,
                one.runs,
                one.tally.missing_ratio,
                tuple(one.tally.classes),
                _of_readings(calibration_rows(one.tally, resamples=resamples, seed=seed)),
            )
            for one in series
        ]
    )


def read_outages(path: Path) -> list[Outages]:
    """Read what `draw_outages` draws from a calibration.csv, without its runs.

    Args:
        path: the table.

    Returns:
        One a task, point, belief and training. Several runs are weighed by their entries, which
        gives the number of all of them; an interval there is only of one.
    """
    with path.open(newline="") as file:
        table = list(csv.DictReader(file))
    classes = sorted({row["steps_since_seen"] for row in table} - {ALL}, key=_first_step)
    kinds: dict[tuple[str, str, str, str], list[dict[str, str]]] = {}
    for row in table:
        # Tables of the first studies name the belief alone.
        method = row.get("method", row["belief"])
        kind = (row["task"], row["point"], method, row["trained_on"])
        kinds.setdefault(kind, []).append(row)
    out = []
    for kind, rows in kinds.items():
        runs = {row["run"]: float(row["missing_ratio"]) for row in rows}
        own: dict[str, list[dict[str, Any]]] = {}
        for row in _of_readings(rows):
            own.setdefault(row["steps_since_seen"], []).append(row)
        pooled = [_pooled(own[name]) for name in classes if name in own]
        missing = sum(runs.values()) / len(runs)
        out.append(Outages(*kind, len(runs), missing, tuple(classes), pooled))
    return out


def draw_outages(outages: Sequence[Outages]) -> Figure | None:
    """Draw NIS over entries, coverage and CRPS over the steps since a sensor was last seen.

    Args:
        outages: one a kind of belief, task and point.

    Returns:
        The figure, a row a task and point, a column a statistic; None where no belief forecasts
        what arrives.
    """
    kinds = list(dict.fromkeys((one.method, one.trained_on) for one in outages))
    colours = {kind: _COLOURS[i % len(_COLOURS)] for i, kind in enumerate(kinds)}
    shown = [one for one in outages if one.rows]
    if not shown:
        return None
    tasks = dict.fromkeys(one.task for one in shown)
    points = dict.fromkeys(one.point for one in shown)
    places = [(task, point) for task in tasks for point in points]
    rows = {place: [o for o in shown if (o.task, o.point) == place] for place in places}
    rows = {place: own for place, own in rows.items() if own}
    handles: dict[str, Any] = {}
    with mpl.rc_context(STYLE):
        size = (_PANEL[0] * len(_STATISTICS), 0.8 * _PANEL[1] * len(rows) + 0.4)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(len(rows), len(_STATISTICS), squeeze=False)
        for line, own in zip(axes, rows.values(), strict=True):
            line[0].set_title(
                _title(own[0].task, own[0].point, [o.missing_ratio for o in own], own),
                fontsize=8.5,
                loc="left",
            )
            for axis, (name, right, text, scale) in zip(line, _STATISTICS, strict=True):
                for one in own:
                    kind = (one.method, one.trained_on)
                    ends = (f"{name}_low", f"{name}_high")
                    points_of_one = [
                        (row["steps_since_seen"], row[name], row[ends[0]], row[ends[1]])
                        for row in one.rows
                    ]
                    label = _label(kind, kinds)
                    _curve(axis, one.classes, points_of_one, "o-", 2.0, colours[kind], label)
                axis.set_yscale(scale)
                if right is not None:
                    axis.axhline(right, color="#444444", lw=0.8)
                _round_ticks(axis)
                axis.set_ylabel(text)
                handles |= dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
        for axis in axes[-1]:
            axis.set_xlabel("steps since last seen, when it arrives")
        _legend(figure, handles, len(_STATISTICS))
    return figure


def _of_readings(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the classes of forecasts of what arrived that have entries enough to be drawn."""
    wanted = (
        _OF_READINGS.estimate,
        "in" if _OF_READINGS.noise else "out",
        _OF_READINGS.target,
        _OF_READINGS.entries,
    )
    names = ("estimate", "sensor_noise", "held_against", "entries")
    return [
        dict(row)
        for row in rows
        if tuple(row[name] for name in names) == wanted
        and row["steps_since_seen"] != ALL
        and int(row["count"]) >= _FEWEST
    ]


def _pooled(rows: Sequence[Mapping[str, str]]) -> dict[str, Any]:
    """Return a class of several runs as one row of numbers."""
    counts = [int(row["count"]) for row in rows]
    out: dict[str, Any] = {"steps_since_seen": rows[0]["steps_since_seen"], "count": sum(counts)}
    for name, *_ in _STATISTICS:
        weighed = (float(row[name]) * n for row, n in zip(rows, counts, strict=True))
        out[name] = sum(weighed) / sum(counts)
        for end in (f"{name}_low", f"{name}_high"):
            alone = rows[0][end] if len(rows) == 1 else ""
            out[end] = float(alone) if alone else None
    return out


def _first_step(name: str) -> float:
    """Return where a class of steps since last seen begins; "never" is after all others."""
    return math.inf if name == "never" else int(name.rstrip("+").split("-")[0])


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
                label = f"{one.method}: {text}, {forecast.estimate}"
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
    kinds = list(dict.fromkeys((s.method, s.trained_on) for s in series))
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
                    kind = (one.method, one.trained_on)
                    named = dataclasses.replace(one, method=_label(kind, kinds))
                    draw(axis, named, colours[kind])
                missing = [s.tally.missing_ratio for s in own]
                axis.set_title(_title(task, point, missing, own), fontsize=8.5)
                _round_ticks(axis)
                handles |= dict(zip(*reversed(axis.get_legend_handles_labels()), strict=True))
                if row == len(points) - 1:
                    axis.set_xlabel(across)
                if column == 0:
                    axis.set_ylabel(up)
        _legend(figure, handles, min(3, len(tasks) + 1))
    return figure


def _label(kind: tuple[str, str], kinds: Sequence[tuple[str, str]]) -> str:
    """Name a belief, and what it was trained on where it was trained on several things."""
    belief, trained_on = kind
    several = len({trained for other, trained in kinds if other == belief}) > 1
    return f"{belief}, trained on {trained_on}" if several else belief


def _title(
    task: str, point: str, missing: Sequence[float], own: Sequence[Series] | Sequence[Outages]
) -> str:
    runs = sum(one.runs for one in own)
    share = 100 * sum(missing) / len(missing)
    return f"{task}, {point}, {share:.0f} % missing, {runs} run{'s' if runs > 1 else ''}"


def _round_ticks(axis: Any) -> None:
    """Mark 1, 2, 5 and their tenfolds on a logarithmic axis."""
    if axis.get_yscale() == "log":
        axis.yaxis.set_major_locator(mpl.ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter(mpl.ticker.NullFormatter())


def _legend(figure: Figure, handles: Mapping[str, Any], columns: int) -> None:
    figure.legend(
        handles.values(),
        handles.keys(),
        loc="outside lower center",
        ncols=columns,
        frameon=False,
        fontsize=8,
    )


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
