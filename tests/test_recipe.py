"""The training recipe as a person runs it.

A run leaves a whole folder. One seed gives one result, and a run that was stopped, by a signal or
by the machine, goes on as if it never had been, to the last bit. An evaluation changes nothing in
the training. A folder that can't be used is answered with one line, and what is in it stays.
"""

from __future__ import annotations

import fcntl
import io
import json
import os
import re
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
import torch
from evaluation.trained import evaluate_training
from ppo_drbpn import train_rollout
from recipe_tools import (
    ROOT,
    SMOKE,
    assembled,
    command,
    differences,
    make_config,
    read_table,
    resume,
    run,
    saved,
)
from tqdm import tqdm
from training.checkpoint import last_checkpoint, load_checkpoint, save_checkpoint
from training.console import BAR, show
from training.errors import DivergedError, UserError
from training.run_folder import Table, read_config

TABLES = ("metrics.csv", "episodes.csv", "evaluation.csv")


def copied(smoke: Path, tmp_path: Path) -> Path:
    return shutil.copytree(smoke, tmp_path / "copy")


def assert_same_run(first: Path, second: Path) -> None:
    for table in TABLES:
        assert read_table(first / table) == read_table(second / table), table
    states = [load_checkpoint(last_checkpoint(folder)) for folder in (first, second)]
    assert differences(*states) == []


# What a run leaves ----------------------------------------------------------------------------


def test_a_run_leaves_configuration_tables_checkpoints_and_versions(smoke: Path) -> None:
    assert read_config(smoke)["missingness"]["eta"] == 0.2
    metrics = read_table(smoke / "metrics.csv")
    assert [int(row["frames"]) for row in metrics] == [128, 256, 384, 512]
    filled = {key for key, value in metrics[-1].items() if value}
    assert {"return", "missing_ratio", "log_likelihood", "loss_model", "kl", "ess"} < filled
    assert {"explained_variance", "emission_noise_std", "clip_fraction", "lr"} < filled
    assert float(metrics[-1]["missing_ratio"]) == pytest.approx(0.2, abs=0.07)
    kinds = [(row["kind"], row["mode"]) for row in read_table(smoke / "evaluation.csv")]
    assert kinds == [(k, m) for k in ("training", "final") for m in ("sampled", "mean")]
    assert len(list((smoke / "checkpoints").glob("*.pt"))) == 2
    versions = json.loads((smoke / "versions.json").read_text())
    assert {"python", "torch", "torchrl", "gymnasium", "mujoco", "git_commit"} < versions.keys()
    assert list((smoke / "logs").rglob("*.csv"))
    assert not list(smoke.rglob(".*.tmp*"))


def test_each_finished_episode_is_a_row_with_its_raw_return(smoke: Path) -> None:
    episodes = read_table(smoke / "episodes.csv")
    assert len(episodes) == int(read_table(smoke / "metrics.csv")[-1]["episodes"])
    # The pendulum earns 1 a step and nothing for the step in which it falls.
    for row in episodes:
        assert float(row["return"]) == float(row["length"]) - 1


@pytest.mark.parametrize(
    ("name", "file", "words"),
    [
        ("tensorboard", "logs/events.out*", []),
        ("wandb", "wandb/offline-run*/*.wandb", ["logger.wandb_kwargs.offline=true"]),
        ("mlflow", "mlflow.db", []),
    ],
)
def test_a_logger_by_name_writes_its_file(
    tmp_path: Path, name: str, file: str, words: list[str]
) -> None:
    pytest.importorskip(name)
    run(tmp_path / "run", *SMOKE, f"logger={name}", "total_frames=128", *words)
    assert list((tmp_path / "run").glob(file))


def test_the_statistics_are_constant_while_a_rollout_is_collected_and_learned_from() -> None:
    training, config = assembled(*SMOKE)
    train_rollout(training, config)
    counts = []
    update = training.algorithm.update

    def watched(data: Any, remaining: float) -> dict[str, float]:
        counts.append(training.agent.norm.count.clone())
        # What the policy stored is what the loss reads, to the bit.
        again = training.agent.norm(data.select("observation", "observed"))
        assert torch.equal(again["normalized_observation"], data["normalized_observation"])
        row = update(data, remaining)
        assert torch.equal(training.agent.norm.count, counts[-1])
        return row

    training.algorithm.update = watched
    train_rollout(training, config)
    assert (training.agent.norm.count > counts[-1]).all()


# One seed, one result -------------------------------------------------------------------------


