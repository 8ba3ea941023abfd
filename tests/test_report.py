"""Reports of run folders with numbers that are easy to sum up; statistics equal values by hand."""

import json
import shutil

import numpy as np
import pandas as pd
import pytest
from analysis.figures import draw_evaluation, episode_summary
from analysis.runs import read_runs
from analysis.statistics import interquartile_mean, interval, probability_of_improvement, ratio
from analysis.tables import derived_tables, point_kind, point_order
from evaluation.points import method_name, missingness_name
from matplotlib.backends.backend_agg import FigureCanvasAgg
from omegaconf import OmegaConf
from recipe_tools import ROOT, make_config, refused
from rendering.style import legend_below, panel_grid
from report import run
from training.run_folder import read_config, write_config, write_table

ASKED = {"run": None, "out": None, "from": None, "title": None}
ASKED |= {"table": None, "reference": "drbpn", "rows": 100, "unfinished": False}
FRAMES = [100, 200, 300, 400]
STUDIES = sorted(path.parent for path in (ROOT / "results").glob("*/runs.csv"))
WRITTEN = ("summary.csv", "aggregate.csv", "comparison.csv", "README.md")


def episodes(returns, mode="sampled"):
    """Rows of recipes/evaluate.py: of two episodes of a point the second is three times as long."""
    return [
        {"frames": 400, "point": point, "mode": mode, "episode": i, "return": value}
        | {"length": 10 + 20 * i, "missing_ratio": point_kind(point)[1], "diverged": 0}
        for point, values in returns.items()
        for i, value in enumerate(values)
    ]


HOPPER = ("env=hopper", "env.version=v4", "total_frames=400")


def make_run(folder, *overrides, seed=0, final=50.0, frames=FRAMES, points=None):
    folder.mkdir(parents=True)
    write_config(folder, OmegaConf.merge(make_config(*HOPPER, *overrides), {"seed": seed}))
    (folder / "versions.json").write_text(json.dumps({"torch": "2.13.0", "git_commit": "abc"}))
    numbers = {"episodes": 200, "return": final, "missing_ratio": 0.3, "log_likelihood": 1.5}
    curve = pd.DataFrame({"frames": frames, **numbers, "steps_per_second": 200.0})
    start = {"episodes": 0, "return": np.nan, "missing_ratio": 0.1, "steps_per_second": 100.0}
    curve.loc[0, list(start)] = list(start.values())
    curve.to_csv(folder / "metrics.csv", index=False)
    numbers = {"return_std": 1.0, "length_mean": 9.0, "missing_ratio": 0.25, "log_likelihood": 1.0}
    evaluations = [
        {"frames": n, "kind": kind, "mode": mode, "episodes": 3, "return_mean": final} | numbers
        for n, kind in ((200, "training"), (400, "final"))
        for mode in ("sampled", "mean")
        if n <= frames[-1]
    ]
    pd.DataFrame(evaluations).to_csv(folder / "evaluation.csv", index=False)
    found = {"none:0": (90.0, 110.0), "mcar:0.5": (80.0, 90.0)} if points is None else points
    write_table(folder / "robustness.csv", episodes(found))
    return folder


def report(folders, out, **options):
    wanted = folders if isinstance(folders, str) else [str(folder) for folder in folders]
    assert run(ASKED | {"run": wanted, "out": str(out)} | options) == 0
    return (out / "README.md").read_text()


def tables(folders, further=None):
    return derived_tables(read_runs(folders, further), "drbpn")


def row(table, point, mode="sampled", **where):
    for name, value in ({"point": point, "mode": mode} | where).items():
        table = table[table[name] == value]
    assert len(table) == 1, (point, mode, where, table)
    return table.iloc[0]


@pytest.fixture
def seeds(tmp_path):
    """Three seeds of one method: 40, 50, 90."""
    finals = enumerate((40.0, 50.0, 90.0))
    return [make_run(tmp_path / "runs" / f"s{i}", seed=i, final=value) for i, value in finals]


def test_the_interquartile_mean_leaves_out_a_quarter_on_each_side():
    values = np.array([[100.0, 1.0, 2.0, 3.0], [-7.0, 5.0, 5.0, 90.0]])
    assert interquartile_mean(values).tolist() == [2.5, 5.0]
    assert interquartile_mean(np.array([1.0, 2.0, 6.0])) == 3.0  # of three none is left out
    eight = np.arange(8.0) ** 2
    assert interquartile_mean(eight[:3], eight[3:]) == eight[2:6].mean()


