"""What the particle filter is held to as a belief module: its duties, its keys, PPO's invariants.

In a pipeline: on fresh data, before any update, PPO's ratio is 1 although particles are random, and
GAE sees the values of the features that the collector stored. Its mathematics are in
test_particles.py, its networks' laws in test_particle_networks.py.
"""

from __future__ import annotations

import functools

import pytest
import torch
from agents import ACTION as POLE_ACTION
from agents import OBS as POLE_OBS
from agents import Agent, collect, make_agent
from contracts import ACTION, OBS, BeliefModuleContract, StaircaseEnv, with_belief_entries
from particle_tools import HIDDEN, LATENT, OPTIONAL, K, make_filter, make_frames
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import step_mdp
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.objectives.value.functional import generalized_advantage_estimate

from torchrl_drbpn import BeliefModelLoss, DRBPNLoss, ParticleFilterModule


# ---------------------------------------------------------------------------------------- duties
class TestContract(BeliefModuleContract):
    all_outputs = ("features", ("belief", "log_likelihood"), *OPTIONAL)

    def make_module(self, obs=OBS, action=ACTION, dtype=None, **kwargs):
        return ParticleFilterModule(make_filter(obs, action, dtype), **kwargs)

    def differentiable(self, out: TensorDictBase) -> Tensor:
        return out["features"].square().mean() - out["belief", "log_likelihood"].mean()


# ------------------------------------------------------------------------------- keys of its own
def test_the_keys_are_those_of_the_belief_filter_with_particles_for_the_mean():
    module = ParticleFilterModule(make_filter())
    state = [("recurrent", "particles"), ("recurrent", "log_weight"), ("recurrent", "age")]
    assert module.in_keys == ["observation", "observed", "previous_action", "is_init", *state]
    assert module.out_keys == [
        "features",
        ("belief", "log_likelihood"),
        *(("next", *key) for key in state),
    ]
    assert module.feature_dim == HIDDEN


def test_a_list_of_four_or_seven_in_keys_renames_by_position():
    four = ["a", ("b", "c"), "d", "e"]
    module = ParticleFilterModule(make_filter(), in_keys=four)
    assert module.in_keys[:4] == four
    module = ParticleFilterModule(make_filter(), in_keys=[*four, "f", "g", ("h", "i")])
    assert set(module.make_tensordict_primer().primers.keys(True, True)) == {"f", "g", ("h", "i")}
    assert module.out_keys[-3:] == [("next", "f"), ("next", "g"), ("next", "h", "i")]


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


def test_a_mask_of_numbers_is_refused():
    data = make_frames((3, 4))
    data["observed"] = data["observed"].double()
    module = ParticleFilterModule(make_filter(dtype=torch.float64))
    with set_recurrent_mode(True), pytest.raises((ValueError, RuntimeError), match="bool"):
        module(data)


# ------------------------------------------------------------------------------ in a pipeline
@functools.cache
def agent_and_rollout() -> tuple[Agent, TensorDictBase]:
    filter = make_filter(POLE_OBS, POLE_ACTION)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        agent = make_agent(ParticleFilterModule(filter), HIDDEN, dtype=torch.float32)
    return agent, collect(agent, dtype=torch.float32)


def make_gae(agent: Agent) -> GAE:
    return GAE(
        gamma=0.99, lmbda=0.95, value_network=agent.value, shifted=False, deactivate_vmap=True
    )


@pytest.mark.parametrize("loss", ["ClipPPOLoss", "DRBPNLoss"])
def test_on_fresh_data_the_ratio_and_the_effective_sample_size_are_one(loss):
    agent, data = agent_and_rollout()
    data = data.clone()
    assert data["is_init"][:, 1:].any()
    assert not data["is_init"][:, 0].all()
    with set_recurrent_mode(True), torch.no_grad():
        make_gae(agent)(data)
    if loss == "ClipPPOLoss":
        out = ClipPPOLoss(agent.policy, agent.value)(data)
    else:
        ppo = ClipPPOLoss(agent.actor, agent.critic)
        out = DRBPNLoss(agent.belief, ppo, BeliefModelLoss())(data)
        assert out["loss_model"].isfinite()
    torch.testing.assert_close(out["ESS"], torch.ones_like(out["ESS"]), rtol=1e-4, atol=0)
    assert out["max_ratio"].item() == pytest.approx(1, abs=1e-4)
    assert out["mean_ratio"].item() == pytest.approx(1, abs=1e-4)
    assert out["kl_approx"].item() == pytest.approx(0, abs=1e-4)


def test_sequences_cut_from_a_rollout_replay_its_particles():
    agent, data = agent_and_rollout()
    pieces = data.reshape(-1, 6)
    with set_recurrent_mode(True), torch.no_grad():
        again = agent.belief(pieces.select(*agent.belief.in_keys))
    for key in ("features", ("belief", "log_likelihood"), ("next", "recurrent", "particles")):
        torch.testing.assert_close(again[key], pieces[key], rtol=1e-4, atol=1e-4)


def test_gae_sees_the_values_of_stored_and_next_features():
    agent, data = agent_and_rollout()
    through = data.clone()
    with set_recurrent_mode(True), torch.no_grad():
        make_gae(agent)(through)
    with torch.no_grad():
        value = agent.critic.module(data["features"])
        following = step_mdp(data, keep_other=False).select(*agent.belief.in_keys)
        with set_recurrent_mode(False):
            next_value = agent.critic.module(agent.belief(following)["features"])
    going_on = ~data["next", "done"][:, :-1]
    torch.testing.assert_close(
        next_value[:, :-1][going_on], value[:, 1:][going_on], rtol=1e-4, atol=1e-4
    )
    advantage, _ = generalized_advantage_estimate(
        0.99,
        0.95,
        value,
        next_value,
        data["next", "reward"],
        data["next", "done"],
        data["next", "terminated"],
    )
    torch.testing.assert_close(through["advantage"], advantage, rtol=1e-4, atol=1e-4)


def test_the_model_is_learned_by_the_loss_that_learns_the_belief_filter():
    # a staircase observed through a mask: the bound rises
    with torch.random.fork_rng():
        torch.manual_seed(0)
        module = ParticleFilterModule(make_filter(num_particles=3))
        env = with_belief_entries(
            TransformedEnv(StaircaseEnv(horizon=20), Compose()), module.make_tensordict_primer()
        )
        data = env.rollout(16, break_when_any_done=False)
        data["observation"] *= 0.01
        data["next", "observation"] *= 0.01
        loss, optimizer = BeliefModelLoss(), torch.optim.Adam(module.parameters(), lr=1e-2)
        history = []
        for _ in range(40):
            with set_recurrent_mode(True):
                value = loss(module(data.select(*module.in_keys, "observed")))["loss_model"]
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
            history.append(value.item())
    assert history[-1] < history[0] - 0.5
