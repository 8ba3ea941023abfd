"""Conditions of an evaluation, and the sensors that are removed."""

import numpy as np
import pytest
import torch
from evaluation.conditions import default_conditions, removed_sensors
from evaluation.sensor_choice import kept_sensors
from evaluation.trained import load_trained_agent
from evaluation_tools import configured, evaluate, parse
from recipe_tools import refused

from torchrl_drbpn.functional import draw_mechanism


@pytest.fixture(scope="module")
def settings(agent):
    return agent.settings


NAMES = (
    "trained -> mcar:0.4, none:0 -> none:0, nmar:.5 -> nmar:0.5, "
    "outages:0.5:20 -> outages:0.5:20:sensor, outages:0.2:5:kind -> outages:0.2:5:kind, "
    "reduction:0.4:model -> reduction:0.4:model, noise:2 -> noise:2, "
    "spikes:0.05 -> spikes:0.05:5, spikes:0.05:2 -> spikes:0.05:2, "
    "stuck:.05 -> stuck:0.05:20:sensor, stuck:0.05:5:joint -> stuck:0.05:5:joint, "
    "drift:0.02 -> drift:0.02:0, drift:0:-0.1 -> drift:0:-0.1, delay:2 -> delay:2, "
    "delay:0:3 -> delay:0:3:sensor, delay:1:3:kind:in_order -> delay:1:3:kind:in_order, "
    "multi_rate:4 -> multi_rate:4:sensor, multi_rate:4:joint:0 -> multi_rate:4:joint:0"
)


@pytest.mark.parametrize(("text", "name"), [pair.split(" -> ") for pair in NAMES.split(", ")])
def test_the_full_name_of_a_condition_reads_back_to_it(text, name, settings):
    condition = parse(text, settings)
    assert condition.name == name
    assert parse(name, settings) == condition


def test_a_condition_leaves_what_it_does_not_name_as_in_training(settings):
    for text in ("noise:3", "spikes:0.1", "stuck:0.1", "drift:1"):
        assert parse(text, settings).missingness == settings.missingness
    for text in ("mar:0.5", "outages:0.5:20", "delay:1", "multi_rate:2", "reduction:0.5:random"):
        assert parse(text, settings).noise == settings.noise
    spiked = parse("spikes:0.1:7", settings).noise
    assert spiked == {**settings.noise, "spike_probability": 0.1, "spike_std": 7.0}


@pytest.mark.parametrize(
    "text",
    ["fog:0.5", "mcar", "mcar:x", "", "outages:0.5", "outages:0.5:20:leg", "reduction:0.5",
     "reduction:0.5:luck", "noise", "noise:-1", "spikes:1.5", "spikes:0.1:inf", "mcar:0.5:3",
     "reduction:1.2:model", "mcar:1.5", "delay:-1", "delay:1.5", "delay:3:2", "delay:1:2:sensor:x",
     "multi_rate:0", "multi_rate:2:sensor:2", "stuck:2", "stuck:0.1:0.5", "drift:-1", "drift:nan"],
)  # fmt: skip
def test_a_condition_that_can_not_be_read_is_refused(text, settings):
    with refused("`points` must hold ") as error:
        parse(text, settings)
    assert repr(text) in str(error.value)


def test_the_default_conditions_are_those_of_the_paper_and_the_full_ones_go_beyond(settings):
    levels = configured()["grid"]
    usual = default_conditions(levels, full=False, model=True)
    ratios = ("0.2", "0.4", "0.5", "0.6", "0.8")
    families = ("mcar:{}", "mar:{}", "reduction:{}:model", "reduction:{}:random")
    assert usual == ["none:0", *(f.format(ratio) for f in families for ratio in ratios)]
    assert not any("model" in c for c in default_conditions(levels, full=True, model=False))
    full = default_conditions(levels, full=True, model=True)
    # A sensor that is off half of the time has outages of at least one step.
    lengths, groups = (1, 2, 5, 10, 20, 50), ("sensor", "joint", "kind")
    beyond = [f"nmar:{ratio}" for ratio in ratios]
    beyond += [f"outages:0.5:{length}:{by}" for by in groups for length in lengths]
    beyond += [f"noise:{sigma}" for sigma in (0, 1, 3, 10, 30)]
    beyond += [f"spikes:{probability}" for probability in (0.01, 0.05, 0.1, 0.2)]
    beyond += [f"stuck:{probability}" for probability in (0.002, 0.01, 0.05)]
    beyond += [f"drift:{std}" for std in (0.003, 0.01, 0.03)]
    beyond += [f"delay:{steps}" for steps in (1, 2, 4)]
    beyond += [f"multi_rate:{period}" for period in (2, 4, 8)]
    assert sorted(full) == sorted([*usual, *beyond])
    for text in full:
        parse(text, settings)


