"""The evaluations of a run: its own, and those of recipes/evaluate.py, one row a point."""

from __future__ import annotations

import csv
import math
import statistics
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from training.config import Settings, missingness_name
from training.errors import UserError
from training.run_folder import EVALUATION_COLUMNS

Row = dict[str, Any]

GRID_TABLE, POINTS_TABLE = "robustness.csv", "points.csv"  # of recipes/evaluate.py
_OWN_TABLE = "evaluation.csv"
_EVALUATED = tuple(name for name in EVALUATION_COLUMNS if name != "kind")


def evaluations(folder: Path, settings: Settings) -> list[Row]:
    """Return one row an evaluation: those of the run, then those of recipes/evaluate.py.

    Args:
        folder: of the run.
        settings: of the run.

    Returns:
        Rows ``source, point, table, episode_seed``, and what was measured. A point that stands in
        both tables of recipes/evaluate.py is taken from that of the grid: two protocols, each with
        episodes of its own, make no mean together.
    """
    own = folder / _OWN_TABLE
    needed = {"frames", "kind", "mode", "return_mean"}
    rows = [
        {"source": row["kind"], "point": missingness_name(settings.missingness)}
        | {"table": _OWN_TABLE, "episode_seed": None}
        | {key: row.get(key) for key in _EVALUATED}
        | {"diverged": None}
        for row in (read_csv(own, needed) if own.is_file() else [])
    ]
    found: dict[tuple[Any, ...], Row] = {}
    for name in (GRID_TABLE, POINTS_TABLE):
        path = folder / name
        if path.is_file():
            for row in _points(path):
                found.setdefault((row["frames"], row["point"], row["mode"]), row)
    return rows + list(found.values())


def _points(path: Path) -> list[Row]:
    """Sum up the episodes of a table of recipes/evaluate.py, one row a point and kind of action."""
    together: dict[tuple[Any, ...], dict[Any, Row]] = {}
    needed = {"frames", "mechanism", "eta", "mode", "return", "length"}
    for index, row in enumerate(read_csv(path, needed)):
        # Older tables have no name of the point, and no seed of its episodes.
        eta = 0.0 if row["mechanism"] == "none" else row["eta"]
        point = row.get("point") or f"{row['mechanism']}:{eta:g}"
        key = (row["frames"], point, row["mode"], row.get("seed"))
        # A point that was asked for under two names has the same episodes twice.
        together.setdefault(key, {})[row.get("episode", index)] = row
    return [_point(path, key, list(rows.values())) for key, rows in together.items()]


def _point(path: Path, key: tuple[Any, ...], found: Sequence[Row]) -> Row:
    frames, point, mode, seed = key
    returns = [row["return"] for row in found]
    steps = [row["length"] for row in found]
    arrived = [n * (1 - row["missing_ratio"]) for n, row in zip(steps, found, strict=True)]
    likelihoods = [row.get("log_likelihood") for row in found]
    return {
        "source": "points",
        "point": point,
        "table": path.name,
        "episode_seed": None if seed is None else int(seed),
        "frames": frames,
        "mode": mode,
        "episodes": len(found),
        "return_mean": mean_of_known(returns),
        "return_std": statistics.stdev(returns) if len(returns) > 1 else 0.0,
        "length_mean": mean_of_known(steps),
        # Over all steps and entries, as in evaluation.csv.
        "missing_ratio": 1 - sum(arrived) / sum(steps),
        "log_likelihood": (
            None
            if None in likelihoods
            else sum(v * w for v, w in zip(likelihoods, arrived, strict=True))
            / max(sum(arrived), 1e-12)
        ),
        # Episodes in which the belief diverged and the robot was stopped, as a share.
        "diverged": sum(row.get("diverged") or 0.0 for row in found) / len(found),
    }


def read_csv(path: Path, needed: set[str]) -> list[Row]:
    """Return the rows of a table: numbers where they are some, None for an empty cell.

    Args:
        path: CSV file, perhaps of a run under way: a last row without an end is left out.
        needed: columns that it must have.

    Returns:
        Rows by column.

    Raises:
        UserError: if it can't be read, or lacks one of the columns.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            absent = needed - set(reader.fieldnames or ())
            whole = [row for row in reader if None not in row.values()]
            rows = [{key: _number(cell) for key, cell in row.items()} for row in whole]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"`{path}` can't be read: is it in a run folder?") from error
    if absent:
        raise UserError(f"`{path}` lacks the columns {', '.join(sorted(absent))}: another table?")
    return rows


def _number(cell: Any) -> Any:
    if not cell:
        return None
    try:
        return float(cell)
    except (TypeError, ValueError):
        return cell


def mean_of_known(values: Iterable[Any]) -> Any:
    """Return the mean of the values that are not None; None where there is none.

    Args:
        values: numbers or None.

    Returns:
        The mean.
    """
    known = [value for value in values if value is not None]
    return math.fsum(known) / len(known) if known else None


def point_order(point: str) -> tuple[str, float]:
    """Return what points are sorted by: nothing missing first, then by kind and number.

    Args:
        point: as ``recipes/evaluate.py`` names it.

    Returns:
        A key for ``sorted``: the kind, and the number in which points of it differ: the nominal
        ratio, the mean length of outages, the size of noise, the probability of spikes.
    """
    kind, parts = point_kind(point), point.split(":")
    number = parts[2] if parts[0] == "outages" and len(parts) > 2 else parts[1]
    return "" if kind == "none" else kind, float(number)


def point_kind(point: str) -> str:
    """Return what points have in common that differ in one number.

    Args:
        point: such as ``mcar:0.5``, ``reduction:0.5:random`` or ``outages:0.5:20:sensor``.

    Returns:
        Such as ``mcar``, ``reduction random`` or ``outages 0.5 sensor``.
    """
    family, *rest = point.split(":")
    varied = 1 if family == "outages" and len(rest) > 1 else 0
    return " ".join([family, *(part for i, part in enumerate(rest) if i != varied)])
