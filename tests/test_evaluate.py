"""The evaluation recipe: points, the grid, the table that grows point by point, the figures.

A point names one thing and leaves the rest as in training; its full name reads back to itself. The
table holds whole points: one that was stopped goes on, to the same bytes as one that was not, and
never mixes settings. Sensors that fail together share a joint or a kind. The interval of a mean is
that of its runs and episodes.
"""

from __future__ import annotations

import csv
import dataclasses
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("hydra")
from evaluation_tools import SMOKE, configured, evaluate, trained_folder  # isort: skip
from recipe_tools import ROOT, make_config  # isort: skip

sys.path.insert(0, str(ROOT / "recipes"))
import evaluate as recipe
import pandas as pd
from analysis.figures import draw_evaluation
from evaluation import grid as evaluation_grid
from evaluation.conditions import Point, evaluate_points, parse_point, removed_sensors
from evaluation.episodes import Episodes
from evaluation.grid import Grid, evaluate_tasks, grid_points
from evaluation.sensor_choice import kept_sensors
from evaluation.trained import TrainedAgent, load_trained_agent
from training.config import Settings, read_settings
from training.errors import UserError
from training.run_folder import read_config, write_config
from training.sensor_groups import sensor_groups
from training.sensors import named_tasks, sensor_names

from torchrl_drbpn.functional import draw_mechanism


@pytest.fixture(scope="module", autouse=True)
def _threads() -> Iterator[None]:
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def drbpn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained_folder(tmp_path_factory.mktemp("runs") / "drbpn")


@pytest.fixture(scope="module")
def feedforward(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained_folder(tmp_path_factory.mktemp("runs") / "none", "belief=none")


@pytest.fixture(scope="module")
def agent(drbpn: Path) -> TrainedAgent:
    return load_trained_agent(drbpn)


@pytest.fixture(scope="module")
def settings() -> Settings:
    return read_settings(make_config(*SMOKE))


def parse(text: str, settings: Settings) -> Point:
    return parse_point(text, settings, spike_std=5.0)


# Points ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("trained", "mcar:0.2"),
        ("none:0", "none:0"),
        ("nmar:.5", "nmar:0.5"),
        ("outages:0.5:20", "outages:0.5:20:sensor"),
        ("outages:0.2:5:kind", "outages:0.2:5:kind"),
        ("reduction:0.4:model", "reduction:0.4:model"),
        ("noise:2", "noise:2"),
        ("spikes:0.05", "spikes:0.05:5"),
        ("spikes:0.05:2", "spikes:0.05:2"),
    ],
)
def test_the_full_name_of_a_point_reads_back_to_it(
    text: str, name: str, settings: Settings
) -> None:
    point = parse(text, settings)
    assert point.name == name
    assert parse(name, settings) == point


def test_a_point_leaves_what_it_does_not_name_as_in_training(settings: Settings) -> None:
    assert parse("noise:3", settings).missingness == settings.missingness
    assert parse("spikes:0.1", settings).missingness == settings.missingness
    for text in ("mar:0.5", "outages:0.5:20", "reduction:0.5:random"):
        assert parse(text, settings).noise == settings.noise
    spiked = parse("spikes:0.1:7", settings).noise
    assert spiked == dataclasses.replace(settings.noise, spike_probability=0.1, spike_std=7.0)


@pytest.mark.parametrize(
    "text",
    ["fog:0.5", "outages:0.5", "outages:0.5:20:leg", "reduction:0.5", "reduction:0.5:luck", "noise",
     "noise:-1", "spikes:1.5", "spikes:0.1:inf", "mcar:0.5:3", "reduction:1.2:model"],
)  # fmt: skip
def test_a_point_that_can_not_be_read_is_refused(text: str, settings: Settings) -> None:
    with pytest.raises(UserError, match="`points` must hold trained or mechanism:eta") as error:
        parse(text, settings)
    assert repr(text) in str(error.value)


def test_outages_that_no_chain_has_are_refused(settings: Settings) -> None:
    with pytest.raises(UserError, match="`mean_length` must be at least eta"):
        parse("outages:0.8:2", settings)


