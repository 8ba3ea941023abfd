"""The training recipe as a person runs it; what stops a run has files of its own."""

import io
import json
import subprocess
import sys
from pathlib import Path

import pytest
import recipe_tools
import torch
from evaluation.trained import evaluate_training
from filter_problems import compiles
from ppo_drbpn import collect, train_rollout
from recipe_tools import SMOKE, assembled, assert_same_run, differences, read_table, refused, run
from suites import saved
from tqdm import tqdm
from training.checkpoint import last_checkpoint
from training.config import new_folder
from training.console import BAR, show
from training.run_folder import read_config


def test_a_run_leaves_configuration_tables_checkpoints_and_versions(smoke):
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


def test_each_finished_episode_is_a_row_with_its_raw_return(smoke):
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
def test_a_logger_by_name_writes_its_file(tmp_path, name, file, words):
    pytest.importorskip(name)
    run(tmp_path / "run", *SMOKE, f"logger={name}", "total_frames=128", *words)
    assert list((tmp_path / "run").glob(file))


def test_first_statistics_are_of_a_rollout_that_is_not_trained_on(monkeypatch):
    training, config = assembled(*SMOKE)
    rollouts, learned = [], []
    update = training.algorithm.update
    monkeypatch.setattr(
        training.algorithm, "update", lambda data, left: learned.append(data) or update(data, left)
    )
    monkeypatch.setattr(
        "ppo_drbpn.collect", lambda training: rollouts.append(collect(training)) or rollouts[-1]
    )
    for _ in range(2):
        train_rollout(training, config)
    assert len(rollouts) == 3
    assert list(map(id, learned)) == list(map(id, rollouts[1:]))
    assert training.frames == sum(data.numel() for data in learned)


def test_the_statistics_are_constant_while_a_rollout_is_collected_and_learned_from():
    training, config = assembled(*SMOKE)
    train_rollout(training, config)
    counts = []
    update = training.algorithm.update

    def watched(data, remaining):
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


@pytest.mark.parametrize(
    ("package", "word", "line"),
    [
        *[(name, f"logger={name}", rf"`logger={name}` .*: pip install {name}\.$")
          for name in ("tensorboard", "wandb", "mlflow")],
        ("ray", "collector=ray", r"`collector=ray` needs Ray: pip install 'ray>=2.60'"),
        ("envpool", "env.backend=envpool", r"pip install 'torchrl-drbpn\[envpool\]'"),
    ],
)  # fmt: skip
def test_a_package_that_is_missing_is_one_line_and_leaves_nothing(
    tmp_path, monkeypatch, package, word, line
):
    monkeypatch.setitem(sys.modules, package, None)
    with refused(line):
        run(tmp_path / "run", *SMOKE, word)
    assert not list(tmp_path.glob("run/*"))


def test_a_missing_compiler_is_one_line(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with refused(r"`optim.compile=true` needs .* `no-such-compiler` .* optim.compile=false"):
        assembled(*SMOKE, "optim.compile=true")


@compiles
def test_a_loss_that_cannot_be_compiled_is_one_line():
    line = "`optim.compile=true`: the compiled loss failed: .*optim.compile=false"
    with torch.compiler.set_stance("fail_on_recompile"):
        training, config = assembled(*SMOKE, "optim.compile=true")
        with refused(line):
            train_rollout(training, config)
        train_rollout(*assembled(*SMOKE))  # nothing is compiled that was not asked for


def test_one_seed_gives_one_result_and_another_seed_another(smoke, tmp_path):
    run(tmp_path / "again", *SMOKE)
    assert_same_run(smoke, tmp_path / "again")
    run(tmp_path / "other", *SMOKE, "seed=1", "total_frames=128")
    other = read_table(tmp_path / "other" / "metrics.csv")
    assert read_table(smoke / "metrics.csv")[:1] != other


def test_evaluation_leaves_the_whole_training_alone():
    training, config = assembled(*SMOKE)
    train_rollout(training, config)
    before = saved(training.state_dict())
    rows = evaluate_training(config, training, "training", 3, lambda: False)
    assert rows is not None
    assert [row["episodes"] for row in rows] == [3, 3]
    assert evaluate_training(config, training, "training", 3, lambda: True) is None
    assert differences(before, saved(training.state_dict())) == []


def test_the_command_runs_from_any_directory(tmp_path):
    words = ("experiment=smoke", "total_frames=128", "evaluation.final_episodes=1")
    done = recipe_tools.command("recipes/ppo_drbpn.py", *words, cwd=tmp_path)
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
def test_what_is_wrong_is_one_line_with_status_2_and_leaves_no_folder(tmp_path, words, line):
    done = recipe_tools.command("recipes/ppo_drbpn.py", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert line in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.glob("runs/*"))
    assert not done.stdout


def test_runs_that_start_in_the_same_second_have_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = [new_folder("Hopper-v5-drbpn-seed0") for _ in range(3)]
    assert len(set(names)) == 3
    assert all(Path(name).is_dir() for name in names)


def test_the_progress_bar_has_room_on_100_columns():
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
def test_a_closed_pipe_does_not_stop_a_run(tmp_path):
    words = [*SMOKE, "total_frames=256", "hydra.run.dir=run", "evaluation.every_frames=0"]
    line = [sys.executable, str(recipe_tools.ROOT / "recipes" / "ppo_drbpn.py"), *words]
    pipe, nowhere = subprocess.PIPE, subprocess.DEVNULL
    job = subprocess.Popen(line, cwd=tmp_path, stdout=pipe, stderr=nowhere)
    assert job.stdout is not None
    job.stdout.close()
    assert job.wait(timeout=240) == 0
    assert len(read_table(tmp_path / "run" / "metrics.csv")) == 2
    assert last_checkpoint(tmp_path / "run").name == "frames_000000000256.pt"


def improvement(folder, *overrides):
    """Train and return the ratio of the last to the first 20 episodes' mean return."""
    assert run(folder, "experiment=inverted_pendulum_test", *overrides) == 0
    returns = [float(row["return"]) for row in read_table(folder / "episodes.csv")]
    assert len(returns) >= 40
    return sum(returns[-20:]) / sum(returns[:20])


@pytest.mark.slow
def test_the_agent_learns_to_balance_with_a_fifth_of_its_sensors_missing(tmp_path):
    assert improvement(tmp_path / "run") >= 5


@pytest.mark.slow
def test_without_learning_the_returns_do_not_rise(tmp_path):
    assert improvement(tmp_path / "run", "optim.lr=0") < 2