def test_one_seed_gives_one_result_and_another_seed_another(smoke: Path, tmp_path: Path) -> None:
    run(tmp_path / "again", *SMOKE)
    assert_same_run(smoke, tmp_path / "again")
    run(tmp_path / "other", *SMOKE, "seed=1", "total_frames=128")
    other = read_table(tmp_path / "other" / "metrics.csv")
    assert read_table(smoke / "metrics.csv")[:1] != other


def test_evaluation_leaves_the_whole_training_alone() -> None:
    training, config = assembled(*SMOKE)
    train_rollout(training, config)
    before = saved(training.state_dict())
    rows = evaluate_training(config, training, "training", 3, lambda: False)
    assert rows is not None
    assert [row["episodes"] for row in rows] == [3, 3]
    assert evaluate_training(config, training, "training", 3, lambda: True) is None
    assert differences(before, saved(training.state_dict())) == []


# Stopped and resumed --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "overrides",
    [
        ("belief=drbpn", "env=hopper", "missingness=mar"),
        ("missingness=outages", "missingness.group_by=joint", "noise=spikes"),
        ("belief=drbpn_propagated", "missingness=mcar"),
    ],
    ids=["hopper", "outages-spikes", "propagated"],
)
def test_a_resumed_run_equals_one_that_never_stopped(
    overrides: tuple[str, ...], tmp_path: Path
) -> None:
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
def test_a_signal_saves_and_the_resumed_run_equals_one_that_never_stopped(tmp_path: Path) -> None:
    longer = (*SMOKE, "total_frames=2048", "evaluation.every_frames=1024")
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    run(straight, *longer)

    def stop() -> None:
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


def test_an_evaluation_that_was_cut_short_is_made_again(smoke: Path, tmp_path: Path) -> None:
    folder = copied(smoke, tmp_path)
    last_checkpoint(folder).unlink()
    state = load_checkpoint(last_checkpoint(folder))
    assert state["progress"]["evaluated_frames"] == 256
    state["progress"]["evaluated_frames"] = -1
    save_checkpoint(folder, 256, state, keep=1)
    assert resume(folder) == 0
    assert_same_run(smoke, folder)


def test_resuming_a_finished_run_says_so_and_changes_nothing(
    smoke: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = copied(smoke, tmp_path)
    assert resume(folder) == 0
    assert "is at its end" in capsys.readouterr().out
    assert_same_run(smoke, folder)


def test_a_run_that_lacks_its_final_evaluation_gets_it(smoke: Path, tmp_path: Path) -> None:
    folder = copied(smoke, tmp_path)
    table = folder / "evaluation.csv"
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:-1]))
    assert resume(folder) == 0
    assert_same_run(smoke, folder)


def test_more_frames_can_be_added_to_a_finished_run_and_none_taken_away(
    smoke: Path, tmp_path: Path
) -> None:
    folder = copied(smoke, tmp_path)
    assert resume(folder, "total_frames=768") == 0
    rows = read_table(folder / "metrics.csv")
    assert [int(row["frames"]) for row in rows] == [128, 256, 384, 512, 640, 768]
    assert float(rows[-1]["lr"]) == pytest.approx(1e-3 * (1 - 640 / 768))
    before = (folder / "config.yaml").read_text()
    with pytest.raises(UserError, match=r"`total_frames` must be at least the 768 .* got 256"):
        resume(folder, "total_frames=256")
    assert (folder / "config.yaml").read_text() == before


# Folders that can't be used -------------------------------------------------------------------


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_second_run_into_a_folder_is_refused_and_the_first_one_stays(smoke: Path) -> None:
    before = contents(smoke)
    with pytest.raises(UserError, match=r"holds a run already: .*resume="):
        run(smoke, *SMOKE, "seed=1")
    assert contents(smoke) == before


