"""What each component of an observation measures, by task and version.

The order is that of Gymnasium's pages on the MuJoCo tasks; the names are short enough for figures.
"""

from __future__ import annotations

from training.errors import UserError


def sensor_names(task: str, version: str, obs_dim: int) -> list[str]:
    """Return a name for each component of an observation.

    Args:
        task: Gymnasium id without the version, such as ``Walker2d``.
        version: ``v4`` or ``v5``.
        obs_dim: components of an observation.

    Returns:
        ``obs_dim`` different names; ``component 0`` and so on for a task that has no table here.

    Raises:
        UserError: if the task has a table and it is of another length.
    """
    names = _TABLES.get((task, version))
    if names is None:
        return [f"component {i}" for i in range(obs_dim)]
    if len(names) != obs_dim:
        raise UserError(
            f"`{task}-{version}` has {len(names)} named components, the observation has {obs_dim}: "
            "is it another variant of the task?"
        )
    return list(names)


def named_tasks() -> list[tuple[str, str]]:
    """Return the (task, version) pairs that have a table."""
    return sorted(_TABLES)


# Angles first, their velocities behind: Gymnasium's order of qpos and qvel ---------------------


def _hinged(body: str, *joints: str) -> list[str]:
    """Name a planar robot: the body's height and angle, the joints', then all velocities."""
    return [
        f"{body} height",
        f"{body} angle",
        *(f"{joint} angle" for joint in joints),
        f"{body} x velocity",
        f"{body} z velocity",
        f"{body} angular velocity",
        *(f"{joint} velocity" for joint in joints),
    ]


def _grid(parts: tuple[str, ...], what: tuple[str, ...]) -> list[str]:
    """Name every quantity of every part, part by part."""
    return [f"{part} {quantity}" for part in parts for quantity in what]


_AXES = ("x", "y", "z")
_FREE_POSITION = ["torso height", *(f"torso orientation {axis}" for axis in ("w", *_AXES))]
_FREE_VELOCITY = [
    *(f"torso {axis} velocity" for axis in _AXES),
    *(f"torso {axis} angular velocity" for axis in _AXES),
]
# MuJoCo's cvel and cfrc_ext: rotation before translation.
_FORCES = (*(f"torque {axis}" for axis in _AXES), *(f"force {axis}" for axis in _AXES))
_SPEEDS = (*(f"com rotation {axis}" for axis in _AXES), *(f"com velocity {axis}" for axis in _AXES))
_INERTIA = (
    *(f"inertia {entry}" for entry in ("xx", "yy", "zz", "xy", "xz", "yz")),
    *(f"mass offset {axis}" for axis in _AXES),
    "mass",
)

_HALFCHEETAH = _hinged(
    "front tip", "back thigh", "back shin", "back foot", "front thigh", "front shin", "front foot"
)
_HOPPER = _hinged("torso", "thigh", "leg", "foot")
_WALKER2D = _hinged(
    "torso", "right thigh", "right leg", "right foot", "left thigh", "left leg", "left foot"
)
_SWIMMER = [
    "front angle",
    "first rotor angle",
    "second rotor angle",
    "front x velocity",
    "front y velocity",
    "front angular velocity",
    "first rotor velocity",
    "second rotor velocity",
]
_INVERTED_PENDULUM = ["cart position", "pole angle", "cart velocity", "pole angular velocity"]
_INVERTED_DOUBLE_PENDULUM = [
    "cart position",
    "sine of first pole",
    "sine of second pole",
    "cosine of first pole",
    "cosine of second pole",
    "cart velocity",
    "first pole angular velocity",
    "second pole angular velocity",
    "cart constraint force",
]
_REACHER = [
    "cosine of first arm",
    "cosine of second arm",
    "sine of first arm",
    "sine of second arm",
    "target x",
    "target y",
    "first arm velocity",
    "second arm velocity",
    "fingertip to target x",
    "fingertip to target y",
]

_ANT_JOINTS = _grid(("front left", "front right", "back left", "back right"), ("hip", "ankle"))
_ANT = [
    *_FREE_POSITION,
    *(f"{joint} angle" for joint in _ANT_JOINTS),
    *_FREE_VELOCITY,
    *(f"{joint} velocity" for joint in _ANT_JOINTS),
]
_ANT_LINKS = _grid(("front left", "front right", "back left", "back right"), ("hip", "leg", "foot"))
_ANT_BODIES = ("torso", *_ANT_LINKS)

_HUMANOID_JOINTS = (
    "abdomen z",
    "abdomen y",
    "abdomen x",
    "right hip x",
    "right hip z",
    "right hip y",
    "right knee",
    "left hip x",
    "left hip z",
    "left hip y",
    "left knee",
    "right shoulder 1",
    "right shoulder 2",
    "right elbow",
    "left shoulder 1",
    "left shoulder 2",
    "left elbow",
)
_HUMANOID_BODIES = (
    "torso",
    "lower waist",
    "pelvis",
    "right thigh",
    "right shin",
    "right foot",
    "left thigh",
    "left shin",
    "left foot",
    "right upper arm",
    "right lower arm",
    "left upper arm",
    "left lower arm",
)


def _humanoid(bodies: tuple[str, ...], actuated: tuple[str, ...]) -> list[str]:
    """Name the Humanoid's components; the versions differ in constant zeros."""
    return [
        *_FREE_POSITION,
        *(f"{joint} angle" for joint in _HUMANOID_JOINTS),
        *_FREE_VELOCITY,
        *(f"{joint} velocity" for joint in _HUMANOID_JOINTS),
        *_grid(bodies, _INERTIA),
        *_grid(bodies, _SPEEDS),
        *(f"{joint} actuator force" for joint in actuated),
        *_grid(bodies, _FORCES),
    ]


_ROOT = tuple(f"root {i}" for i in range(6))
_SAME_IN_BOTH = {
    "HalfCheetah": _HALFCHEETAH,
    "Hopper": _HOPPER,
    "Walker2d": _WALKER2D,
    "Swimmer": _SWIMMER,
    "InvertedPendulum": _INVERTED_PENDULUM,
}
_TABLES: dict[tuple[str, str], list[str]] = {
    **{(task, version): names for task, names in _SAME_IN_BOTH.items() for version in ("v4", "v5")},
    ("InvertedDoublePendulum", "v4"): [
        *_INVERTED_DOUBLE_PENDULUM,
        "first pole constraint force",
        "second pole constraint force",
    ],
    ("InvertedDoublePendulum", "v5"): _INVERTED_DOUBLE_PENDULUM,
    ("Reacher", "v4"): [*_REACHER, "fingertip to target z"],
    ("Reacher", "v5"): _REACHER,
    ("Ant", "v4"): _ANT,
    ("Ant", "v5"): [*_ANT, *_grid(_ANT_BODIES, _FORCES)],
    ("Humanoid", "v4"): _humanoid(("world", *_HUMANOID_BODIES), (*_ROOT, *_HUMANOID_JOINTS)),
    ("Humanoid", "v5"): _humanoid(_HUMANOID_BODIES, _HUMANOID_JOINTS),
}
