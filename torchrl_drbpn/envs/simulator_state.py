"""The whole state of Gymnasium's MuJoCo environments as tensors, for runs that go on bit for bit.

Three things make up what the next step depends on: the integration state of MuJoCo (positions,
velocities, warm start of the solver, controls), the quantities that MuJoCo derives from it, and
the random generator and the plain numbers that the Gymnasium object holds. The second is needed
because the tasks read it between steps and it lags: after ``mj_step`` the body positions are those
from before the last integration, and Ant and Humanoid take their velocities from them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.utils import seeding

__all__ = ["is_mujoco", "load_simulator_state", "simulator_state"]

# Derived quantities of fixed size. Contacts and constraints are left out: a step makes them anew.
_DERIVED = [
    "qacc",
    "xpos",
    "xquat",
    "xmat",
    "xipos",
    "ximat",
    "xanchor",
    "xaxis",
    "geom_xpos",
    "geom_xmat",
    "site_xpos",
    "site_xmat",
    "cam_xpos",
    "cam_xmat",
    "light_xpos",
    "light_xdir",
    "subtree_com",
    "subtree_linvel",
    "subtree_angmom",
    "cdof",
    "cinert",
    "cvel",
    "cacc",
    "cfrc_int",
    "cfrc_ext",
    "qfrc_actuator",
    "qfrc_passive",
    "qfrc_bias",
    "qfrc_smooth",
    "qfrc_constraint",
    "qacc_smooth",
    "actuator_length",
    "actuator_velocity",
    "actuator_force",
    "sensordata",
]


def is_mujoco(env: gymnasium.Env[Any, Any]) -> bool:
    """Tell whether ``env`` is a plain MuJoCo environment of Gymnasium, without wrappers.

    Args:
        env: the environment.

    Returns:
        True where its whole state can be saved.

    Examples:
        >>> env = gymnasium.make("Swimmer-v5")
        >>> is_mujoco(env), is_mujoco(env.unwrapped)
        (False, True)
    """
    if env.unwrapped is not env:
        return False
    from gymnasium.envs.mujoco import MujocoEnv  # imports mujoco, which not every task needs

    return isinstance(env, MujocoEnv)


def simulator_state(envs: Sequence[Any]) -> dict[str, torch.Tensor]:
    """Return the whole state of MuJoCo environments as tensors.

    Args:
        envs: MuJoCo environments of one task, without wrappers.

    Returns:
        ``physics`` float64 ``(num_envs, size)``, the integration state; ``derived`` float64
        ``(num_envs, size)``; ``generators`` uint8 ``(bytes,)``, JSON with one entry an environment:
        its random generator (whose integers have 128 bits) and its plain numbers.
    """
    import mujoco

    what = mujoco.mjtState.mjSTATE_INTEGRATION
    physics = np.empty((len(envs), mujoco.mj_stateSize(envs[0].model, what)))
    for env, row in zip(envs, physics, strict=True):
        mujoco.mj_getState(env.model, env.data, row, what)
    derived = np.stack([_derived(env.data) for env in envs])
    held = [
        {"generator": env.np_random.bit_generator.state, "numbers": _numbers(env)} for env in envs
    ]
    text = json.dumps(held).encode()
    return {
        "physics": torch.from_numpy(physics),
        "derived": torch.from_numpy(derived),
        "generators": torch.frombuffer(bytearray(text), dtype=torch.uint8),
    }


def load_simulator_state(envs: Sequence[Any], state: dict[str, torch.Tensor]) -> None:
    """Put MuJoCo environments into a state that :func:`simulator_state` returned.

    Args:
        envs: MuJoCo environments of the same task, without wrappers.
        state: the tensors that :func:`simulator_state` returned.

    Raises:
        ValueError: where the state is of another task or incomplete.

    Examples:
        >>> env = gymnasium.make("Hopper-v5").unwrapped
        >>> _ = env.reset(seed=0)
        >>> saved, action = simulator_state([env]), np.ones(3)
        >>> first = env.step(action)[0]
        >>> load_simulator_state([env], saved)
        >>> bool((env.step(action)[0] == first).all())
        True
    """
    import mujoco

    what = mujoco.mjtState.mjSTATE_INTEGRATION
    shapes = {
        "physics": (len(envs), mujoco.mj_stateSize(envs[0].model, what)),
        "derived": (len(envs), _derived(envs[0].data).size),
    }
    for name, shape in shapes.items():
        given = tuple(state[name].shape) if name in state else "nothing"
        if given != shape:
            raise ValueError(
                f"`{name}` must have shape {shape}, got {given}: is it the state of another task, "
                "number of environments or MuJoCo version?"
            )
    try:
        held = json.loads(bytes(state["generators"].cpu().numpy()))
        if len(held) != len(envs):
            raise ValueError(f"{len(held)} entries for {len(envs)} environments")
    except (KeyError, ValueError) as error:
        raise ValueError(f"`generators` must be the JSON that was saved: {error}.") from error
    physics, derived = state["physics"].cpu().numpy(), state["derived"].cpu().numpy()
    for env, numbers, values, own in zip(envs, physics, derived, held, strict=True):
        # Forward makes contacts and whatever is not in the two lists; it comes first because it
        # also overwrites what they hold.
        mujoco.mj_setState(env.model, env.data, numbers, what)
        mujoco.mj_forward(env.model, env.data)
        mujoco.mj_setState(env.model, env.data, numbers, what)
        _set_derived(env.data, values)
        env.np_random, _ = seeding.np_random(0)
        env.np_random.bit_generator.state = own["generator"]
        for name, (value, dtype) in own["numbers"].items():
            # [()] makes a scalar of an array without dimensions.
            setattr(env, name, value if dtype is None else np.array(value, dtype=dtype)[()])


def _derived(data: Any) -> Any:
    return np.concatenate([getattr(data, name).ravel() for name in _DERIVED])


def _set_derived(data: Any, values: Any) -> None:
    start = 0
    for name in _DERIVED:
        field = getattr(data, name)
        field[...] = values[start : start + field.size].reshape(field.shape)
        start += field.size


def _numbers(env: Any) -> dict[str, tuple[Any, str | None]]:
    """Collect the numbers and arrays among an environment's attributes (Reacher's goal, say)."""
    found: dict[str, tuple[Any, str | None]] = {}
    for name, value in vars(env).items():
        if isinstance(value, np.ndarray | np.generic):
            if value.dtype.kind in "biuf":
                found[name] = (value.tolist(), value.dtype.str)
        elif isinstance(value, bool | int | float):
            found[name] = (value, None)
    return found
