"""What the method of a run is called, so that runs of different methods are never pooled.

A cell of a study is called what the study calls it. Any other run by its belief, and in parentheses
by what sets it apart from a plain run of that belief: ``none (acktr)``, ``drbpn (model_coeff 0)``.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from training.config import Settings
from training.errors import UserError
from training.run_folder import CELL_FILE

# What the name of a belief alone stands for; a belief without such a setting has nothing to tell.
_PLAIN: dict[str, Any] = {
    "belief.cell": "gru",
    "belief.with_action": False,
    "belief.with_mask": False,
    "belief.policy_input": "mean",
    "belief.transition.cov_network": False,
    "heads.critic_input": "features",
    "loss.model_coeff": 1.0,
    "loss.detach_belief": False,
}
# Beliefs whose name says that one of these is otherwise.
_NAMED: dict[str, dict[str, Any]] = {"gru_action": {"belief.with_action": True}}
# The axes that are no part of a method's name: a mean is taken over seeds, within a task.
_NO_METHOD = ("task", "method", "seed")


def read_cell(folder: Path) -> tuple[str | None, dict[str, str]]:
    """Return which cell of which study a run is.

    Args:
        folder: the run folder.

    Returns:
        The study and its choices by axis; None and nothing for a run by itself.

    Raises:
        UserError: if the file that says so can't be read.
    """
    path = folder / CELL_FILE
    if not path.is_file():
        return None, {}
    try:
        cell = json.loads(path.read_text(encoding="utf-8"))
        choices = {str(axis): str(name) for axis, name in cell["choices"].items()}
        return str(cell["study"]), choices
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(f"`{path}` can't be read: remove it, or run the cell again.") from error


def method_name(settings: Settings, choices: Mapping[str, str]) -> str:
    """Name the method of a run.

    Args:
        settings: of the run.
        choices: see :func:`read_cell`.

    Returns:
        What its study calls it, else its belief and what sets it apart.
    """
    if "method" in choices:
        return choices["method"]
    belief, algo = str(settings.belief.get("name", "")), str(settings.algo.get("name", ""))
    apart = [] if algo == "ppo" else [algo]
    for name, plain in (_PLAIN | _NAMED.get(belief, {})).items():
        value = _setting(settings, name)
        if value is not None and value != plain:
            apart.append(_told(name.rpartition(".")[2], value))
    return f"{belief} ({', '.join(apart)})" if apart else belief


def further_choices(choices: Mapping[str, str]) -> dict[str, str]:
    """Return the choices of a cell on axes beside task, method and seed.

    Args:
        choices: see :func:`read_cell`.

    Returns:
        Choices by axis, such as ``{"rate": "lr1e-3"}``.
    """
    return {axis: name for axis, name in choices.items() if axis not in _NO_METHOD}


def method_label(settings: Settings, choices: Mapping[str, str]) -> str:
    """Name the method of a run and its choices on the study's other axes, such as ``gru, lr1e-3``.

    Args:
        settings: of the run.
        choices: see :func:`read_cell`.

    Returns:
        The label; runs of one label differ in task, seed and training corruption alone.
    """
    return ", ".join([method_name(settings, choices), *further_choices(choices).values()])


def training_labels(
    kinds: Iterable[tuple[str, str, float]],
) -> dict[tuple[str, str, float], str]:
    """Tell kinds of runs apart that are drawn together.

    Args:
        kinds: method, what did not arrive in training, sigma of the noise in training.

    Returns:
        Labels: the method, with the corruption and the sigma where these differ between the kinds.
    """
    different = list(dict.fromkeys(kinds))
    several_on = len({trained_on for _, trained_on, _ in different}) > 1
    several_sigma = len({sigma for _, _, sigma in different}) > 1
    labels = {}
    for method, trained_on, sigma in different:
        parts = [method]
        parts += [trained_on] if several_on else []
        parts += [f"sigma {sigma:g}"] if several_sigma else []
        labels[method, trained_on, sigma] = ", ".join(parts)
    return labels


def _setting(settings: Settings, name: str) -> Any:
    """Return a setting by its dotted name; None where the run has none of that name."""
    group, *path = name.split(".")
    value: Any = getattr(settings, group)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    for part in path:
        value = value.get(part) if isinstance(value, Mapping) else None
    return value


def _told(name: str, value: Any) -> str:
    if isinstance(value, bool):
        return name if value else f"no {name}"
    return f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}"
