"""Run a grid of runs as one job: ``python recipes/study.py study=robust``.

A study is a file of conf/study: axes (tasks, methods, seeds, ...), each with choices, each choice
a list of overrides of recipes/ppo_drbpn.py. Every combination is a cell, with a run folder
``runs/<study>/<cell>`` and its printed lines in ``runs/<study>/logs``. Call it again after anything
at all, and it goes on: what is done is skipped, what was cut off is resumed from its last
checkpoint, and a run that an earlier call has left running is waited for. Ctrl-C and SIGTERM let
the runs save before they leave. A cell that failed is started again by ``retry_failed=true`` only.

``dry_run=true`` prints how far the study is, also while it runs; ``at_once=4`` runs four cells at
a time; ``'only=hopper-*'`` takes a part. ``python recipes/report.py 'run=runs/robust/*'
out=results/robust`` then makes the tables.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import hydra
from omegaconf import DictConfig
from studies.cells import StudyFolder
from studies.grid import read_grid
from studies.job import StudyJob
from training.console import start
from training.errors import UserError


def run(config: dict[str, Any]) -> int:
    """Run a study, or show how far it is.

    Args:
        config: see conf/study.yaml.

    Returns:
        The exit status: 0 where every cell is done.
    """
    for name, least in (("at_once", 1), ("status_seconds", 0)):
        value = config[name]
        if isinstance(value, bool) or not isinstance(value, (int, float)) or value < least:
            raise UserError(f"`{name}` must be a number of {least} or more, got {value!r}.")
    grid = read_grid(config["study"])
    folder = StudyFolder(Path(config["folder"]) / grid.name)
    job = StudyJob(
        folder,
        grid.chosen(config["only"]),
        at_once=int(config["at_once"]),
        retry_failed=config["retry_failed"],
        status_seconds=config["status_seconds"],
    )
    if config["dry_run"]:
        job.look()
        job.show()
        return 0
    lock = folder.lock()
    try:
        job.look()
        return job.run()
    finally:
        os.close(lock)


@hydra.main(version_base="1.3", config_path="../conf", config_name="study")
def main(config: DictConfig) -> None:
    """Start from the command line."""
    start(run, config)


if __name__ == "__main__":
    main()
