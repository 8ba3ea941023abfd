"""What the tests of the recipe share: composing configurations, comparing what runs leave."""

import contextlib
import copy
import csv
import functools
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
import torch
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
    from ppo_drbpn import train

    with torch.random.fork_rng(devices=[]):
        return train(make_config(*overrides), folder)


def resume(folder, *overrides):
    """Go on with a run as ``resume=<folder>`` does."""
    from ppo_drbpn import train

    config = resumed_config(make_config(*overrides), ["resume=x", *overrides], folder)
    with torch.random.fork_rng(devices=[]):
        return train(config, folder)


def assembled(*overrides):
    """Build the parts of a run, and return its configuration beside them."""
    from ppo_drbpn import assemble

    config = make_config(*overrides)
    return assemble(config), config


def make_folder(folder, *overrides):
    """Leave a run folder with a checkpoint after one rollout with two fifths of it missing."""
    smoke = ("experiment=smoke", "missingness=mcar", "missingness.eta=0.4", "total_frames=128")
    blind = ("evaluation.every_frames=0", "evaluation.final_episodes=0")
    run(folder, *smoke, *blind, *overrides)
    return folder


def command(script, *words, cwd, **env):
    """Run a script of the repository as a person does."""
    return subprocess.run(
        [sys.executable, str(ROOT / script), *words],
        cwd=cwd,
        env={**os.environ, **env},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )


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


def assert_same_run(first, second):
    """Two runs left the same tables and the same last checkpoint, to the last bit."""
    for table in TABLES:
        assert read_table(first / table) == read_table(second / table), table
    states = [load_checkpoint(last_checkpoint(folder)) for folder in (first, second)]
    assert differences(*states) == []


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
