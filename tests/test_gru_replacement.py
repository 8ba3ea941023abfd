"""What TorchRL's own tests ask of GRUModule, asked of the belief modules here and of GRUModule.

Only the constructor differs: a belief module takes the place of a GRU of one value without a state
at first, with `is_init` in the middle, with padded data, under `vmap` over stacked parameters.
"""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict, pad
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.envs.utils import step_mdp
from torchrl.modules import GRUModule, set_recurrent_mode

from torchrl_drbpn import BeliefFilter, BeliefFilterModule, ParticleFilter, ParticleFilterModule

OBS, HIDDEN = 3, 4
KEYS = {"in_keys": {"observed": None, "previous_action": None, "observation": "value"}}

pytestmark = pytest.mark.filterwarnings("ignore:.*make_tensordict_primer:UserWarning")


def gru() -> GRUModule:
    return GRUModule(input_size=OBS, hidden_size=HIDDEN, in_key="value", out_key="features")


def belief_filter() -> BeliefFilterModule:
    return BeliefFilterModule(BeliefFilter(OBS, 1, HIDDEN, validate=False), **KEYS)


def particle_filter() -> ParticleFilterModule:
    sizes = {"num_particles": 3, "hidden_dim": HIDDEN, "latent_dim": 2, "validate": False}
    return ParticleFilterModule(ParticleFilter(OBS, 1, **sizes), **KEYS)


@pytest.fixture(params=[gru, belief_filter, particle_filter], ids=lambda make: make.__name__)
def module(request) -> TensorDictModuleBase:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return request.param()


def frames(*shape: int) -> TensorDict:
    value = torch.ones(*shape, OBS).cumsum(-2) if shape else torch.ones(OBS)
    return TensorDict({"value": value, "is_init": torch.zeros(*shape, 1, dtype=torch.bool)}, shape)


@pytest.mark.parametrize("shape", [(), (2,), (2, 3), (2, 3, 4)])
def test_a_step_without_a_state_is_followed_by_one_that_step_mdp_hands_it(module, shape):
    first = module(frames(*shape))
    second = module(step_mdp(first.clone(), keep_other=True))
    assert second.batch_size == shape
    assert not torch.isclose(first["features"], second["features"]).any()


@pytest.mark.parametrize("shape", [(), (2,), (2, 3, 4)])
@pytest.mark.parametrize(("time", "restart"), [(1, None), (12, None), (12, 7)])
def test_consecutive_steps_equal_the_trajectory_with_a_restart_inside(module, shape, restart, time):
    whole = frames(*shape, time)
    if restart is not None:
        whole["is_init"][(*([0] if shape else []), ..., restart, slice(None))] = True
    step = whole[..., 0].clone()
    for t in range(time):
        step.update(whole[..., t].select("value", "is_init"))
        module(step)
        carried, step = step, step_mdp(step.clone(), keep_other=True)
    with set_recurrent_mode(True):
        module(whole)
    torch.testing.assert_close(carried["features"], whole["features"][..., -1, :])
    for key in module.out_keys:
        if key[0] == "next":
            last = whole[key].select(len(shape), time - 1)
            torch.testing.assert_close(carried[key], last)


def test_padded_data_are_taken(module):
    assert module(pad(frames(3), [0, 5]))["features"].shape == (8, HIDDEN)


@pytest.mark.parametrize("over_time", [False, True])
def test_vmap_over_stacked_parameters_is_a_loop(over_time):
    # PyTorch's fused GRU, in GRUModule and over particles, has no batching rule
    embed = TensorDictModule(nn.Linear(OBS, OBS), ["raw"], ["value"])
    head = TensorDictModule(nn.Linear(HIDDEN, 2), ["features"], ["out"])
    model = TensorDictSequential(embed, belief_filter(), head)
    data = frames(5, 6).rename_key_("value", "raw")
    data["is_init"][1, 3] = True
    params = TensorDict.from_module(model).detach()
    stacked = torch.stack([params, params * 0.9])

    def call(data, params):
        with set_recurrent_mode(over_time), params.to_module(model):
            return model(data.clone())["out"]

    received = torch.vmap(call, (None, 0))(data, stacked)
    expected = torch.stack([call(data, part) for part in stacked.unbind(0)])
    torch.testing.assert_close(received, expected, rtol=1e-4, atol=1e-5)