def test_each_family_changes_what_the_agent_gets(agent: TrainedAgent) -> None:
    texts = ("outages:0.5:3:kind", "reduction:0.5:random", "reduction:0.5:model", "spikes:1:5")
    points = [parse(text, agent.settings) for text in ("noise:0", *texts)]
    found = [
        result
        for _, _, result in evaluate_points(agent, points, episodes=20, modes=["sampled"], seed=1)
    ]
    ratios = [result.missing_ratio for result in found]
    assert ratios[0] == pytest.approx(0.2, abs=0.06)  # as in training
    assert ratios[1] == pytest.approx(0.5, abs=0.15)
    assert ratios[2] == ratios[3] == 0.5  # 2 of 4 sensors
    assert ratios[4] == pytest.approx(0.2, abs=0.06)
    clean, spiked = found[0].log_likelihood, found[4].log_likelihood
    assert clean is not None
    assert spiked is not None
    assert spiked < clean  # a reading that is 5 off is not what the model expects


def removed_at_random(ratio: float, trained: TrainedAgent, episodes: int, seed: int = 0) -> Any:
    point = parse(f"reduction:{ratio}:random", trained.settings)
    return removed_sensors(point, trained, episodes=episodes, reduction_seed=seed)


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
    with pytest.raises(UserError, match="has learned no H, P and R"):
        removed_sensors(
            parse("reduction:0.5:model", other.settings), other, episodes=1, reduction_seed=0
        )


def test_each_episode_lacks_sensors_of_its_own_by_its_number_alone(agent: TrainedAgent) -> None:
    many = removed_at_random(0.5, agent, 400)
    assert torch.equal(removed_at_random(0.5, agent, 3), many[:3])
    assert not torch.equal(removed_at_random(0.5, agent, 400, seed=1), many)
    assert len({tuple(row) for row in many.tolist()}) == 6  # all pairs of four
    # Every sensor is removed in half of the episodes; five standard deviations of 400 draws.
    assert (many.double().mean(0) - 0.5).abs().max() < 5 * 0.5 / 400**0.5
    chosen = removed_sensors(
        parse("reduction:0.5:model", agent.settings), agent, episodes=3, reduction_seed=0
    )
    assert chosen is not None
    assert (chosen == chosen[0]).all()
    kept = (~chosen[0]).nonzero().squeeze(-1).tolist()
    assert sorted(kept_sensors(agent, 2)) == kept


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_random_reduction_does_not_draw_what_training_never_lost(
    agent: TrainedAgent, seed: int
) -> None:
    """Both seeds are 0 by default: the always observed sensors must not be those removed."""
    both, episodes = 0.0, 400
    for row in removed_at_random(0.25, agent, episodes, seed):
        drawn = draw_mechanism("mar", 4, 1, generator=torch.Generator().manual_seed(seed))
        both += int((row & drawn.always_observed).any())
    # One of four is always observed, one of four is removed: they meet in a quarter.
    assert abs(both / episodes - 0.25) < 5 * (0.25 * 0.75 / episodes) ** 0.5


def test_a_small_share_of_one_entry_weighs_as_what_it_is() -> None:
    """In two episodes one entry of 100 arrived in all: its likelihood is that of the evaluation."""
    few = Episodes([0.0, 0.0], [10, 10], [0.99, 1.0], [-2.5, 0.0], [False, False])
    assert few.log_likelihood == pytest.approx(-2.5)
    assert Episodes([0.0], [10], [1.0], [0.0], [False]).log_likelihood == 0.0


# The grid -------------------------------------------------------------------------------------


