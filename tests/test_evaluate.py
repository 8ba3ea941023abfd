"""The evaluation recipe: episodes, the table that grows condition by condition, its folders."""

import dataclasses
import shlex
import shutil
from pathlib import Path

import evaluate as recipe
import numpy as np
import pandas as pd
import pytest
from analysis.figures import draw_evaluation
from evaluation import episodes as episodes_room
from evaluation import table as table_room
from evaluation.episodes import over_episodes
from evaluation.folders import find_folders, override
from evaluation.table import evaluate_tasks
from evaluation.trained import load_trained_agent
from evaluation_tools import configured, evaluate
from recipe_tools import read_table, refused
from training.run_folder import read_config, write_config


def test_more_episodes_only_add(trained_run, tmp_path, monkeypatch):
    """Starts, gaps, noise, spikes, outages, actions and particles, across blocks of simulators."""
    monkeypatch.setattr(episodes_room, "BLOCK", 3)
    monkeypatch.setattr("evaluation.trained.BLOCK", 3)
    folder = trained_run("dvrl")
    points = "'mar:0.5','outages:0.5:3','spikes:0.2','reduction:0.5:random'"
    how = {"points": points, "modes": ["sampled"]}
    many = evaluate(tmp_path / "many.csv", folder, episodes=7, **how)
    for count in (2, 4):
        few = evaluate(tmp_path / f"{count}.csv", folder, episodes=count, **how)
        assert few == [row for row in many if int(row["episode"]) < count]
    returns = [float(row["log_likelihood"] or row["return"]) for row in many]
    assert len(set(returns)) > len(returns) / 2  # no episode is another one again


def test_a_small_share_of_one_entry_weighs_as_what_it_is():
    """In two episodes one entry of 100 arrived in all: its likelihood is that of the evaluation."""
    few = pd.DataFrame({"return": 0.0, "length": 10, "missing_ratio": [0.99, 1, 1, 0]})
    few = few.assign(log_likelihood=[-2.5, 0, 0, np.nan], point=["few", "few", "none", "nan"])
    found = over_episodes(few, ["point"]).log_likelihood
    np.testing.assert_allclose(found, [-2.5, 0.0, np.nan])
    two = pd.DataFrame({"return": [1.0, 2.0], "length": [10, 30], "missing_ratio": [0.2, 0.6]})
    two = two.assign(log_likelihood=[1.0, 2.0], diverged=[0, 1], point="two")
    found = over_episodes(two, ["point"]).iloc[0]
    assert found.missing_ratio == pytest.approx((0.2 * 10 + 0.6 * 30) / 40)
    assert found.log_likelihood == pytest.approx((1.0 * 8 + 2.0 * 12) / 20)
    assert (found.return_mean, found.diverged, found.episodes) == (1.5, 0.5, 2)


def test_one_row_an_episode_and_a_baseline_only_at_random(drbpn, feedforward, tmp_path, capsys):
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


def test_an_evaluation_that_was_killed_goes_on_to_the_same_bytes(drbpn, tmp_path, monkeypatch):
    points = "none:0,'mcar:0.5','outages:0.5:4'"
    whole, broken = tmp_path / "whole.csv", tmp_path / "broken.csv"
    evaluate(whole, drbpn, points=points)
    real, calls = table_room.evaluate_condition, []

    def dies(*args, **options):
        calls.append(args)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*args, **options)

    monkeypatch.setattr(table_room, "evaluate_condition", dies)
    with pytest.raises(KeyboardInterrupt):
        evaluate(broken, drbpn, points=points)
    assert {row["point"] for row in read_table(broken)} == {"none:0"}
    evaluate(broken, drbpn, points=points)
    assert len(calls) == 2 + 2  # the finished condition was not evaluated again
    assert broken.read_bytes() == whole.read_bytes()
    assert not list(tmp_path.glob(".*"))


def test_the_order_of_the_table_is_that_of_the_points_and_others_are_kept(drbpn, tmp_path, capsys):
    out = tmp_path / "out.csv"
    evaluate(out, drbpn, points="'mcar:0.5'")
    evaluate(out, drbpn, points="'mar:0.5'", modes=["mean"])
    rows = evaluate(out, drbpn, points="none:0,'mar:0.5'")
    assert list(dict.fromkeys(row["point"] for row in rows)) == ["mcar:0.5", "none:0", "mar:0.5"]
    assert [row["mode"] for row in rows] == ["sampled", "sampled", "mean", "mean"] * 3
    before = out.read_bytes()
    capsys.readouterr()
    evaluate(out, drbpn, points="none:0,'mar:0.5'", modes="mean")
    assert "2 of 2 points are in" in capsys.readouterr().out
    assert out.read_bytes() == before


def test_two_processes_give_the_numbers_of_one(drbpn, tmp_path):
    options = {"points": "none:0,'mcar:0.5'", "robust": "huber"}
    one = evaluate(tmp_path / "one.csv", drbpn, **options)
    two = evaluate(tmp_path / "two.csv", drbpn, **options, processes=2)
    assert one == two
    assert list(evaluate_tasks([], None, 2)) == []


