"""Studies with an axis beside task, method and seed, such as the learning rate."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from assembly.report_evaluations import Row
from assembly.run_folder import CELL_FILE

# Axes that a report knows by themselves: a mean is taken over seeds, within a task and a method.
_USUAL = ("task", "method", "seed")
_NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def further_choices(folder: Path) -> dict[str, str]:
    """Return which choices a cell of a study takes on axes beside task, method and seed.

    Args:
        folder: a run folder whose cell.json, where it has one, can be read.

    Returns:
        Choices by axis, such as ``{"rate": "lr1e-3"}``; none for a run that is no cell.
    """
    path = folder / CELL_FILE
    if not path.is_file():
        return {}
    choices: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))["choices"]
    return {str(axis): str(name) for axis, name in choices.items() if axis not in _USUAL}


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