def test_the_interval_of_few_runs_is_their_range_and_of_one_run_nothing():
    # One of 27 resamples is three times the lowest run: more than one in forty.
    assert interval([6.0, 1.0, 2.0]) == (1.0, 6.0)
    assert interval([6.0, 1.0]) == (1.0, 6.0)
    assert np.isnan(interval([6.0])).all()


def test_runs_are_resampled_within_their_task_and_curves_as_a_whole():
    assert interval([1.0, 1.0], [5.0, 5.0]) == (3.0, 3.0)
    curves = np.array([[1.0, 2.0, 4.0], [5.0, 6.0, 4.0]])
    low, high = interval(curves)
    assert [(low[i], high[i]) for i in (0, 1)] == [interval(curve) for curve in curves]


def test_the_probability_of_improvement_counts_pairs():
    first, second = np.array([3.0, 5.0]), np.array([1.0, 3.0, 9.0])
    # Of six pairs 3 > 1, 5 > 1, 5 > 3 are won and 3 = 3 is half won.
    assert probability_of_improvement(first, second) == pytest.approx(3.5 / 6)
    always = probability_of_improvement(first, second, np.array([9.0]), np.array([1.0]))
    assert always == pytest.approx((3.5 / 6 + 1) / 2)
    assert ratio(first, second[:2]) == 2.0


def test_a_run_is_called_by_its_belief_unless_it_is_named():
    config = make_config(*HOPPER, "belief=gru")
    assert method_name(config) == "gru"
    assert method_name({**config} | {"method": "mine"}) == "mine"
    assert method_name(make_config(*HOPPER, "belief=gru", "algo=acktr")) == "gru (acktr)"


def test_a_table_that_is_not_there_is_not_called_damaged(tmp_path):
    folder = make_run(tmp_path / "a")
    with refused(r"`nope\.csv` can't be read as a table: it is not there"):
        read_runs([folder], "nope.csv")


def test_a_task_without_a_version_of_its_own_is_called_by_its_id(tmp_path):
    gym = [make_run(tmp_path / "a", "env=gym", "env.id=Pendulum-v1", "env.version=null")]
    assert read_runs(gym).runs.task.item() == "Pendulum-v1"
    assert read_runs([make_run(tmp_path / "b")]).runs.task.item() == "Hopper-v4"


def test_points_of_one_kind_differ_in_one_number_and_are_sorted_by_it():
    assert point_kind("reduction:0.5:random") == ("reduction random", 0.5)
    assert point_kind("outages:0.5:20:joint") == ("outages 0.5 joint", 20.0)
    assert point_kind("spikes:0.05:5") == ("spikes 5", 0.05)
    shuffled = ["mcar:0.8", "none:0", "noise:10", "mcar:0.2", "training", "noise:3"]
    ordered = sorted(shuffled, key=dict(zip(shuffled, point_order(pd.Series(shuffled)), strict=True)).get)  # fmt: skip # noqa: E501
    assert ordered == ["training", "none:0", "mcar:0.2", "mcar:0.8", "noise:3", "noise:10"]
    outages = make_config("missingness=outages", "missingness.mean_length=20")["missingness"]
    assert missingness_name(outages).endswith(":20:sensor")


def test_means_over_seeds_stand_beside_every_seeds_own_number(seeds):
    summary = tables(seeds)["summary"]
    training = row(summary, "training")
    assert (training["return"], training.low, training.high) == (60, 40, 90)
    assert training.per_seed == "0=40 1=50 2=90"
    assert training.missing_ratio == pytest.approx((0.1 + 3 * 0.3) / 4)  # over all rollouts
    assert training.steps_per_second == pytest.approx(4 / (1 / 100 + 3 / 200))
    assert row(summary, "mar:0.5", "mean")["return"] == 60  # the run's own, at the end


def test_a_share_is_a_ratio_of_means_and_no_mean_lacks_a_seed(tmp_path):
    points = [
        {"none:0": (90.0, 110.0), "mcar:0.5": (85.0,)},
        {"none:0": (10.0,), "mcar:0.5": (20.0,)},
    ]
    folders = [make_run(tmp_path / f"s{i}", seed=i, points=p) for i, p in enumerate(points)]
    half = row(tables(folders)["summary"], "mcar:0.5")
    assert half["return"] == (85 + 20) / 2
    assert half.share == pytest.approx((85 + 20) / (100 + 10))  # not (0.85 + 2) / 2
    (folders[1] / "robustness.csv").unlink()
    points = set(tables(folders)["summary"].point)
    assert "mcar:0.5" not in points
    assert "training" in points


