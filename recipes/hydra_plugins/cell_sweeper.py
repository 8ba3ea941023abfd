"""The sweeper of conf/config.yaml. Hydra takes sweepers from packages of this name alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

# What `hydra/sweeper=basic` names; Hydra has no public name for it.
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from omegaconf import DictConfig
from training.sweep import run_sweep

_LINES = 11  # joblib's verbose: over 10 it prints a line a run, with the time left


class CellSweeper(BasicSweeper):
    """Hydra's grid of overrides; then says which cells failed, and leaves with a status."""

    def setup(self, *, config: DictConfig, **kwargs: Any) -> None:
        """Take the configuration of the sweep.

        Args:
            config: with ``hydra.launcher``.
            kwargs: what else Hydra hands over.
        """
        self.folder = Path(config.hydra.sweep.dir)
        self.launcher_name = config.hydra.launcher._target_.rpartition(".")[2]
        if self.launcher_name == "JoblibLauncher" and not config.hydra.launcher.verbose:
            config.hydra.launcher.verbose = _LINES
        super().setup(config=config, **kwargs)

    def sweep(self, arguments: list[str]) -> Any:
        """Run every cell.

        Args:
            arguments: words of the command line; they win over ``hydra.sweeper.params``.

        Returns:
            What the cells returned, where all of them are done.
        """
        apart = self.launcher_name != "BasicLauncher"
        return run_sweep(
            lambda: super(CellSweeper, self).sweep(arguments), self.folder, apart=apart
        )
