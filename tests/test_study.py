"""Studies and methods: sweeps of Hydra whose cells are runs that can be killed at any moment."""

import contextlib
import functools
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import hydra
import pytest
import recipe_tools
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra_plugins.cell_sweeper import CellSweeper, continued, run_cell
from omegaconf import OmegaConf
from ppo_drbpn import train
from recipe_tools import CONF, command, make_config, read_table, refused, run
from training.checkpoint import checkpoint_frames, last_checkpoint, load_checkpoint
from training.config import composed_config
from training.console import STOP_FILE, stop_request

STUDIES = sorted(path.stem for path in (CONF / "study").glob("*.yaml"))
METHODS = sorted(path.stem for path in (CONF / "method").glob("*.yaml"))
OVERLAYS = ("experiment", "study", "method")
BRIEF = ("experiment=smoke", "total_frames=200", "evaluation.every_frames=0")
# Long enough to be caught while it runs; it saves when it is stopped.
LONG = (
    *("evaluation.every_frames=0", "checkpoint.every_frames=10_000_000", "optim.epochs=1"),
    *("total_frames=1_000_000", "hydra.sweep.dir=out"),
)


def compose(words):
    """Compose a configuration, what Hydra says of its job included."""
    with hydra.initialize_config_dir(str(CONF), version_base="1.3"):
        return hydra.compose("config", list(words), return_hydra_config=True)


def cells(study, *words):
    """Compose the first cell of ``--multirun study=... <words>``, and those one word apart."""
    base = compose([f"study={study}", *words])
    params = [f"{key}={value}" for key, value in base.hydra.sweeper.params.items()]
    assert params[0].startswith("seed=")  # one seed of everything before the second of anything
    parsed = OverridesParser.create().parse_overrides([*params, f"study={study}", *words])
    (listed,) = CellSweeper.split_arguments(parsed, None)
    near = [each for each in listed if len({*each} - {*listed[0]}) < 2]
    return [compose(each) for each in near]


def folder_of(cell):
    HydraConfig.instance().set_config(cell)
    return Path(cell.hydra.sweep.dir) / cell.hydra.sweep.subdir


def keys(node, path=""):
    if not isinstance(node, dict):
        return {path}
    return {path}.union(*(keys(node[key], f"{path}.{key}") for key in node if key != "hydra"))


def assert_no_unknown_key(config):
    """An overlay may add a key by a slip of the pen; what the groups hold is all that is read."""
    choices = config.hydra.runtime.choices
    names = sorted(path.name for path in CONF.iterdir() if path.is_dir())
    groups = tuple(f"{name}={choices[name]}" for name in names if name not in OVERLAYS)
    assert keys(OmegaConf.to_container(config)) == _keys(groups)


@functools.cache
def _keys(groups):
    return keys(OmegaConf.to_container(compose(groups)))


@pytest.mark.parametrize("study", STUDIES)
def test_every_cell_of_a_study_is_a_run_in_a_folder_of_its_own(study):
    every = cells(study)
    names = [folder_of(cell) for cell in every]
    assert len(set(names)) == len(names)
    assert {name.parent for name in names} == {Path("runs") / study}
    assert all(re.fullmatch(r"[A-Za-z0-9._-]+-s\d", name.name) for name in names)
    for cell in every:
        assert_no_unknown_key(cell)
    composed_config([f"study={study}"])


@pytest.mark.parametrize("method", METHODS)
def test_a_method_is_a_belief_with_its_settings_under_its_name(method):
    config = compose([f"method={method}"])
    assert config.method == method
    assert config.hydra.runtime.choices.belief in (method, "drbpn", "none")
    assert_no_unknown_key(config)
    composed_config([f"method={method}", "experiment=thorough"])