def test_the_default_grid_is_that_of_the_paper_and_the_full_one_goes_beyond(
    settings: Settings,
) -> None:
    grid = Grid(**configured()["grid"])
    points = grid_points(grid, full=False, model=True)
    ratios = ("0.2", "0.4", "0.5", "0.6", "0.8")
    families = ("mcar:{}", "mar:{}", "reduction:{}:model", "reduction:{}:random")
    assert points == ["none:0", *(f.format(ratio) for f in families for ratio in ratios)]
    assert not any("model" in p for p in grid_points(grid, full=True, model=False))
    everything = grid_points(grid, full=True, model=True)
    beyond = [f"nmar:{ratio}" for ratio in ratios]
    # A sensor that is off half of the time has outages of at least one step.
    lengths, groups = (1, 2, 5, 10, 20, 50), ("sensor", "joint", "kind")
    beyond += [f"outages:0.5:{length}:{by}" for by in groups for length in lengths]
    beyond += [f"noise:{sigma}" for sigma in (0, 1, 3, 10, 30)]
    beyond += [f"spikes:{probability}" for probability in (0.01, 0.05, 0.1, 0.2)]
    assert sorted(everything) == sorted([*points, *beyond])
    assert len(points) == 21
    assert len(everything) == 53
    assert configured()["modes"] == ["sampled", "mean"]
    for point in everything:
        parse(point, settings)


def test_mean_lengths_that_no_chain_has_are_left_out_of_the_grid(settings: Settings) -> None:
    grid = Grid([], [0.8], [1, 2, 4, 20], ["sensor"], [], [])
    points = grid_points(grid, full=True, model=False)
    assert points == ["outages:0.8:4:sensor", "outages:0.8:20:sensor"]
    for point in points:
        parse(point, settings)


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
    mcar = [row for row in rows if row["point"] == "mcar:0.5"]
    assert {row["eta"] for row in mcar} == {"0.5"}
    assert 0.3 < np.mean([float(row["missing_ratio"]) for row in mcar]) < 0.7


def test_an_evaluation_that_was_killed_goes_on_to_the_same_bytes(
    drbpn: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = "none:0,'mcar:0.5','outages:0.5:4'"
    whole, broken = tmp_path / "whole.csv", tmp_path / "broken.csv"
    evaluate(whole, drbpn, points=points)
    real, calls = evaluation_grid.evaluate_point, []

    def dies(*args: Any) -> Any:
        calls.append(args)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*args)

    monkeypatch.setattr(evaluation_grid, "evaluate_point", dies)
    with pytest.raises(KeyboardInterrupt):
        evaluate(broken, drbpn, points=points)
    with broken.open(newline="") as file:
        assert {row["point"] for row in csv.DictReader(file)} == {"none:0"}
    evaluate(broken, drbpn, points=points)
    assert len(calls) == 2 + 2  # the finished point was not made again
    assert broken.read_bytes() == whole.read_bytes()
    assert not list(tmp_path.glob(".*"))


def test_the_order_of_the_table_is_that_of_the_points_and_others_are_kept(
    drbpn: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out.csv"
    evaluate(out, drbpn, points="'mcar:0.5'")
    evaluate(out, drbpn, points="'mar:0.5'")
    rows = evaluate(out, drbpn, points="none:0,'mar:0.5'")
    assert list(dict.fromkeys(row["point"] for row in rows)) == ["mcar:0.5", "none:0", "mar:0.5"]


def test_two_processes_give_the_numbers_of_one(
    drbpn: Path, tmp_path: Path, settings: Settings
) -> None:
    one = evaluate(tmp_path / "one.csv", drbpn, points="none:0,'mcar:0.5'")
    two = evaluate(tmp_path / "two.csv", drbpn, points="none:0,'mcar:0.5'", processes=2)
    assert one == two
    assert list(evaluate_tasks([], None, 2)) == []  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "what"),
    [({"episodes": 3}, "with episodes 2, and 3"), ({"seed": 5}, "with seed 10000, and 5")],
)
def test_a_table_of_other_settings_is_not_mixed_with(
    drbpn: Path, tmp_path: Path, change: dict[str, int], what: str
) -> None:
    out = tmp_path / "out.csv"
    evaluate(out, drbpn, points="none:0")
    with pytest.raises(UserError, match=what):
        evaluate(out, drbpn, points="none:0", **change)
    rows = evaluate(out, drbpn, points="none:0", overwrite=True, **change)
    assert len(rows) == 2 * change.get("episodes", 2)


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


