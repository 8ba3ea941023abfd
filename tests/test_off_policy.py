"""Transforms and normalisation work without a filter: TorchRL's SAC learns with them."""

import pytest
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, DoubleToFloat, TransformedEnv
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_drbpn import GymnasiumBatchEnv, MaskedObservationNorm, seed_env
from torchrl_drbpn.transforms import FillLastObserved, ObservationMissingness, ObservationNoise

ENVS, OBS, ACTION, FRAMES, BATCHES = 4, 4, 1, 64, 4


def make_env(last):
    noise = ObservationNoise(0.01)
    chain = Compose(DoubleToFloat(), noise, ObservationMissingness("mcar", 0.3), *last)
    env = TransformedEnv(GymnasiumBatchEnv("InvertedPendulum-v5", ENVS), chain)
    seed_env(env, 0)
    return env


def make_networks():
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
    filling = [FillLastObserved(fill_value=float("nan"))] if missing == "keep" else []
    norm = MaskedObservationNorm(OBS, missing=missing)
    actor, qvalue = make_networks()
    loss = SACLoss(actor, qvalue, num_qvalue_nets=2, target_entropy=-float(ACTION))
    loss.make_value_estimator(gamma=0.99)
    target = SoftUpdate(loss, eps=0.99)
    optimizer = torch.optim.Adam(loss.parameters(), lr=3e-3)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), batch_size=32)
    before = [parameter.detach().clone() for parameter in actor.parameters()]
    sizes = {"frames_per_batch": FRAMES, "total_frames": BATCHES * FRAMES}
    policy = TensorDictSequential(norm, actor)
    options = sizes | {"auto_register_policy_transforms": False}
    collector = Collector(make_env(filling), policy, **options)
    losses = []
    try:
        for data in collector:
            norm.update(data)
            buffer.extend(data.reshape(-1))
            for _ in range(4):
                sample = buffer.sample()
                norm(sample)
                norm(sample["next"])
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
