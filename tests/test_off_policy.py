"""Transforms and normalisation work without a filter: TorchRL's SAC learns with them."""

import pytest
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, TransformedEnv
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss

from torchrl_drbpn import GymnasiumBatchEnv, MaskedObservationNorm
from torchrl_drbpn.transforms import FillLastObserved, ObservationMissingness, ObservationNoise

OBS = 4


@pytest.mark.parametrize("missing", ["zero", "keep"])
def test_sac_learns_from_corrupted_observations(missing):
    filling = [FillLastObserved(fill_value=float("nan"))] if missing == "keep" else []
    chain = Compose(ObservationNoise(0.01), ObservationMissingness("mcar", 0.3), *filling)
    env = TransformedEnv(GymnasiumBatchEnv("InvertedPendulum-v5", 4, seed=0), chain)
    norm = MaskedObservationNorm(OBS, missing=missing)
    head = nn.Sequential(MLP(OBS, 2, num_cells=[32]), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(head, ["normalized_observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
    )
    value = MLP(OBS + 1, 1, num_cells=[32])
    qvalue = ValueOperator(value, in_keys=["normalized_observation", "action"])
    loss = SACLoss(actor, qvalue, delay_qvalue=False, alpha_init=0.1, target_entropy=-1.0)
    loss.make_value_estimator(gamma=0.5)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(1_000), batch_size=32)
    policy, losses = TensorDictSequential(norm, actor), []
    options = {"auto_register_policy_transforms": False}
    for data in Collector(env, policy, frames_per_batch=64, total_frames=256, **options):
        # what acted was scaled by what was learned until then, and by nothing else
        again = norm.normalize(data["observation"], data["observed"])
        assert torch.equal(data["normalized_observation"], again)
        norm.update(data)
        buffer.extend(data.reshape(-1))
        for _ in range(20):
            sample = buffer.sample()
            for part in (sample, sample["next"]):
                norm(part)
                assert part["normalized_observation"].isfinite().all()
            out = loss(sample)
            optimizer.zero_grad()
            sum(value for key, value in out.items() if key.startswith("loss")).backward()
            optimizer.step()
            losses.append(out["loss_qvalue"].item())
    assert norm.count.min() > 100
    assert sum(losses[-10:]) < 0.5 * sum(losses[:10])