def test_another_choice_of_random_sensors_is_not_mixed_with(drbpn: Path, tmp_path: Path) -> None:
    out, points = tmp_path / "out.csv", "'reduction:0.5:random'"
    rows = evaluate(out, drbpn, points=points + ",none:0")
    assert {(row["point"], row["reduction_seed"]) for row in rows} == {
        ("reduction:0.5:random", "0"),
        ("none:0", ""),
    }
    with pytest.raises(UserError, match="with reduction_seed 0, and 3 is asked for"):
        evaluate(out, drbpn, points=points, reduction_seed=3)
    with pytest.raises(UserError, match="`reduction_seed` must be a whole number of at least 0"):
        evaluate(out, drbpn, points=points, reduction_seed=-1)


def test_one_kind_of_action_after_the_other_gives_the_table_of_both(
    drbpn: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both, apart = tmp_path / "both.csv", tmp_path / "apart.csv"
    evaluate(both, drbpn, points="none:0,'mcar:0.5'")
    evaluate(apart, drbpn, points="none:0,'mcar:0.5'", modes=["mean"])
    evaluate(apart, drbpn, points="none:0,'mcar:0.5'", modes=["sampled"])
    assert apart.read_bytes() == both.read_bytes()
    capsys.readouterr()
    evaluate(apart, drbpn, points="none:0,'mcar:0.5'", modes=["mean"])
    assert "2 of 2 points are in" in capsys.readouterr().out
    assert apart.read_bytes() == both.read_bytes()


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


def test_the_full_grid_of_a_task_without_sensor_names_has_no_groups(
    agent: TrainedAgent, capsys: pytest.CaptureFixture[str]
) -> None:
    env = dataclasses.replace(agent.settings.env, id="Homemade")
    unnamed = dataclasses.replace(agent, settings=dataclasses.replace(agent.settings, env=env))
    names = {point.name for point in recipe._points(configured("full=true"), "run", unnamed)}
    assert "outages:0.5:20:sensor" in names
    assert not any(name.endswith((":joint", ":kind")) for name in names)
    assert "run: outages of single sensors only; those of Homemade-v5" in capsys.readouterr().out
    with_names = {point.name for point in recipe._points(configured("full=true"), "run", agent)}
    assert "outages:0.5:20:joint" in with_names


def test_a_foreign_table_is_not_overwritten(drbpn: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.csv"
    out.write_text("frames,mechanism\n1,mcar\n")
    with pytest.raises(UserError, match="no table of this command, or of an earlier one"):
        evaluate(out, drbpn, points="none:0")
    assert out.read_text() == "frames,mechanism\n1,mcar\n"


@pytest.mark.parametrize(
    ("options", "what"),
    [
        ({"run": None}, "`run` must name a run folder"),
        ({"run": "no/such/run"}, "there is no folder no/such/run"),
        ({"episodes": 0}, "`episodes` must be a whole number of at least 1"),
        ({"processes": 0}, "`processes` must be a whole number"),
        ({"modes": ["best"]}, "`modes` must hold sampled and mean"),
        ({"modes": []}, "`modes` must hold sampled, mean or both"),
        ({"output": "no/such/folder/x.csv"}, "`output` must lie in an existing folder"),
    ],
)
def test_bad_settings_are_one_line(
    drbpn: Path, tmp_path: Path, options: dict[str, Any], what: str
) -> None:
    with pytest.raises(UserError, match=what):
        evaluate(tmp_path / "out.csv", drbpn, points="none:0", **options)


# A gate ---------------------------------------------------------------------------------------


def test_a_gate_changes_what_spikes_do_and_tells_in_the_table(drbpn: Path, tmp_path: Path) -> None:
    out, points = tmp_path / "out.csv", "'spikes:1:50'"
    believed = evaluate(out, drbpn, points=points)
    bounded = evaluate(tmp_path / "bounded.csv", drbpn, points=points, gate=1)
    assert {row["method"] for row in believed} == {"drbpn"}
    assert {row["method"] for row in bounded} == {"drbpn, gate 1"}
    assert [r["log_likelihood"] for r in believed] != [r["log_likelihood"] for r in bounded]
    two = evaluate(tmp_path / "two.csv", drbpn, points=points + ",none:0", gate=1, processes=2)
    assert [row for row in two if row["point"] != "none:0"] == bounded
    with pytest.raises(UserError, match="with method drbpn, and drbpn, gate 1 is asked for"):
        evaluate(out, drbpn, points=points, gate=1)


def test_tables_with_a_gate_have_a_name_of_their_own(drbpn: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(drbpn, folder)
    base = configured("points=[none:0]", "gate=2.5") | {"run": str(folder), "figures": False}
    assert recipe.run(base | {"processes": 1, "episodes": 2}) == 0
    assert (folder / "points-gate2.5.csv").is_file()
    assert not (folder / "points.csv").exists()
    with pytest.raises(UserError, match=r"`output` must not be called points\.csv with a gate"):
        recipe.run(base | {"output": str(folder / "points.csv")})


@pytest.mark.parametrize("gate", [0, "wide", True])
def test_a_gate_that_is_no_positive_number_is_one_line(
    drbpn: Path, tmp_path: Path, gate: Any
) -> None:
    with pytest.raises(UserError, match="`gate` must be a positive, finite number"):
        evaluate(tmp_path / "out.csv", drbpn, points="none:0", gate=gate)


def test_a_belief_without_a_forecast_has_no_gate(feedforward: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="`gate` must be null for belief=none, got 3"):
        evaluate(tmp_path / "out.csv", feedforward, points="none:0", gate=3)


# Sensors that fail together -------------------------------------------------------------------


def test_groups_hold_every_component_once_in_every_named_task() -> None:
    sizes = {("Reacher", "v4"): 11, ("Reacher", "v5"): 10}
    for task, version in named_tasks():
        grouped = 0
        for obs_dim in [sizes[task, version]] if (task, version) in sizes else range(4, 400):
            try:
                names = sensor_names(task, version, obs_dim)
            except UserError:
                continue  # no size of this task; some size is
            grouped += 1
            for by in ("joint", "kind"):
                groups = sensor_groups(names, by)
                assert groups is not None
                assert sorted(i for group in groups for i in group) == list(range(obs_dim))
                assert 1 < len(groups) < obs_dim, (task, by)
        assert grouped, (task, version)


def test_a_joint_is_its_angle_and_its_velocity_and_a_kind_all_positions() -> None:
    names = sensor_names("Hopper", "v5", 11)
    assert sensor_groups(names, "sensor") is None
    joints = sensor_groups(names, "joint")
    assert joints == [[0, 1, 5, 6, 7], [2, 8], [3, 9], [4, 10]]
    assert sensor_groups(names, "kind") == [[0, 1, 2, 3, 4], [5, 6, 7, 8, 9, 10]]


def test_groups_need_names() -> None:
    with pytest.raises(UserError, match="goes by the names of the sensors"):
        sensor_groups(["component 0", "component 1"], "joint")
    with pytest.raises(UserError, match="`group_by` must be sensor, joint or kind"):
        sensor_groups(["pole angle"], "leg")


# Figures --------------------------------------------------------------------------------------


def test_a_figure_has_a_panel_a_family_and_kind_of_action(drbpn: Path, tmp_path: Path) -> None:
    points = "none:0,'mcar:0.5','reduction:0.5:random','outages:0.5:2','outages:0.5:9','noise:1'"
    evaluate(tmp_path / "out.csv", drbpn, points=points, figures=True)
    assert (tmp_path / "out-InvertedPendulum-v5.png").is_file()
    (figure,) = draw_evaluation(pd.read_csv(tmp_path / "out.csv")).values()
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    kinds = ["MCAR", "outages 0.5 sensor", "reduction random"]  # noise has one level
    assert titles == [f"{kind}, {mode}" for mode in ("mean", "sampled") for kind in kinds]