def test_mean_lengths_that_no_chain_has_are_left_out_and_refused(settings):
    levels = dict.fromkeys(configured()["grid"], ()) | {
        "outage_ratios": [0.8], "outage_lengths": [1, 2, 4, 20], "outage_groups": ["sensor"],
    }  # fmt: skip
    texts = default_conditions(levels, full=True, model=False)
    assert texts == ["outages:0.8:4:sensor", "outages:0.8:20:sensor"]
    with refused("`mean_length` must be at least eta"):
        parse("outages:0.8:2", settings)


def test_each_family_changes_what_the_agent_gets(drbpn, tmp_path):
    texts = ("noise:0", "outages:0.5:3:kind", "reduction:0.5:random", "reduction:0.5:model")
    late = ("delay:3", "multi_rate:4", "stuck:1:20", "drift:0:1")
    points = ",".join(f"'{text}'" for text in (*texts, *late, "spikes:1:5", "none:0", "mcar:1"))
    rows = evaluate(
        tmp_path / "out.csv", drbpn, points=points, episodes=20, modes=["sampled"]
    )  # fmt: skip
    frame = {row["point"]: [r for r in rows if r["point"] == row["point"]] for row in rows}

    def mean(point, column):
        steps = [int(row["length"]) for row in frame[point]]
        return float(np.average([float(row[column]) for row in frame[point]], weights=steps))

    assert mean("noise:0", "missing_ratio") == pytest.approx(0.4, abs=0.08)  # as in training
    assert mean("spikes:1:5", "missing_ratio") == pytest.approx(0.4, abs=0.08)
    assert mean("outages:0.5:3:kind", "missing_ratio") == pytest.approx(0.5, abs=0.15)
    for by in ("random", "model"):  # 2 of 4 sensors
        assert mean(f"reduction:0.5:{by}", "missing_ratio") == pytest.approx(0.5)
    assert (mean("none:0", "missing_ratio"), mean("mcar:1", "missing_ratio")) == (0.0, 1.0)
    assert mean("multi_rate:4:sensor", "missing_ratio") == pytest.approx(0.75, abs=0.06)
    late_rows = frame["delay:3"]  # nothing in the first three steps, all of the rest
    for row in late_rows:
        assert float(row["missing_ratio"]) == pytest.approx(3 / int(row["length"]))
    for wrong in ("stuck:1:20:sensor", "drift:0:1"):
        assert mean(wrong, "missing_ratio") == pytest.approx(0.4, abs=0.08)
    # What is stuck is easy to predict; what drifts is not.
    assert mean("drift:0:1", "log_likelihood") < mean("noise:0", "log_likelihood")
    # A reading that is 5 off is not what the model expects.
    assert mean("spikes:1:5", "log_likelihood") < mean("noise:0", "log_likelihood")


def removed_at_random(ratio, trained, episodes, seed=0):
    condition = parse(f"reduction:{ratio}:random", trained.settings)
    return removed_sensors(condition, trained, episodes=episodes, reduction_seed=seed)


def test_random_reduction_is_the_same_for_every_agent_and_nested(agent, feedforward):
    other = load_trained_agent(feedforward)
    smaller = torch.zeros(30, 4, dtype=torch.bool)
    for ratio, count in ((0.25, 1), (0.5, 2), (1.0, 4)):
        removed = removed_at_random(ratio, agent, 30)
        assert torch.equal(removed, removed_at_random(ratio, other, 30))
        assert removed.sum(-1).tolist() == [count] * 30
        assert (removed | ~smaller).all()
        smaller = removed
    by_model = parse("reduction:0.5:model", other.settings)
    with refused("has learned no H, P and R"):
        removed_sensors(by_model, other, episodes=1, reduction_seed=0)


def test_each_episode_lacks_sensors_of_its_own_by_its_number_alone(agent):
    many = removed_at_random(0.5, agent, 400)
    assert torch.equal(removed_at_random(0.5, agent, 3), many[:3])
    assert not torch.equal(removed_at_random(0.5, agent, 400, seed=1), many)
    assert len({tuple(row) for row in many.tolist()}) == 6  # all pairs of four
    # Every sensor is removed in half of the episodes; five standard deviations of 400 draws.
    assert (many.double().mean(0) - 0.5).abs().max() < 5 * 0.5 / 400**0.5
    by_model = parse("reduction:0.5:model", agent.settings)
    chosen = removed_sensors(by_model, agent, episodes=3, reduction_seed=0)
    assert chosen is not None
    assert (chosen == chosen[0]).all()
    assert sorted(kept_sensors(agent, 2)) == (~chosen[0]).nonzero().squeeze(-1).tolist()


def test_random_reduction_does_not_draw_what_training_never_lost(agent):
    """Both seeds are 0 by default: the always observed sensors must not be those removed."""
    drawn = draw_mechanism("mar", 4, 1, generator=torch.Generator().manual_seed(0))
    both = (removed_at_random(0.25, agent, 400) & drawn.always_observed).any(-1)
    # One of four is always observed, one of four is removed: they meet in a quarter.
    assert abs(both.double().mean().item() - 0.25) < 5 * (0.25 * 0.75 / 400) ** 0.5
