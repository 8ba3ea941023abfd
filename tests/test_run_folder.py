"""What stops a run, what its folder holds then, and how it goes on: equal to the last bit."""

import fcntl
import os
import random
import re
import resource
import shlex
import shutil
import signal

import ppo_drbpn
import pytest
import recipe_tools
import torch
from filter_problems import compiles
from recipe_tools import SMOKE, assert_same_run, read_table, refused, resume, run
from training.checkpoint import last_checkpoint, load_checkpoint, save_checkpoint
from training.errors import UserError
from training.run_folder import Table, read_config


def contents(folder):
    return {str(p): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_a_second_run_into_a_folder_is_refused_and_the_first_one_stays(smoke):
    before = contents(smoke)
    with refused(r"holds a run already: .*resume="):
        run(smoke, *SMOKE, "seed=1")
    assert contents(smoke) == before


def test_the_command_that_a_refusal_prints_goes_on_with_that_folder(smoke, tmp_path):
    folder = shutil.copytree(smoke, tmp_path / "eta=0.5, [s 0]")
    with pytest.raises(UserError) as error:
        run(folder, *SMOKE)
    (word,) = shlex.split(str(error.value).removesuffix(".").split("or ")[-1])
    assert recipe_tools.make_config(word).resume == str(folder)


def test_a_folder_of_a_run_without_a_checkpoint_is_refused_without_a_promise(folder):
    shutil.rmtree(folder / "checkpoints")
    with refused("ended before its first checkpoint: remove it, or name"):
        run(folder, *SMOKE)


def test_two_runs_in_one_folder_at_once_are_refused(folder):
    with (folder / ".lock").open("w") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with refused("is in use by a run that has not ended"):
            resume(folder, "total_frames=768")
    assert len(read_table(folder / "metrics.csv")) == 4
    assert resume(folder, "total_frames=640") == 0


def test_a_file_where_a_folder_should_be_is_named(tmp_path):
    (tmp_path / "run").write_text("hello")
    with refused("can't be a run folder: "):
        run(tmp_path / "run" / "below", *SMOKE)


@pytest.mark.parametrize(("name", "content", "line"), recipe_tools.DAMAGED)
def test_what_is_damaged_is_named_and_stays_as_it_is(folder, name, content, line):
    recipe_tools.damage(folder, name, content)
    before = contents(folder)
    with refused(line):
        resume(folder, "total_frames=640")
    assert contents(folder) == before


def test_a_flipped_bit_in_a_checkpoint_is_refused_and_the_one_before_is_named(folder):
    path = last_checkpoint(folder)
    whole, draw = path.read_bytes(), random.Random(0)
    for place in (82, *(draw.randrange(8 * len(whole)) for _ in range(100))):
        data = bytearray(whole)
        data[place // 8] ^= 1 << place % 8
        path.write_bytes(data)
        with refused(recipe_tools.CHECKPOINT):
            load_checkpoint(path)
        assert path.read_bytes() == data


def test_a_bit_that_the_archive_does_not_watch_is_seen_by_the_sum_beside_it(folder):
    path = last_checkpoint(folder)
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 12] ^= 1  # a time of the archive's directory
    path.write_bytes(data)
    with refused(r"not as frames_.*\.sha256 says"):
        load_checkpoint(path)
    path.with_name(path.name + ".sha256").unlink()
    assert load_checkpoint(path)["progress"]["frames"] == 512


@pytest.mark.parametrize("share", [0.08, 0.9])
def test_a_full_disk_ends_in_one_line_and_the_last_checkpoint_stays(folder, smoke, share):
    """No file may grow beyond a share of what a checkpoint holds."""
    size = int(share * last_checkpoint(folder).stat().st_size)
    last_checkpoint(folder).unlink()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
        with refused(r"can't be written: .*before it are kept"):
            resume(folder)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert last_checkpoint(folder).name == "frames_000000000256.pt"
    assert not list(folder.rglob(".*.tmp*"))
    assert resume(folder) == 0
    assert_same_run(smoke, folder)


def test_what_a_killed_writer_left_is_removed_and_foreign_files_are_left_alone(folder, smoke):
    last_checkpoint(folder).unlink()
    stale = [".metrics.csv.7.tmp", "checkpoints/.frames_000000000384.pt.tmp"]
    foreign = folder / "checkpoints" / "frames_zzz.pt"
    for path in (*(folder / name for name in stale), foreign):
        path.write_text("half")
    with (folder / "metrics.csv").open("a") as table:
        table.write("9999,1.")
    assert resume(folder) == 0
    assert_same_run(smoke, folder)
    assert not list(folder.rglob(".*.tmp*"))
    assert foreign.read_text() == "half"


def test_a_table_drops_what_was_written_after_the_checkpoint(tmp_path):
    path = tmp_path / "t.csv"
    table = Table(path, ["frames", "value"])
    table.append([{"frames": 1, "value": None}, {"frames": 2, "value": 5, "more": 6}])
    Table(path, ["frames", "value", "new"], up_to_frames=1)
    assert path.read_text() == "frames,value,new\n1,,\n"


def test_a_run_folder_of_the_first_version_is_refused_by_the_commit_that_reads_it(tmp_path):
    (tmp_path / "config.yaml").write_text("env:\n  name: hopper\n  backend: gymnasium\n")
    with refused(r"version 0.1.0, which the code of commit 2ebd861 reads"):
        read_config(tmp_path)


@pytest.mark.parametrize(
    "overrides",
    [("env=hopper",), ("collector.num_envs=8",), ("heads.hidden=[32,32]",)],
    ids=["another-task", "another-number-of-environments", "other-heads"],
)
def test_a_checkpoint_of_another_shape_is_refused(smoke, overrides):
    state = load_checkpoint(last_checkpoint(smoke))
    training, _ = recipe_tools.assembled(*SMOKE, *overrides)
    with refused("does not fit the settings of this run"):
        training.load_state_dict(state, "there")


@pytest.mark.parametrize(
    "overrides",
    [
        ("belief=drbpn", "env=hopper", "missingness=mar"),
        ("missingness=outages", "missingness.group_by=joint", "noise=spikes"),
        ("belief=drbpn_propagated", "missingness=mcar"),
        ("env=halfcheetah", "+env.kwargs.max_episode_steps=150"),
        pytest.param(("optim.compile=true",), marks=[compiles, pytest.mark.slow]),
    ],
    ids=["hopper", "outages-spikes", "propagated", "first-episodes-cut", "compiled"],
)
def test_a_resumed_run_equals_one_that_never_stopped(overrides, tmp_path):
    straight = tmp_path / "straight"
    run(straight, "experiment=smoke", *overrides)
    broken = shutil.copytree(straight, tmp_path / "broken")
    # The machine stopped after the second rollout's checkpoint, in the middle of a later row.
    last_checkpoint(broken).unlink()
    assert last_checkpoint(broken).name == "frames_000000000256.pt"
    for table in recipe_tools.TABLES:
        with (broken / table).open("a") as file:
            file.write("640,1.")
    assert resume(broken) == 0
    assert_same_run(straight, broken)


def test_a_signal_saves_and_the_resumed_run_equals_one_that_never_stopped(
    smoke, tmp_path, monkeypatch
):
    stopped, collect = tmp_path / "stopped", ppo_drbpn.collect

    def signalled(training):
        if training.frames == 256:
            os.kill(os.getpid(), signal.SIGTERM)
        return collect(training)

    handler = signal.getsignal(signal.SIGTERM)
    with monkeypatch.context() as patch:
        patch.setattr(ppo_drbpn, "collect", signalled)
        assert run(stopped, *SMOKE) == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is handler
    assert len(read_table(stopped / "metrics.csv")) == 3  # the rollout is taken to its end
    assert load_checkpoint(last_checkpoint(stopped))["progress"]["frames"] == 384
    assert resume(stopped) == 0
    assert_same_run(smoke, stopped)


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


def test_a_compiled_run_goes_on_where_there_is_no_compiler(folder, monkeypatch):
    text = (folder / "config.yaml").read_text()
    (folder / "config.yaml").write_text(text.replace("compile: false", "compile: true"))
    monkeypatch.setenv("PATH", str(folder))
    with refused("optim.compile=false"):
        resume(folder, "total_frames=768")
    assert resume(folder, "total_frames=768", "optim.compile=false") == 0


def test_more_frames_can_be_added_to_a_finished_run_and_none_taken_away(folder):
    assert resume(folder, "total_frames=768") == 0
    rows = read_table(folder / "metrics.csv")
    assert [int(row["frames"]) for row in rows] == [128, 256, 384, 512, 640, 768]
    assert float(rows[-1]["lr"]) == pytest.approx(2e-3 * (1 - 640 / 768))
    before = (folder / "config.yaml").read_text()
    with refused(r"`total_frames` must be at least the 768 .* got 256"):
        resume(folder, "total_frames=256")
    assert (folder / "config.yaml").read_text() == before


@pytest.mark.parametrize("belief", ["drbpn", "gru", "none"])
def test_a_run_that_diverges_stops_with_its_step_and_saves_nothing(tmp_path, belief):
    folder = tmp_path / "run"
    with refused(r"training stopped at 0 steps: .*(nan|inf|no longer finite)") as error:
        run(folder, *SMOKE, f"belief={belief}", "optim.lr=1e30")
    assert "checkpoint" not in str(error.value)
    assert not list(folder.rglob("*.pt"))
    assert not read_table(folder / "evaluation.csv")


def test_a_run_that_diverges_later_names_its_last_good_checkpoint(tmp_path, monkeypatch):
    collect = ppo_drbpn.collect

    def spoilt(training):
        if training.frames == 256:
            with torch.no_grad():
                next(training.agent.critic.parameters())[0] = torch.inf
        return collect(training)

    monkeypatch.setattr(ppo_drbpn, "collect", spoilt)
    folder = tmp_path / "run"
    what = r"at 256 steps: the (loss|weight|gradient) `.*` is (nan|inf)"
    kept = rf"Its last checkpoint, at 256 steps, is in {re.escape(str(folder))}"
    with refused(f"{what}.* {kept}"):
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
    tmp_path, monkeypatch, fault, line
):
    collect, calls = ppo_drbpn.collect, []

    def faulty(training):
        calls.append(1)
        if len(calls) == 4:  # the first gives statistics alone
            rollout = training.collector.rollout

            def broken():
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
    with refused(line):
        run(folder, *SMOKE, "checkpoint.every_frames=10000")
    assert load_checkpoint(last_checkpoint(folder))["progress"]["frames"] == 256
    monkeypatch.undo()
    assert resume(folder) == 0  # with new episodes
    assert len(read_table(folder / "metrics.csv")) == 4


def test_an_engine_that_resets_itself_is_counted_and_said_once(tmp_path, monkeypatch, capsys):
    collect = ppo_drbpn.collect

    def wild(training):
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