def test_a_table_of_other_settings_is_not_mixed_with(drbpn, tmp_path):
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
        with refused(f"{what} is asked for"):
            evaluate(out, drbpn, points=points, **change)
        assert out.read_bytes() == before
    rows = evaluate(out, drbpn, points="none:0", overwrite=True, episodes=1)
    assert [row["mode"] for row in rows] == ["sampled", "mean"]


def test_another_study_of_the_same_folder_names_is_not_taken_for_it(drbpn, feedforward, tmp_path):
    """Cells are called alike in every study: the name of a folder says nothing of whose it is."""
    out = tmp_path / "out.csv"
    first, second = (tmp_path / study / "hopper-s0" for study in ("robust", "clean"))
    shutil.copytree(drbpn, first)
    evaluate(out, first, points="none:0")
    before = out.read_bytes()
    shutil.copytree(feedforward, second)
    with refused("holds hopper-s0 at none:0 with belief drbpn, and none is"):
        evaluate(out, second, points="none:0")
    shutil.rmtree(second)
    shutil.copytree(drbpn, second)
    write_config(second, read_config(second) | {"method": "ppo_ours"})
    with refused("with method drbpn, and ppo_ours is asked for"):
        evaluate(out, second, points="none:0")
    assert out.read_bytes() == before
    with refused("different names, hopper-s0 comes twice"):
        evaluate(out, first, second, points="none:0")


@pytest.mark.parametrize("text", ["frames,mechanism\n1,mcar\n", "\x00\x01", ""])
def test_a_foreign_table_is_not_overwritten(drbpn, tmp_path, text):
    out = tmp_path / "out.csv"
    out.write_text(text)
    with refused(r"no table of this command|can't be read as a table"):
        evaluate(out, drbpn, points="none:0")
    assert out.read_text() == text


@pytest.mark.parametrize(
    "name", ["a=b", "a,b", "[ab]", "a b", "it's", 'a"b', "a*", "$HOME", "eta={0.5}", "back\\slash"]
)
def test_a_folder_is_found_whatever_its_name_holds(tmp_path, name):
    folder = tmp_path / name
    folder.mkdir()
    (tmp_path / "a").mkdir()
    assert find_folders(str(folder)) == [folder]
    # What is printed for a shell comes back from shell and Hydra as it was.
    (word,) = shlex.split(override("run", folder))
    assert configured("evaluate", word)["run"] == str(folder)


def test_a_pattern_gives_the_runs_and_a_folder_named_twice_is_one(drbpn, feedforward, tmp_path):
    for folder in (drbpn, feedforward):
        shutil.copytree(folder, tmp_path / folder.name)
    (tmp_path / "empty").mkdir()
    both = [tmp_path / "drbpn", tmp_path / "none"]
    assert find_folders(str(tmp_path / "*")) == both
    assert find_folders([str(both[0]), str(tmp_path / "*")]) == both
    for wanted in (str(tmp_path / "x*"), str(tmp_path / "x"), [], None):
        with refused("`run` must name run folders"):
            find_folders(wanted)


def test_a_run_that_has_no_checkpoint_yet_is_left_out_with_a_line(drbpn, young, tmp_path, capsys):
    rows = evaluate(tmp_path / "out.csv", drbpn, young, points="none:0")
    assert {row["run"] for row in rows} == {"drbpn"}
    assert "young: left out, it has no checkpoint yet" in capsys.readouterr().out
    with refused("young` holds no checkpoint"):
        evaluate(tmp_path / "out.csv", young, points="none:0")


def test_the_full_list_of_a_task_without_sensor_names_has_no_groups(agent, capsys):
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
    drbpn, feedforward, tmp_path
):
    folder = shutil.copytree(drbpn, tmp_path / "run")
    points = "'spikes:1:50'"
    believed = evaluate(tmp_path / "out.csv", folder, points=points)
    base = configured("evaluate", f"points=[{points}]", "robust=huber") | {"run": str(folder)}
    assert recipe.run(base | {"processes": 1, "episodes": 2, "figures": False}) == 0
    weighted = read_table(folder / "points-huber4.0.csv")
    assert not (folder / "points.csv").exists()
    assert {row["method"] for row in believed} == {"drbpn"}
    assert {row["method"] for row in weighted} == {"drbpn, huber 4"}
    assert [r["log_likelihood"] for r in believed] != [r["log_likelihood"] for r in weighted]
    with refused("`robust` must be null for belief=none, got 'imq'"):
        evaluate(tmp_path / "none.csv", feedforward, points="none:0", robust="imq")
    with refused(r"`output` must not be called points\.csv with robust="):
        recipe.run(base | {"output": str(folder / "points.csv")})


def test_an_agent_trained_with_a_robust_update_acts_with_it_unless_told_otherwise(drbpn, tmp_path):
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


def test_a_figure_has_a_panel_a_family_and_kind_of_action(drbpn, tmp_path):
    points = "none:0,'mcar:0.5','outages:0.5:2','outages:0.5:9','noise:1'"
    evaluate(tmp_path / "out.csv", drbpn, points=points, figures=True)
    assert (tmp_path / "out-InvertedPendulum-v5.png").is_file()
    (figure,) = draw_evaluation(pd.read_csv(tmp_path / "out.csv")).values()
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    kinds = ["MCAR", "outages 0.5 sensor"]  # noise has one level
    assert titles == [f"{kind}, {mode}" for mode in ("mean", "sampled") for kind in kinds]
