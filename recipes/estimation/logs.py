"""Read a log of a robot: a table with a row a step, whose missing cells are NaN or empty."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
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
    if not moves:
        actions = np.zeros((len(table), 1))
    names, readings, previous = [], [], []
    for name, rows in table.groupby(column, sort=False).indices.items():
        rows = np.sort(rows)
        before = actions[rows[:-1]]
        if (gaps := np.isnan(before).any(1)).any():
            raise UserError(
                f"`action`: a cell is empty in row {rows[gaps.argmax()] + 1}; only readings may "
                "be missing."
            )
        names.append(str(name))
        readings.append(torch.from_numpy(values[rows]))
        previous.append(torch.from_numpy(np.pad(before, ((1, 0), (0, 0)))).float())
    padded = pad_sequence(readings, batch_first=True, padding_value=torch.nan)
    observed, step = ~padded.isnan(), torch.arange(padded.shape[1])
    reset = (step == 0) | (step >= torch.tensor([[len(rows)] for rows in readings]))
    actions_before = pad_sequence(previous, batch_first=True)
    return Log(padded.where(observed, 0.0), observed, actions_before, reset, seen, names)


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
