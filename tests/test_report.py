"""The report of finished runs.

Every seed stands beside every mean and none is left out: a mean over fewer seeds than were run is
not given. Interquartile means, intervals, margins and sample efficiency are what a few numbers give
by hand. The same folders give the same bytes, also from a copy of what is committed, and the
commands give back the configurations. A folder that can't be used, or runs that make no mean
together, are answered with one line, and an earlier report is left as it was.
"""

from __future__ import annotations

import dataclasses
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("hydra")
pytest.importorskip("matplotlib")
from recipe_tools import ROOT, make_config  # isort: skip
from report_tools import ASKED, VERSIONS, make_run, quantity, report, table  # isort: skip

from analysis.report_commands import training_command
from analysis.report_evaluations import point_kind, point_order
from analysis.report_index import index_page, studies_of
from analysis.report_paper import steps_to_threshold, top_return
from analysis.report_runs import StudyRun, find_folders, flat, read_study
from analysis.report_tables import format_number
from report import run
from training.errors import UserError
from training.run_folder import Table, write_table

COMMITTED = sorted(path.parent for path in (ROOT / "results").glob("*/runs"))


@pytest.fixture
def seeds(tmp_path: Path) -> list[Path]:
    return [make_run(tmp_path / "runs" / f"s{s}", seed=s, final=50.0 + s) for s in (0, 1, 2)]


# What is in it --------------------------------------------------------------------------------


def test_the_mean_over_seeds_stands_beside_every_seeds_own_number(
    seeds: list[Path], tmp_path: Path
) -> None:
    report(seeds, tmp_path / "out")
    row = quantity(tmp_path / "out", "training return")
    assert (row["mean"], row["std"], row["seeds"]) == ("51", "1", "3")
    assert row["per_seed"] == "0=50 1=51 2=52"
    assert (
        "**51.00** [50.00, 52.00] (50.00, 51.00, 52.00)"
        in (tmp_path / "out" / "README.md").read_text()
    )


def test_means_over_a_run_weigh_every_rollout_the_same(seeds: list[Path], tmp_path: Path) -> None:
    report(seeds[:1], tmp_path / "out")
    # Three rollouts at .3 and one at .1; 400 frames in 100/100 + 300/200 seconds.
    assert quantity(tmp_path / "out", "training missing ratio")["mean"] == "0.25"
    assert quantity(tmp_path / "out", "training steps/s")["mean"] == "160"
    assert quantity(tmp_path / "out", "training return")["std"] == ""


def test_episodes_of_a_point_are_summed_up_over_their_steps(
    seeds: list[Path], tmp_path: Path
) -> None:
    report(seeds, tmp_path / "out")
    rows = table(tmp_path / "out" / "evaluation.csv")
    assert len(rows) == 3 * (4 + 2)
    (point,) = [r for r in rows if r["seed"] == "1" and r["point"] == "mcar:0.5"]
    assert (point["source"], point["episodes"], point["return_mean"]) == ("points", "2", "85")
    assert (point["length_mean"], point["missing_ratio"]) == ("20", "0.5")
    kept = quantity(tmp_path / "out", "evaluation return kept", point="mcar:0.5", mode="sampled")
    assert kept["mean"] == "0.85"


def test_a_mean_that_lacks_a_seed_is_not_given(tmp_path: Path) -> None:
    folders = [make_run(tmp_path / f"s{s}", seed=s, points=s == 0) for s in (0, 1)]
    report(folders, tmp_path / "out")
    row = quantity(tmp_path / "out", "evaluation return", point="mcar:0.5")
    assert (row["mean"], row["per_seed"]) == ("", "0=85 1=")
    assert "| mcar:0.5 |  | **none** |" in (tmp_path / "out" / "README.md").read_text()


def test_learning_curves_are_thinned_over_the_whole_run(seeds: list[Path], tmp_path: Path) -> None:
    report(seeds, tmp_path / "out", rows=2)
    rows = [row for row in table(tmp_path / "out" / "training.csv") if row["seed"] == "2"]
    assert [row["frames"] for row in rows] == ["200", "400"]
    assert [row["missing_ratio"] for row in rows] == ["0.2", "0.3"]


