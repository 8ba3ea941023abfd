"""heads.critic_input=complete: the value reads the complete observation, the policy never does.

For every belief of conf/belief: what the critic is shown is what complete, noiseless sensors would
have shown, at the root and at the next step; advantages come from it; nothing that acts reads it;
a stopped run goes on to the last bit, and the trained agent acts where it is not written.
"""

from __future__ import annotations

import functools
from pathlib import Path

import pytest
import recipe_tools
import torch
from contracts import saved
from recipe_tools import BELIEFS, differences, make_config
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv

from torchrl_drbpn import MaskedObservationNorm

COMPLETE = "complete_observation"
SMOKE = ("experiment=smoke", "heads.critic_input=complete")
CORRUPTION = {
    "noise and gaps": ("missingness=mcar", "missingness.eta=0.5", "noise.sigma=10"),
    "gaps": ("missingness=mcar", "missingness.eta=0.5", "noise=none"),
    "noise": ("missingness=none", "noise.sigma=10"),
    "spikes and outages": ("missingness=outages", "noise=spikes"),
    "nothing": ("missingness=none", "noise=none"),
}


def assemble(*overrides: str):
    from training.config import read_settings
    from training.loop import assemble as assembled

    settings = read_settings(make_config(*SMOKE, *overrides))
    return assembled(settings), settings


@functools.cache
def rollout(belief: str):
    """Return a training and its second rollout: rows begin in mid-episode, and episodes end."""
    with torch.random.fork_rng():
        training, _ = assemble(f"belief={belief}", "missingness=mcar", "missingness.eta=0.5")
        training.collector.rollout()
        data = training.collector.rollout().clone()
    assert data["next", "done"][:, :-1].any()
    return training, data


def with_advantages(belief: str):
    from training.rollout import add_advantages

    training, data = rollout(belief)
    data = data.clone()
    add_advantages(data, training.agent, training.algorithm.gae)
    return training, data


# ------------------------------------------------------------------------------ what it is shown
def raw(env: TransformedEnv, data: TensorDictBase, key: str) -> torch.Tensor:
    (norm,) = (t for t in env.transform if isinstance(t, MaskedObservationNorm))
    return norm.denormalize(data[key])


@pytest.mark.parametrize("corruption", CORRUPTION.values(), ids=CORRUPTION)
def test_the_complete_observation_is_what_complete_noiseless_sensors_show(corruption):
    from training.config import read_settings
    from training.envs import make_environment

    def make(*overrides, complete):
        s = read_settings(make_config(*SMOKE, *overrides))
        return make_environment(
            s.env,
            s.missingness,
            s.noise,
            s.normalisation,
            num_envs=64,
            num_threads=1,
            gamma=s.loss.gamma,
            seed=3,
            complete=complete,
        )

    env = make(*corruption, complete=True)
    clean = make(*CORRUPTION["nothing"], complete=False)
    data, expected = env.reset(), clean.reset()
    assert COMPLETE not in expected
    for _ in range(2):
        # float32 through two normalisations of different statistics
        shown, truth = raw(env, data, COMPLETE), raw(clean, expected, "observation")
        torch.testing.assert_close(shown, truth, rtol=1e-4, atol=1e-6)
        corrupted = corruption != CORRUPTION["nothing"]
        assert torch.equal(data[COMPLETE], data["observation"]) is not corrupted
        action = torch.full_like(data["previous_action"], 0.5)
        data = env.step(data.set("action", action))["next"]
        expected = clean.step(expected.set("action", action))["next"]


def test_by_default_nothing_complete_is_written():
    from training.config import read_settings
    from training.loop import assemble as assembled

    with torch.random.fork_rng():
        training = assembled(read_settings(make_config("experiment=smoke")))
    assert COMPLETE not in training.env.full_observation_spec.keys(True, True)
    assert training.agent.critic.in_keys == ["features"]


