"""How far a study is, and how long it will take."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from studies.grid import Cell

_RIDGE = (
    0.1  # on effects of log speed: what one cell shows about its choices is halved by .. seen once
)


def expected_speeds(cells: Sequence[Cell], measured: Mapping[str, float]) -> dict[str, float]:
    """Expect the speed of every cell from those that were measured.

    The logarithm of a speed is taken as the sum of one effect a choice, fitted by ridge
    regression: a slow method is slow on every task. A choice that was never measured has no effect.

    Args:
        cells: of the study.
        measured: environment steps a second by name of a cell.

    Returns:
        Steps a second by name; empty where nothing was measured.
    """
    if not measured:
        return {}
    columns: dict[tuple[str, str], int] = {}
    for cell in cells:
        for choice in cell.choices.items():
            columns.setdefault(choice, len(columns))

    def effects(cell: Cell) -> list[float]:
        row = [0.0] * len(columns)
        for choice in cell.choices.items():
            row[columns[choice]] = 1.0
        return row

    known = [cell for cell in cells if cell.name in measured]
    x = np.array([effects(cell) for cell in known])
    y = np.log([measured[cell.name] for cell in known])
    mean = y.mean()
    fitted = np.linalg.solve(x.T @ x + _RIDGE * np.eye(x.shape[1]), x.T @ (y - mean))
    expected = {cell.name: math.exp(mean + np.dot(effects(cell), fitted)) for cell in cells}
    return expected | dict(measured)


def seconds_left(running: Iterable[float], queued: Iterable[float], at_once: int) -> float:
    """Return how long runs take that are started in order, some at a time.

    Args:
        running: what is left of those that run, s.
        queued: of those that wait, in their order, s.
        at_once: how many run at a time.

    Returns:
        Until the last of them ends, s.
    """
    ends = sorted(running)
    ends += [0.0] * (at_once - len(ends))
    heapq.heapify(ends)
    for seconds in queued:
        # Takes the place of the one that ends first; an earlier study.py may have had more places.
        while len(ends) > at_once:
            heapq.heappop(ends)
        heapq.heapreplace(ends, ends[0] + seconds)
    return max(ends, default=0.0)


def duration(seconds: float) -> str:
    """Return a duration in words, rounded to what an estimate deserves.

    Args:
        seconds: of it.

    Returns:
        Such as ``5 h 10 min``.
    """
    minutes = round(seconds / 60)
    if minutes < 1:
        return f"{math.ceil(seconds)} s"
    hours, minutes = divmod(minutes, 60)
    if hours >= 48:
        return f"{hours / 24:.1f} days"
    return f"{hours} h {minutes} min" if hours else f"{minutes} min"
