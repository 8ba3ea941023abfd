"""Make the Gymnasium environments of a batch, with clear errors for those that can not be one."""

from __future__ import annotations

import difflib
import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TimeLimit

__all__ = ["check_spaces", "find_limit", "make_simulators", "near_ids"]

_log = logging.getLogger(__name__)


def find_limit(env_id: str) -> int | None:
    """Return the registered time limit of a Gymnasium id.

    Args:
        env_id: the id.

    Returns:
        Steps after which an episode is truncated, or None for no limit.

    Raises:
        ValueError: where the id is unknown; the message lists ids that are spelt like it.

    Examples:
        >>> find_limit("Walker2d-v5")
        1000
    """
    try:
        limit: int | None = gymnasium.spec(env_id).max_episode_steps
    except (gymnasium.error.Error, ModuleNotFoundError) as error:
        hint = near_ids(env_id, gymnasium.registry) or "is its package imported?"
        raise ValueError(
            f"`env_id` must be a registered Gymnasium environment, got {env_id!r}: {hint}"
        ) from error
    return limit


def near_ids(env_id: str, known: Iterable[str]) -> str:
    """Return a question that names the ids spelt like an unknown one.

    Args:
        env_id: the unknown id.
        known: the ids that exist.

    Returns:
        The question; "" where no id is near.

    Examples:
        >>> near_ids("Walker2D-v5", ["Walker2d-v5", "Ant-v5"])
        'did you mean Walker2d-v5?'
    """
    near = difflib.get_close_matches(env_id, known, n=4, cutoff=0.5)
    return f"did you mean {', '.join(near)}?" if near else ""


def make_simulators(
    env_id: str, num_envs: int, make_kwargs: Mapping[str, Any]
) -> list[gymnasium.Env[Any, Any]]:
    """Make ``num_envs`` environments without time limit and without Gymnasium's outer checks.

    The checks cost time at every step and change no result; the time limit is kept by the caller.

    Args:
        env_id: a registered Gymnasium id.
        num_envs: how many to make.
        make_kwargs: passed to ``gymnasium.make``.

    Returns:
        The environments. For the MuJoCo tasks they are the bare simulator objects.

    Raises:
        ValueError: where observation or action is not a vector of real numbers.

    Examples:
        >>> [type(env).__name__ for env in make_simulators("Hopper-v5", 2, {})]
        ['HopperEnv', 'HopperEnv']
    """
    envs = []
    with _model_warnings_once():
        for _ in range(num_envs):
            env = gymnasium.make(
                env_id, max_episode_steps=-1, disable_env_checker=True, **make_kwargs
            )
            while isinstance(env, OrderEnforcing | PassiveEnvChecker | TimeLimit):
                env = env.env
            envs.append(env)
            if len(envs) == 1:
                check_spaces(env_id, env.observation_space, env.action_space)
    return envs


def check_spaces(env_id: str, observation: object, action: object) -> None:
    """Refuse a task whose observation or action is not a vector of real numbers.

    Args:
        env_id: the task, for the message.
        observation: its observation space.
        action: its action space.

    Raises:
        ValueError: where one of them is not a Box of floats with one dimension, or an action has
            no limit.
    """
    if (
        not isinstance(observation, gymnasium.spaces.Box)
        or len(observation.shape) != 1
        or not np.issubdtype(observation.dtype, np.floating)
    ):
        raise ValueError(
            f"`{env_id}` must have a vector observation (a Box of floats with one dimension), got "
            f"{observation}: images, integers and dictionaries are not supported."
        )
    if (
        not isinstance(action, gymnasium.spaces.Box)
        or len(action.shape) != 1
        or not np.issubdtype(action.dtype, np.floating)
    ):
        raise ValueError(
            f"`{env_id}` must have a continuous action (a Box of floats with one dimension), got "
            f"{action}: discrete actions are not supported."
        )
    if not (np.isfinite(action.low).all() and np.isfinite(action.high).all()):
        raise ValueError(
            f"`{env_id}` must have an action with finite limits, got {action}: a policy's action "
            "is scaled into them."
        )


@contextmanager
def _model_warnings_once() -> Iterator[None]:
    """Log each warning about a model file once.

    MuJoCo prints them, and appends them to a file in the current directory, once for every
    simulator made: HalfCheetah's model has one in MuJoCo 4.0.
    """
    try:
        import mujoco
    except ImportError:  # not every Gymnasium task needs it
        yield
        return
    messages: dict[str, None] = {}
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda text: messages.update({text: None}))
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)
        for text in messages:
            _log.info("MuJoCo: %s", text)
