"""A run that was stopped goes on as if it never had been, to the last bit."""

import os
import shutil
import signal
import threading
import time

import pytest
from recipe_tools import SMOKE, assert_same_run, read_table, refused, resume, run
from training.checkpoint import last_checkpoint, load_checkpoint, save_checkpoint

TABLES = ("metrics.csv", "episodes.csv", "evaluation.csv")


@pytest.mark.parametrize(
    "overrides",
    [
        ("belief=drbpn", "env=hopper", "missingness=mar"),
        ("missingness=outages", "missingness.group_by=joint", "noise=spikes"),
        ("belief=drbpn_propagated", "missingness=mcar"),
    ],
    ids=["hopper", "outages-spikes", "propagated"],
)
def test_a_resumed_run_equals_one_that_never_stopped(overrides, tmp_path):
    straight = tmp_path / "straight"
    run(straight, "experiment=smoke", *overrides)
    broken = shutil.copytree(straight, tmp_path / "broken")
    # The machine stopped after the second rollout's checkpoint, in the middle of a later row.
    last_checkpoint(broken).unlink()
    assert last_checkpoint(broken).name == "frames_000000000256.pt"
    for table in TABLES:
        with (broken / table).open("a") as file:
            file.write("640,1.")
    assert resume(broken) == 0
    assert_same_run(straight, broken)


@pytest.mark.slow
def test_a_signal_saves_and_the_resumed_run_equals_one_that_never_stopped(tmp_path):
    longer = (*SMOKE, "total_frames=2048", "evaluation.every_frames=1024")
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    run(straight, *longer)

    def stop():
        metrics = stopped / "metrics.csv"
        while not metrics.is_file() or metrics.read_text().count("\n") < 4:
            time.sleep(0.005)
        os.kill(os.getpid(), signal.SIGTERM)

    handler = signal.getsignal(signal.SIGTERM)
    killer = threading.Thread(target=stop)
    killer.start()
    status = run(stopped, *longer)
    killer.join()
    assert status == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is handler
    rows = read_table(stopped / "metrics.csv")
    assert 3 <= len(rows) < 16
    assert load_checkpoint(last_checkpoint(stopped))["progress"]["frames"] == len(rows) * 128
    assert resume(stopped) == 0
    assert_same_run(straight, stopped)


def test_an_evaluation_that_was_cut_short_is_made_again(folder, smoke):
    last_checkpoint(folder).unlink()
    state = load_checkpoint(last_checkpoint(folder))
    assert state["progress"]["evaluated_frames"] == 256
    state["progress"]["evaluated_frames"] = -1
    save_checkpoint(folder, 256, state, keep=1)
    assert resume(folder) == 0
    assert_same_run(smoke, folder)


def test_resuming_a_finished_run_says_so_and_changes_nothing(folder, smoke, capsys):
    assert resume(folder) == 0
    assert "is at its end" in capsys.readouterr().out
    assert_same_run(smoke, folder)


def test_a_run_that_lacks_its_final_evaluation_gets_it(folder, smoke):
    table = folder / "evaluation.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:-1]))
    assert resume(folder) == 0
    assert_same_run(smoke, folder)


def test_more_frames_can_be_added_to_a_finished_run_and_none_taken_away(folder):
    assert resume(folder, "total_frames=768") == 0
    rows = read_table(folder / "metrics.csv")
    assert [int(row["frames"]) for row in rows] == [128, 256, 384, 512, 640, 768]
    assert float(rows[-1]["lr"]) == pytest.approx(1e-3 * (1 - 640 / 768))
    before = (folder / "config.yaml").read_text()
    with refused(r"`total_frames` must be at least the 768 .* got 256"):
        resume(folder, "total_frames=256")
    assert (folder / "config.yaml").read_text() == before
