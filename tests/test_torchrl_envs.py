"""Specification of `env=torchrl`: any environment of TorchRL in the place of ours."""

from functools import partial
from typing import Any

import pytest
import torch
from contract_environments import ACTION, OBS, StaircaseEnv
from ppo_drbpn import train_rollout
from recipe_tools import SMOKE, assembled, read_table, refused, resume, run
from tensordict import TensorDict
from torchrl.data import Binary, Bounded
from torchrl.envs import GymEnv, TransformedEnv
from training.envs import make_torchrl_env


def made(make: Any, num_envs: int = 3, keys: tuple[str, ...] = ("observation",)) -> TransformedEnv:
    return make_torchrl_env(
        id="mine", version=None, make=make, num_envs=num_envs, parallel=False, observation_keys=keys
    )


def test_an_action_beyond_its_limits_is_clipped_and_stored_as_it_was_sampled():
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
def test_what_can_not_be_trained_is_one_line(make, num_envs, keys, message):
    with refused(message):
        made(make, num_envs, keys)


class MaskingEnv(StaircaseEnv):
    """Component i arrives at the steps that i + 1 divides; elsewhere a number that is none."""

    def __init__(self, batch: int) -> None:
        super().__init__(batch, horizon=7)
        spec = self.observation_spec.clone()
        spec["mask"] = Binary(shape=(batch, OBS), dtype=torch.bool)
        self.observation_spec = spec
        self.action_spec = Bounded(-1.0, 1.0, shape=(batch, ACTION), dtype=torch.float32)

    def _observe(self) -> TensorDict:
        data = super()._observe()
        data["mask"] = self.time[:, None] % torch.arange(1, OBS + 1) == 0
        return data.set("observation", data["observation"].where(data["mask"], -9e3))


def test_an_environment_trains_and_resumes_by_its_target(tmp_path):
    make = ["env.make._target_=torchrl.envs.GymEnv", "+env.make.env_name=Pendulum-v1"]
    words = [*SMOKE, "env=torchrl", "env.id=pendulum", *make]
    run(tmp_path / "run", *words, "total_frames=128")
    resume(tmp_path / "run", "total_frames=256")
    (row, *_) = read_table(tmp_path / "run" / "metrics.csv")
    assert row["missing_ratio"]


@pytest.mark.parametrize("eta", [0.0, 0.5])
def test_the_mask_that_an_environment_writes_says_what_arrived(eta):
    words = (f"env.make._target_={__name__}.MaskingEnv", "+env.make.batch=4", "env.id=staircase")
    more = ("env=torchrl", "missingness=from_mask", f"missingness.eta={eta}", "noise=none")
    training, config = assembled("experiment=smoke", "collector.num_envs=4", *more, *words)
    row, _ = train_rollout(training, config)
    assert torch.tensor([v for v in row.values() if v is not None]).isfinite().all()
    data = training.collector.rollout()
    for frame, time in ((data, data["step_count"]), (data["next"], data["next", "step_count"])):
        arrived = time % torch.arange(1, OBS + 1) == 0
        assert frame["observed"].any()
        assert not (frame["observed"] & ~arrived).any()
        assert torch.equal(frame["observed"], arrived) is (eta == 0)
        assert not frame["observation"][~frame["observed"]].any()
    assert data["normalized_observation"].isfinite().all()
    assert row["missing_ratio"] > 0.4
