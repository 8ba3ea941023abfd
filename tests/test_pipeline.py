"""Belief modules in a GRU's place: TorchRL's collector, GAE and ClipPPOLoss, one code for all."""

import functools

import pytest
import torch
from particle_tools import make_filter as make_particles
from small_agents import ACTION, GAMMA, LMBDA, OBS, TIME, collect, make_agent, make_filter, make_gae
from tensordict import TensorDict, pad
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs.utils import step_mdp
from torchrl.modules import GRUModule, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import generalized_advantage_estimate

from torchrl_drbpn import BeliefFilterModule, BeliefModelLoss, DRBPNLoss, ParticleFilterModule

DTYPE, HIDDEN = torch.float32, 6


def gru(**kwargs):
    out_keys = ["features", ("next", "recurrent_state")]
    keys = {"in_keys": ["observation", "recurrent_state", "is_init"], "out_keys": out_keys}
    return GRUModule(input_size=OBS, hidden_size=HIDDEN, **keys)


def belief_filter(**kwargs):
    return BeliefFilterModule(make_filter(OBS, ACTION, DTYPE, state=HIDDEN), **kwargs)


def particle_filter(**kwargs):
    return ParticleFilterModule(make_particles(OBS, ACTION), **kwargs)


EVERY = pytest.mark.parametrize("make_module", [gru, belief_filter, particle_filter])


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
    outputs = [ClipPPOLoss(agent.policy, agent.value)(data)]
    if make_module is not gru:
        ppo = ClipPPOLoss(agent.actor, agent.critic)
        outputs.append(DRBPNLoss(agent.belief, ppo, BeliefModelLoss())(data))
        assert outputs[1]["loss_model"].isfinite()
    for out in outputs:
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


# What TorchRL's own tests ask of GRUModule, asked of all three.
BARE = {"in_keys": {"observed": None, "previous_action": None}}
without_a_primer = pytest.mark.filterwarnings("ignore:.*make_tensordict_primer:UserWarning")


def frames(*shape):
    value, is_init = torch.ones(*shape, OBS).cumsum(-2), torch.zeros(*shape, 1, dtype=torch.bool)
    return TensorDict({"observation": value, "is_init": is_init}, shape)


@without_a_primer
@EVERY
def test_padded_data_are_taken(make_module):
    padded = pad(frames(3), [0, 5])
    assert make_module(**BARE)(padded)["features"].shape == (8, HIDDEN)


@without_a_primer
@EVERY
@pytest.mark.parametrize("shape", [(), (2,), (2, 3)], ids=str)
def test_a_sequence_with_starts_inside_equals_its_steps(make_module, shape):
    # test_multi_consecutive of GRUModule: sequences in one call, then the same step by step
    module = make_module(**BARE)
    data = frames(*shape, TIME)
    data["is_init"][(0,) * len(shape) + (TIME // 2,)] = True
    with set_recurrent_mode(True):
        whole = module(data.clone())
    step = frames(*shape, 1)[..., 0].select("observation", "is_init")
    for t in range(TIME):
        step.update(data[..., t])
        step = step_mdp(module(step), keep_other=True)
    torch.testing.assert_close(
        step["features"], whole["features"][..., -1, :], rtol=1e-4, atol=1e-5
    )


@without_a_primer
@pytest.mark.parametrize("over_time", [False, True])
def test_vmap_over_stacked_parameters_is_a_loop(over_time):
    # PyTorch's fused GRU, in GRUModule and over particles, has no batching rule
    embed = TensorDictModule(nn.Linear(OBS, OBS), ["raw"], ["observation"])
    head = TensorDictModule(nn.Linear(HIDDEN, 2), ["features"], ["out"])
    model = TensorDictSequential(embed, belief_filter(**BARE), head)
    data = frames(5, 6).rename_key_("observation", "raw")
    data["is_init"][1, 3] = True
    params = TensorDict.from_module(model).detach()
    stacked = torch.stack([params, params * 0.9])

    def call(data, params):
        with set_recurrent_mode(over_time), params.to_module(model):
            return model(data.clone())["out"]

    received = torch.vmap(call, (None, 0))(data, stacked)
    expected = torch.stack([call(data, part) for part in stacked.unbind(0)])
    torch.testing.assert_close(received, expected, rtol=1e-4, atol=1e-5)
