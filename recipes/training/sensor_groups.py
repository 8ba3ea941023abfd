"""Which components of an observation fail together, by their names."""

from __future__ import annotations

import re
from collections.abc import Sequence

from training.errors import UserError

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
    """Return what fails together.

    Args:
        names: of the components, see :func:`training.sensors.sensor_names`.
        by: ``sensor``: each component by itself; ``joint``: all that is measured at one joint or
            body, such as angle and velocity; ``kind``: all positions and angles, all velocities,
            all forces, all inertias.

    Returns:
        Lists of indices in the order of their first, each component in one; None for ``sensor``.

    Raises:
        UserError: if ``by`` is none of these, or the task's components have no names to go by.
    """
    if by == "sensor":
        return None
    if by not in ("joint", "kind"):
        raise UserError(f"`group_by` must be sensor, joint or kind, got {by!r}.")
    if not have_names(names):
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


def have_names(names: Sequence[str]) -> bool:
    """Return whether sensors have names by which they can be grouped.

    Args:
        names: of the components, see :func:`training.sensors.sensor_names`.
    """
    return not any(name.startswith("component ") for name in names)


def _joint(name: str, hinges: set[str]) -> str:
    # "abdomen z velocity" is that of the hinge abdomen z, "torso z velocity" the torso's along z
    hinge = name.removesuffix(" velocity")
    return hinge if hinge in hinges else _QUANTITY.sub("", _FUNCTION.sub("", name))


def _kind(name: str) -> str:
    return next((kind for kind, words in _KINDS if words.search(name)), "position")
