"""The recipe's parts for the benchmarks: settings composed from conf/ as its command line does."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from timing import ROOT

if str(ROOT / "recipes") not in sys.path:
    sys.path.insert(0, str(ROOT / "recipes"))

from algorithms.ppo import PPO
from training.config import read_settings
from training.loop import Training, assemble, train_rollout
from training.rollout import add_advantages, minibatches, to_sequences

if TYPE_CHECKING:
    from training.config import Settings

__all__ = [
    "PPO",
    "Training",
    "add_advantages",
    "assemble",
    "minibatches",
    "settings_of",
    "to_sequences",
    "train_rollout",
]


def settings_of(*overrides: str) -> Settings:
    """Compose the settings that a command line gives.

    Args:
        overrides: as on the command line of ``recipes/ppo_drbpn.py``.

    Returns:
        Checked settings.
    """
    OmegaConf.register_new_resolver("run_folder", lambda resume, new: resume or new, replace=True)
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        config = OmegaConf.to_container(compose("config", list(overrides)), resolve=True)
    assert isinstance(config, dict)
    return read_settings({str(key): value for key, value in config.items()})