def test_a_point_of_two_tables_is_one_evaluation_that_of_the_grid(tmp_path):
    folder = make_run(tmp_path / "a")
    write_table(folder / "points.csv", episodes({"mcar:0.5": (1.0, 1.0), "nmar:0.5": (7.0, 7.0)}))
    summary = tables([folder])["summary"]
    assert row(summary, "mcar:0.5")["return"] == 85
    assert row(summary, "nmar:0.5")["return"] == 7


def test_a_table_over_several_runs_is_read_by_their_names(seeds, tmp_path):
    parts = [
        pd.DataFrame(episodes({"noise:3": (value,)})).assign(run=folder.name)
        for value, folder in zip((1.0, 2.0, 6.0), seeds, strict=True)
    ]
    write_table(tmp_path / "robust.csv", pd.concat(parts))
    summary = tables(seeds, str(tmp_path / "robust.csv"))["summary"]
    assert row(summary, "noise:3").per_seed == "0=1 1=2 2=6"


def test_settings_tasks_and_corruptions_have_means_of_their_own(tmp_path):
    kinds = [(), ("optim.lr=0.1",), ("missingness.eta=0.2",), ("noise.sigma=3",), ("env=ant",)]
    kinds += [("loss.model_coeff=0", "method=ppo_ours"), ("noise=spikes",)]
    folders = [
        make_run(tmp_path / f"{i}-{seed}", *kind, seed=seed, final=10.0 * i)
        for i, kind in enumerate(kinds)
        for seed in (0, 1)
    ]
    for seed, folder in zip((0, 1) * len(kinds), folders, strict=True):
        config = read_config(folder)
        # What follows the seed is no difference, nor is what changes speed alone.
        own = {"_target_": "my.Dropout", "seed": seed}
        more = {"collector_seed": seed, "transforms": {"own": own}}
        more |= {"threads": 1 + seed, "optim": config["optim"] | {"compile": bool(seed)}}
        write_config(folder, config | more)
    summary = tables(folders)["summary"]
    training = summary[summary.point == "training"]
    assert sorted(training["return"]) == [10.0 * i for i in range(len(kinds))]
    assert (training.seeds == 2).all()
    assert training[training["return"] == 10.0].settings.tolist() == ["optim.lr=0.1"]
    assert training[training["return"] == 50.0].method.tolist() == ["ppo_ours"]


def test_the_reference_is_compared_where_half_is_missing_and_at_equal_steps(tmp_path):
    points = {"none:0": (100.0,), "mcar:0.5": (60.0,)}
    folders = [make_run(tmp_path / f"a{i}", seed=i, final=40.0 + i, points=points) for i in (0, 1)]
    short = ("belief=dvrl", "total_frames=200")
    for i in (0, 1):
        path = make_run(tmp_path / f"b{i}", *short, seed=i, final=20.0, frames=[100, 200])
        rows = episodes({"none:0": (100.0,), "mcar:0.5": (50.0,)})
        write_table(path / "robustness.csv", [row | {"frames": 200} for row in rows])
        own = pd.read_csv(path / "evaluation.csv").assign(kind="final")
        write_table(path / "evaluation.csv", own)
        folders.append(path)
    comparison = tables(folders)["comparison"]
    half = row(comparison, "mcar:0.5")
    assert (half.over, half.margin, half.probability) == ("dvrl", pytest.approx(0.2), 1.0)
    assert (half.steps, half.steps_over, half.paper) == (400, 200, 0.2)
    equal = row(comparison, "training")
    assert equal.margin == pytest.approx(40.5 / 20 - 1)
    assert (equal.steps, equal.steps_over) == (200, 200)


def test_over_all_tasks_returns_are_shares_of_the_papers_thresholds(tmp_path):
    folders = [
        make_run(tmp_path / f"{env}{seed}", f"env={env}", seed=seed, points={"none:0": (value,)})
        for env, value in (("hopper", 2000.0), ("walker2d", 1500.0), ("reacher", -5.0))
        for seed in (0, 1)
    ]
    score = row(tables(folders)["aggregate"], "none:0")
    assert (score.tasks, score.runs) == (2, 4)
    assert (score.score, score.low, score.high) == (0.75, 0.75, 0.75)