def test_the_command_that_a_refusal_prints_goes_on_with_that_folder(
    smoke: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(smoke, tmp_path / "eta=0.5, [s 0]")
    with pytest.raises(UserError) as error:
        run(folder, *SMOKE)
    (word,) = shlex.split(str(error.value).removesuffix(".").split("or ")[-1])
    assert make_config(word).resume == str(folder)


def test_a_folder_of_a_run_without_a_checkpoint_is_refused_without_a_promise(
    smoke: Path, tmp_path: Path
) -> None:
    folder = copied(smoke, tmp_path)
    shutil.rmtree(folder / "checkpoints")
    with pytest.raises(UserError, match="ended before its first checkpoint: remove it, or name"):
        run(folder, *SMOKE)


def test_two_runs_in_one_folder_at_once_are_refused(smoke: Path, tmp_path: Path) -> None:
    folder = copied(smoke, tmp_path)
    with (folder / ".lock").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(UserError, match="is in use by a run that has not ended"):
            resume(folder, "total_frames=768")
    assert len(read_table(folder / "metrics.csv")) == 4
    assert resume(folder, "total_frames=640") == 0


def test_a_file_where_a_folder_should_be_is_named(tmp_path: Path) -> None:
    (tmp_path / "run").write_text("hello")
    with pytest.raises(UserError, match="can't be a run folder: "):
        run(tmp_path / "run" / "below", *SMOKE)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("metrics.csv", "metrics.csv` can't be read as a table: is it damaged"),
        ("checkpoints", "copy` holds no checkpoint"),
        ("last checkpoint", "512.pt` must be a checkpoint"),
        ("config.yaml", "config.yaml"),
    ],
)
def test_a_file_for_a_folder_and_a_folder_for_a_file_are_one_line(
    smoke: Path, tmp_path: Path, name: str, line: str
) -> None:
    folder = copied(smoke, tmp_path)
    path = last_checkpoint(folder) if name == "last checkpoint" else folder / name
    if path.is_dir():
        shutil.rmtree(path)
        path.write_text("no folder")
    else:
        path.unlink()
        path.mkdir()
    before = contents(folder / "checkpoints")
    with pytest.raises(UserError, match=line) as error:
        resume(folder, "total_frames=640")
    assert "\n" not in str(error.value)
    assert contents(folder / "checkpoints") == before


@pytest.mark.parametrize("content", [b"\xff\xfe\x00", b"", b"fram\n1\n"], ids=repr)
def test_a_damaged_table_is_named_and_stays_as_it_is(
    smoke: Path, tmp_path: Path, content: bytes
) -> None:
    folder = copied(smoke, tmp_path)
    (folder / "metrics.csv").write_bytes(content)
    with pytest.raises(UserError, match=r"metrics.csv` (can't be read|must begin).*damaged"):
        resume(folder, "total_frames=640")
    assert (folder / "metrics.csv").read_bytes() == content


@pytest.mark.parametrize("place", [10, 0.3, 0.6, -40], ids=["head", "third", "middle", "end"])
def test_a_flipped_bit_in_a_checkpoint_is_refused_and_the_one_before_is_named(
    smoke: Path, tmp_path: Path, place: float
) -> None:
    folder = copied(smoke, tmp_path)
    path = last_checkpoint(folder)
    data = bytearray(path.read_bytes())
    data[int(place * len(data)) if isinstance(place, float) else place] ^= 4
    path.write_bytes(data)
    with pytest.raises(UserError, match=r"512.pt` can't be read.* go on from `frames_.*256.pt`"):
        resume(folder, "total_frames=640")
    assert path.read_bytes() == data


def test_a_bit_that_the_archive_does_not_watch_is_seen_by_the_sum_beside_it(
    smoke: Path, tmp_path: Path
) -> None:
    path = last_checkpoint(copied(smoke, tmp_path))
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 12] ^= 1  # a time of the archive's directory
    path.write_bytes(data)
    with pytest.raises(UserError, match=r"not as frames_.*\.sha256 says"):
        load_checkpoint(path)
    path.with_name(path.name + ".sha256").unlink()
    assert load_checkpoint(path)["progress"]["frames"] == 512


def test_a_full_disk_ends_in_one_line_and_the_last_checkpoint_stays(
    smoke: Path, tmp_path: Path
) -> None:
    folder = copied(smoke, tmp_path)
    last_checkpoint(folder).unlink()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, limits[1]))
        with pytest.raises(UserError, match=r"can't be written: .*before it are kept") as error:
            resume(folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "\n" not in str(error.value)
    assert last_checkpoint(folder).name == "frames_000000000256.pt"
    assert not list(folder.rglob(".*.tmp*"))
    assert resume(folder) == 0
    assert_same_run(smoke, folder)


def test_what_a_killed_writer_left_is_removed_and_foreign_files_are_left_alone(
    smoke: Path, tmp_path: Path
) -> None:
    folder = copied(smoke, tmp_path)
    last_checkpoint(folder).unlink()
    stale = [".metrics.csv.7.tmp", "checkpoints/.frames_000000000384.pt.tmp"]
    foreign = folder / "checkpoints" / "frames_zzz.pt"
    for path in (*(folder / name for name in stale), foreign):
        path.write_text("half")
    assert resume(folder) == 0
    assert_same_run(smoke, folder)
    assert not list(folder.rglob(".*.tmp*"))
    assert foreign.read_text() == "half"


@pytest.mark.parametrize("name", ["tensorboard", "wandb", "mlflow"])
def test_a_logger_that_is_not_installed_is_one_line_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UserError, match=rf"`logger={name}` .*: pip install {name}\.$"):
        run(tmp_path / "run", *SMOKE, f"logger={name}")
    assert not list((tmp_path / "run").iterdir())


