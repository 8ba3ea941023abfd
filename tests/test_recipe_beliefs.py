"""Every belief of conf/belief, found on disk, and a critic that reads the complete observation.

A new belief is tested here without an edit. gru_action reads the action and gru does not;
filling keeps the last value.
"""

import functools

import pytest
import recipe_tools
import torch
from evaluation.trained import load_trained_agent
from ppo_drbpn import train_rollout
from recipe_tools import BELIEFS, assembled, differences, make_config, read_table, refused, run
from suites import ACTION, OBS, RecipeBeliefSuite, saved
from torchrl.modules import set_recurrent_mode
from training.config import build
from training.envs import make_env
from training.ppo import add_advantages
from training.run_folder import metric_columns

# Choices inside a belief that change what it reads, writes or remembers.
FURTHER = [
    "drbpn belief.policy_input=mean_cov belief.transition.cov_network=true",
    "fill belief.with_mask=true",
    "gru belief.cell=lstm",
    "none belief.with_mask=true",
    "transformer belief.window=4",
]


@functools.cache
def settings_of(name):
    return make_config(*f"belief={name}".split()).belief


class TestEveryBelief(RecipeBeliefSuite):
    @pytest.fixture(autouse=True, params=[*BELIEFS, *FURTHER])
    def _name(self, request):
        self.name = request.param

    def make_belief(self, obs=OBS, action=ACTION):
        with torch.random.fork_rng():
            torch.manual_seed(0)
            return build("belief", settings_of(self.name), obs_dim=obs, action_dim=action)


def test_the_beliefs_on_disk_are_found():
    assert {"drbpn", "gru", "gru_action", "fill", "none", "dvrl", "transformer"} <= set(BELIEFS)


@pytest.mark.parametrize("belief", BELIEFS)
def test_its_entry_holds_the_keys_that_its_target_takes(belief):
    entry = settings_of(belief)
    assert entry["name"] == belief
    with refused(r"`belief`: .*colour"):
        build("belief", {**entry, "colour": "red"}, obs_dim=3, action_dim=1)


@pytest.mark.parametrize("belief", [*BELIEFS, "drbpn heads.critic_input=complete"])
def test_a_run_learns_and_goes_on_from_its_files_to_the_last_bit(belief):
    words = ("experiment=smoke", *f"belief={belief}".split())
    whole, config = assembled(*words)
    start = [p.detach().clone() for p in whole.agent.parameters()]
    train_rollout(whole, config)
    state = saved(whole.state_dict())
    row, _ = train_rollout(whole, config)
    expected = saved(whole.state_dict())
    resumed, _ = assembled(*words)
    resumed.load_state_dict(state, "here")
    train_rollout(resumed, config)
    received = saved(resumed.state_dict())
    assert differences(expected, received) == []
    columns = metric_columns(whole.agent.summary())
    assert len(set(columns)) == len(columns)
    assert row.keys() <= set(columns) | {"entropy", "max_ratio", "mean_ratio"}
    numbers = [value for value in row.values() if value is not None]
    assert torch.tensor(numbers, dtype=torch.float64).isfinite().all()
    for old, new in zip(start, whole.agent.parameters(), strict=True):
        assert not torch.equal(old, new)


def test_only_gru_action_reads_the_action():
    for name, reads in (("gru", False), ("gru_action", True)):
        every = TestEveryBelief()
        every.name = name
        frames, changed, module = every.frames(), every.frames(), every.make_belief().module
        changed["previous_action"] += 1.0
        with set_recurrent_mode(True):
            before, after = module(frames)["features"], module(changed)["features"]
        assert torch.equal(before, after) is not reads


def test_filling_holds_the_last_normalised_value_and_the_mean_before_the_first():
    words = ("experiment=smoke", "belief=fill", "missingness=mcar")
    training, _ = assembled(*words)
    training.agent.norm.update(training.collector.rollout())
    training.start_episodes()
    data = training.collector.rollout()
    seen, value, start = data["observed"], data["normalized_observation"], data["is_init"]
    held = torch.zeros_like(value[:, 0])  # 0 is the running mean, which raw 0 may be far from
    never = 0
    for t in range(data.shape[1]):
        held = torch.where(start[:, t], 0.0, held)
        held = torch.where(seen[:, t], value[:, t], held)
        assert torch.equal(data["features"][:, t], held)
        never += int((held == 0).sum())
    assert never > 0
    assert (data["features"][~seen] != 0).float().mean() > 0.5


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
def rollout(belief):
    """Return a training and its second rollout: rows begin in mid-episode, and episodes end."""
    with torch.random.fork_rng():
        gaps = ("missingness=mcar", "missingness.eta=0.5")
        training, data = recipe_tools.second_rollout(*SMOKE, f"belief={belief}", *gaps)
    assert data["next", "done"][:, :-1].any()
    return training, data


def with_advantages(belief):
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


def test_the_trained_agent_acts_where_nothing_complete_is_written(tmp_path):
    assert run(tmp_path / "run", *SMOKE, "total_frames=128") == 0
    trained = load_trained_agent(tmp_path / "run")
    env = trained.environments()(0)
    root = env.reset()
    assert "complete_observation" not in root
    assert trained.agent.policy(root)["action"].isfinite().all()
    table = read_table(tmp_path / "run" / "evaluation.csv")
    assert {row["kind"] for row in table} == {"final"}