# ------------------------------------------------------------------------------ who reads it
@pytest.mark.parametrize("belief", BELIEFS)
def test_the_critic_reads_it_and_the_policy_does_not(belief):
    training, data = rollout(belief)
    assert COMPLETE in training.algorithm.loss.in_keys
    step = data[:, 5].select(*training.agent.policy.in_keys)
    assert COMPLETE not in step
    for part in (training.agent.policy, training.agent.actor, training.agent.belief):
        assert COMPLETE not in part.in_keys
    blind = step.clone().set(COMPLETE, torch.full_like(data[COMPLETE][:, 5], torch.nan))
    expected, received = training.agent.policy(step), training.agent.policy(blind)
    for key in ("features", "loc", "scale"):
        assert received[key].isfinite().all()
        assert torch.equal(received[key], expected[key])


@pytest.mark.parametrize("belief", BELIEFS)
def test_the_values_of_the_advantages_are_those_of_the_complete_observations(belief):
    from training.rollout import recompute_advantages

    training, data = with_advantages(belief)
    critic = training.agent.critic.module
    with torch.no_grad():
        expected = critic(data["features"], data[COMPLETE])
    torch.testing.assert_close(data["state_value"], expected)
    # the value of what follows is the value stored there, wherever the episode goes on
    goes_on = ~data["next", "done"][:, :-1]
    following, stored = data["next", "state_value"][:, :-1], data["state_value"][:, 1:]
    torch.testing.assert_close(following[goes_on], stored[goes_on], rtol=1e-4, atol=1e-4)
    # advantages that are recomputed in later epochs see it too
    again = data.clone()
    recompute_advantages(again, training.agent, training.algorithm.gae)
    for key in ("state_value", ("next", "state_value"), "advantage"):
        torch.testing.assert_close(again[key], data[key], rtol=1e-3, atol=1e-4)
    # and it reads the next complete observation where the episode ends or the rollout is cut
    changed = rollout(belief)[1]["next"].clone()
    changed[COMPLETE] += 1.0
    moved = training.agent.one_step_value(changed)
    assert (moved != data["next", "state_value"]).all()


@pytest.mark.parametrize("belief", BELIEFS)
def test_every_belief_trains_with_it(belief):
    from training.loop import train_rollout
    from training.rollout import to_sequences

    training, data = with_advantages(belief)
    out = training.algorithm.loss(to_sequences(data, training.algorithm.loss, 16))
    assert out["max_ratio"].item() == pytest.approx(1, abs=1e-4)
    first = training.agent.critic.module[0]
    (grad,) = torch.autograd.grad(out["loss_critic"], first.weight, retain_graph=True)
    assert grad[:, -data[COMPLETE].shape[-1] :].abs().min() > 0
    with torch.random.fork_rng():
        training, settings = assemble(f"belief={belief}")
        before = [p.clone() for p in training.agent.critic.parameters()]
        row, _ = train_rollout(training, settings)
    values = [value for value in row.values() if isinstance(value, float)]
    assert torch.tensor(values).isfinite().all()
    after = training.agent.critic.parameters()
    assert all((new != old).any() for new, old in zip(after, before, strict=True))


# ------------------------------------------------------------------------------ files
def test_a_stopped_run_goes_on_to_the_last_bit():
    from training.loop import restore, train_rollout, training_state

    with torch.random.fork_rng():
        whole, settings = assemble()
        train_rollout(whole, settings)
        state = saved(training_state(whole))
        train_rollout(whole, settings)
        expected = saved(training_state(whole))
        resumed, _ = assemble()
        restore(resumed, state, "here")
        train_rollout(resumed, settings)
        received = saved(training_state(resumed))
    assert COMPLETE in state["carrier"]
    assert differences(expected, received) == []


def test_the_trained_agent_acts_where_nothing_complete_is_written(tmp_path: Path):
    from evaluation.episodes import evaluate
    from evaluation.trained import load_trained_agent
    from training.run import run

    with torch.random.fork_rng():
        assert run(make_config(*SMOKE, "total_frames=128"), tmp_path / "run") == 0
        trained = load_trained_agent(tmp_path / "run")
    make_env = trained.environments()
    assert COMPLETE not in make_env(0).reset()
    result = evaluate(trained.agent.policy, make_env, episodes=2, mode="mean", seed=0)
    assert result is not None
    table = recipe_tools.read_table(tmp_path / "run" / "evaluation.csv")
    assert {row["kind"] for row in table} == {"final"}