def test_a_table_drops_what_was_written_after_the_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    table = Table(path, ["frames", "value"])
    table.append([{"frames": 1, "value": None}, {"frames": 2, "value": 5, "more": 6}])
    Table(path, ["frames", "value", "new"], up_to_frames=1)
    assert path.read_text() == "frames,value,new\n1,,\n"


def test_a_run_folder_of_the_first_version_is_refused_by_the_commit_that_reads_it(
    tmp_path: Path,
) -> None:
    (tmp_path / "config.yaml").write_text("env:\n  name: hopper\n  backend: gymnasium\n")
    with pytest.raises(UserError, match=r"version 0.1.0, which the code of commit 2ebd861 reads"):
        read_config(tmp_path)


@pytest.mark.parametrize(
    "overrides",
    [("env=hopper",), ("collector.num_envs=8",), ("heads.hidden=[32,32]",)],
    ids=["another-task", "another-number-of-environments", "other-heads"],
)
def test_a_checkpoint_of_another_shape_is_refused(smoke: Path, overrides: tuple[str, ...]) -> None:
    state = load_checkpoint(last_checkpoint(smoke))
    training, _ = assembled(*SMOKE, *overrides)
    with pytest.raises(UserError, match="does not fit the settings of this run") as error:
        training.load_state_dict(state, "there")
    assert "\n" not in str(error.value)


# Numbers that are none ------------------------------------------------------------------------


@pytest.mark.parametrize("belief", ["drbpn", "gru", "none"])
def test_a_run_that_diverges_stops_with_its_step_and_saves_nothing(
    tmp_path: Path, belief: str
) -> None:
    folder = tmp_path / "run"
    with pytest.raises(
        UserError, match=r"training stopped at 0 steps: .*(nan|inf|no longer finite)"
    ) as error:
        run(folder, *SMOKE, f"belief={belief}", "optim.lr=1e30")
    assert "\n" not in str(error.value)
    assert "checkpoint" not in str(error.value)
    assert not list(folder.rglob("*.pt"))
    assert not read_table(folder / "evaluation.csv")


def test_a_run_that_diverges_later_names_its_last_good_checkpoint(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import ppo_drbpn

    collect = ppo_drbpn.collect

    def spoilt(training: Any) -> Any:
        if training.frames == 256:
            with torch.no_grad():
                next(training.agent.critic.parameters())[0] = torch.inf
        return collect(training)

    monkeypatch.setattr(ppo_drbpn, "collect", spoilt)
    folder = tmp_path / "run"
    kept = rf"at 256 steps: .* Its last checkpoint, at 256 steps, is in {re.escape(str(folder))}"
    with pytest.raises(UserError, match=kept):
        run(folder, *SMOKE, "checkpoint.every_frames=128")
    assert load_checkpoint(last_checkpoint(folder))["progress"]["frames"] == 256
    assert "final" not in (folder / "evaluation.csv").read_text()


@pytest.mark.parametrize(
    ("fault", "line"),
    [
        ("reward", "training stopped at 256 steps: the reward of environment 2 is not finite"),
        ("observation", "training stopped at 256 steps: the observation of environment 2 is not"),
        ("raise", "training stopped at 256 steps: the environment failed: motor on fire"),
    ],
)
def test_a_fault_of_the_environment_ends_in_one_line_and_a_saved_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: str, line: str
) -> None:
    import ppo_drbpn

    collect, calls = ppo_drbpn.collect, []

    def faulty(training: Any) -> Any:
        calls.append(1)
        if len(calls) == 4:  # the first gives statistics alone
            rollout = training.collector.rollout

            def broken() -> Any:
                if fault == "raise":
                    raise RuntimeError("motor\non fire")
                data = rollout()
                data["next", fault][2, 5] = torch.nan
                data["next", "observed"][2, 5] = True
                return data

            monkeypatch.setattr(training.collector, "rollout", broken)
        return collect(training)

    monkeypatch.setattr(ppo_drbpn, "collect", faulty)
    folder = tmp_path / "run"
    with pytest.raises(UserError, match=line):
        run(folder, *SMOKE, "checkpoint.every_frames=10000")
    assert load_checkpoint(last_checkpoint(folder))["progress"]["frames"] == 256
    monkeypatch.undo()
    assert resume(folder) == 0  # with new episodes
    assert len(read_table(folder / "metrics.csv")) == 4