def test_the_command_line_wins_over_a_study_and_a_method():
    given = ("seed=7", "env=ant", "method=dvrl", "total_frames=200_000", "optim.lr=1e-4")
    (cell,) = cells("robust", *given, "hydra.sweep.dir=elsewhere")
    assert (cell.seed, cell.env.id, cell.belief.name) == (7, "Ant", "dvrl")
    assert (cell.total_frames, cell.optim.lr) == (200_000, 1e-4)
    assert (cell.env.version, cell.optim.minibatches) == ("v4", 16)  # of the study, its experiment
    assert folder_of(cell) == Path("elsewhere/Ant-dvrl-s7")


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A run of 200 steps, rounded up to two rollouts of 128."""
    folder = tmp_path_factory.mktemp("sweep") / "cell"
    assert run(folder, *BRIEF) == 0
    assert checkpoint_frames(folder) == 256
    return folder


def test_a_cell_that_is_done_is_left_as_it_is(done, capsys):
    before = {path: path.stat().st_mtime_ns for path in done.rglob("*") if path.suffix}
    assert continued(make_config(*BRIEF), done) is None
    assert capsys.readouterr().out == "cell: done already, left as it is\n"
    assert {path: path.stat().st_mtime_ns for path in done.rglob("*") if path.suffix} == before


@pytest.mark.parametrize("total", [200, 512], ids=["in its final evaluation", "before its end"])
def test_a_cell_that_was_cut_off_goes_on_to_its_end(done, tmp_path, total):
    folder = shutil.copytree(done, tmp_path / "cell")
    (folder / "evaluation.csv").unlink()
    config = continued(make_config(*BRIEF, f"total_frames={total}"), folder)
    assert config is not None
    assert config.resume == str(folder)
    assert train(config, folder) == 0
    assert checkpoint_frames(folder) == max(256, total)
    assert len(read_table(folder / "evaluation.csv")) == 2


def test_a_cell_that_was_killed_before_its_first_checkpoint_starts_anew(done, tmp_path):
    folder = shutil.copytree(done, tmp_path / "cell")
    shutil.rmtree(folder / "checkpoints")
    with (folder / "metrics.csv").open("a") as file:
        file.write("384,1.")
    config = continued(make_config(*BRIEF), folder)
    assert config is not None
    assert config.resume is None
    assert run(folder, *BRIEF) == 0
    assert read_table(folder / "metrics.csv") == read_table(done / "metrics.csv")


def test_another_configuration_in_the_folder_of_a_cell_is_refused(done):
    with refused(r"other settings \(seed, optim.lr\): name another folder"):
        continued(make_config(*BRIEF, "seed=1", "optim.lr=0.1"), done)


def test_whatever_ends_a_cell_is_one_line_and_a_stop_of_the_sweep_starts_no_other(
    tmp_path, monkeypatch
):
    def broken():
        raise RuntimeError("two\nlines")

    assert run_cell(broken, tmp_path / "cell") == ("cell", "RuntimeError: two lines")
    assert run_cell(lambda: 0, tmp_path / "cell") == ("cell", "")
    monkeypatch.setenv(STOP_FILE, str(tmp_path / "stop"))
    with stop_request(tmp_path / "stop"):
        os.kill(os.getpid(), signal.SIGTERM)
        assert run_cell(broken, tmp_path / "cell") == ("cell", "stopped")


def sweep(folder, rates, launcher="basic"):
    place = ("belief=none", "hydra.sweep.dir=out", f"hydra/launcher={launcher}")
    words = (*place, f"optim.lr={rates}")
    return command("recipes/ppo_drbpn.py", "--multirun", *BRIEF, *words, cwd=folder)


@pytest.mark.slow
def test_what_fails_ends_no_other_and_launchers_run_the_same_cells_to_the_same_bit(tmp_path):
    """One cell diverges, one is refused, one is well; one after another, then by each launcher."""
    made = {}
    for launcher in ("basic", "joblib", "submitit_local"):
        (tmp_path / launcher).mkdir()
        answer = sweep(tmp_path / launcher, "1e30,-1,1e-3", launcher)
        assert answer.returncode == 1, answer.stderr
        assert "\n1 of 3 cells are done: out\n" in "\n" + answer.stdout
        failed = re.findall(r"^failed: \S+: (.*)$", answer.stdout, re.MULTILINE)
        assert [line.split(" ")[0] for line in failed] == ["training", "`optim.lr`"]
        assert launcher != "joblib" or "Done   3 out of   3" in answer.stderr
        (made[launcher],) = (tmp_path / launcher / "out").glob("*lr-0.001*")
    first = load_checkpoint(last_checkpoint(made.pop("basic")))
    for folder in made.values():
        assert not recipe_tools.differences(first, load_checkpoint(last_checkpoint(folder)))


def test_slurm_gets_one_array_with_a_task_for_each_cell(tmp_path):
    """A dry run: `sbatch` keeps what it is given, and `sacct` says that every task failed."""
    fake, sweep = tmp_path / "bin", tmp_path / "sweep"
    fake.mkdir()
    scripts = {
        "sbatch": f'cp "$1" {tmp_path}/submitted.sh; echo "Submitted batch job 42"',
        "srun": "exit 1",
        "sacct": "echo 'JobID|State|NodeList'; printf '42_%s|FAILED|\\n' 0 1 2",
    }
    for name, line in scripts.items():
        (fake / name).write_text(f"#!/bin/sh\n{line}\n")
        (fake / name).chmod(0o755)
    done = command(
        "recipes/ppo_drbpn.py", "--multirun", "experiment=smoke", "seed=0,1,2",
        f"hydra.sweep.dir={sweep}", "hydra/launcher=submitit_slurm",
        "hydra.launcher.partition=cpu", "hydra.launcher.timeout_min=90",
        "hydra.launcher.cpus_per_task=2", "hydra.launcher.array_parallelism=2",
        cwd=tmp_path, PATH=f"{fake}:{os.environ['PATH']}",
    )  # fmt: skip
    assert done.returncode
    lines = (tmp_path / "submitted.sh").read_text().splitlines()
    wanted = {"array=0-2%2", "partition=cpu", "time=90", "cpus-per-task=2", "job-name=ppo_drbpn"}
    assert {f"#SBATCH --{flag}" for flag in wanted} <= set(lines)
    (run,) = [line for line in lines if line.startswith("srun ")]
    assert f"{sys.executable} -u -m submitit.core._submit {sweep}/.submitit/" in run
    cells = sorted(sweep.glob(".submitit/42_*/42_*_submitted.pkl"))
    assert len(cells) == 3
    for seed, cell in enumerate(cells):
        assert f"seed={seed}".encode() in cell.read_bytes()


@pytest.fixture
def start(tmp_path):
    """Start a sweep in a process group of its own; nothing of it is left at the end."""
    script = str(recipe_tools.ROOT / "recipes" / "ppo_drbpn.py")
    line = [sys.executable, script, "-m", "study=smoke", *LONG]
    started = []

    def begin(*words):
        options = {"stdout": subprocess.PIPE, "text": True, "start_new_session": True}
        started.append(subprocess.Popen([*line, *words], cwd=tmp_path, **options))
        return started[-1]

    yield begin
    for process in started:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


def wait_for_rows(folder, cells):
    deadline = time.monotonic() + 240
    tables = []
    while sum(path.read_text().count("\n") > 2 for path in tables) < cells:
        assert time.monotonic() < deadline
        time.sleep(0.05)
        tables = list(folder.glob("out/*/metrics.csv"))
    return [path.parent for path in tables]


@pytest.mark.slow
@pytest.mark.parametrize(("launcher", "at_once"), [("basic", 1), ("joblib", 2)])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["Ctrl-C", "SIGTERM"])
def test_a_signal_stops_a_sweep_and_every_cell_is_saved(start, tmp_path, launcher, at_once, number):
    """Ctrl-C reaches every process of the terminal, SIGTERM the sweep alone."""
    several = ["hydra.launcher.n_jobs=2"] if launcher == "joblib" else []
    process = start("seed=0", "method=none,drbpn,gru", f"hydra/launcher={launcher}", *several)
    folders = wait_for_rows(tmp_path, at_once)
    send = os.killpg if number == signal.SIGINT else os.kill
    send(process.pid, number)
    said, _ = process.communicate(timeout=240)
    assert process.returncode == 128 + number, said
    assert said.count("\nstopped: ") == 3
    assert len(folders) == len(list((tmp_path / "out").glob("Inv*"))) == at_once
    for folder in folders:
        assert checkpoint_frames(folder) == int(read_table(folder / "metrics.csv")[-1]["frames"])
    assert not list((tmp_path / "out").glob(".stop*"))


@pytest.mark.slow
def test_a_sweep_goes_on_after_it_was_killed(start, tmp_path):
    words = ("seed=0", "method=none", "checkpoint.every_frames=128", "total_frames=2048")
    process = start(*words)
    (folder,) = wait_for_rows(tmp_path, 1)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    reached = checkpoint_frames(folder) or 0
    for where in ("out", "straight"):
        again = start(*words, f"hydra.sweep.dir={where}")
        said, _ = again.communicate(timeout=240)
        assert again.returncode == 0, said
        assert (f"going on at {reached:,} steps" in said) == (where == "out")
    recipe_tools.assert_same_run(tmp_path / "straight" / folder.name, folder)
