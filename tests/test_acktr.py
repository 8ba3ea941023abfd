"""ACKTR behind the recipe's one path (`algo=acktr`)."""

import shutil

import pytest
import torch
from algorithms.acktr import ACKTR
from ppo_drbpn import collect, train_rollout
from recipe_tools import assembled, assert_same_run, read_table, resume, run
from tensordict import TensorDictBase
from training.checkpoint import last_checkpoint, load_checkpoint
from training.ppo import add_advantages
from training.state import Training

SMOKE = ("algo=acktr", "belief=none", "experiment=[smoke,clean]", "algo.critic.steps=3")


@pytest.fixture(scope="module")
def acktr(tmp_path_factory):
    """Run the smoke experiment once, to its end."""
    folder = tmp_path_factory.mktemp("run") / "smoke"
    assert run(folder, *SMOKE) == 0
    return folder


def rollout_of(*overrides: str) -> tuple[Training, TensorDictBase]:
    """A freshly assembled training and its first rollout, with advantages."""
    training, _ = assembled(*SMOKE, *overrides)
    assert isinstance(training.algorithm, ACKTR)
    data = collect(training)
    add_advantages(data, training.agent, training.gae)
    return training, data


def test_a_run_leaves_its_numbers_and_no_column_of_ppo(acktr):
    rows = read_table(acktr / "metrics.csv")
    assert [int(row["frames"]) for row in rows] == [128, 256, 384, 512]
    filled = {key for key, value in rows[-1].items() if value}
    assert {"return", "kl", "lr", "loss_objective", "loss_critic", "grad_norm"} < filled
    assert {"clip_fraction", "ess", "loss_model"}.isdisjoint(filled)
    assert len(read_table(acktr / "evaluation.csv")) == 4


def test_a_stopped_run_goes_on_to_the_last_bit(acktr, tmp_path):
    broken = shutil.copytree(acktr, tmp_path / "broken")
    last_checkpoint(broken).unlink()
    assert resume(broken) == 0
    assert_same_run(acktr, broken)
    state = load_checkpoint(last_checkpoint(broken))
    assert state["policy_optimizer"]["state"]
    assert state["critic_optimizer"]["state"]


def test_the_value_comes_nearer_to_its_targets():
    training, data = rollout_of("algo.critic.steps=25", "algo.critic.lr=0.1")

    def error():
        with torch.no_grad():
            value = training.agent.value(data)
        return (value - data.get("value_target")).square().mean().item() / 2

    before = error()
    row = training.algorithm.update(data, 1.0)
    assert row["loss_critic"] == pytest.approx(before, rel=1e-4)
    assert error() < 0.5 * before


def test_the_policy_climbs_its_objective_and_reports_its_divergence():
    training, data = rollout_of("algo.policy.momentum=0", "algo.policy.lr=0.2")
    advantage = data.get("advantage").squeeze(-1)
    advantage = (advantage - advantage.mean()) / advantage.std()
    old = training.agent.actor.get_dist(data.select("features"))
    row = training.algorithm.update(data, 1.0)
    with torch.no_grad():
        new = training.agent.actor.get_dist(data.select("features"))
        ratio = new.log_prob(data["action"]) - old.log_prob(data["action"])
    assert (ratio * advantage).mean() > 0
    kl = torch.distributions.kl_divergence(old, new).mean().item()
    assert row["kl"] == pytest.approx(kl, rel=1e-3)
    assert 0 < kl < 2 * 5e-3  # within reach of the trust region's 5e-3


@pytest.mark.parametrize(
    ("desired", "factor"), [(1e-9, 1 / 1.5), (1.0, 1.5)], ids=["too far", "too near"]
)
def test_the_step_size_follows_the_divergence(desired, factor):
    training, data = rollout_of(f"algo.desired_kl={desired}", "algo.policy.momentum=0")
    steps = [training.algorithm.update(data, 1.0)["lr"] for _ in range(2)]
    assert steps[0] == 0.03
    assert steps[1] == pytest.approx(0.03 * factor)


@pytest.mark.slow
def test_the_divergence_comes_to_the_one_asked_for():
    training, config = assembled(*SMOKE, "algo.policy.momentum=0.5")
    kls = [train_rollout(training, config)[0]["kl"] for _ in range(40)]
    assert 0.001 < sum(kls[20:]) / 20 < 0.004


def test_the_generator_of_the_whole_process_is_left_alone():
    training, data = rollout_of()
    before = torch.get_rng_state()
    training.algorithm.update(data, 1.0)
    assert torch.equal(before, torch.get_rng_state())
