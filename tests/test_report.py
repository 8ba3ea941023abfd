"""The report of finished runs.

Every seed stands beside every mean and none is left out: a mean over fewer seeds than were run is
not given. The tables are those of the run folders, the same folders give the same bytes, and the
commands give back the configurations. A folder that can't be used, or runs that make no mean
together, are answered with one line, and an earlier report is left as it was.
"""

from __future__ import annotations

import csv
import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("hydra")
pytest.importorskip("matplotlib")
from recipe_tools import make_config  # isort: skip

from assembly.errors import UserError
from assembly.report_commands import training_command
from assembly.report_runs import find_folders, flat, read_study
from assembly.report_tables import format_number
from assembly.run import EVALUATION_COLUMNS
from assembly.run_folder import Table, write_config
from report import run

FRAMES = [100, 200, 300, 400]
VERSIONS = {"python": "3.11.7", "torch": "2.13.0", "platform": "here", "git_commit": "abc"}


def make_run(
    folder: Path,
    *overrides: str,
    seed: int = 0,
    final: float = 50.0,
    frames: list[int] = FRAMES,
    points: bool = True,
    versions: dict[str, str] = VERSIONS,
) -> Path:
    """Write what a run leaves behind, with numbers that are easy to sum up."""
    folder.mkdir(parents=True)
    choices = ("env=hopper", "env.version=v4", "total_frames=400", f"seed={seed}")
    config = make_config(*choices, *overrides)
    write_config(folder, config)
    (folder / "versions.json").write_text(json.dumps(versions))
    columns = ("frames", "return", "missing_ratio", "log_likelihood", "steps_per_second")
    last = {"return": final, "missing_ratio": 0.3, "log_likelihood": 1.5, "steps_per_second": 200.0}
    first = last | {"return": None, "missing_ratio": 0.1, "steps_per_second": 100.0}
    rows = [{"frames": n, **(first if n == frames[0] else last)} for n in frames]
    Table(folder / "metrics.csv", columns).append(rows)
    numbers = {"return_std": 1.0, "length_mean": 9.0, "missing_ratio": 0.25, "log_likelihood": 1.0}
    evaluations = [
        {"frames": n, "kind": kind, "mode": mode, "episodes": 3, "return_mean": final} | numbers
        for n, kind in ((200, "training"), (400, "final"))
        for mode in ("sampled", "mean")
        if n <= frames[-1]
    ]
    Table(folder / "evaluation.csv", EVALUATION_COLUMNS).append(evaluations)
    if points:
        episodes = [
            {"frames": 400, "mechanism": mechanism, "eta": eta, "mode": "sampled", "episode": i}
            | {"return": value, "length": length, "missing_ratio": eta, "log_likelihood": None}
            for mechanism, eta, returns in (("none", 0.0, (90, 110)), ("mcar", 0.5, (80, 90)))
            for i, (value, length) in enumerate(zip(returns, (10, 30), strict=True))
        ]
        Table(folder / "points.csv", ("frames", *(k for k in episodes[0] if k != "frames"))).append(
            episodes
        )
    return folder


def report(folders: list[Path] | str, out: Path, **options: Any) -> None:
    wanted = folders if isinstance(folders, str) else [str(folder) for folder in folders]
    base = {"run": wanted, "out": str(out), "title": None, "rows": 100, "unfinished": False}
    assert run(base | options) == 0


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def quantity(out: Path, name: str, **where: str) -> dict[str, str]:
    found = [
        row
        for row in table(out / "summary.csv")
        if row["quantity"] == name and all(row[key] == value for key, value in where.items())
    ]
    assert len(found) == 1, (name, where, found)
    return found[0]


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
    assert "**51.00** (50.00, 51.00, 52.00)" in (tmp_path / "out" / "README.md").read_text()


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
    assert "**none** (85.00, none)" in (tmp_path / "out" / "README.md").read_text()


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


# Rebuilding -----------------------------------------------------------------------------------


def test_the_same_run_folders_give_the_same_bytes(seeds: list[Path], tmp_path: Path) -> None:
    report(seeds, tmp_path / "first" / "study")
    moved = shutil.copytree(tmp_path / "runs", tmp_path / "elsewhere")
    report(str(moved / "*"), tmp_path / "second" / "study")
    first, second = (sorted((tmp_path / n / "study").iterdir()) for n in ("first", "second"))
    assert [p.name for p in first] == [p.name for p in second]
    assert len(first) == 6
    for one, other in zip(first, second, strict=True):
        assert one.read_bytes() == other.read_bytes(), one.name


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
    with pytest.raises(UserError, match="`run` and `out` must be given"):
        report([], tmp_path / "out", run=None)
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="`out` must be a folder"):
        report([], tmp_path / "file")
