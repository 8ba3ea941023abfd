"""A study: a grid of runs as one job that can be killed at any moment.

Every combination of the axes is a cell with a folder of its own and its overrides, of which the
last one of a setting counts. What is done is not run again, what was cut off goes on from its last
checkpoint and has every rollout once, what has failed waits until it
is asked for, and a folder that is not the cell's own is left alone. Two calls never work on one
study; a run that a killed call has left behind is neither lost nor started twice.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("hydra")
from recipe_tools import ROOT, make_config, read_table  # isort: skip

from omegaconf import OmegaConf
from studies.cells import StudyFolder
from studies.grid import Cell, read_grid
from studies.job import StudyJob
from studies.status import duration, expected_speeds, seconds_left
from training.checkpoint import checkpoint_frames
from training.errors import UserError
from training.run_folder import write_config

STUDIES = sorted((ROOT / "conf" / "study").glob("*.yaml"), key=lambda path: path.stem)
# One process starts in seconds; the run itself then takes little more.
BRIEF = ["experiment=smoke", "total_frames=256", "evaluation.every_frames=0"]
PATIENCE = 240.0  # s; on a busy machine a process may take a minute to start
# Long enough to be caught while it runs, with a checkpoint after every rollout.
LONG = [
    "experiment=smoke",
    "total_frames=1_000_000",
    "evaluation.every_frames=0",
    "checkpoint.every_frames=128",
    "optim.epochs=1",
]


def grid_config(**changes: Any) -> dict[str, Any]:
    base: dict[str, Any] = {
        "name": "study",
        "overrides": ["total_frames=1000", "seed=9"],
        "axes": {
            "task": {"hopper": ["env=hopper"], "walker2d": ["env=walker2d"]},
            "method": {"gru": ["belief=gru"], "ours": ["belief=drbpn", "loss.model_coeff=0"]},
            "seed": {"s0": ["seed=0"], "s1": ["seed=1"]},
        },
        "cells": {},
        "skip": [],
    }
    return base | changes


def cells(*overrides: str, names: tuple[str, ...] = ("a",)) -> list[Cell]:
    return [Cell(name, {"method": name}, (*overrides, f"seed={i}")) for i, name in enumerate(names)]


def job(folder: Path, study: list[Cell], **options: Any) -> StudyJob:
    base: dict[str, Any] = {"at_once": 2, "retry_failed": False, "status_seconds": 60.0}
    return StudyJob(StudyFolder(folder), study, **(base | options))


def run(folder: Path, study: list[Cell], **options: Any) -> int:
    made = job(folder, study, **options)
    made.look()
    return made.run()


def wait(until: Callable[[], Any]) -> None:
    end = time.monotonic() + PATIENCE
    while not until():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


# Cells ----------------------------------------------------------------------------------------


def test_every_combination_is_a_cell_and_the_last_axis_turns_slowest() -> None:
    grid = read_grid(grid_config())
    names = [cell.name for cell in grid.cells]
    assert names[:4] == ["hopper-gru-s0", "hopper-ours-s0", "walker2d-gru-s0", "walker2d-ours-s0"]
    assert names[4:] == [name.replace("s0", "s1") for name in names[:4]]
    assert grid.cells[5].choices == {"task": "hopper", "method": "ours", "seed": "s1"}


def test_the_last_override_of_a_setting_counts() -> None:
    further = {"*-gru-s1": ["total_frames=50"], "hopper-*": ["++loss.gamma=.9"]}
    by_name = {cell.name: cell for cell in read_grid(grid_config(cells=further)).cells}
    assert by_name["walker2d-ours-s1"].overrides == (
        "total_frames=1000",
        "seed=1",
        "env=walker2d",
        "belief=drbpn",
        "loss.model_coeff=0",
    )
    settings = by_name["hopper-gru-s1"].settings()
    assert (settings.total_frames, settings.seed, settings.loss.gamma) == (50, 1, 0.9)


def test_cells_can_be_left_out_and_chosen() -> None:
    grid = read_grid(grid_config(skip=["hopper-gru-*"]))
    assert len(grid.cells) == 6
    assert [c.name for c in grid.chosen("*-gru-s1")] == ["walker2d-gru-s1"]
    assert len(grid.chosen(["hopper-*", "walker2d-gru-s0"])) == 3
    with pytest.raises(UserError, match=r"`only` must hold names or patterns .* 'ant-\*' matches"):
        grid.chosen("ant-*")


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"name": "a=b"}, "`study.name` must be a name of letters"),
        ({"axes": {}}, "`study.axes` must hold at least one axis"),
        ({"axes": {"task": {}}}, "`study.axes.task` must give each choice its overrides"),
        ({"axes": {"task": {"a,b": []}}}, "`study.axes.task` must be a name .* got 'a,b'"),
        ({"axes": {"task": {"a": "env=ant"}}}, "`study.axes.task.a` must be a list of overrides"),
        ({"axes": {"task": {"a": ["ant"]}}}, "`study.axes.task.a` must hold overrides .* 'ant'"),
        ({"axes": {"x": {"logs": []}}}, "`study.axes` can't name a cell logs"),
        (
            {"axes": {"x": {"a": [], "a-b": []}, "y": {"b-c": [], "c": []}}},
            "`study.axes` give two cells the name a-b-c",
        ),
        ({"overrides": ["resume=x"]}, "`study.overrides` can't hold 'resume=x'"),
        ({"overrides": ["hydra.run.dir=x"]}, "`study.overrides` can't hold 'hydra.run.dir=x'"),
        ({"cells": {"ant-*": ["seed=1"]}}, "`study.cells` must hold names .* 'ant-\\*' matches"),
        ({"skip": "hopper-*"}, "`study.skip` must be a list"),
        ({"other": 1}, "`study` must have the keys name, overrides, axes, cells, skip"),
    ],
)
def test_a_bad_grid_is_refused_in_one_line(changes: dict[str, Any], line: str) -> None:
    with pytest.raises(UserError, match=line) as error:
        read_grid(grid_config(**changes))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_every_study_of_conf_composes_into_settings(path: Path) -> None:
    config = OmegaConf.to_container(OmegaConf.load(path))
    assert isinstance(config, dict)
    grid = read_grid({str(key): value for key, value in config.items()})
    assert grid.name == path.stem
    # Each choice once: a choice means the same in every cell.
    fresh = set()
    for cell in grid.cells:
        if not set(cell.choices.items()) <= fresh:
            fresh |= set(cell.choices.items())
            cell.settings()


def test_the_studies_of_the_issue_are_what_they_claim() -> None:
    def settings(study: str, cell: str) -> Any:
        config: Any = OmegaConf.to_container(OmegaConf.load(ROOT / f"conf/study/{study}.yaml"))
        (chosen,) = read_grid(config).chosen(cell)
        return chosen.settings()

    robust = settings("robust", "walker2d-transformer-s2")
    assert (robust.env.env_id, robust.seed, robust.total_frames) == ("Walker2d-v4", 2, 1_000_000)
    assert (robust.missingness.mechanism, robust.missingness.eta) == ("mar", 0.5)
    assert (robust.noise.sigma, robust.belief["name"]) == (1.0, "transformer")
    assert settings("robust", "hopper-dvrl-s0").total_frames < 1_000_000
    ours, plain = (settings("clean", f"halfcheetah-{m}-s1") for m in ("ppo_ours", "ppo"))
    assert (ours.belief["name"], ours.loss.model_coeff) == ("drbpn", 0.0)
    assert plain.belief["name"] == "none"
    assert (ours.missingness.mechanism, ours.noise.sigma) == ("none", 0.0)


# How long it will take ------------------------------------------------------------------------


def test_the_time_left_is_that_of_runs_started_in_order() -> None:
    assert seconds_left([10.0], [5.0, 5.0], at_once=1) == 20.0
    assert seconds_left([10.0, 1.0], [5.0, 5.0], at_once=2) == 11.0
    assert seconds_left([], [4.0, 1.0, 1.0, 1.0], at_once=2) == 4.0
    # An earlier call had started three at a time: places fall away as they end.
    assert seconds_left([1.0, 2.0, 3.0], [10.0], at_once=1) == 13.0
    assert seconds_left([], [], at_once=2) == 0.0
    assert [duration(s) for s in (20, 600, 4000, 400_000)] == [
        "20 s",
        "10 min",
        "1 h 7 min",
        "4.6 days",
    ]


def test_the_overrides_that_a_study_suggests_leave_seeds_of_one_mean_alike() -> None:
    """The comment beside ``cells`` is what a reader copies; report.py has to take what it gives."""
    suggested = 0
    for path in STUDIES:
        config: Any = OmegaConf.to_container(OmegaConf.load(path))
        comment = re.search(r"^cells:.*?#.*?(\{'.*?\})", path.read_text(), re.MULTILINE)
        if comment is None:
            continue
        suggested += 1
        config["cells"] = yaml.safe_load(comment[1])
        by_mean: dict[tuple[str, ...], set[tuple[str, ...]]] = {}
        for cell in read_grid(config).cells:
            mean = tuple(choice for axis, choice in cell.choices.items() if axis != "seed")
            words = tuple(sorted(w for w in cell.overrides if not w.startswith("seed=")))
            by_mean.setdefault(mean, set()).add(words)
        assert {len(words) for words in by_mean.values()} == {1}
    assert suggested


def test_a_slow_method_is_expected_to_be_slow_on_every_task() -> None:
    study = read_grid(grid_config()).cells
    known = {"hopper-gru-s0": 100.0, "hopper-ours-s0": 1000.0, "walker2d-gru-s0": 50.0}
    speeds = expected_speeds(study, known)
    assert speeds["hopper-gru-s0"] == 100.0
    assert 400 < speeds["walker2d-ours-s0"] < 700  # half as fast as on hopper
    assert 80 < speeds["hopper-gru-s1"] < 125
    assert expected_speeds(study, {}) == {}


# Running --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study of two cells, one of which can't be trained."""
    folder = tmp_path_factory.mktemp("runs") / "study"
    study = study_of(folder)
    # Seen from outside, by the locks that processes hold: never more than were asked for.
    seen, over = [], threading.Event()

    def watch() -> None:
        while not over.wait(0.05):
            seen.append(sum(map(StudyFolder(folder).running, study)))

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        assert run(folder, study, at_once=1) == 1
    finally:
        over.set()
        watcher.join()
    (folder.parent / "at_once").write_text(str(max(seen)))
    return folder


