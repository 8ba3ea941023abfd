"""Specification of `env=torchrl`: any environment of TorchRL in the place of ours."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch
from contract_environments import StaircaseEnv
from torchrl.envs import GymEnv, TransformedEnv

pytest.importorskip("hydra")
from recipe_tools import SMOKE, make_config  # isort: skip
from training.envs import make_env, make_torchrl_env
from training.errors import UserError


def made(make: Any, num_envs: int = 3, keys: tuple[str, ...] = ("observation",)) -> TransformedEnv:
    return make_torchrl_env(
        id="mine", version=None, make=make, num_envs=num_envs, parallel=False, observation_keys=keys
    )


def test_an_action_beyond_its_limits_is_clipped_and_stored_as_it_was_sampled() -> None:
    rewards = []
    for action in (2.0, 5.0):
        env = made(partial(GymEnv, "Pendulum-v1"))
        env.set_seed(0)
        data = env.reset().set("action", torch.full((3, 1), action))
        rewards.append(env.step(data)["next", "reward"])
        assert (data["action"] == action).all()
    assert torch.equal(*rewards)


@pytest.mark.parametrize(
    ("make", "num_envs", "keys", "message"),
    [
        (partial(GymEnv, "CartPole-v1"), 3, ("observation",), "a vector of bounded real numbers"),
        (partial(GymEnv, "Nope-v1"), 3, ("observation",), "`Nope` doesn't exist"),
        (partial(GymEnv, "Pendulum-v1"), 3, ("position",), "hold entries .* observation; got pos"),
        (partial(StaircaseEnv, batch=5), 3, ("observation",), "set collector.num_envs=5, got 3"),
    ],
    ids=["discrete", "unknown", "keys", "batch"],
)
def test_what_can_not_be_trained_is_one_line(
    make: Any, num_envs: int, keys: tuple[str, ...], message: str
) -> None:
    with pytest.raises(UserError, match=message) as error:
        made(make, num_envs, keys)
    assert "\n" not in str(error.value)


def test_a_mask_that_the_environment_does_not_write_is_named() -> None:
    with pytest.raises(UserError, match=r"mask is to be read, .* writes observation"):
        make_env(make_config(*SMOKE, "missingness=from_mask"))
