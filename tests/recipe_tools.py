"""What the tests of the recipe share: composing configurations, comparing what runs leave."""

from __future__ import annotations

import csv
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf"
if str(ROOT / "recipes") not in sys.path:
    sys.path.insert(0, str(ROOT / "recipes"))

# Every belief module of the recipe, found on disk: a new one is tested without an edit here.
BELIEFS = sorted(path.stem for path in (CONF / "belief").glob("*.yaml"))

TIMES = ("steps_per_second", "wall_time")


def make_config(*overrides: str) -> dict[str, Any]:
    """Compose the configuration that a command line gives."""
    OmegaConf.register_new_resolver("run_folder", lambda resume, new: resume or new, replace=True)
    with initialize_config_dir(str(CONF), version_base="1.3"):
        composed = OmegaConf.to_container(compose("config", list(overrides)), resolve=True)
    assert isinstance(composed, dict)
    return {str(key): value for key, value in composed.items()}


def make_folder(folder: Path, *overrides: str) -> Path:
    """Leave a run folder with a checkpoint after one rollout with two fifths of it missing."""
    from training.checkpoint import save_checkpoint
    from training.config import read_settings
    from training.loop import assemble, train_rollout, training_state
    from training.run_folder import write_config

    smoke = ("experiment=smoke", "missingness=mcar", "missingness.eta=0.4")
    config = make_config(*smoke, *overrides)
    folder.mkdir()
    with torch.random.fork_rng(devices=[]):
        settings = read_settings(config)
        training = assemble(settings)
        train_rollout(training, settings)
        save_checkpoint(folder, training.progress.frames, training_state(training), keep=1)
    write_config(folder, config)
    return folder


def read_table(path: Path) -> list[dict[str, str]]:
    """Read a CSV file without the columns that tell times."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return [{k: v for k, v in row.items() if k not in TIMES} for row in rows]


def differences(first: Any, second: Any, path: str = "") -> list[str]:
    """Name every entry in which two checkpoints differ, in the last bit or in its presence."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        found = [f"{path}/{key} only once" for key in first.keys() ^ second.keys()]
        for key in first.keys() & second.keys() - {"train_seconds"}:
            found += differences(first[key], second[key], f"{path}/{key}")
        return found
    if isinstance(first, torch.Tensor) and isinstance(second, torch.Tensor):
        return [] if torch.equal(first, second) else [path]
    if isinstance(first, (list, tuple)) and isinstance(second, (list, tuple)):
        found = [] if len(first) == len(second) else [f"{path} length"]
        for index, (a, b) in enumerate(zip(first, second, strict=False)):
            found += differences(a, b, f"{path}/{index}")
        return found
    return [] if first == second else [path]
