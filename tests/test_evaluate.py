"""The evaluation recipe: conditions, episodes, the table that grows condition by condition.

A condition names one thing and leaves the rest as in training; its full name reads back to itself.
Every episode draws from a stream of its own, so that more episodes only add. The table holds whole
conditions: one that was stopped goes on, to the same bytes as one that was not, and never mixes
settings. Folders are found whatever their names hold.
"""

from __future__ import annotations

import dataclasses
import shlex
import shutil
from pathlib import Path
from typing import Any

import evaluate as recipe
import numpy as np
import pandas as pd
import pytest
import torch
from analysis.figures import draw_evaluation
from evaluation import episodes as episodes_room
from evaluation import table as table_room
from evaluation.conditions import default_conditions, removed_sensors
from evaluation.episodes import StoppingPolicy, over_episodes
from evaluation.folders import find_folders, override
from evaluation.sensor_choice import kept_sensors
from evaluation.table import evaluate_tasks
from evaluation.trained import TrainedAgent, load_trained_agent
from evaluation_tools import configured, evaluate, parse, read_rows
from omegaconf import DictConfig
from training.errors import UserError
from training.run_folder import read_config, write_config

from torchrl_drbpn.functional import draw_mechanism


@pytest.fixture(scope="module")
def agent(drbpn: Path) -> TrainedAgent:
    return load_trained_agent(drbpn)


@pytest.fixture(scope="module")
def settings(agent: TrainedAgent) -> DictConfig:
    return agent.settings


# Conditions -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("trained", "mcar:0.4"),
        ("none:0", "none:0"),
        ("nmar:.5", "nmar:0.5"),
        ("outages:0.5:20", "outages:0.5:20:sensor"),
        ("outages:0.2:5:kind", "outages:0.2:5:kind"),
        ("reduction:0.4:model", "reduction:0.4:model"),
        ("noise:2", "noise:2"),
        ("spikes:0.05", "spikes:0.05:5"),
        ("spikes:0.05:2", "spikes:0.05:2"),
        ("stuck:.05", "stuck:0.05:20:sensor"),
        ("stuck:0.05:5:joint", "stuck:0.05:5:joint"),
        ("drift:0.02", "drift:0.02:0"),
        ("drift:0:-0.1", "drift:0:-0.1"),
        ("delay:2", "delay:2"),
        ("delay:0:3", "delay:0:3:sensor"),
        ("delay:1:3:kind:in_order", "delay:1:3:kind:in_order"),
        ("multi_rate:4", "multi_rate:4:sensor"),
        ("multi_rate:4:joint:0", "multi_rate:4:joint:0"),
    ],
)
def test_the_full_name_of_a_condition_reads_back_to_it(
    text: str, name: str, settings: DictConfig
) -> None:
    condition = parse(text, settings)
    assert condition.name == name
    assert parse(name, settings) == condition


def test_a_condition_leaves_what_it_does_not_name_as_in_training(settings: DictConfig) -> None:
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
def test_a_condition_that_can_not_be_read_is_refused(text: str, settings: DictConfig) -> None:
    with pytest.raises(UserError, match="`points` must hold ") as error:
        parse(text, settings)
    assert repr(text) in str(error.value)


def test_the_default_conditions_are_those_of_the_paper_and_the_full_ones_go_beyond(
    settings: DictConfig,
) -> None:
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


def test_mean_lengths_that_no_chain_has_are_left_out_and_refused(settings: DictConfig) -> None:
    levels = dict.fromkeys(configured()["grid"], ()) | {
        "outage_ratios": [0.8], "outage_lengths": [1, 2, 4, 20], "outage_groups": ["sensor"],
    }  # fmt: skip
    texts = default_conditions(levels, full=True, model=False)
    assert texts == ["outages:0.8:4:sensor", "outages:0.8:20:sensor"]
    with pytest.raises(UserError, match="`mean_length` must be at least eta"):
        parse("outages:0.8:2", settings)


