"""`env=torchrl`: any environment of TorchRL by its `_target_`, and the mask that it may write."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from contracts import OBS, StaircaseEnv
from ppo_drbpn import train_rollout
from recipe_tools import SMOKE, assembled, read_table, resume, run
from tensordict import TensorDict
from torchrl.data import Binary
from training.errors import UserError


class MaskingEnv(StaircaseEnv):
    """Component i arrives at the steps that i + 1 divides; elsewhere a number that is none."""

    def __init__(self, batch: int) -> None:
        super().__init__(batch, horizon=7)
        spec = self.observation_spec.clone()
        spec["mask"] = Binary(shape=(batch, OBS), dtype=torch.bool)
        self.observation_spec = spec

    def _observe(self) -> TensorDict:
        data = super()._observe()
        data["mask"] = self.time[:, None] % torch.arange(1, OBS + 1) == 0
        return data.set("observation", data["observation"].where(data["mask"], -9e3))


def test_an_environment_trains_and_resumes_by_its_target(tmp_path: Path) -> None:
    make = ["env.make._target_=torchrl.envs.GymEnv", "+env.make.env_name=Pendulum-v1"]
    words = [*SMOKE, "env=torchrl", "env.id=pendulum", *make]
    run(tmp_path / "run", *words, "total_frames=128")
    resume(tmp_path / "run", "total_frames=256")
    (row, *_) = read_table(tmp_path / "run" / "metrics.csv")
    assert row["missing_ratio"]
    with pytest.raises(UserError, match=r"`env.observation_keys` .* observation; got x\.$"):
        run(tmp_path / "other", *words, "env.observation_keys=[x]")


@pytest.mark.parametrize("eta", [0.0, 0.5])
def test_the_mask_that_an_environment_writes_says_what_arrived(eta: float) -> None:
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