def test_sample_efficiency_counts_within_two_million_steps(tmp_path):
    folder = make_run(tmp_path / "a", final=2500.0)
    table = pd.DataFrame({"frames": [*range(1, 12), 3_000_000], "return": [*range(11), 10**6]})
    write_table(folder / "episodes.csv", table)
    runs = read_runs([folder]).runs
    assert runs.top_10_return.item() == np.arange(1, 11).mean()
    assert runs.steps_to_threshold.item() == 200  # the first row of 100 episodes or more


def test_learning_curves_are_thinned_over_the_whole_run(seeds):
    curve = read_runs(seeds, rows=2).training.query("seed == 1")
    assert curve.frames.tolist() == [200, 400]
    np.testing.assert_allclose(curve.missing_ratio, [0.2, 0.3])


def test_the_tables_alone_give_the_same_page_and_keep_the_notes(seeds, tmp_path):
    out = tmp_path / "out"
    report(seeds, out, title="Three seeds")
    (out / "notes.md").write_text("What to conclude.")
    (out / "robustness_mean_actions.png").write_text("of an earlier report")
    page = report(seeds, out)
    assert page.startswith("# Three seeds\n\nWhat to conclude.\n")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert {"learning_curves.png", "robustness.png", "summary.csv", "runs.csv"} <= before.keys()
    assert "robustness_mean_actions.png" not in before  # no kind has two levels of mean actions
    shutil.rmtree(tmp_path / "runs")
    assert run(ASKED | {"from": str(tmp_path / "o*")}) == 0
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_a_page_has_means_intervals_shares_and_what_diverged(tmp_path):
    clean = ("experiment=clean", "total_frames=400")
    folders = [make_run(tmp_path / f"s{i}", *clean, seed=i, final=40.0 + i) for i in (0, 1)]
    table = pd.DataFrame(episodes({"none:0": (90.0, 110.0), "mcar:0.5": (80.0, 90.0)}))
    write_table(folders[0] / "robustness.csv", table.assign(diverged=[0, 0, 1, 0]))
    page = report(folders, tmp_path / "out")
    for text in ("**40.5** [40, 41]", "**85** [85, 85] 85% (diverged: 25%)", "commit: abc"):
        assert text in page  # one of four episodes diverged
    assert "the plain mean, and the interval" in page
    assert "## Sample efficiency" in page


def test_no_page_calls_readings_complete_that_a_transform_takes_away(tmp_path):
    clean = ("experiment=clean", "total_frames=400")
    chain = "{_target_: training.envs.make_outages, eta: 0.3, mean_length: 9.0, group_by: kind}"
    kinds = [("experiment=sensor_faults", "noise=spikes"), ("missingness=from_nan", *clean)]
    kinds += [(f"transforms.own={own}", *clean) for own in (chain, f"[{chain}]")]
    folders = [make_run(tmp_path / f"{i}", *kind, seed=i) for i, kind in enumerate(kinds)]
    assert read_runs(folders).runs.sort_values("seed").trained_on.tolist() == [
        "outages:0.2254:20:sensor outages:0.2254:20:kind spikes:0.05:5",
        "from_nan none:0",
        *["none:0 outages:0.3:9:kind"] * 2,
    ]
    assert "## Sample efficiency" not in report(folders, tmp_path / "out")


@pytest.mark.parametrize("name", ["acktr-v4-1m", "methods-v4-500k"])
def test_committed_tables_and_pages_are_what_the_committed_runs_give(name, tmp_path):
    copy = tmp_path / name
    shutil.copytree(ROOT / "results" / name, copy)
    assert run(ASKED | {"from": str(copy)}) == 0
    for written in WRITTEN:
        committed = ROOT / "results" / name / written
        assert committed.is_file() == (copy / written).is_file()
        if committed.is_file():
            assert (copy / written).read_text() == committed.read_text(), written


def test_results_stay_small():
    size = sum(path.stat().st_size for path in (ROOT / "results").rglob("*") if path.is_file())
    assert size < 10e6
    assert len(STUDIES) >= 12


