"""What the tests of the recipe share: composing configurations, comparing what runs leave."""

import contextlib
import copy
import csv
import functools
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
import torch
from ppo_drbpn import assemble, collect, train
from training.checkpoint import last_checkpoint, load_checkpoint
from training.config import composed_config
from training.errors import UserError
from training.run_folder import resumed_config

ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf"
# Every belief module of the recipe, found on disk: a new one is tested without an edit here.
BELIEFS = sorted(path.stem for path in (CONF / "belief").glob("*.yaml"))

TIMES = ("steps_per_second", "wall_time")
TABLES = ("metrics.csv", "episodes.csv", "evaluation.csv")
# A run of seconds with a fifth of its entries missing.
SMOKE = ("experiment=smoke", "missingness=mcar", "missingness.eta=0.2")

LAST = "checkpoints/frames_000000000512.pt"
TABLE = r"metrics.csv` can't be read.*damaged"
CHECKPOINT = r"512.pt` can't be read.* go on from `frames_.*256.pt`"
# A file of the smoke run, what is in it instead (so many of its bytes; None: it is a folder), and
# the line that refuses to go on with it.
DAMAGED = [
    ("metrics.csv", b"\xff\xfe\x00", TABLE),
    ("metrics.csv", bytes(range(256)), TABLE),
    ("metrics.csv", 0, TABLE),
    ("metrics.csv", 4, "metrics.csv` can't be read as a table: is it damaged"),
    ("metrics.csv", b"fram\n1\n", "metrics.csv` lacks the columns frames"),
    ("metrics.csv", None, "metrics.csv` can't be read as a table: is it damaged"),
    ("config.yaml", b"\xff\xfe\x00", "config.yaml"),
    ("config.yaml", bytes(range(256)), "config.yaml"),
    ("config.yaml", 0, "config.yaml"),
    ("config.yaml", None, "config.yaml"),
    ("checkpoints", b"no folder", "copy` holds no checkpoint"),
    (LAST, 0, CHECKPOINT),
    (LAST, 5000, CHECKPOINT),
    (LAST, b"PK\x03\x04 cut", CHECKPOINT),
    (LAST, None, CHECKPOINT),
]


def damage(folder, name, content):
    """Put something else where a file or a folder of a run is; see `DAMAGED`."""
    path = folder / name
    if isinstance(content, int):
        content = path.read_bytes()[:content]
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    path.mkdir() if content is None else path.write_bytes(content)


@functools.cache
def _composed(*overrides):
    return composed_config(overrides)


def make_config(*overrides):
    """Compose and check the configuration that a command line gives."""
    return copy.deepcopy(_composed(*overrides))


@contextlib.contextmanager
def refused(line):
    """What is done inside is refused by one line in which ``line`` is found."""
    with pytest.raises(UserError, match=line) as caught:
        yield caught
    assert "\n" not in str(caught.value)


def run(folder, *overrides):
    """Train as a command line does, and leave torch's generator alone."""
    with torch.random.fork_rng(devices=[]):
        return train(make_config(*overrides), folder)


def resume(folder, *overrides):
    """Go on with a run as ``resume=<folder>`` does."""
    config = resumed_config(make_config(*overrides), ["resume=x", *overrides], folder)
    with torch.random.fork_rng(devices=[]):
        return train(config, folder)


def assembled(*overrides):
    """Build the parts of a run, and return its configuration beside them."""
    config = make_config(*overrides)
    return assemble(config), config


def second_rollout(*overrides):
    """Return a training, and its second rollout after one for the statistics of its norm."""
    training, _ = assembled(*overrides)
    training.agent.norm.update(collect(training))
    collect(training)
    return training, collect(training).clone()


def make_folder(folder, *overrides):
    """Leave a run folder with a checkpoint after one rollout with two fifths of it missing."""
    smoke = ("experiment=smoke", "missingness=mcar", "missingness.eta=0.4", "total_frames=128")
    blind = ("evaluation.every_frames=0", "evaluation.final_episodes=0")
    run(folder, *smoke, *blind, *overrides)
    return folder


def command(script, *words, cwd, **env):
    """Run a script of the repository as a person does."""
    options = {"capture_output": True, "text": True, "timeout": 600, "check": False}
    line = [sys.executable, str(ROOT / script), *words]
    return subprocess.run(line, cwd=cwd, env={**os.environ, **env}, **options)


def printed(script, *words, cwd, **env):
    """Return what a script that ends well has printed."""
    done = command(script, *words, cwd=cwd, **{"OMP_NUM_THREADS": "1"} | env)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def read_table(path):
    """Read a CSV file without the columns that tell times."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if k not in TIMES} for row in rows]


def unequal(first, second):
    """Name what differs in the tables and the last checkpoints of two runs, to the last bit."""
    found = [t for t in TABLES if read_table(first / t) != read_table(second / t)]
    states = [load_checkpoint(last_checkpoint(folder)) for folder in (first, second)]
    return found + differences(*states)


def assert_same_run(first, second):
    assert unequal(first, second) == []


def differences(first, second, path=""):
    """Name every entry in which two checkpoints differ, in the last bit or in its presence."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        found = [f"{path}/{key} only once" for key in first.keys() ^ second.keys()]
        for key in first.keys() & second.keys() - {"train_seconds"}:
            found += differences(first[key], second[key], f"{path}/{key}")
        return found
    if isinstance(first, torch.Tensor) and isinstance(second, torch.Tensor):
        same = first.dtype == second.dtype and first.shape == second.shape
        # By their bits: a reading that did not arrive is NaN, which equals nothing.
        bits = [tensor.reshape(-1).view(torch.uint8) for tensor in (first, second)]
        return [] if same and torch.equal(*bits) else [path]
    if isinstance(first, (list, tuple)) and isinstance(second, (list, tuple)):
        found = [] if len(first) == len(second) else [f"{path} length"]
        for index, (a, b) in enumerate(zip(first, second, strict=False)):
            found += differences(a, b, f"{path}/{index}")
        return found
    return [] if first == second else [path]