def test_an_engine_that_resets_itself_is_counted_and_said_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import ppo_drbpn

    collect = ppo_drbpn.collect

    def wild(training: Any) -> Any:
        if 0 < training.frames < 384:
            training.env.base_env.envs[1].unwrapped.data.qvel[0] = 1e12
        return collect(training)

    monkeypatch.setattr(ppo_drbpn, "collect", wild)
    assert run(tmp_path / "run", *SMOKE) == 0
    rows = read_table(tmp_path / "run" / "metrics.csv")
    assert [row["engine_resets"] for row in rows] == ["0", "1", "2", "2"]
    printed = "".join(capsys.readouterr())
    assert printed.count("reset it") == 1
    assert "Warning" not in printed


def test_a_weight_that_is_none_is_named() -> None:
    training, config = assembled(*SMOKE)
    with torch.no_grad():
        training.agent.critic.module[0].bias[3] = torch.inf
    with pytest.raises(DivergedError, match=r"the (loss|weight|gradient) `.*` is (nan|inf)"):
        train_rollout(training, config)


# The command line ------------------------------------------------------------------------------


def test_the_command_runs_from_any_directory(tmp_path: Path) -> None:
    words = ("experiment=smoke", "total_frames=128", "evaluation.final_episodes=1")
    done = command("ppo_drbpn.py", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "steps/s in collection and update" in done.stdout
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("InvertedPendulum-v5-drbpn-seed0-")
    assert not set("=,") & set(folder.name)
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["missingness.eta=1.5"], "`missingness`: `eta` must be a missing rate in [0, 1], got 1.5"),
        (["resume=nowhere"], "nowhere` must be a run folder with config.yaml"),
        (["hydra.run.dir=/dev/null/below"], "`/dev/null/below` can't be used: Not a directory"),
        (["hydra.run.dir=/proc/below"], "`/proc/below` can't be used: "),  # not writable
    ],
)
def test_what_is_wrong_is_one_line_with_status_2_and_leaves_no_folder(
    tmp_path: Path, words: list[str], line: str
) -> None:
    done = command("ppo_drbpn.py", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert line in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.glob("runs/*"))
    assert not done.stdout


def test_runs_that_start_in_the_same_second_have_folders_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from training.config import new_folder

    monkeypatch.chdir(tmp_path)
    names = [new_folder("Hopper-v5-drbpn-seed0") for _ in range(3)]
    assert len(set(names)) == 3
    assert all(Path(name).is_dir() for name in names)


def test_the_progress_bar_has_room_on_100_columns() -> None:
    row = {"return": -1234.5, "missing_ratio": 0.512, "log_likelihood": -12.34,
           "steps_per_second": 12345.6, "frames": 900_000}  # fmt: skip
    file = io.StringIO()
    with tqdm(total=1_000_000, unit_scale=True, ncols=100, file=file, bar_format=BAR) as bar:
        show(bar, row)
        bar.refresh()
    (line,) = [part for part in file.getvalue().split("\r") if "missing 0.51" in part][-1:]
    assert len(line.split("|")[1]) >= 10
    assert "return -1234" in line
    assert "12346 steps/s" in line


@pytest.mark.slow
def test_a_closed_pipe_does_not_stop_a_run(tmp_path: Path) -> None:
    words = [*SMOKE, "total_frames=256", "hydra.run.dir=run", "evaluation.every_frames=0"]
    job = subprocess.Popen(
        [sys.executable, str(ROOT / "recipes" / "ppo_drbpn.py"), *words],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert job.stdout is not None
    job.stdout.close()
    assert job.wait(timeout=240) == 0
    assert len(read_table(tmp_path / "run" / "metrics.csv")) == 2
    assert last_checkpoint(tmp_path / "run").name == "frames_000000000256.pt"


# It learns ---------------------------------------------------------------------------------------


def improvement(folder: Path, *overrides: str) -> float:
    """Train and return the ratio of the last to the first 20 episodes' mean return."""
    assert run(folder, "experiment=inverted_pendulum_test", *overrides) == 0
    returns = [float(row["return"]) for row in read_table(folder / "episodes.csv")]
    assert len(returns) >= 40
    return sum(returns[-20:]) / sum(returns[:20])


@pytest.mark.slow
def test_the_agent_learns_to_balance_with_a_fifth_of_its_sensors_missing(tmp_path: Path) -> None:
    assert improvement(tmp_path / "run") >= 5


@pytest.mark.slow
def test_without_learning_the_returns_do_not_rise(tmp_path: Path) -> None:
    assert improvement(tmp_path / "run", "optim.lr=0") < 2