def test_an_evaluation_draws_methods_noise_and_runs_of_one_seed_apart():
    def rows(run, method, sigma, value):
        table = pd.DataFrame(episodes({"mcar:0.2": (value,), "mcar:0.5": (value,)}, "mean"))
        agent = {"run": run, "env": "Hopper-v4", "method": method, "trained_on": "mar:0.5"}
        return table.assign(**agent, trained_noise_sigma=sigma, noise_sigma=0, training_seed=0)

    two = pd.concat([rows("a", "drbpn", 1.0, 3000.0), rows("b", "ppo_ours", 1.0, 100.0)])
    (figure,) = draw_evaluation(two).values()
    drawn = {line.get_label(): set(line.get_ydata()) for line in figure.axes[0].get_lines()}
    assert drawn == {"drbpn": {3000.0}, "ppo_ours": {100.0}}
    noises = pd.concat([rows("a", "drbpn", 1.0, 1.0), rows("b", "drbpn", 3.0, 3.0)])
    (figure,) = draw_evaluation(noises).values()
    assert [x.get_label() for x in figure.axes[0].get_lines()] == ["drbpn, sigma 1", "drbpn, sigma 3"]  # fmt: skip # noqa: E501
    twins = pd.concat([rows("a", "drbpn", 1.0, 1.0), rows("b", "drbpn", 1.0, 3.0)])
    assert sorted(set(episode_summary(twins).settings)) == ["a", "b"]
    seeds = twins.assign(training_seed=(twins.run == "b").astype(int))
    summary = episode_summary(seeds)
    assert set(summary["return"]) == {2.0}
    assert (summary.low.iloc[0], summary.high.iloc[0]) == (1.0, 3.0)


@pytest.mark.parametrize("panels", [1, 3])
def test_a_legend_is_as_wide_as_its_figure_and_no_wider(panels):
    figure, axes = panel_grid(1, panels, (3.0, 2.0))
    for method in range(7):
        axes[0, 0].plot([0, 1], label=f"a method with a long name {method}")
    legend_below(figure, 6)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    box = figure.legends[0].get_window_extent(canvas.get_renderer())
    assert 0 <= box.x0 < box.x1 <= figure.bbox.width
    assert box.y0 >= 0
    assert len(figure.legends) == 1


def test_a_run_without_evaluation_or_finished_episode_is_reported(tmp_path):
    folder = make_run(tmp_path / "a", "evaluation.final_episodes=0", points={})
    for name in ("evaluation.csv", "robustness.csv"):
        (folder / name).unlink()
    assert "## Evaluation" not in report([folder], tmp_path / "out")
    curve = pd.read_csv(folder / "metrics.csv").assign(**{"return": None})
    write_table(folder / "metrics.csv", curve)
    assert "## Training" in report([folder], tmp_path / "out")


def test_runs_that_are_not_finished_are_refused_unless_asked_for(tmp_path):
    folder = make_run(tmp_path / "a", frames=[100, 200])
    with refused(r"`a` has 200 of 400 steps or lacks its final evaluation"):
        report([folder], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert "- `a` is not finished: 200 steps" in report([folder], tmp_path / "out", unfinished=True)
    (folder / "evaluation.csv").unlink()
    with refused("lacks its final evaluation"):
        report([folder], tmp_path / "out")


def test_a_bad_folder_is_one_line_and_the_old_report_stays(seeds, tmp_path):
    page = report(seeds, tmp_path / "out")
    for name, content, line in (
        ("metrics.csv", "frames,return\n1,2\n", "lacks the columns missing_ratio: is it another"),
        ("metrics.csv", "frames\n1,2\n1,2,3\n", "can't be read as a table"),
        ("metrics.csv", None, "can't be read as a table"),
        ("config.yaml", "a: [", "config.yaml` can't be read as a configuration"),
        ("config.yaml", None, "must be a run folder with config.yaml"),
    ):
        bad = shutil.copytree(seeds[0], tmp_path / "bad")
        (bad / name).write_text(content) if content else (bad / name).unlink()
        with refused(line):
            report([*seeds, bad], tmp_path / "out")
        shutil.rmtree(bad)
    twin = shutil.copytree(seeds[0], tmp_path / "twin")
    with refused("are the same task, method, settings and corruption with"):
        report([*seeds, twin], tmp_path / "out")
    assert (tmp_path / "out" / "README.md").read_text() == page