def test_each_family_changes_what_the_agent_gets(drbpn: Path, tmp_path: Path) -> None:
    texts = ("noise:0", "outages:0.5:3:kind", "reduction:0.5:random", "reduction:0.5:model")
    late = ("delay:3", "multi_rate:4", "stuck:1:20", "drift:0:1")
    points = ",".join(f"'{text}'" for text in (*texts, *late, "spikes:1:5", "none:0", "mcar:1"))
    rows = evaluate(
        tmp_path / "out.csv", drbpn, points=points, episodes=20, modes=["sampled"]
    )  # fmt: skip
    frame = {row["point"]: [r for r in rows if r["point"] == row["point"]] for row in rows}

    def mean(point: str, column: str) -> float:
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


# Sensors that are removed ---------------------------------------------------------------------


def removed_at_random(ratio: float, trained: TrainedAgent, episodes: int, seed: int = 0) -> Any:
    condition = parse(f"reduction:{ratio}:random", trained.settings)
    return removed_sensors(condition, trained, episodes=episodes, reduction_seed=seed)


def test_random_reduction_is_the_same_for_every_agent_and_nested(
    agent: TrainedAgent, feedforward: Path
) -> None:
    other = load_trained_agent(feedforward)
    smaller = torch.zeros(30, 4, dtype=torch.bool)
    for ratio, count in ((0.25, 1), (0.5, 2), (1.0, 4)):
        removed = removed_at_random(ratio, agent, 30)
        assert torch.equal(removed, removed_at_random(ratio, other, 30))
        assert removed.sum(-1).tolist() == [count] * 30
        assert (removed | ~smaller).all()
        smaller = removed
    by_model = parse("reduction:0.5:model", other.settings)
    with pytest.raises(UserError, match="has learned no H, P and R"):
        removed_sensors(by_model, other, episodes=1, reduction_seed=0)


def test_each_episode_lacks_sensors_of_its_own_by_its_number_alone(agent: TrainedAgent) -> None:
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


def test_random_reduction_does_not_draw_what_training_never_lost(agent: TrainedAgent) -> None:
    """Both seeds are 0 by default: the always observed sensors must not be those removed."""
    drawn = draw_mechanism("mar", 4, 1, generator=torch.Generator().manual_seed(0))
    both = (removed_at_random(0.25, agent, 400) & drawn.always_observed).any(-1)
    # One of four is always observed, one of four is removed: they meet in a quarter.
    assert abs(both.double().mean().item() - 0.25) < 5 * (0.25 * 0.75 / 400) ** 0.5


# Episodes -------------------------------------------------------------------------------------


