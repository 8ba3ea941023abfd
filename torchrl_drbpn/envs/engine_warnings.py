"""Warnings of MuJoCo: about model files, and about states that it gives up during a run."""

from __future__ import annotations

import logging
from collections.abc import Iterator, MutableSequence
from contextlib import contextmanager
from typing import Any

import gymnasium
import mujoco

_log = logging.getLogger(__name__)


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