def study_of(folder: Path) -> list[Cell]:
    good, bad = cells(*BRIEF, names=("good", "bad"))
    return [Cell("bad", bad.choices, (*bad.overrides, "env.id=NoSuchRobot")), good]


def test_a_cell_that_fails_is_recorded_with_its_last_line_and_does_not_stop_others(
    finished: Path,
) -> None:
    study = StudyFolder(finished)
    bad, good = study_of(finished)
    assert study.finished(good)
    assert not study.finished(bad)
    assert list(study.failures()) == ["bad"]
    assert study.failures()["bad"].startswith("error: `env_id` must be a registered")
    assert not list(finished.glob("**/.*.tmp"))


def test_no_more_cells_run_at_once_than_were_asked_for(finished: Path) -> None:
    assert (finished.parent / "at_once").read_text() == "1"


def test_what_is_done_is_skipped_and_what_failed_waits_until_it_is_asked_for(
    finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {p: p.stat().st_mtime_ns for p in finished.rglob("*") if p.is_file()}
    assert run(finished, study_of(finished)) == 1
    assert {p: p.stat().st_mtime_ns for p in finished.rglob("*") if p.is_file()} == before
    assert "study: 1 done, 0 running, 0 queued, 1 failed" in capsys.readouterr().out
    job_of_all = job(finished, study_of(finished), retry_failed=True)
    job_of_all.look()
    job_of_all.show()
    shown = capsys.readouterr().out
    assert "study: 1 done, 0 running, 1 queued, 0 failed" in shown
    assert "queued   bad: python " in shown
    assert f"hydra.run.dir={finished}/bad" in shown


def test_a_cell_is_continued_when_it_shall_take_more_steps(finished: Path) -> None:
    (more,) = cells(*(w.replace("=256", "=512") for w in BRIEF), names=("good",))
    study = StudyFolder(finished)
    study.check(more)
    assert not study.finished(more)
    assert study.resumable(more)


def test_a_folder_that_is_not_the_cells_own_is_left_alone(finished: Path, tmp_path: Path) -> None:
    (good,) = cells(*BRIEF, names=("good",))
    other = Cell("good", good.choices, (*good.overrides, "optim.lr=0.1"))
    with pytest.raises(UserError, match=r"was run with other overrides .* differ in optim\.lr"):
        run(finished, [other])
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "thesis.txt").write_text("mine")
    with pytest.raises(UserError, match="is in the way of a cell, and no study has made it"):
        run(tmp_path, cells(*BRIEF))
    assert (tmp_path / "a" / "thesis.txt").read_text() == "mine"