def test_more_episodes_only_add(
    trained_run: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Starts, gaps, noise, spikes, outages, actions and particles, across blocks of simulators."""
    monkeypatch.setattr(episodes_room, "BLOCK", 3)
    monkeypatch.setattr("evaluation.trained.BLOCK", 3)
    folder = trained_run("dvrl")
    points = "'mar:0.5','outages:0.5:3','spikes:0.2','reduction:0.5:random'"
    how: dict[str, Any] = {"points": points, "modes": ["sampled"]}
    many = evaluate(tmp_path / "many.csv", folder, episodes=7, **how)
    for count in (2, 4):
        few = evaluate(tmp_path / f"{count}.csv", folder, episodes=count, **how)
        assert few == [row for row in many if int(row["episode"]) < count]
    returns = [float(row["log_likelihood"] or row["return"]) for row in many]
    assert len(set(returns)) > len(returns) / 2  # no episode is another one again


def test_the_global_generator_is_left_alone_and_stopping_gives_nothing(agent: TrainedAgent) -> None:
    before = torch.get_rng_state()
    how = {"episodes": 2, "mode": "mean", "seed": 5}
    policy = StoppingPolicy(agent.agent)
    result = episodes_room.evaluate(policy, agent.environments(), **how)
    assert result is not None
    assert len(result) == 2
    assert episodes_room.evaluate(policy, agent.environments(), **how, stop=lambda: True) is None
    assert torch.equal(torch.get_rng_state(), before)


def test_a_small_share_of_one_entry_weighs_as_what_it_is() -> None:
    """In two episodes one entry of 100 arrived in all: its likelihood is that of the evaluation."""
    few = pd.DataFrame({"return": 0.0, "length": 10, "missing_ratio": [0.99, 1, 1, 0]})
    few = few.assign(log_likelihood=[-2.5, 0, 0, np.nan], point=["few", "few", "none", "diverged"])
    found = over_episodes(few, ["point"]).log_likelihood
    np.testing.assert_allclose(found, [-2.5, 0.0, np.nan])


# The table ------------------------------------------------------------------------------------


def test_one_row_an_episode_and_a_baseline_only_at_random(
    drbpn: Path, feedforward: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    small = configured()["grid"] | {"ratios": [0, 0.5]}
    rows = evaluate(tmp_path / "out.csv", drbpn, feedforward, grid=small)
    points = {(row["run"], row["point"]) for row in rows}
    assert len(points) == 5 + 4
    assert ("drbpn", "reduction:0.5:model") in points
    assert ("none", "reduction:0.5:model") not in points
    assert "none: sensors are removed at random only" in capsys.readouterr().out
    assert len(rows) == 9 * 2 * 2
    assert {row["seed"] for row in rows} == {"10000"}
    assert {row["eta"] for row in rows if row["point"] == "mcar:0.5"} == {"0.5"}


def test_an_evaluation_that_was_killed_goes_on_to_the_same_bytes(
    drbpn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = "none:0,'mcar:0.5','outages:0.5:4'"
    whole, broken = tmp_path / "whole.csv", tmp_path / "broken.csv"
    evaluate(whole, drbpn, points=points)
    real, calls = table_room.evaluate_condition, []

    def dies(*args: Any, **options: Any) -> Any:
        calls.append(args)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*args, **options)

    monkeypatch.setattr(table_room, "evaluate_condition", dies)
    with pytest.raises(KeyboardInterrupt):
        evaluate(broken, drbpn, points=points)
    assert {row["point"] for row in read_rows(broken)} == {"none:0"}
    evaluate(broken, drbpn, points=points)
    assert len(calls) == 2 + 2  # the finished condition was not evaluated again
    assert broken.read_bytes() == whole.read_bytes()
    assert not list(tmp_path.glob(".*"))


def test_the_order_of_the_table_is_that_of_the_points_and_others_are_kept(
    drbpn: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.csv"
    evaluate(out, drbpn, points="'mcar:0.5'")
    evaluate(out, drbpn, points="'mar:0.5'", modes=["mean"])
    rows = evaluate(out, drbpn, points="none:0,'mar:0.5'")
    assert list(dict.fromkeys(row["point"] for row in rows)) == ["mcar:0.5", "none:0", "mar:0.5"]
    assert [row["mode"] for row in rows] == ["sampled", "sampled", "mean", "mean"] * 3
    before = out.read_bytes()
    capsys.readouterr()
    evaluate(out, drbpn, points="none:0,'mar:0.5'", modes=["mean"])
    assert "2 of 2 points are in" in capsys.readouterr().out
    assert out.read_bytes() == before


def test_two_processes_give_the_numbers_of_one(drbpn: Path, tmp_path: Path) -> None:
    options = {"points": "none:0,'mcar:0.5'", "robust": "huber"}
    one = evaluate(tmp_path / "one.csv", drbpn, **options)
    two = evaluate(tmp_path / "two.csv", drbpn, **options, processes=2)
    assert one == two
    assert list(evaluate_tasks([], None, 2)) == []


def test_a_table_of_other_settings_is_not_mixed_with(drbpn: Path, tmp_path: Path) -> None:
    out, points = tmp_path / "out.csv", "'reduction:0.5:random',none:0"
    rows = evaluate(out, drbpn, points=points)
    assert [row["reduction_seed"] for row in rows] == ["0"] * 4 + [""] * 4
    before = out.read_bytes()
    for change, what in (
        ({"episodes": 3}, "with episodes 2, and 3"),
        ({"seed": 5}, "with seed 10000, and 5"),
        ({"reduction_seed": 3}, "with reduction_seed 0, and 3"),
        ({"robust": "imq"}, "with method drbpn, and drbpn, imq 4"),
    ):
        with pytest.raises(UserError, match=f"{what} is asked for"):
            evaluate(out, drbpn, points=points, **change)
        assert out.read_bytes() == before
    rows = evaluate(out, drbpn, points="none:0", overwrite=True, episodes=1)
    assert [row["mode"] for row in rows] == ["sampled", "mean"]


def test_another_study_of_the_same_folder_names_is_not_taken_for_it(
    drbpn: Path, feedforward: Path, tmp_path: Path
) -> None:
    """Cells are called alike in every study: the name of a folder says nothing of whose it is."""
    out = tmp_path / "out.csv"
    first, second = (tmp_path / study / "hopper-s0" for study in ("robust", "clean"))
    shutil.copytree(drbpn, first)
    evaluate(out, first, points="none:0")
    before = out.read_bytes()
    shutil.copytree(feedforward, second)
    with pytest.raises(UserError, match="holds hopper-s0 at none:0 with belief drbpn, and none is"):
        evaluate(out, second, points="none:0")
    shutil.rmtree(second)
    shutil.copytree(drbpn, second)
    write_config(second, read_config(second) | {"method": "ppo_ours"})
    with pytest.raises(UserError, match="with method drbpn, and ppo_ours is asked for"):
        evaluate(out, second, points="none:0")
    assert out.read_bytes() == before
    with pytest.raises(UserError, match="different names, hopper-s0 comes twice"):
        evaluate(out, first, second, points="none:0")


@pytest.mark.parametrize("text", ["frames,mechanism\n1,mcar\n", "\x00\x01", ""])
def test_a_foreign_table_is_not_overwritten(drbpn: Path, tmp_path: Path, text: str) -> None:
    out = tmp_path / "out.csv"
    out.write_text(text)
    with pytest.raises(UserError, match=r"no table of this command|can't be read as a table"):
        evaluate(out, drbpn, points="none:0")
    assert out.read_text() == text


# Folders --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["a=b", "a,b", "[ab]", "a b", "it's", 'a"b', "a*", "$HOME", "eta={0.5}", "back\\slash"]
)
def test_a_folder_is_found_whatever_its_name_holds(tmp_path: Path, name: str) -> None:
    folder = tmp_path / name
    folder.mkdir()
    (tmp_path / "a").mkdir()
    assert find_folders(str(folder)) == [folder]
    # What is printed for a shell comes back from shell and Hydra as it was.
    (word,) = shlex.split(override("run", folder))
    assert configured("evaluate", word)["run"] == str(folder)


def test_a_pattern_gives_the_runs_and_a_folder_named_twice_is_one(
    drbpn: Path, feedforward: Path, tmp_path: Path
) -> None:
    for folder in (drbpn, feedforward):
        shutil.copytree(folder, tmp_path / folder.name)
    (tmp_path / "empty").mkdir()
    both = [tmp_path / "drbpn", tmp_path / "none"]
    assert find_folders(str(tmp_path / "*")) == both
    assert find_folders([str(both[0]), str(tmp_path / "*")]) == both
    for wanted in (str(tmp_path / "x*"), str(tmp_path / "x"), [], None):
        with pytest.raises(UserError, match="`run` must name run folders"):
            find_folders(wanted)


def test_a_run_that_has_no_checkpoint_yet_is_left_out_with_a_line(
    drbpn: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    young = tmp_path / "young"
    young.mkdir()
    shutil.copy(drbpn / "config.yaml", young)
    rows = evaluate(tmp_path / "out.csv", drbpn, young, points="none:0")
    assert {row["run"] for row in rows} == {"drbpn"}
    assert "young: left out, it has no checkpoint yet" in capsys.readouterr().out
    with pytest.raises(UserError, match="young` holds no checkpoint"):
        evaluate(tmp_path / "out.csv", young, points="none:0")


# Settings -------------------------------------------------------------------------------------


def test_the_full_list_of_a_task_without_sensor_names_has_no_groups(
    agent: TrainedAgent, capsys: pytest.CaptureFixture[str]
) -> None:
    unnamed = dataclasses.replace(agent, settings=agent.settings.copy())
    unnamed.settings.env.id = "Homemade"
    full = configured("evaluate", "full=true")
    names = {c.name for c in recipe._conditions(full, Path("run"), unnamed)}
    assert "outages:0.5:20:sensor" in names
    assert not any(name.endswith((":joint", ":kind")) for name in names)
    assert "run: outages of single sensors only" in capsys.readouterr().out
    with_names = {c.name for c in recipe._conditions(full, Path("run"), agent)}
    assert "outages:0.5:20:joint" in with_names


def test_a_robust_update_changes_what_spikes_do_and_its_table_has_a_name_of_its_own(
    drbpn: Path, feedforward: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(drbpn, tmp_path / "run")
    points = "'spikes:1:50'"
    believed = evaluate(tmp_path / "out.csv", folder, points=points)
    base = configured("evaluate", f"points=[{points}]", "robust=huber") | {"run": str(folder)}
    assert recipe.run(base | {"processes": 1, "episodes": 2, "figures": False}) == 0
    weighted = read_rows(folder / "points-huber4.0.csv")
    assert not (folder / "points.csv").exists()
    assert {row["method"] for row in believed} == {"drbpn"}
    assert {row["method"] for row in weighted} == {"drbpn, huber 4"}
    assert [r["log_likelihood"] for r in believed] != [r["log_likelihood"] for r in weighted]
    with pytest.raises(UserError, match="`robust` must be null for belief=none, got 'imq'"):
        evaluate(tmp_path / "none.csv", feedforward, points="none:0", robust="imq")
    with pytest.raises(UserError, match=r"`output` must not be called points\.csv with robust="):
        recipe.run(base | {"output": str(folder / "points.csv")})


def test_an_agent_trained_with_a_robust_update_acts_with_it_unless_told_otherwise(
    drbpn: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(drbpn, tmp_path / "run")
    config = folder / "config.yaml"
    text = config.read_text().replace("robust: null", "robust: imq")
    config.write_text(text.replace("robust_threshold: 4.0", "robust_threshold: 2.0"))
    settings = []
    for robust in (None, "none", "huber"):
        trained = load_trained_agent(folder, robust)
        filter = trained.agent.belief.filter
        settings.append((filter.robust, filter.robust_threshold, trained.method))
    assert settings == [
        ("imq", 2.0, "drbpn"), (None, 4.0, "drbpn, not robust"), ("huber", 4.0, "drbpn, huber 4"),
    ]  # fmt: skip


def test_a_figure_has_a_panel_a_family_and_kind_of_action(drbpn: Path, tmp_path: Path) -> None:
    points = "none:0,'mcar:0.5','outages:0.5:2','outages:0.5:9','noise:1'"
    evaluate(tmp_path / "out.csv", drbpn, points=points, figures=True)
    assert (tmp_path / "out-InvertedPendulum-v5.png").is_file()
    (figure,) = draw_evaluation(pd.read_csv(tmp_path / "out.csv")).values()
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    kinds = ["MCAR", "outages 0.5 sensor"]  # noise has one level
    assert titles == [f"{kind}, {mode}" for mode in ("mean", "sampled") for kind in kinds]
