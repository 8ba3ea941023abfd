"""Read a log of a robot: a table with a row a step, whose missing cells are NaN or empty."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from training.config import nearest, one_line
from training.errors import UserError

_READERS = {".csv": pd.read_csv, ".parquet": pd.read_parquet}


class Log(NamedTuple):
    """Episodes side by side, each from its first row; steps behind the end of one are resets.

    Shapes are ``(episodes, time[, obs or action])``; a missing reading is 0, and so is the action
    before the first step. ``names`` are those of the components of an observation.
    """

    observation: Tensor
    observed: Tensor
    previous_action: Tensor
    reset: Tensor
    names: list[str]
    episodes: list[str]


def read_log(
    path: str | None, observation: Sequence[str], action: Sequence[str], episode: str | None
) -> Log:
    """Read columns of a CSV, Parquet or NPZ file, see conf/fit.yaml.

    An action belongs to the row in which it was taken and leads to the next row. A log without
    actions has one that is always 0.
    """
    table = _read_table(path)
    there = f"there are {', '.join(map(str, table.columns))}"
    if episode is None:
        raise UserError(f"`episode` must name the column that tells episodes apart; {there}.")
    seen, moves = _columns(table, "observation", observation), _columns(table, "action", action)
    (column,) = _columns(table, "episode", [episode])
    if not seen:
        raise UserError(f"`observation` must name columns; {there}.")
    everything = [*seen, *moves, column]
    if twice := [name for name in dict.fromkeys(everything) if everything.count(name) > 1]:
        raise UserError(f"column `{twice[0]}` is named twice: as observation, action or episode.")
    values, actions = _numbers(table, seen), _numbers(table, moves)
    for name, readings in pd.DataFrame(values, columns=seen).items():
        if not readings.count():
            raise UserError(f"`observation`: column `{name}` has no reading at all; leave it out.")
        if readings.nunique() == 1:
            raise UserError(
                f"`observation`: column `{name}` is constant at {readings.max():g}: there is "
                "nothing to learn; leave it out."
            )
    if (empty := table[column].isna()).any():
        raise UserError(f"`episode`: column `{column}` is empty in row {empty.argmax() + 1}.")
    groups = list(table.groupby(column, sort=False).indices.items())
    longest = max(len(rows) for _, rows in groups)
    shape = len(groups), longest
    observations = np.full((*shape, len(seen)), np.nan)
    previous = np.zeros((*shape, max(1, len(moves))), np.float32)
    reset = np.ones(shape, bool)
    for i, (_, rows) in enumerate(groups):
        rows = np.sort(rows)
        observations[i, : len(rows)], reset[i, 1 : len(rows)] = values[rows], False
        if moves and (gaps := np.isnan(actions[rows[:-1]]).any(1)).any():
            raise UserError(
                f"`action`: a cell is empty in row {rows[gaps.argmax()] + 1}; only readings may "
                "be missing."
            )
        previous[i, 1 : len(rows), : len(moves)] = actions[rows[:-1]]
    observed = ~np.isnan(observations)
    return Log(
        torch.from_numpy(np.where(observed, observations, 0.0)),
        torch.from_numpy(observed),
        torch.from_numpy(previous),
        torch.from_numpy(reset),
        seen,
        [str(name) for name, _ in groups],
    )


def _read_table(path: str | None) -> pd.DataFrame:
    """Read a file as a table."""
    if path is None or not Path(path).is_file():
        raise UserError(f"`data` must be a file with a row a step, there is no {path}.")
    suffix = Path(path).suffix.lower()
    if suffix not in (*_READERS, ".npz"):
        raise UserError(f"`data` must be .csv, .parquet or .npz, got {path}.")
    try:
        if suffix != ".npz":
            return _READERS[suffix](path)
        flat: dict[str, Any] = {}
        with np.load(path, allow_pickle=False) as arrays:
            for name, array in arrays.items():
                parts = enumerate(array.T) if array.ndim == 2 else ()
                flat |= {f"{name}[{i}]": part for i, part in parts} or {name: array}
        return pd.DataFrame(flat)
    except ImportError as error:
        raise UserError("`data`: Parquet needs pyarrow: pip install pyarrow.") from error
    except Exception as error:  # whatever a parser raises
        raise UserError(f"`data`: {path} can't be read as a table: {one_line(error)}") from error


def _columns(table: pd.DataFrame, key: str, names: Sequence[str]) -> list[str]:
    """Return the columns that names stand for."""
    there, found = [str(name) for name in table.columns], []
    for name in map(str, names):
        parts = [column for column in there if column.startswith(f"{name}[")]
        if name not in there and not parts:
            raise UserError(f"`{key}`: there is no column `{name}`: {nearest(name, there)}")
        found += [name] if name in there else parts
    return found


def _numbers(table: pd.DataFrame, names: Sequence[str]) -> np.ndarray:
    """Return columns as float64, NaN where a cell is empty."""
    out = np.zeros((len(table), len(names)))
    for i, name in enumerate(names):
        cells = table[name]
        numbers = pd.to_numeric(cells, errors="coerce").to_numpy(float, na_value=np.nan)
        wrong = np.isinf(numbers) | (np.isnan(numbers) & cells.notna().to_numpy())
        if wrong.any():
            row = int(wrong.argmax())
            raise UserError(
                f"column `{name}` holds {cells.iloc[row]!r} in row {row + 1}, which is no finite "
                "number; leave missing cells empty."
            )
        out[:, i] = numbers
    return out
