"""What each component of an observation measures, by task and version, and what fails together.

The order is that of Gymnasium's pages on the MuJoCo tasks; the names are short enough for figures.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

from training.errors import UserError


def named_sensors(task: str, version: str | None) -> list[str]:
    """Return the names of a task's sensors; none where the task has no table here.

    The id is ``Walker2d``, or ``Walker2d-v5`` where ``version`` is None.
    """
    if version is None:
        task, _, version = task.rpartition("-")
    return list(_TABLES.get((task, version), ()))


def sensor_names(task: str, version: str | None, obs_dim: int) -> list[str]:
    """Return ``obs_dim`` different names; ``component 0`` and so on without a table."""
    names = named_sensors(task, version) or [f"component {i}" for i in range(obs_dim)]
    if len(names) != obs_dim:
        raise UserError(
            f"`{task}-{version}` has {len(names)} named components, the observation has {obs_dim}: "
            "is it another variant of the task?"
        )
    return names


def named_tasks() -> list[tuple[str, str]]:
    """Return the (task, version) pairs that have a table."""
    return sorted(_TABLES)


# Angles first, their velocities behind: Gymnasium's order of qpos and qvel ---------------------


def _list(names: str) -> list[str]:
    return [name.strip() for name in names.split(",")]


def _grid(parts: list[str], what: list[str]) -> list[str]:
    """Name every quantity of every part, part by part."""
    return [f"{part} {quantity}" for part in parts for quantity in what]


def _hinged(body: str, joints: str) -> list[str]:
    """Name a planar robot: the body's height and angle, the joints', then all velocities."""
    first = [f"{body} height", f"{body} angle", *_grid(_list(joints), ["angle"])]
    moving = _grid([body], ["x velocity", "z velocity", "angular velocity"])
    return [*first, *moving, *_grid(_list(joints), ["velocity"])]


_FREE_POSITION = ["torso height", *_grid(["torso orientation"], ["w", "x", "y", "z"])]
_FREE_VELOCITY = _grid(
    ["torso"], [f"{axis} {of}velocity" for of in ("", "angular ") for axis in "xyz"]
)
# MuJoCo's cvel and cfrc_ext: rotation before translation.
_FORCES = [f"{what} {axis}" for what in ("torque", "force") for axis in "xyz"]
_SPEEDS = [f"com {what} {axis}" for what in ("rotation", "velocity") for axis in "xyz"]
_INERTIA = [
    *_grid(["inertia"], ["xx", "yy", "zz", "xy", "xz", "yz"]),
    *_grid(["mass offset"], ["x", "y", "z"]),
    "mass",
]
_DOUBLE_PENDULUM = _list(
    "cart position, sine of first pole, sine of second pole, cosine of first pole, "
    "cosine of second pole, cart velocity, first pole angular velocity, "
    "second pole angular velocity, cart constraint force"
)
_REACHER = _list(
    "cosine of first arm, cosine of second arm, sine of first arm, sine of second arm, target x, "
    "target y, first arm velocity, second arm velocity, fingertip to target x, "
    "fingertip to target y"
)
_LEGS = _list("front left, front right, back left, back right")
_ANT_JOINTS = _grid(_LEGS, ["hip", "ankle"])
_ANT = [
    *_FREE_POSITION,
    *_grid(_ANT_JOINTS, ["angle"]),
    *_FREE_VELOCITY,
    *_grid(_ANT_JOINTS, ["velocity"]),
]
_ANT_BODIES = ["torso", *_grid(_LEGS, ["hip", "leg", "foot"])]
_HUMANOID_JOINTS = _list(
    "abdomen z, abdomen y, abdomen x, right hip x, right hip z, right hip y, right knee, "
    "left hip x, left hip z, left hip y, left knee, right shoulder 1, right shoulder 2, "
    "right elbow, left shoulder 1, left shoulder 2, left elbow"
)
_HUMANOID_BODIES = _list(
    "torso, lower waist, pelvis, right thigh, right shin, right foot, left thigh, left shin, "
    "left foot, right upper arm, right lower arm, left upper arm, left lower arm"
)


def _humanoid(bodies: list[str], actuated: list[str]) -> list[str]:
    """Name the Humanoid's components; the versions differ in constant zeros."""
    return [
        *_FREE_POSITION,
        *_grid(_HUMANOID_JOINTS, ["angle"]),
        *_FREE_VELOCITY,
        *_grid(_HUMANOID_JOINTS, ["velocity"]),
        *_grid(bodies, _INERTIA),
        *_grid(bodies, _SPEEDS),
        *_grid(actuated, ["actuator force"]),
        *_grid(bodies, _FORCES),
    ]


_SAME_IN_BOTH = {
    "HalfCheetah": _hinged(
        "front tip", "back thigh, back shin, back foot, front thigh, front shin, front foot"
    ),
    "Hopper": _hinged("torso", "thigh, leg, foot"),
    "Walker2d": _hinged(
        "torso", "right thigh, right leg, right foot, left thigh, left leg, left foot"
    ),
    "Swimmer": _list(
        "front angle, first rotor angle, second rotor angle, front x velocity, front y velocity, "
        "front angular velocity, first rotor velocity, second rotor velocity"
    ),
    "InvertedPendulum": _list("cart position, pole angle, cart velocity, pole angular velocity"),
}
_TABLES: dict[tuple[str, str], list[str]] = {
    **{(task, version): names for task, names in _SAME_IN_BOTH.items() for version in ("v4", "v5")},
    ("InvertedDoublePendulum", "v4"): [
        *_DOUBLE_PENDULUM,
        *_grid(["first pole", "second pole"], ["constraint force"]),
    ],
    ("InvertedDoublePendulum", "v5"): _DOUBLE_PENDULUM,
    ("Reacher", "v4"): [*_REACHER, "fingertip to target z"],
    ("Reacher", "v5"): _REACHER,
    ("Ant", "v4"): _ANT,
    ("Ant", "v5"): [*_ANT, *_grid(_ANT_BODIES, _FORCES)],
    ("Humanoid", "v4"): _humanoid(
        ["world", *_HUMANOID_BODIES], [*(f"root {i}" for i in range(6)), *_HUMANOID_JOINTS]
    ),
    ("Humanoid", "v5"): _humanoid(_HUMANOID_BODIES, _HUMANOID_JOINTS),
}


# What fails together ----------------------------------------------------------------------------

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
    """Return what fails together: indices in the order of their first; None for ``sensor``.

    ``by`` is ``sensor``: each component by itself; ``joint``: all that is measured at one joint or
    body, such as angle and velocity; ``kind``: all positions and angles, all velocities, all
    forces, all inertias.
    """
    if by == "sensor":
        return None
    if by not in ("joint", "kind"):
        raise UserError(f"`group_by` must be sensor, joint or kind, got {by!r}.")
    if not names or not have_names(names):
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
    """Return whether sensors have names by which they can be grouped."""
    return not any(name.startswith("component ") for name in names)


def _joint(name: str, hinges: set[str]) -> str:
    # "abdomen z velocity" is that of the hinge abdomen z, "torso z velocity" the torso's along z
    hinge = name.removesuffix(" velocity")
    return hinge if hinge in hinges else _QUANTITY.sub("", _FUNCTION.sub("", name))


def _kind(name: str) -> str:
    return next((kind for kind, words in _KINDS if words.search(name)), "position")
