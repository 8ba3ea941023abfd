"""Belief modules in a GRU's place: TorchRL's collector, GAE and ClipPPOLoss, one code for all."""

from __future__ import annotations

import functools

import pytest
import torch
from particle_tools import make_filter as make_particles
from small_agents import (
    ACTION,
    GAMMA,
    LMBDA,
    OBS,
    TIME,
    Agent,
    collect,
    make_agent,
    make_env,
    make_filter,
    make_gae,
)
from tensordict import TensorDictBase
from torchrl.envs.utils import step_mdp
from torchrl.modules import GRUModule, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value.functional import generalized_advantage_estimate

from torchrl_drbpn import BeliefFilterModule, BeliefModelLoss, DRBPNLoss, ParticleFilterModule

DTYPE = torch.float32


def gru() -> GRUModule:
    return GRUModule(
        input_size=OBS,
        hidden_size=6,
        in_keys=["observation", "recurrent_state", "is_init"],
        out_keys=["features", ("next", "recurrent_state")],
    )


def belief_filter() -> BeliefFilterModule:
    return BeliefFilterModule(make_filter(OBS, ACTION, DTYPE, state=6))


def particle_filter() -> ParticleFilterModule:
    return ParticleFilterModule(make_particles(OBS, ACTION))


EVERY = pytest.mark.parametrize("make_module", [gru, belief_filter, particle_filter])


@functools.cache
def agent_and_rollout(make_module) -> tuple[Agent, TensorDictBase]:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        agent = make_agent(make_module(), 6, dtype=DTYPE)
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


def test_without_its_primer_the_filter_says_so_where_a_gru_is_silent():
    agent = make_agent(belief_filter(), 6, dtype=DTYPE)
    with pytest.warns(UserWarning, match=r"make_tensordict_primer\(\)"), torch.no_grad():
        data = make_env(DTYPE).rollout(4, agent.policy, break_when_any_done=False)
    # nothing is remembered: every step starts from the initial belief
    with set_recurrent_mode(False), torch.no_grad():
        step = data[:, 2].select("observation", "observed", "previous_action", "is_init")
        alone = agent.belief(step)["features"]
    assert torch.equal(alone, data["features"][:, 2])
