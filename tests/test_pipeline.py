"""Belief modules in a GRU's place: TorchRL's collector, GAE, ClipPPOLoss, stacked parameters."""

import functools

import pytest
import torch
from particle_tools import make_filter as make_particles
from small_agents import ACTION, GAMMA, LMBDA, OBS, TIME, collect, make_agent, make_filter, make_gae
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs.utils import step_mdp
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import generalized_advantage_estimate

from torchrl_drbpn import BeliefFilterModule, ParticleFilterModule

DTYPE, HIDDEN = torch.float32, 6


def belief_filter(**kwargs):
    return BeliefFilterModule(make_filter(OBS, ACTION, DTYPE, state=HIDDEN), **kwargs)


def particle_filter():
    return ParticleFilterModule(make_particles(OBS, ACTION))


EVERY = pytest.mark.parametrize("make_module", [belief_filter, particle_filter])


@functools.cache
def agent_and_rollout(make_module):
    with torch.random.fork_rng():
        torch.manual_seed(0)
        agent = make_agent(make_module(), HIDDEN, dtype=DTYPE)
    return agent, collect(agent, dtype=DTYPE)


@EVERY
def test_on_fresh_data_the_ratio_and_the_effective_sample_size_are_one(make_module):
    agent, data = agent_and_rollout(make_module)
    data = data.clone()
    assert data["is_init"][:, 1:].any()
    assert not data["is_init"][:, 0].all()
    with set_recurrent_mode(True), torch.no_grad():
        make_gae(agent)(data)
    out = ClipPPOLoss(agent.policy, agent.value)(data)
    torch.testing.assert_close(out["ESS"], torch.ones_like(out["ESS"]), rtol=1e-4, atol=0)
    assert out["max_ratio"].item() == pytest.approx(1, abs=1e-4)
    assert out["mean_ratio"].item() == pytest.approx(1, abs=1e-4)
    assert out["kl_approx"].item() == pytest.approx(0, abs=1e-4)


@pytest.mark.parametrize("shifted", [False, True])
@EVERY
def test_gae_reads_the_values_of_stored_and_next_beliefs(make_module, shifted):
    agent, data = agent_and_rollout(make_module)
    through = data.clone()
    with set_recurrent_mode(True), torch.no_grad():
        # one pass over the sequence and, where an episode is truncated, its last observation
        make_gae(agent, shifted=shifted, shifted_budget=TIME)(through)

    with torch.no_grad():
        value = agent.critic.module(data["features"])
        # one step from the stored state at t + 1, for all steps at once
        following = step_mdp(data, keep_other=False).select(*agent.belief.in_keys)
        with set_recurrent_mode(False):
            next_value = agent.critic.module(agent.belief(following)["features"])
        ends = (data["next", key] for key in ("reward", "done", "terminated"))
        advantage, target = generalized_advantage_estimate(GAMMA, LMBDA, value, next_value, *ends)
    assert data["next", "truncated"][:, :-1].any()
    assert through.get("shifted_valid", torch.ones(())).all()
    limit = 1e-4 if make_module is particle_filter else 1e-5
    scale = advantage.abs().max().item()
    torch.testing.assert_close(through["advantage"], advantage, rtol=limit, atol=limit * scale)
    torch.testing.assert_close(through["value_target"], target, rtol=limit, atol=limit * scale)


@pytest.mark.filterwarnings("ignore:.*make_tensordict_primer:UserWarning")
@pytest.mark.parametrize("over_time", [False, True])
def test_vmap_over_stacked_parameters_is_a_loop(over_time):
    # PyTorch's fused GRU, over particles, has no batching rule
    bare = belief_filter(in_keys={"observed": None, "previous_action": None})
    embed = TensorDictModule(nn.Linear(OBS, OBS), ["raw"], ["observation"])
    head = TensorDictModule(nn.Linear(HIDDEN, 2), ["features"], ["out"])
    model = TensorDictSequential(embed, bare, head)
    value, is_init = torch.ones(5, 6, OBS).cumsum(-2), torch.zeros(5, 6, 1, dtype=torch.bool)
    is_init[1, 3] = True
    data = TensorDict({"raw": value, "is_init": is_init}, [5, 6])
    params = TensorDict.from_module(model).detach()
    stacked = torch.stack([params, params * 0.9])

    def call(data, params):
        with set_recurrent_mode(over_time), params.to_module(model):
            return model(data.clone())["out"]

    received = torch.vmap(call, (None, 0))(data, stacked)
    expected = torch.stack([call(data, part) for part in stacked.unbind(0)])
    torch.testing.assert_close(received, expected, rtol=1e-4, atol=1e-5)
