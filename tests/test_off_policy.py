"""Transforms and normalisation work without a filter: TorchRL's SAC learns with them.

A short real run on InvertedPendulum-v5: collector, replay buffer, SACLoss, SoftUpdate. What the
buffer holds is what arrived, in raw units: a missing entry is 0, or the last value that
arrived where it is filled, at the root of a transition as in its next step. The normalisation is
first in the policy, learns from each collected batch once, and is applied to what is sampled.
"""

from __future__ import annotations

import pytest
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, DoubleToFloat, EnvBase, Transform, TransformedEnv
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_drbpn import (
    FillLastObserved,
    GymnasiumBatchEnv,
    ObservationMissingness,
    ObservationNoise,
    seed_env,
)
from torchrl_drbpn.modules import MaskedObservationNorm

ENVS, OBS, ACTION, FRAMES, BATCHES = 4, 4, 1, 64, 4
NOISE = 0.01


def make_env(last: list[Transform]) -> EnvBase:
    noise = ObservationNoise(NOISE, complete_key="complete_observation")
    chain = Compose(DoubleToFloat(), noise, ObservationMissingness("mcar", 0.3), *last)
    env = TransformedEnv(GymnasiumBatchEnv("InvertedPendulum-v5", ENVS), chain)
    seed_env(env, 0)
    return env


def make_networks() -> tuple[ProbabilisticActor, ValueOperator]:
    class Network(nn.Sequential):
        """Reads which entries arrived as well."""

        def forward(self, *parts):
            return super().forward(torch.cat([part.float() for part in parts], -1))

    policy = Network(
        nn.Linear(2 * OBS, 32), nn.ReLU(), nn.Linear(32, 2 * ACTION), NormalParamExtractor()
    )
    value = Network(nn.Linear(2 * OBS + ACTION, 32), nn.ReLU(), nn.Linear(32, 1))
    actor = ProbabilisticActor(
        TensorDictModule(policy, ["normalized_observation", "observed"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -3.0, "high": 3.0},
        return_log_prob=False,
    )
    return actor, ValueOperator(value, in_keys=["normalized_observation", "observed", "action"])


@pytest.mark.parametrize("missing", ["zero", "keep"])
def test_sac_learns_from_corrupted_observations(missing):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        filling = [FillLastObserved(fill_value=float("nan"))] if missing == "keep" else []
        norm = MaskedObservationNorm(OBS, missing=missing)
        actor, qvalue = make_networks()
        loss = SACLoss(actor, qvalue, num_qvalue_nets=2, target_entropy=-float(ACTION))
        loss.make_value_estimator(gamma=0.99)
        target = SoftUpdate(loss, eps=0.99)
        optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
        buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), batch_size=32)
        before = [parameter.detach().clone() for parameter in actor.parameters()]
        collector = Collector(
            make_env(filling),
            TensorDictSequential(norm, actor),
            frames_per_batch=FRAMES,
            total_frames=BATCHES * FRAMES,
            auto_register_policy_transforms=False,
        )
        rollouts, losses = [], []
        try:
            for data in collector:
                rollouts.append(data.clone())
                norm.update(data)
                buffer.extend(data.reshape(-1))
                for _ in range(4):
                    sample = buffer.sample()
                    norm(sample)
                    norm(sample["next"])
                    check_normalised(sample, norm)
                    out = loss(sample)
                    total = out["loss_actor"] + out["loss_qvalue"] + out["loss_alpha"]
                    optimizer.zero_grad()
                    total.backward()
                    optimizer.step()
                    target.step()
                    losses.append(total.detach())
        finally:
            collector.shutdown()

    assert torch.stack(losses).isfinite().all()
    assert any((p != old).any() for p, old in zip(actor.parameters(), before, strict=True))
    data = torch.cat(rollouts, 1)
    assert data.shape == (ENVS, BATCHES * FRAMES // ENVS)
    assert data["next", "done"].any()
    gaps = 1 - data["observed"].float().mean((0, 1))
    assert (gaps - 0.3).abs().max() < 0.1
    if missing == "keep":
        check_filled(data)


def check_normalised(sample, norm: MaskedObservationNorm) -> None:
    for part in (sample, sample["next"]):
        raw, observed, scaled = (
            part[key] for key in ("observation", "observed", "normalized_observation")
        )
        assert scaled.isfinite().all()
        expected = (raw - norm.mean) / norm.std
        torch.testing.assert_close(scaled[observed].double(), expected[observed])
        unknown = ~observed if norm.missing == "zero" else raw.isnan()
        assert torch.equal(scaled == 0, unknown)
        error = raw[observed] - part["complete_observation"][observed]
        assert error.abs().max() < 6 * NOISE
        assert (error != 0).all()


def check_filled(data) -> None:
    """Along each row a missing entry repeats the one before; none is known at a start."""
    for t in range(data.shape[1]):
        before, after = data[:, t], data[:, t]["next"]
        expected = torch.where(after["observed"], after["observation"], before["observation"])
        torch.testing.assert_close(after["observation"], expected, rtol=0, atol=0, equal_nan=True)
