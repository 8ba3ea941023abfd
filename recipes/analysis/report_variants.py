"""Studies with an axis beside task, method and seed, such as the learning rate."""

from __future__ import annotations

import re
from collections.abc import Sequence

from analysis.report_evaluations import Row

_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def variant_order(variant: str) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Return what variants are sorted by: words, then the numbers in them by their size.

    Args:
        variant: such as ``lr2.5e-4``, which comes before ``lr1e-3``.

    Returns:
        A key for ``sorted``.
    """
    numbers = tuple(float(number) for number in _NUMBER.findall(variant))
    return tuple(_NUMBER.split(variant)), numbers


def mark_best(cells: Sequence[Row]) -> list[bool]:
    """Return which cells of a line hold its highest value.

    Args:
        cells: rows with ``iqm``, and ``finished``: a run that is not over is not compared.

    Returns:
        One flag a cell. None is marked where fewer than two can be compared.
    """
    values = [cell["iqm"] for cell in cells if cell["finished"] and cell["iqm"] is not None]
    if len(values) < 2:
        return [False] * len(cells)
    return [bool(cell["finished"]) and cell["iqm"] == max(values) for cell in cells]


def variant_lines(groups: Sequence[Row]) -> dict[tuple[str, ...], dict[str, Row]]:
    """Lay means out as a table: a line for each task and method, a column for each variant.

    Args:
        groups: one row a mean, with ``task, method, trained_on, noise_sigma, variant``.

    Returns:
        Rows by variant, by task and method; also by what a line was trained on, where an axis does
        not decide that by itself.
    """
    short = {(row["task"], row["method"], row["variant"]) for row in groups}
    lines: dict[tuple[str, ...], dict[str, Row]] = {}
    for row in groups:
        key: tuple[str, ...] = (row["task"], row["method"])
        if len(short) < len(groups):
            key += (f"{row['trained_on']}, sigma {row['noise_sigma']:g}",)
        lines.setdefault(key, {})[row["variant"]] = row
    return lines