def test_tasks_and_corruptions_have_means_of_their_own(tmp_path: Path) -> None:
    folders = [
        make_run(tmp_path / "a", final=10.0),
        make_run(tmp_path / "b", "env=walker2d", "env.version=v4", final=20.0),
        make_run(tmp_path / "c", "missingness=mcar", "missingness.eta=0.2", final=30.0),
    ]
    report(folders, tmp_path / "out")
    rows = [
        r for r in table(tmp_path / "out" / "summary.csv") if r["quantity"] == "training return"
    ]
    found = [(row["task"], row["trained_on"], row["mean"]) for row in rows]
    assert found == [
        ("Hopper-v4", "mar:0.5", "10"),
        ("Hopper-v4", "mcar:0.2", "30"),
        ("Walker2d-v4", "mar:0.5", "20"),
    ]


def test_figures_are_drawn_and_a_stale_one_does_not_stay(seeds: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    report(seeds, out)
    for name in ("learning_curves.png", "robustness.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")
        assert (out / name).stat().st_size > 10_000
    for folder in seeds:
        (folder / "points.csv").unlink()
    report(seeds, out)
    assert not (out / "robustness.png").exists()
    assert "robustness.png" not in (out / "README.md").read_text()


def test_versions_that_differ_are_told_run_by_run(tmp_path: Path) -> None:
    folders = [
        make_run(tmp_path / f"s{s}", seed=s, versions=VERSIONS | {"torch": f"2.13.{s}"})
        for s in (0, 1)
    ]
    report(folders, tmp_path / "out")
    page = (tmp_path / "out" / "README.md").read_text()
    assert "- torch: 2.13.0 (s0); 2.13.1 (s1)\n" in page
    assert "- python: 3.11.7\n" in page
    assert "platform" not in page
    assert str(tmp_path) not in page


# Beside the paper -----------------------------------------------------------------------------


def test_margins_over_other_methods_stand_beside_those_of_the_paper(tmp_path: Path) -> None:
    finals = {"drbpn": (240.0, 260.0), "dvrl": (90.0, 110.0), "fill": (400.0, 600.0)}
    folders = [
        make_run(tmp_path / f"{m}{s}", method=m, seed=s, final=returns[s], points=False)
        for m, returns in finals.items()
        for s in (0, 1)
    ]
    report(folders, tmp_path / "out")
    rows = [row for row in table(tmp_path / "out" / "margins.csv") if row["mode"] == "sampled"]
    assert [(row["over"], row["margin"], row["paper"]) for row in rows] == [
        ("dvrl", "1.5", "0.2"),  # Hopper
        ("fill", "-0.5", ""),
    ]
    # 240 / 110 and 260 / 90 are the extremes of 16 resamples.
    assert [float(rows[0][end]) for end in ("low", "high")] == pytest.approx(
        [240 / 110 - 1, 260 / 90 - 1], abs=1e-5
    )
    page = (tmp_path / "out" / "README.md").read_text()
    assert "| mar:0.5 | sampled actions | `dvrl` | 400 | +150 % [+" in page
    assert "python recipes/study.py study=grid\n" in page
    assert "python recipes/report.py 'run=runs/grid/*' out=results/out rows=100\n" in page


def test_runs_of_unequal_length_are_compared_at_equal_steps_too(tmp_path: Path) -> None:
    """The other method was stopped at 200 steps: as long as it ran, drbpn had 20, it had 40."""
    for seed in (0, 1):
        folder = make_run(tmp_path / f"d{seed}", method="drbpn", seed=seed, final=80.0)
        rows = table(folder / "metrics.csv")
        for row in rows[:2]:
            row["return"] = "20"
        write_table(folder / "metrics.csv", rows)
        name = tmp_path / f"p{seed}"
        make_run(name, "total_frames=200", frames=[100, 200], method="dvrl", seed=seed, final=40.0)
        (name / "points.csv").unlink()
        evaluated = table(name / "evaluation.csv")
        for row in evaluated:
            row["kind"] = "final"
        write_table(name / "evaluation.csv", evaluated[:2])
    report([tmp_path / n for n in ("d0", "d1", "p0", "p1")], tmp_path / "out")
    rows = [r for r in table(tmp_path / "out" / "margins.csv") if r["mode"] == "sampled"]
    found = [(r["point"], r["steps"], r["steps_over"], r["margin"]) for r in rows]
    assert found == [("mar:0.5", "400", "200", "1"), ("training", "200", "200", "-0.5")]
    page = (tmp_path / "out" / "README.md").read_text()
    assert "| `dvrl` | 400 and 200 | +100 % [+100 %, +100 %] | +20 % |" in page
    assert "| training | sampled actions | `dvrl` | 200 | -50 % [-50 %, -50 %] | +20 % |" in page


def test_over_all_tasks_returns_are_shares_of_the_papers_thresholds(tmp_path: Path) -> None:
    finals = {"hopper": (1000.0, 3000.0), "walker2d": (3000.0, 6000.0)}  # thresholds 2000, 3000
    folders = [
        make_run(tmp_path / f"{t}{s}", f"env={t}", "env.version=v4", seed=s, final=f, points=False)
        for t, returns in finals.items()
        for s, f in enumerate(returns)
    ]
    # A method with one task only is not compared with one that has both.
    folders.append(make_run(tmp_path / "gru", "belief=gru", points=False))
    report(folders, tmp_path / "out")
    rows = [r for r in table(tmp_path / "out" / "aggregate.csv") if r["mode"] == "sampled"]
    assert [(r["method"], r["iqm"], r["runs"]) for r in rows] == [("drbpn", "1.25", "4")]


@pytest.fixture
def clean_run(tmp_path: Path) -> StudyRun:
    folder = make_run(tmp_path / "clean", "experiment=clean", "env.version=v4", points=False)
    episodes = [{"frames": 10 * i, "return": float(i), "length": 10} for i in range(1, 31)]
    episodes.append({"frames": 2_000_001, "return": 1e9, "length": 10})  # too late
    Table(folder / "episodes.csv", ("frames", "return", "length")).append(episodes)
    (run_read,) = read_study([folder])
    return run_read


def test_the_top_ten_are_the_best_episodes_within_two_million_steps(clean_run: StudyRun) -> None:
    assert top_return(clean_run) == np.mean(range(21, 31))
    assert top_return(dataclasses.replace(clean_run, episodes=clean_run.episodes[:9])) is None


def test_a_threshold_is_reached_by_a_mean_of_a_hundred_episodes(clean_run: StudyRun) -> None:
    def steps(*rows: tuple[int, int, float | None]) -> int | None:
        keys = ("frames", "episodes", "return")
        training = [dict(zip(keys, row, strict=True)) for row in rows]
        return steps_to_threshold(dataclasses.replace(clean_run, training=training), 2000.0)

    lucky, good, bad = (2048, 7, 2500.0), (8192, 130, 2001.0), (6144, 120, 1999.0)
    assert steps((1024, 0, None), lucky, (4096, 100, None), bad, good) == 8192
    assert steps(lucky, bad) is None
    assert steps((2_000_001, 900, 2500.0)) is None


def test_runs_with_spikes_are_not_complete_and_exact_and_have_a_mean_of_their_own(
    tmp_path: Path,
) -> None:
    spikes = ("noise=spikes", "noise.sigma=0", "noise.spike_probability=0.1", "noise.spike_std=5")
    make_run(tmp_path / "exact", "experiment=clean", "env.version=v4")
    make_run(tmp_path / "spiked", "experiment=clean", "env.version=v4", *spikes, final=10.0)
    report([tmp_path / "exact", tmp_path / "spiked"], tmp_path / "out")
    assert len(table(tmp_path / "out" / "efficiency.csv")) == 1
    row = quantity(tmp_path / "out", "training return", trained_on="none:0 spikes:0.1:5")
    assert row["mean"] == "10"


def test_sample_efficiency_is_told_of_clean_runs_and_says_what_was_not_reached(
    clean_run: StudyRun, tmp_path: Path
) -> None:
    del clean_run  # written
    make_run(tmp_path / "noisy", points=False)
    report([tmp_path / "clean", tmp_path / "noisy"], tmp_path / "out")
    rows = table(tmp_path / "out" / "efficiency.csv")
    assert [(r["task"], r["threshold"], r["steps_to_threshold"]) for r in rows] == [
        ("Hopper-v4", "2000", "")
    ]
    page = (tmp_path / "out" / "README.md").read_text()
    assert "| `drbpn` | 0 | **25.50** (25.50) | 2000 | not reached in 400 |" in page


# Points ---------------------------------------------------------------------------------------


def test_points_of_one_kind_differ_in_one_number() -> None:
    names = ["none:0", "mcar:0.5", "reduction:0.4:model", "outages:0.5:20:sensor", "spikes:0.1:10"]
    assert [point_kind(name) for name in names] == [
        "none",
        "mcar",
        "reduction model",
        "outages 0.5 sensor",
        "spikes 10",
    ]
    assert [point_order(name)[1] for name in names] == [0.0, 0.5, 0.4, 20.0, 0.1]
    assert point_order("outages:0.5")[1] == 0.5
    assert sorted(["mcar:0.2", "none:0", "mar:0.5"], key=point_order)[0] == "none:0"


def test_points_go_by_the_name_that_the_evaluation_gave_them(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    rows = table(folder / "points.csv")
    for row in rows:  # two ways of taking sensors away, which mechanism and eta do not tell apart
        if row["mechanism"] == "mcar":
            row["mechanism"], row["eta"] = "none", "0"
            row["point"] = f"reduction:0.5:{'model' if row['episode'] == '0' else 'random'}"
    for row in rows:
        row.setdefault("point", "none:0")
    write_table(folder / "points.csv", rows)
    report([folder], tmp_path / "out")
    means = {
        row["point"]: row["return_mean"]
        for row in table(tmp_path / "out" / "evaluation.csv")
        if row["source"] == "points"
    }
    assert means == {"none:0": "100", "reduction:0.5:model": "80", "reduction:0.5:random": "90"}


def episodes(folder: Path, name: str, seed: int, returns: dict[str, list[float]]) -> None:
    """Write a table of recipes/evaluate.py: returns of episodes by point."""
    write_table(
        folder / name,
        [
            {"frames": 400, "mechanism": "mcar", "eta": 0.5, "point": point, "mode": "sampled"}
            | {"episode": i, "return": value, "length": 10, "missing_ratio": 0.5, "seed": seed}
            for point, values in returns.items()
            for i, value in enumerate(values)
        ],
    )


def test_a_point_of_two_tables_is_one_evaluation_that_of_the_grid(tmp_path: Path) -> None:
    """Five episodes of one seed and two of another are neither seven nor five of both."""
    folder = make_run(tmp_path / "run", points=False)
    episodes(folder, "points.csv", 99, {"mcar:0.5": [1.0] * 5, "mcar:0.3": [7.0]})
    episodes(folder, "robustness.csv", 1, {"mcar:0.5": [10.0, 20.0]})
    report([folder], tmp_path / "out")
    found = {
        row["point"]: (row["table"], row["episode_seed"], row["episodes"], row["return_mean"])
        for row in table(tmp_path / "out" / "evaluation.csv")
        if row["source"] == "points"
    }
    assert found == {
        "mcar:0.5": ("robustness.csv", "1", "2", "15"),
        "mcar:0.3": ("points.csv", "99", "1", "7"),
    }


# Commands -------------------------------------------------------------------------------------


def commands(page: Path, program: str) -> list[str]:
    return [line for line in page.read_text().splitlines() if f"recipes/{program}" in line]


def test_the_evaluation_of_a_mixed_study_asks_no_agent_for_a_model_that_it_lacks(
    tmp_path: Path,
) -> None:
    """Points of the grid are asked for as the grid, which knows; others run by run."""
    grid = {"none:0": [1.0] * 30, "mcar:0.5": [1.0] * 30}
    for method in ("drbpn", "gru"):
        name = tmp_path / "runs" / method
        folder = make_run(name, f"belief={method}", method=method, points=False)
        model = {"reduction:0.5:model": [1.0] * 30} if method == "drbpn" else {}
        episodes(folder, "robustness.csv", 10_000, grid | model)
    report(str(tmp_path / "runs" / "*"), tmp_path / "out")
    page = tmp_path / "out" / "README.md"
    every = "for run in $(dirname runs/grid/*/config.yaml)"
    assert commands(page, "evaluate.py")[0] == (
        f"{every}; do python recipes/evaluate.py run=$run 'modes=[sampled]'; done"
    )
    for method in ("drbpn", "gru"):
        folder = tmp_path / "runs" / method
        (folder / "robustness.csv").rename(folder / "points.csv")
    report(str(tmp_path / "runs" / "*"), tmp_path / "out")
    first, second = commands(page, "evaluate.py")
    assert first.startswith("for run in runs/grid/drbpn; do")
    assert "reduction:0.5:model" in first
    assert second.startswith("for run in runs/grid/gru; do")
    assert "points=[none:0,mcar:0.5]" in second


def test_the_command_of_an_evaluation_names_what_is_not_the_default(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run", points=False)
    episodes(folder, "robustness.csv", 7, {"nmar:0.5": [1.0] * 5, "spikes:0.05:5": [1.0] * 5})
    report([folder], tmp_path / "out")
    (line,) = commands(tmp_path / "out" / "README.md", "evaluate.py")
    words = "full=true episodes=5 'modes=[sampled]' seed=7"
    assert line == f"python recipes/evaluate.py run=runs/run {words}"
    episodes(folder, "robustness.csv", 7, {"nmar:0.55": [1.0] * 5})  # on no grid
    report([folder], tmp_path / "out")
    (line,) = commands(tmp_path / "out" / "README.md", "evaluate.py")
    assert "'points=[nmar:0.55]' episodes=5" in line


# Rebuilding -----------------------------------------------------------------------------------


def test_the_same_run_folders_give_the_same_bytes(seeds: list[Path], tmp_path: Path) -> None:
    report(seeds, tmp_path / "first" / "study")
    moved = shutil.copytree(tmp_path / "runs", tmp_path / "elsewhere")
    report(str(moved / "*"), tmp_path / "second" / "study")
    first, second = (sorted((tmp_path / n / "study").iterdir()) for n in ("first", "second"))
    assert [p.name for p in first] == [p.name for p in second]
    assert len(first) == 7
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes(), one.name


def test_a_report_is_made_again_from_a_copy_of_what_is_committed(
    seeds: list[Path], tmp_path: Path
) -> None:
    study = tmp_path / "results" / "study"
    study.mkdir(parents=True)
    (study / "notes.md").write_text("What we saw.\n\nMore of it.\n")
    report(seeds, study, title='Three "seeds"', rows=3)
    shutil.copytree(tmp_path / "runs", study / "runs")
    clone = shutil.copytree(tmp_path / "results", tmp_path / "clone")
    for path in (clone / "study").glob("*.*"):  # of what is committed, the made files
        if path.name not in ("notes.md", "report.yaml"):
            path.unlink()
    run(ASKED | {"index": str(clone)})
    for path in (p for p in study.iterdir() if p.is_file()):
        assert (clone / "study" / path.name).read_bytes() == path.read_bytes(), path.name
    index = (clone / "README.md").read_text()
    assert '## [Three "seeds"](study/README.md)\n\nWhat we saw.\n' in index
    assert "More of it" not in index
    report([], study, run=None)  # once more, in its own place
    run(ASKED | {"index": str(tmp_path / "results")})
    assert (tmp_path / "results" / "README.md").read_text() == index
    assert "# Three" in (study / "README.md").read_text()


def test_the_committed_index_is_what_the_committed_tables_give() -> None:
    """And those are what the committed runs give, as the next test says."""
    results = ROOT / "results"
    assert index_page(results, studies_of(results)) == (results / "README.md").read_text()


def test_the_index_holds_the_tables_of_every_study_beside_the_papers_figures(
    tmp_path: Path,
) -> None:
    results = tmp_path / "results"
    for method, final in (("drbpn", 50.0), ("dvrl", 40.0)):
        make_run(results / "gaps" / "runs" / method, method=method, final=final)
    make_run(results / "clean" / "runs" / "a", "experiment=clean", "env.version=v4", points=False)
    noisy = ("experiment=clean", "noise=gaussian", "noise.sigma=0.5", "env.version=v4")
    make_run(results / "clean" / "runs" / "b", *noisy, final=7.0, points=False)
    (results / "gaps" / "sensors").mkdir()
    run(ASKED | {"index": str(results)})
    clean, gaps = (results / "README.md").read_text().split("\n## ")[1:]
    assert "| Hopper-v4 | `drbpn` | none:0, sigma 0 | 1 | **50.00** | **50.00** | 2000 |" in clean
    assert "| Hopper-v4 | `drbpn` | none:0, sigma 0.5 | 1 | **7.00** | **7.00** |  |" in clean
    assert "| task | method | trained on | seeds | training | none:0 | mcar:0.5 | mar:0.5 |" in gaps
    line = "| Hopper-v4 | `dvrl` | mar:0.5, sigma 1 | 1 | **40.00** | **100** | **85.00** |"
    assert line in gaps
    line = "| Hopper-v4 | mar:0.5, sigma 1 | mar:0.5 | `dvrl` | 400 | +25 % | +20 % |"
    assert line in gaps
    assert "paper |" not in gaps.split("margin")[0]  # no threshold beside runs with gaps
    assert "steps to it" not in gaps
    _, lines = clean.split("| task | method | top-10 return of each seed | paper's threshold |")
    (line,) = [line for line in lines.splitlines() if "`drbpn`" in line]
    assert line.endswith("| 2000 | not reached |")
    assert "Beside it: [sensors](gaps/sensors/)." in gaps
    for study, text in (("clean", clean), ("gaps", gaps)):
        assert (results / study / "learning_curves.png").is_file()
        assert f"]({study}/learning_curves.png)" in text


@pytest.mark.parametrize("study", COMMITTED, ids=lambda path: path.name)
def test_committed_tables_are_what_their_runs_give(study: Path, tmp_path: Path) -> None:
    copy = tmp_path / study.name
    copy.mkdir()
    for name in ("notes.md", "report.yaml"):
        shutil.copy(study / name, copy / name)
    report(str(study / "runs" / "*"), copy)
    for path in (*study.glob("*.csv"), study / "README.md"):
        assert (copy / path.name).read_bytes() == path.read_bytes(), path.name


def test_the_command_of_a_run_gives_its_configuration_back(tmp_path: Path) -> None:
    overrides = ("missingness=nmar", "experiment=paper", "belief=none", "heads.hidden=[8]")
    folder = make_run(tmp_path / "odd", *overrides, "noise=none", seed=3)
    (odd,) = read_study([folder])
    program, *words = shlex.split(training_command(odd))[1:]
    assert program == "recipes/ppo_drbpn.py"
    again = make_config(*(word for word in words if not word.startswith("hydra.")))
    assert flat(again) == flat(odd.config)


def test_numbers_have_one_form() -> None:
    numbers = (1.0, 1234567.8, 0.000123456789, -0.0, float("nan"), None, 3, 50.125)
    assert [format_number(n) for n in numbers] == [
        "1",
        "1234568",
        "0.000123457",
        "0",
        "",
        "",
        "3",
        "50.125",
    ]


# Bad input ------------------------------------------------------------------------------------


def test_a_run_that_is_not_finished_is_refused_unless_asked_for(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "half", frames=[100, 200], points=False)
    with pytest.raises(UserError, match=r"`half` has 200 of 400 steps.*unfinished=true"):
        report([folder], tmp_path / "out")
    report([folder], tmp_path / "out", unfinished=True)
    page = (tmp_path / "out" / "README.md").read_text()
    assert "`half` is not finished: 200 of 400 steps" in page
    assert "unfinished=true" in page


def test_a_run_before_its_first_rollout_is_listed_and_does_not_stop_the_report(
    seeds: list[Path], tmp_path: Path
) -> None:
    begun = make_run(tmp_path / "runs" / "begun", seed=3)
    header = (begun / "metrics.csv").read_text().splitlines()[0]
    # A row that is being written while the report reads has no end.
    with (seeds[2] / "metrics.csv").open("a") as file:
        file.write("500,1.0")
    for content in (f"{header}\n", None):
        if content is None:
            (begun / "metrics.csv").unlink()
        else:
            (begun / "metrics.csv").write_text(content)
        with pytest.raises(UserError, match=r"metrics\.csv"):
            report([*seeds, begun], tmp_path / "out")
        report([*seeds, begun], tmp_path / "out", unfinished=True)
        page = (tmp_path / "out" / "README.md").read_text()
        assert "- `begun` has finished no rollout yet\n" in page
        assert quantity(tmp_path / "out", "training return")["seeds"] == "3"
        shutil.rmtree(tmp_path / "out")
    with pytest.raises(UserError, match="`run` must name runs with a finished rollout, 1 have no"):
        report([begun], tmp_path / "out", unfinished=True)


def test_runs_that_make_no_mean_together_are_refused(tmp_path: Path) -> None:
    first = make_run(tmp_path / "first")
    with pytest.raises(UserError, match=r"`first` and `other` differ in optim.lr"):
        read_study([first, make_run(tmp_path / "other", "optim.lr=0.5", seed=1)])
    with pytest.raises(UserError, match=r"`first` and `twin` are the same .* seed 0"):
        read_study([first, make_run(tmp_path / "twin")])


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("metrics.csv", None, "`.*metrics.csv` can't be read"),
        ("metrics.csv", "a,b\n1,2\n", "`.*metrics.csv` lacks the columns frames, missing_ratio"),
        ("metrics.csv", "frames,return,missing_ratio\n", "metrics.csv is empty"),
        ("versions.json", "{", "`.*versions.json` can't be read"),
        ("config.yaml", None, "must be a run folder with config.yaml"),
        ("config.yaml", "seed: 1\n", "`.*config.yaml`: .* must have the keys"),
    ],
)
def test_a_bad_folder_is_answered_with_one_line_and_the_old_report_stays(
    seeds: list[Path], tmp_path: Path, file: str, content: str | None, message: str
) -> None:
    out = tmp_path / "out"
    report(seeds[:2], out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    if content is None:
        (seeds[2] / file).unlink()
    else:
        (seeds[2] / file).write_text(content)
    with pytest.raises(UserError, match=message) as caught:
        report(seeds, out)
    assert "\n" not in str(caught.value)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "runs"]


def test_no_folder_at_all_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="matches none"):
        find_folders(str(tmp_path / "*"))
    with pytest.raises(UserError, match="`out` must be given"):
        run(ASKED | {"run": str(tmp_path)})
    with pytest.raises(UserError, match=r"out/runs/\* matches none"):
        report([], tmp_path / "out", run=None)
    with pytest.raises(UserError, match=r"`index` .* leave out `run` and `out`"):
        run(ASKED | {"index": str(tmp_path), "out": "x"})
    with pytest.raises(UserError, match=r"`index` must be a folder of studies .* holds none"):
        run(ASKED | {"index": str(tmp_path)})
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="`out` must be a folder"):
        report([], tmp_path / "file")
