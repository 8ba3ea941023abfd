"""Every belief of conf/belief, found on disk: the duties of all, and a run of each.

A new file there is tested here without an edit. gru_action reads the action and gru does not;
filling keeps the last value. What else one does that others do not stands in
test_transformer_belief.py, test_belief_filter_module.py and test_particle_filter.py.
"""

import functools

import pytest
import torch
from beliefs import Belief
from contracts import ACTION, OBS, RecipeBeliefContract, saved
from omegaconf import DictConfig
from ppo_drbpn import train_rollout
from recipe_tools import BELIEFS, assembled, differences, make_config, refused
from torchrl.modules import set_recurrent_mode
from training.config import build
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
def settings_of(name: str) -> DictConfig:
    return make_config(*f"belief={name}".split()).belief


class TestEveryBelief(RecipeBeliefContract):
    @pytest.fixture(autouse=True, params=[*BELIEFS, *FURTHER])
    def _name(self, request):
        self.name = request.param

    def make_belief(self, obs: int = OBS, action: int = ACTION) -> Belief:
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
    with torch.random.fork_rng():
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
    with torch.random.fork_rng():
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
