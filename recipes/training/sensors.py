"""What each component of an observation measures (conf/sensors.yaml), and what fails together."""

import functools
import itertools
import re
from collections.abc import Sequence
from typing import Any

from omegaconf import OmegaConf

from training.config import CONF
from training.errors import UserError


@functools.cache
def _table() -> dict[str, list[str]]:
    read: Any = OmegaConf.to_container(OmegaConf.load(CONF / "sensors.yaml"), resolve=True)
    return {task: _expanded(node) for task, node in read.items() if not task.startswith("_")}


def _expanded(node: Any) -> list[str]:
    """Return the names that a text with braces, or a list of such, stands for."""
    if not isinstance(node, str):
        return [name for part in node for name in _expanded(part)]
    parts = [part.split(",") if i % 2 else [part] for i, part in enumerate(re.split("[{}]", node))]
    return ["".join(words) for words in itertools.product(*parts)]


def named_sensors(task: str, version: str | None) -> list[str]:
    """Return the names of a task's sensors; none where the task has no table."""
    return list(_table().get(f"{task}-{version}" if version else task, ()))


def sensor_names(task: str, version: str | None, obs_dim: int) -> list[str]:
    """Return ``obs_dim`` different names; ``component 0`` and so on without a table."""
    names = named_sensors(task, version) or [f"component {i}" for i in range(obs_dim)]
    if len(names) != obs_dim:
        raise UserError(
            f"`{task}{f'-{version}' if version else ''}` has {len(names)} named components, the "
            f"observation has {obs_dim}: is it another variant of the task?"
        )
    return names


# What a name says about a part of the robot, behind the part's own name or before it.
_QUANTITY = re.compile(
    r" (?:(?:[xyz] )?(?:angular )?velocity|angle|position|height|orientation [wxyz]"
    r"|(?:actuator|constraint) force|inertia [xyz]{2}|mass offset [xyz]|mass"
    r"|com (?:rotation|velocity) [xyz]|(?:torque|force) [xyz]|[xyz])$"
)
_FUNCTION = re.compile(r"^(?:sine|cosine) of ")
_KINDS = (
    ("force", re.compile(r"\b(?:force|torque)\b")),
    ("velocity", re.compile(r"\b(?:velocity|rotation)\b")),
    ("inertia", re.compile(r"\b(?:inertia|mass)\b")),
)


def sensor_groups(names: Sequence[str], by: str) -> list[list[int]] | None:
    """Return what fails together, indices in the order of their first; None: each by itself.

    By ``joint``: all that is measured at one joint or body, such as angle and velocity; by
    ``kind``: all positions and angles, all velocities, all forces, all inertias.
    """
    if by == "sensor":
        return None
    if by not in ("joint", "kind"):
        raise UserError(f"`group_by` must be sensor, joint or kind, got {by!r}.")
    if not names:
        raise UserError(
            f"`group_by={by}` goes by the names of the sensors, which this task has none of: "
            "take group_by=sensor."
        )
    hinges = {name.removesuffix(" angle") for name in names if name.endswith(" angle")}
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        group = _joint(name, hinges) if by == "joint" else _kind(name)
        groups.setdefault(group, []).append(index)
    return list(groups.values())


def _joint(name: str, hinges: set[str]) -> str:
    # "abdomen z velocity" is that of the hinge abdomen z, "torso z velocity" the torso's along z
    hinge = name.removesuffix(" velocity")
    return hinge if hinge in hinges else _QUANTITY.sub("", _FUNCTION.sub("", name))


def _kind(name: str) -> str:
    return next((kind for kind, words in _KINDS if words.search(name)), "position")
