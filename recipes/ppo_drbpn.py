"""Train an agent on incomplete, noisy sensors: ``python recipes/ppo_drbpn.py env=walker2d``.

Settings and their defaults stand in conf/. A run leaves its configuration, tables, checkpoints and
versions in ``runs/<env>-<version>-<belief>-seed<seed>-<time>``; ``resume=<that folder>`` continues
it. Ctrl-C and SIGTERM save after the rollout in progress and leave with status 130 or 143.
"""

from __future__ import annotations

import contextlib
import sys
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from training.console import run_or_explain
from training.resume import resumed_config
from training.run import run

# A resumed run stays in its own folder; see hydra.run.dir in conf/config.yaml.
OmegaConf.register_new_resolver("run_folder", lambda resume, new: resume or new, replace=True)


def train(config: DictConfig) -> int:
    """Run one job of the command line.

    Args:
        config: what Hydra composed.

    Returns:
        The exit status.
    """
    job = HydraConfig.get()
    folder = Path(job.runtime.output_dir)
    plain = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))
    if plain["resume"] is not None:
        plain = resumed_config(plain, list(job.overrides.task), folder)
    return run(plain, folder)


@hydra.main(version_base="1.3", config_path="../conf", config_name="config")
def main(config: DictConfig) -> None:
    """Start from the command line."""
    status = run_or_explain(lambda: train(config))
    # Hydra makes the folder before any setting is looked at: leave none behind for a bad one.
    with contextlib.suppress(OSError):
        Path(HydraConfig.get().runtime.output_dir).rmdir()
    if status:
        sys.exit(status)


if __name__ == "__main__":
    main()
