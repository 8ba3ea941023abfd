"""What is asked of MuJoCo itself: its warnings, states that it gave up, and its whole state.

The next step depends on the integration state of MuJoCo, on the quantities derived from it, and on
the random generator and the plain numbers that the Gymnasium object holds. Derived quantities lag:
after ``mj_step`` the body positions are those from before the last integration, and Ant and
Humanoid take their velocities from them.
"""

import json
import logging
from collections.abc import Iterator, MutableSequence, Sequence
from contextlib import contextmanager
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
from gymnasium.utils import seeding

_log = logging.getLogger(__name__)
_INTEGRATION = mujoco.mjtState.mjSTATE_INTEGRATION
# Derived quantities of fixed size. Contacts and constraints are left out: a step makes them anew.
# fmt: off
_DERIVED = (
    "qacc", "xpos", "xquat", "xmat", "xipos", "ximat", "xanchor", "xaxis", "geom_xpos",
    "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir",
    "subtree_com", "subtree_linvel", "subtree_angmom", "cdof", "cinert", "cvel", "cacc", "cfrc_int",
    "cfrc_ext", "qfrc_actuator", "qfrc_passive", "qfrc_bias", "qfrc_smooth", "qfrc_constraint",
    "qacc_smooth", "actuator_length", "actuator_velocity", "actuator_force", "sensordata",
)
# fmt: on


def bad_state_counters(env: gymnasium.Env[Any, Any]) -> MutableSequence[int]:
    """Return a view on MuJoCo's counters of states that it gave up; empty for other environments.

    MuJoCo resets itself where positions, velocities or accelerations are huge or NaN, and drops
    controls that are NaN.
    """
    data = getattr(env.unwrapped, "data", None)
    if not isinstance(data, mujoco.MjData):
        return []
    # The four of interest are the last ones; a memoryview is read ten times faster than an array.
    counters: Any = memoryview(data.warning.number[int(mujoco.mjtWarning.mjWARN_BADQPOS) :])
    return counters


@contextmanager
def model_warnings_once() -> Iterator[None]:
    """Log each warning about a model file once.

    MuJoCo prints them, and appends them to a file in the current directory, once for every
    simulator made: HalfCheetah's model has one in MuJoCo 4.0.
    """
    messages: dict[str, None] = {}
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: messages.update({text: None}))
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)
        for text in messages:
            _log.info("MuJoCo: %s", text)


def save_state(envs: Sequence[Any]) -> dict[str, torch.Tensor]:
    """Return the whole state of MuJoCo environments of one task as tensors.

    ``physics`` float64 ``(num_envs, size)`` is the integration state, ``derived`` float64
    ``(num_envs, size)``, ``generators`` uint8 ``(bytes,)`` is JSON with one entry an environment:
    its random generator (whose integers have 128 bits) and its plain numbers.
    """
    physics = np.empty((len(envs), mujoco.mj_stateSize(envs[0].model, _INTEGRATION)))
    for env, row in zip(envs, physics, strict=True):
        mujoco.mj_getState(env.model, env.data, row, _INTEGRATION)
    derived = [np.concatenate([field.ravel() for field in _derived(env.data)]) for env in envs]
    held = [
        {"generator": env.np_random.bit_generator.state, "numbers": _numbers(env)} for env in envs
    ]
    return {
        "physics": torch.from_numpy(physics),
        "derived": torch.from_numpy(np.stack(derived)),
        "generators": torch.frombuffer(bytearray(json.dumps(held).encode()), dtype=torch.uint8),
    }


def load_state(envs: Sequence[Any], state: dict[str, torch.Tensor]) -> None:
    """Put environments into a state of :func:`save_state`; a ValueError if it does not fit."""
    sizes = {
        "physics": mujoco.mj_stateSize(envs[0].model, _INTEGRATION),
        "derived": sum(field.size for field in _derived(envs[0].data)),
    }
    for name, size in sizes.items():
        given = tuple(state[name].shape) if name in state else "nothing"
        if given != (len(envs), size):
            raise ValueError(
                f"`{name}` must have shape {(len(envs), size)}, got {given}: is it the state of "
                "another task, number of environments or MuJoCo version?"
            )
    try:
        held = json.loads(bytes(state["generators"].cpu().numpy()))
        if len(held) != len(envs):
            raise ValueError(f"{len(held)} entries for {len(envs)} environments")
    except (KeyError, ValueError) as error:
        raise ValueError(f"`generators` must be the JSON that was saved: {error}.") from error
    arrays = (state[name].cpu().numpy() for name in sizes)
    for env, numbers, values, own in zip(envs, *arrays, held, strict=True):
        # Forward makes contacts and whatever is not in the two lists; it comes first because it
        # also overwrites what they hold.
        mujoco.mj_setState(env.model, env.data, numbers, _INTEGRATION)
        mujoco.mj_forward(env.model, env.data)
        mujoco.mj_setState(env.model, env.data, numbers, _INTEGRATION)
        for field in _derived(env.data):
            field[...] = values[: field.size].reshape(field.shape)
            values = values[field.size :]
        env.np_random, _ = seeding.np_random(0)
        env.np_random.bit_generator.state = own["generator"]
        for name, (value, dtype) in own["numbers"].items():
            # [()] makes a scalar of an array without dimensions.
            setattr(env, name, value if dtype is None else np.array(value, dtype=dtype)[()])


def _derived(data: Any) -> list[Any]:
    return [getattr(data, name) for name in _DERIVED]


def _numbers(env: Any) -> dict[str, tuple[Any, str | None]]:
    """Collect the numbers and arrays among an environment's attributes, as Reacher's goal."""
    found: dict[str, tuple[Any, str | None]] = {}
    for name, value in vars(env).items():
        if isinstance(value, np.ndarray | np.generic):
            if value.dtype.kind in "biuf":
                found[name] = (value.tolist(), value.dtype.str)
        elif isinstance(value, bool | int | float):
            found[name] = (value, None)
    return found
