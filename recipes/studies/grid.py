"""The cells of a study: every combination of its axes, with the overrides of each."""

from __future__ import annotations

import fnmatch
import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException
from training.composition import composed_config
from training.config import Settings, read_settings
from training.errors import UserError

OWN_NAMES = ("logs", "locks", "failed.json")  # in the folder of a study, beside the cells
_KEYS = ("name", "overrides", "axes", "cells", "skip")
# Names become parts of folder names, and those stand unquoted on Hydra's command line.
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_FRAMES = "total_frames"
# The job decides where a cell lies and whether it is resumed.
_OF_THE_JOB = ("resume", "hydra")


@dataclass(frozen=True)
class Cell:
    """One run of a study.

    Attributes:
        name: of its folder.
        choices: which choice of each axis.
        overrides: of ``recipes/ppo_drbpn.py``, each setting once.
    """

    name: str
    choices: Mapping[str, str]
    overrides: tuple[str, ...]

    def settings(self) -> Settings:
        """Return the checked settings that conf/ and the overrides give.

        Raises:
            UserError: if conf/ has no such group or key, or a value makes no sense.
        """
        try:
            return read_settings(composed_config(self.overrides))
        except (HydraException, OmegaConfBaseException, UserError) as error:
            reason = " ".join(str(error).split())[:300]
            raise UserError(f"`{self.name}` has overrides that can't be used: {reason}") from error


@dataclass(frozen=True)
class Grid:
    """A study.

    Attributes:
        name: of its folder.
        cells: in the order in which they are run.
    """

    name: str
    cells: tuple[Cell, ...]

    def chosen(self, only: str | Sequence[str] | None) -> tuple[Cell, ...]:
        """Return some of the cells.

        Args:
            only: names or patterns; None: all.

        Raises:
            UserError: if one of them matches no cell.
        """
        if only is None:
            return self.cells
        patterns = [only] if isinstance(only, str) else [str(pattern) for pattern in only]
        _check_patterns("only", patterns, [cell.name for cell in self.cells])
        return tuple(cell for cell in self.cells if _matches(cell.name, patterns))


def read_grid(config: Mapping[str, Any]) -> Grid:
    """Lay out the cells of a study.

    Overrides of a cell are those of the study, then those of its choices in the order of the axes,
    then those of ``cells``; a later one takes the place of an earlier one of the same setting. The
    last axis turns slowest.

    Args:
        config: a file of conf/study as plain containers.

    Returns:
        The study.

    Raises:
        UserError: if it has other keys, an empty axis, a name that can't be part of a folder's, an
            override that is none, or two cells of one name.
    """
    if not isinstance(config, Mapping) or set(config) != set(_KEYS):
        given = sorted(config) if isinstance(config, Mapping) else config
        raise UserError(f"`study` must have the keys {', '.join(_KEYS)}, got {given}.")
    name = _checked_name("study.name", config["name"])
    axes = {str(axis): _axis(str(axis), choices) for axis, choices in _items("axes", config)}
    if not axes:
        raise UserError("`study.axes` must hold at least one axis, got none.")
    common = _words("study.overrides", config["overrides"])
    further = {
        pattern: _words(f"study.cells.{pattern}", words)
        for pattern, words in _items("cells", config)
    }
    skipped = config["skip"]
    if not isinstance(skipped, list):
        raise UserError(f"`study.skip` must be a list of names or patterns, got {skipped!r}.")
    cells: dict[str, Cell] = {}
    names = list(axes)
    for slowest, *others in itertools.product(axes[names[-1]], *(axes[n] for n in names[:-1])):
        choices = dict(zip(names, [*others, slowest], strict=True))
        cell_name = "-".join(choices.values())
        if cell_name in OWN_NAMES:
            raise UserError(
                f"`study.axes` can't name a cell {cell_name}: the study has one itself."
            )
        if cell_name in cells:
            raise UserError(f"`study.axes` give two cells the name {cell_name}: rename a choice.")
        words = [
            *common,
            *(word for axis, choice in choices.items() for word in axes[axis][choice]),
        ]
        words += [
            w for pattern in further if _matches(cell_name, [pattern]) for w in further[pattern]
        ]
        cells[cell_name] = Cell(cell_name, choices, _last_of_each(words))
    _check_patterns("study.cells", list(further), list(cells))
    _check_patterns("study.skip", [str(pattern) for pattern in skipped], list(cells))
    left = [cell for cell in cells.values() if not _matches(cell.name, map(str, skipped))]
    return Grid(name, tuple(left))


def differing(first: Sequence[str], second: Sequence[str]) -> list[str]:
    """Return the settings in which two lists of overrides differ, ``total_frames`` left out.

    Args:
        first: overrides.
        second: others.

    Returns:
        Names of settings.
    """
    one, other = ({setting(word): word for word in words} for words in (first, second))
    names = sorted((one.keys() | other.keys()) - {_FRAMES})
    return [name for name in names if one.get(name) != other.get(name)]


def setting(word: str) -> str:
    """Return the setting that an override names.

    Args:
        word: such as ``+belief.width=3``.

    Returns:
        Such as ``belief.width``.
    """
    return word.split("=", 1)[0].lstrip("+~")


def _items(key: str, config: Mapping[str, Any]) -> list[tuple[str, Any]]:
    if not isinstance(config[key], Mapping):
        raise UserError(f"`study.{key}` must be a mapping, got {config[key]!r}.")
    return [(str(name), value) for name, value in config[key].items()]


def _axis(axis: str, choices: Any) -> dict[str, list[str]]:
    where = f"study.axes.{axis}"
    if not isinstance(choices, Mapping) or not choices:
        raise UserError(
            f"`{where}` must give each choice its overrides, such as "
            f"{{hopper: [env=hopper]}}, got {choices!r}."
        )
    return {
        _checked_name(where, choice): _words(f"{where}.{choice}", words)
        for choice, words in choices.items()
    }


def _checked_name(where: str, name: Any) -> str:
    if not _NAME.fullmatch(str(name)):
        raise UserError(
            f"`{where}` must be a name of letters, digits, '_', '.' and '-', which becomes part of "
            f"a folder's; got {name!r}."
        )
    return str(name)


def _words(where: str, words: Any) -> list[str]:
    if not isinstance(words, list):
        raise UserError(f"`{where}` must be a list of overrides such as [seed=1], got {words!r}.")
    for word in words:
        if not isinstance(word, str) or "=" not in word or not setting(word):
            raise UserError(f"`{where}` must hold overrides such as seed=1, got {word!r}.")
        if setting(word).split(".")[0] in _OF_THE_JOB:
            raise UserError(f"`{where}` can't hold {word!r}: the study decides that itself.")
    return words


def _last_of_each(words: Sequence[str]) -> tuple[str, ...]:
    return tuple({setting(word): word for word in words}.values())


def _matches(name: str, patterns: Any) -> bool:
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)


def _check_patterns(where: str, patterns: Sequence[str], names: Sequence[str]) -> None:
    for pattern in patterns:
        if not any(_matches(name, [pattern]) for name in names):
            raise UserError(
                f"`{where}` must hold names or patterns of cells, {pattern!r} matches none of "
                f"{', '.join(names[:4])}{', ...' if len(names) > 4 else ''}."
            )
