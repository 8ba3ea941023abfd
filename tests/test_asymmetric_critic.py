"""heads.critic_input=complete: the value reads the complete observation, the policy never does."""

import functools

import pytest
import torch
from ppo_drbpn import collect
from recipe_tools import assembled, make_config, read_table, run
from training.envs import make_env
from training.ppo import add_advantages, to_sequences

# A filter, a network with memory, and no memory.
KINDS = ("drbpn", "gru", "none")
COMPLETE = "normalized_complete_observation"
SMOKE = ("experiment=smoke", "heads.critic_input=complete")
CORRUPTION = {
    "noise and gaps": ("missingness=mcar", "missingness.eta=0.5", "noise.sigma=10"),
    "gaps": ("missingness=mcar", "missingness.eta=0.5", "noise=none"),
    "noise": ("missingness=none", "noise.sigma=10"),
    "spikes and outages": ("missingness=outages", "noise=spikes"),
    "nothing": ("missingness=none", "noise=none"),
}


@functools.cache
def rollout(belief: str):
    """Return a training and its second rollout: rows begin in mid-episode, and episodes end."""
    with torch.random.fork_rng():
        gaps = ("missingness=mcar", "missingness.eta=0.5")
        training, _ = assembled(*SMOKE, f"belief={belief}", *gaps)
        training.agent.norm.update(collect(training))
        collect(training)
        data = collect(training).clone()
    assert data["next", "done"][:, :-1].any()
    return training, data


def with_advantages(belief: str):
    training, data = rollout(belief)
    data = data.clone()
    add_advantages(data, training.agent, training.gae)
    return training, data


@pytest.mark.parametrize("corruption", CORRUPTION.values(), ids=CORRUPTION)
def test_the_complete_observation_is_what_complete_noiseless_sensors_show(corruption):
    env = make_env(make_config(*SMOKE, *corruption), num_envs=64, seed=3)
    nothing = make_config(*SMOKE, *CORRUPTION["nothing"])
    clean = make_env(nothing, num_envs=64, seed=3, complete=False)
    data, expected = env.reset(), clean.reset()
    assert "complete_observation" not in expected
    for _ in range(2):
        shown = data["complete_observation"]
        assert torch.equal(shown, expected["observation"])
        corrupted = corruption != CORRUPTION["nothing"]
        assert torch.equal(shown, data["observation"]) is not corrupted
        action = torch.full_like(data["previous_action"], 0.5)
        data = env.step(data.set("action", action))["next"]
        expected = clean.step(expected.set("action", action))["next"]


def test_by_default_nothing_complete_is_written():
    with torch.random.fork_rng():
        training, _ = assembled("experiment=smoke")
    assert "complete_observation" not in training.env.full_observation_spec.keys(True, True)
    assert training.agent.critic.in_keys == ["features"]


@pytest.mark.parametrize("belief", KINDS)
def test_the_critic_reads_it_and_the_policy_does_not(belief):
    training, data = rollout(belief)
    assert COMPLETE in training.algorithm.loss.in_keys
    scaled = training.agent.norm.normalize(data["complete_observation"])  # as the observations are
    torch.testing.assert_close(data[COMPLETE], scaled)
    step = data[:, 5].select(*training.agent.policy.in_keys)
    assert COMPLETE not in step
    for part in (training.agent.actor, training.agent.belief):
        assert COMPLETE not in part.in_keys
    step = step.exclude("complete_observation")
    blind = step.clone().set(COMPLETE, torch.full_like(data[COMPLETE][:, 5], torch.nan))
    expected, received = training.agent.policy(step), training.agent.policy(blind)
    for key in ("features", "loc", "scale"):
        assert received[key].isfinite().all()
        assert torch.equal(received[key], expected[key])


@pytest.mark.parametrize("belief", KINDS)
def test_the_values_of_the_advantages_are_those_of_the_complete_observations(belief):
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
    add_advantages(again, training.agent, training.gae, recompute=True)
    for key in ("state_value", ("next", "state_value"), "advantage"):
        torch.testing.assert_close(again[key], data[key], rtol=1e-3, atol=1e-4)
    # and it reads the next complete observation where the episode ends or the rollout is cut
    changed = rollout(belief)[1]["next"].clone()
    changed[COMPLETE] += 1.0
    moved = training.agent.one_step_value(changed)
    assert (moved != data["next", "state_value"]).all()


@pytest.mark.parametrize("belief", KINDS)
def test_every_belief_trains_with_it(belief):
    training, data = with_advantages(belief)
    out = training.algorithm.loss(to_sequences(data, training.algorithm.loss, 16))
    assert out["max_ratio"].item() == pytest.approx(1, abs=1e-4)
    first = training.agent.critic.module[0]
    (grad,) = torch.autograd.grad(out["loss_critic"], first.weight, retain_graph=True)
    assert grad[:, -data[COMPLETE].shape[-1] :].abs().min() > 0


def test_the_trained_agent_acts_where_nothing_complete_is_written(tmp_path):
    from evaluation.trained import load_trained_agent

    assert run(tmp_path / "run", *SMOKE, "total_frames=128") == 0
    trained = load_trained_agent(tmp_path / "run")
    env = trained.environments()(0)
    root = env.reset()
    assert "complete_observation" not in root
    assert trained.agent.policy(root)["action"].isfinite().all()
    table = read_table(tmp_path / "run" / "evaluation.csv")
    assert {row["kind"] for row in table} == {"final"}
