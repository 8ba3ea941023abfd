"""The training recipe as a person runs it.

A run leaves a whole folder. One seed gives one result, and a run that was stopped, by a signal or
by the machine, goes on as if it never had been, to the last bit. An evaluation changes nothing in
the training. The agent read back from its folder acts as the one that was saved. A folder or a
checkpoint that can't be used is answered with one line.
"""

from __future__ import annotations

import io
import json
import os
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

pytest.importorskip("hydra")
from recipe_tools import ROOT, differences, make_config, read_table  # isort: skip

from evaluation.episodes import evaluate, make_evaluation_environment
from evaluation.trained import load_trained_agent
from training import run_folder
from training.checkpoint import last_checkpoint, load_checkpoint, save_checkpoint
from training.config import read_settings
from training.errors import UserError
from training.loop import assemble, restore, train_rollout, training_state
from training.resume import resumed_config
from training.run import run
from training.run_folder import Table, read_config

SMOKE = ("experiment=smoke", "missingness=mcar", "missingness.eta=0.2")


@pytest.fixture(scope="module")
def smoke(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the smoke experiment once, to its end."""
    folder = tmp_path_factory.mktemp("run") / "smoke"
    with torch.random.fork_rng(devices=[]):
        assert run(make_config(*SMOKE), folder) == 0
    return folder


def resume(folder: Path, *overrides: str) -> int:
    config = resumed_config(make_config(*overrides), ["resume=x", *overrides], folder)
    return run(config, folder)


def copied(smoke: Path, tmp_path: Path) -> Path:
    return shutil.copytree(smoke, tmp_path / "copy")


def assert_same_run(first: Path, second: Path) -> None:
    for table in ("metrics.csv", "episodes.csv", "evaluation.csv"):
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
    assert len(list((smoke / "checkpoints").iterdir())) == 2
    versions = json.loads((smoke / "versions.json").read_text())
    assert {"python", "torch", "torchrl", "gymnasium", "mujoco", "git_commit"} < versions.keys()
    assert list((smoke / "logs").rglob("*.csv"))
    assert not list(smoke.rglob("*.tmp"))


def test_each_finished_episode_is_a_row_with_its_raw_return(smoke: Path) -> None:
    episodes = read_table(smoke / "episodes.csv")
    assert len(episodes) == int(read_table(smoke / "metrics.csv")[-1]["episodes"])
    # The pendulum earns 1 a step and nothing for the step in which it falls.
    for row in episodes:
        assert float(row["return"]) == float(row["length"]) - 1


def test_the_tensorboard_logger_writes_its_file(tmp_path: Path) -> None:
    pytest.importorskip("tensorboard")
    run(make_config(*SMOKE, "logger=tensorboard", "total_frames=128"), tmp_path / "run")
    assert list((tmp_path / "run" / "logs").glob("events.out*"))


# One seed, one result -------------------------------------------------------------------------


def test_one_seed_gives_one_result_and_another_seed_another(smoke: Path, tmp_path: Path) -> None:
    run(make_config(*SMOKE), tmp_path / "again")
    assert_same_run(smoke, tmp_path / "again")
    run(make_config(*SMOKE, "seed=1"), tmp_path / "other")
    assert read_table(smoke / "metrics.csv") != read_table(tmp_path / "other" / "metrics.csv")


def test_evaluation_changes_nothing_in_the_training(smoke: Path, tmp_path: Path) -> None:
    off = ("evaluation.every_frames=0", "evaluation.final_episodes=0")
    run(make_config(*SMOKE, *off), tmp_path / "blind")
    assert read_table(smoke / "metrics.csv") == read_table(tmp_path / "blind" / "metrics.csv")


def test_evaluation_leaves_the_global_generator_and_the_statistics_alone() -> None:
    settings = read_settings(make_config(*SMOKE))
    training = assemble(settings)
    train_rollout(training, settings)
    before = _copy(training_state(training))

    def make_env(_: int) -> Any:
        return make_evaluation_environment(
            settings, training.belief, training.agent, statistics=training.env
        )

    policy, how = training.agent.policy, {"episodes": 3, "seed": 5}
    result = evaluate(policy, make_env, mode="sampled", **how)
    assert result is not None
    assert len(result.returns) == len(result.lengths) == 3
    assert evaluate(policy, make_env, mode="mean", **how, stop=lambda: True) is None
    assert differences(before, _copy(training_state(training))) == []


def _copy(state: dict[str, Any]) -> Any:
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


# Stopped and resumed --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "overrides",
    [
        ("belief=drbpn", "env=hopper", "missingness=mar"),
        ("belief=none", "missingness=nmar", "env=inverted_double_pendulum"),
        ("missingness=outages", "missingness.group_by=joint", "noise=spikes"),
    ],
    ids=["drbpn-hopper", "none-double-pendulum", "drbpn-outages-spikes"],
)
def test_a_resumed_run_equals_one_that_never_stopped(
    overrides: tuple[str, ...], tmp_path: Path
) -> None:
    straight = tmp_path / "straight"
    run(make_config("experiment=smoke", *overrides), straight)
    broken = shutil.copytree(straight, tmp_path / "broken")
    # The machine stopped after the second rollout's checkpoint, in the middle of a later row.
    last_checkpoint(broken).unlink()
    assert last_checkpoint(broken).name == "frames_000000000256.pt"
    for table in ("metrics.csv", "episodes.csv", "evaluation.csv"):
        with (broken / table).open("a") as file:
            file.write("640,1.")
    assert resume(broken) == 0
    assert_same_run(straight, broken)


def test_a_signal_saves_and_the_resumed_run_equals_one_that_never_stopped(tmp_path: Path) -> None:
    longer = (*SMOKE, "total_frames=4096", "evaluation.every_frames=1024")
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    run(make_config(*longer), straight)

    def stop() -> None:
        metrics = stopped / "metrics.csv"
        while not metrics.is_file() or metrics.read_text().count("\n") < 4:
            time.sleep(0.005)
        os.kill(os.getpid(), signal.SIGTERM)

    handler = signal.getsignal(signal.SIGTERM)
    killer = threading.Thread(target=stop)
    killer.start()
    status = run(make_config(*longer), stopped)
    killer.join()
    assert status == 128 + signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is handler
    rows = read_table(stopped / "metrics.csv")
    assert 3 <= len(rows) < 32
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


def test_resuming_a_finished_run_changes_nothing(smoke: Path, tmp_path: Path) -> None:
    folder = copied(smoke, tmp_path)
    assert resume(folder) == 0
    assert_same_run(smoke, folder)


def test_more_frames_can_be_added_to_a_finished_run(smoke: Path, tmp_path: Path) -> None:
    folder = copied(smoke, tmp_path)
    assert resume(folder, "total_frames=768") == 0
    rows = read_table(folder / "metrics.csv")
    assert [int(row["frames"]) for row in rows] == [128, 256, 384, 512, 640, 768]
    assert float(rows[-1]["lr"]) == pytest.approx(1e-3 * (1 - 640 / 768))


# Folders and checkpoints that can't be used ----------------------------------------------------


def test_a_truncated_checkpoint_is_named_and_nothing_is_lost(smoke: Path, tmp_path: Path) -> None:
    folder = copied(smoke, tmp_path)
    path = last_checkpoint(folder)
    path.write_bytes(path.read_bytes()[:-1000])
    before = (folder / "metrics.csv").read_text()
    with pytest.raises(UserError, match=r"frames_000000000512.pt` can't be read: .*truncated"):
        resume(folder)
    assert (folder / "metrics.csv").read_text() == before
    path.unlink()
    assert resume(folder) == 0
    assert_same_run(smoke, folder)


def test_a_foreign_file_is_no_checkpoint(smoke: Path, tmp_path: Path) -> None:
    folder = copied(smoke, tmp_path)
    torch.save({"weights": torch.zeros(3)}, last_checkpoint(folder))
    with pytest.raises(UserError, match="is not a checkpoint of this recipe"):
        resume(folder)
    last_checkpoint(folder).write_text("hello")
    with pytest.raises(UserError, match="truncated or no checkpoint"):
        resume(folder)


@pytest.mark.parametrize(
    ("setting", "value"),
    [("env", {"id": "Hopper", "name": "hopper", "version": "v5", "backend": "gymnasium"}),
     ("collector", {"num_envs": 8, "steps_per_env": 32, "num_threads": 1}),
     ("heads", None)],
    ids=["another-task", "another-number-of-environments", "other-heads"],
)  # fmt: skip
def test_a_checkpoint_of_another_shape_is_refused(
    smoke: Path, tmp_path: Path, setting: str, value: Any
) -> None:
    config = read_config(smoke)
    config[setting] = value or config["heads"] | {"hidden": [32, 32]}
    settings = read_settings(config)
    state = load_checkpoint(last_checkpoint(smoke))
    with pytest.raises(UserError, match="does not fit the settings of this run") as error:
        restore(assemble(settings), state, "there")
    assert "\n" not in str(error.value)


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"must be a run folder with config.yaml"):
        resume(tmp_path)
    with pytest.raises(UserError, match="holds no checkpoint"):
        last_checkpoint(tmp_path)


def test_a_checkpoint_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    save_checkpoint(tmp_path, 1, {"value": 1}, keep=2)

    class Unwritable:
        def __reduce__(self) -> Any:
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        save_checkpoint(tmp_path, 2, {"value": Unwritable()}, keep=2)
    assert load_checkpoint(last_checkpoint(tmp_path))["value"] == 1


def test_a_table_drops_what_was_written_after_the_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    table = Table(path, ["frames", "value"])
    table.append([{"frames": 1, "value": None}, {"frames": 2, "value": 5, "more": 6}])
    Table(path, ["frames", "value", "new"], up_to_frames=1)
    assert path.read_text() == "frames,value,new\n1,,\n"


# Evaluation of a trained agent -----------------------------------------------------------------


def test_the_agent_read_back_repeats_the_final_evaluation(smoke: Path) -> None:
    trained = load_trained_agent(smoke)
    final = [row for row in read_table(smoke / "evaluation.csv") if row["kind"] == "final"]
    for row in final:
        result = evaluate(
            trained.agent.policy,
            trained.environments(),
            episodes=3,
            mode=row["mode"],
            seed=trained.settings.evaluation.seed,
        )
        assert result is not None
        assert result.mean_return == float(row["return_mean"])
        assert result.missing_ratio == pytest.approx(float(row["missing_ratio"]))
        assert result.log_likelihood == pytest.approx(float(row["log_likelihood"]))


# The command line ------------------------------------------------------------------------------


def command(recipe: str, *words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(ROOT / "recipes" / recipe), *words],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_the_commands_run_from_any_directory(tmp_path: Path) -> None:
    done = command("ppo_drbpn.py", "experiment=smoke", "total_frames=128", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "steps/s from the first collected frame to the last update" in done.stdout
    (folder,) = (tmp_path / "runs").iterdir()
    assert folder.name.startswith("inverted_pendulum-v5-drbpn-seed0-")
    assert not set("=,") & set(folder.name)
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    words = (
        f"run={folder}",
        "points=[none:0,mcar:.5]",
        "episodes=2",
        "output=out.csv",
        "figures=false",
    )
    done = command("evaluate.py", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(read_table(tmp_path / "out.csv")) == 2 * 2 * 2


def test_a_bad_value_on_the_command_line_prints_one_line_and_leaves_no_folder(
    tmp_path: Path,
) -> None:
    done = command("ppo_drbpn.py", "missingness.eta=1.5", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr == "error: `missingness.eta` must lie in [0, 1], got 1.5.\n"
    assert not list(tmp_path.rglob("*seed*"))


def test_a_run_folder_from_before_a_setting_was_added_stays_readable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_folder, "_LATER_SETTINGS", {"heads.width": 3, "heads.hidden": [1]})
    (tmp_path / "config.yaml").write_text("heads:\n  hidden: [64, 64]\n")

    config = read_config(tmp_path)

    assert config["heads"] == {"hidden": [64, 64], "width": 3}  # what was written is kept
