"""The particle filter as a belief module: the shared requirements, its keys, its learning.

Its mathematics are in test_particles.py, its networks' laws in test_particle_networks.py, PPO's
invariants with it in test_pipeline.py.
"""

from __future__ import annotations

import pytest
import torch
from contracts import ACTION, OBS, BeliefModuleContract
from particle_tools import HIDDEN, LATENT, OPTIONAL, K, make_filter, make_frames
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode

from torchrl_drbpn import ParticleFilterModule


class TestContract(BeliefModuleContract):
    all_outputs = ("features", ("belief", "log_likelihood"), *OPTIONAL)

    def make_module(self, obs=OBS, action=ACTION, dtype=None, **kwargs):
        return ParticleFilterModule(make_filter(obs, action, dtype), **kwargs)

    def differentiable(self, out: TensorDictBase) -> Tensor:
        return out["features"].square().mean() - out["belief", "log_likelihood"].mean()


def test_keys_are_those_of_the_belief_filter_with_particles_for_the_mean():
    module = ParticleFilterModule(make_filter())
    state = [("recurrent", "particles"), ("recurrent", "log_weight"), ("recurrent", "age")]
    assert module.in_keys == ["observation", "observed", "previous_action", "is_init", *state]
    next_state = [("next", *key) for key in state]
    assert module.out_keys == ["features", ("belief", "log_likelihood"), *next_state]
    assert module.feature_dim == HIDDEN


@pytest.mark.parametrize("over_time", [False, True])
def test_optional_entries_are_written_where_asked_for(over_time):
    data = make_frames((3, 4))
    data["is_init"][:] = not over_time
    filter = make_filter(dtype=torch.float64)
    module = ParticleFilterModule(filter, out_keys=["features", *OPTIONAL])
    with set_recurrent_mode(over_time), torch.no_grad():
        state = {k: s.expand(3, 4, *s.shape).zero() for k, s in
                 module.make_tensordict_primer().primers.items(True, True)}  # fmt: skip
        out = module(data.update(state))
    assert ("belief", "log_likelihood") not in out.keys(True)
    assert out["belief", "observation"].shape == (3, 4, OBS)
    assert out["belief", "latent"].shape == (3, 4, K, LATENT)
    share = out["belief", "effective_sample_size"]
    assert share.shape == (3, 4)
    assert (share >= 1 - 1e-9).all()
    assert (share <= K + 1e-9).all()


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"num_particles": 0}, "`num_particles` must be an int of at least 1, got 0"),
        ({"latent_dim": 2.0}, "`latent_dim` must be an int of at least 1, got 2.0"),
        ({"encoder_sizes": (4,)}, "`encoder_sizes` must be two sizes"),
        ({"min_std": -1.0}, "`min_std` must be at least 0, got -1.0"),
    ],
)
def test_a_wrong_size_is_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_filter(**kwargs)