def test_bad_overrides_are_refused_before_anything_is_started(tmp_path: Path) -> None:
    good, bad = cells(*BRIEF, names=("good", "bad"))
    for word, reason in (("optim.lr=-1", "`optim.lr` must be 0 or more"), ("belief=x", "belief/x")):
        wrong = Cell("bad", bad.choices, (*bad.overrides, word))
        with pytest.raises(UserError, match=f"`bad` has overrides that can't be used: .*{reason}"):
            run(tmp_path, [good, wrong])
    assert list(tmp_path.iterdir()) == []


def test_a_file_is_no_place_for_a_study(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    for path in (tmp_path / "file", tmp_path / "file" / "study"):
        with pytest.raises(UserError, match=r"`folder` must be a folder.*file` is a file"):
            StudyFolder(path)


def test_two_calls_never_work_on_one_study(tmp_path: Path) -> None:
    study = StudyFolder(tmp_path)
    held = study.lock()
    with pytest.raises(UserError, match=rf"in use by another study.py \(process {os.getpid()}\)"):
        study.lock()
    os.close(held)
    os.close(study.lock())


@pytest.mark.parametrize(
    "left",
    [
        "nothing",
        "an empty folder",
        "a folder without checkpoint",
        "a checkpoint cut off",
        "a folder half removed",
    ],
)
def test_what_a_killed_start_has_left_is_started_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left: str
) -> None:
    study, (cell,) = StudyFolder(tmp_path), cells(*BRIEF)
    folder = study.run_folder(cell)
    if left == "an empty folder":
        folder.mkdir(parents=True)
    elif left != "nothing":
        study.prepare(cell)
        (folder / "config.yaml").write_text(OmegaConf.to_yaml(make_config(*cell.overrides)))
        (folder / "metrics.csv").write_text("frames,return,wall_time\n128,1.0,")
        if left == "a checkpoint cut off":  # a temporary file, never renamed
            (folder / "checkpoints").mkdir()
            (folder / "checkpoints" / ".frames_000000000128.pt.7.tmp").write_bytes(b"half")
    if left == "a folder half removed":
        with monkeypatch.context() as killed:
            killed.setattr("shutil.rmtree", _killed_after_the_first_file)
            with pytest.raises(KeyboardInterrupt):
                study.prepare(cell)
    study.check(cell)
    assert not study.finished(cell)
    assert not study.resumable(cell)
    assert study.measured(cell) is None
    study.prepare(cell)
    assert [path.name for path in folder.iterdir()] == ["cell.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def _killed_after_the_first_file(folder: Path) -> None:
    """Remove cell.json, which a real removal may well come to first, and end there."""
    (folder / "cell.json").unlink()
    raise KeyboardInterrupt


def test_the_printed_lines_hold_the_state_of_every_cell_and_the_time_left(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One cell is done, one half done at work, one waits: 100 steps a second."""
    names = ("done", "works", "waits")
    study = cells(*(w.replace("=256", "=3000") for w in BRIEF), names=names)
    done, works = study[:2]
    made = StudyFolder(tmp_path / "study")
    for cell, frames in ((done, 3000), (works, 1500)):
        made.prepare(cell)
        folder = made.run_folder(cell)
        write_config(folder, make_config(*cell.overrides))
        text = f"frames,return,wall_time\n{frames},7.5,{frames / 100}\n"
        (folder / "metrics.csv").write_text(text)
        (folder / "checkpoints").mkdir()
        (folder / "checkpoints" / f"frames_{frames:012d}.pt").touch()
    rows = [f"3000,final,{mode}" for mode in ("sampled", "mean")]
    text = "\n".join(["frames,kind,mode", *rows]) + "\n"
    (made.run_folder(done) / "evaluation.csv").write_text(text)
    held = made.lock_cell(works)
    try:
        shown = job(made.path, study, at_once=1)
        shown.look()
        shown.show()
    finally:
        os.close(held)
    lines = capsys.readouterr().out.splitlines()
    # 15 s of the one at work, then 30 s of the one that waits.
    head = "study: 1 done, 1 running, 1 queued, 0 failed; about 1 min of training left"
    assert lines[0] == head
    at_work = "1,500 of 3,000 steps, 100 steps/s, return 7.5, about 15 s left"
    assert lines[1] == f"  running  works: {at_work}"
    assert lines[2] == "  done     done: 3,000 steps, return 7.5"
    assert lines[3].startswith("  queued   waits: python ")
    assert len(lines) == 4


def command(folder: Path, overrides: list[str], *more: str) -> list[str]:
    listed = ",".join(f'"{word}"' for word in overrides)
    return [
        sys.executable,
        str(ROOT / "recipes" / "study.py"),
        "study=smoke",
        f"folder={folder}",
        f"study.overrides=[{listed}]",
        *more,
    ]


@pytest.fixture
def killed_study(tmp_path: Path) -> Iterator[tuple[StudyFolder, Cell]]:
    """A study of one long cell; nothing of it is left running when a test fails half way."""
    (cell,) = cells(*LONG, names=("none-s0",))
    folder = StudyFolder(tmp_path / "smoke")
    yield folder, cell
    for process in (folder.process(), folder.process_of(cell)):
        if process is not None:
            os.kill(process, signal.SIGKILL)


@pytest.mark.slow
def test_a_study_goes_on_after_it_and_its_runs_were_killed(
    killed_study: tuple[StudyFolder, Cell],
) -> None:
    """Kill study.py, stop the call that waits for its run, kill the run; then let it end."""
    folder, cell = killed_study
    arguments = command(folder.path.parent, LONG, "only=none-s0")

    def frames() -> int:
        return checkpoint_frames(folder.run_folder(cell)) or 0

    first = subprocess.Popen(arguments, stdout=subprocess.DEVNULL)
    wait(lambda: frames() >= 256)
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert folder.process() is None
    orphan = folder.process_of(cell)
    assert orphan is not None  # still at work

    second = subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True)
    assert second.stdout is not None
    assert second.stdout.readline().startswith("smoke: 0 done, 1 running, 0 queued, 0 failed")
    assert folder.process() == second.pid
    seen = frames()
    wait(lambda: frames() >= seen + 256)
    assert folder.process_of(cell) == orphan  # waited for, not started twice
    second.send_signal(signal.SIGTERM)
    second.send_signal(signal.SIGTERM)  # an impatient one
    output, _ = second.communicate(timeout=PATIENCE)
    assert second.returncode == 143, output
    assert "1 runs save and leave" in output
    assert not folder.running(cell)
    assert not folder.failures()

    stopped = frames()
    third = subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True)
    wait(lambda: frames() >= stopped + 256)
    process = folder.process_of(cell)
    assert process is not None
    os.kill(process, signal.SIGKILL)
    output, _ = third.communicate(timeout=PATIENCE)
    assert third.returncode == 1
    assert "going on with none-s0" in output
    assert "cut off none-s0: its process was ended from outside" in output
    assert not folder.failures()

    # The same cell with fewer steps to go: only so much of it may change.
    total = frames() + 256
    short = [w for w in LONG if not w.startswith("total_frames")] + [f"total_frames={total}"]
    last = subprocess.run(
        command(folder.path.parent, short, "only=none-s0"), capture_output=True, text=True
    )
    assert last.returncode == 0, last.stdout
    rows = read_table(folder.run_folder(cell) / "metrics.csv")
    # No rollout is missing, none is there twice.
    assert [int(row["frames"]) for row in rows] == list(range(128, total + 1, 128))
