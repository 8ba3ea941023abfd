"""Many runs by one command: ``python recipes/ppo_drbpn.py --multirun study=robust``.

A cell is a run in a folder of its own. One that is done is left as it is, one that was cut off goes
on, one that was killed before its first checkpoint starts anew; the same command therefore also
continues. A cell that fails ends no other. Hydra takes sweepers from packages of this name alone.
"""

import os
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

# What `hydra/sweeper=basic` names; Hydra has no public name for it.
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.utils import JobReturn
from omegaconf import DictConfig, OmegaConf
from training.checkpoint import checkpoint_frames
from training.config import EXPECTED, explain, leaves, one_line
from training.console import STOP_FILE, log_line, stop_request
from training.errors import UserError
from training.run_folder import MAY_CHANGE, is_evaluated, load_config, locked

_RECIPES = str(Path(__file__).parents[1])
STOPPED = "stopped"
_FAILED = 1
_LINES = 11  # joblib's verbose: over 10 it prints a line a run, with the time left


def run_cell(job: Callable[[], int], folder: Path) -> tuple[str, str]:
    """Run a cell, whatever happens in it; return its name, and in a line why it is not done."""
    with stop_request() as stop:
        if stop:
            return folder.name, STOPPED
        try:
            status = job()
        except EXPECTED as error:
            line = explain(error)
        except Exception as error:  # a fault of ours, or of a library
            traceback.print_exc()
            line = f"{type(error).__name__}: {one_line(error)}"
        else:
            return folder.name, STOPPED if stop else f"status {status}" if status else ""
    sys.stderr.write(f"{folder.name}: error: {line}\n")
    return folder.name, line


def continued(config: DictConfig, folder: Path) -> DictConfig | None:
    """Return how a cell goes on with what its folder holds; None where it is done."""
    if config.resume is not None:
        raise UserError("`resume` continues one run; a sweep goes on by the same command.")
    if not (folder / "config.yaml").exists():
        return config
    with locked(folder):
        stored = load_config(folder)
        if differing := _differing(stored, config):
            raise UserError(
                f"`{folder}` holds a run with other settings ({', '.join(differing)}): name "
                "another folder by `hydra.sweep.dir`, or remove this one."
            )
        frames = checkpoint_frames(folder)
        if frames is None:
            (folder / "config.yaml").unlink()  # killed before its first checkpoint
            return config
        if frames >= config.total_frames and is_evaluated(folder, config):
            log_line(f"{folder.name}: done already, left as it is")
            return None
    log_line(f"{folder.name}: going on at {frames:,} steps")
    config.resume = str(folder)
    return config


def _differing(first: DictConfig, second: DictConfig) -> list[str]:
    """Name the settings in which two runs differ, of those that ``resume=`` does not let change."""
    flat = []
    for config in (first, second):
        plain: Any = OmegaConf.to_container(config, resolve=True)
        kept = {key: plain[key] for key in plain if key not in (*MAY_CHANGE, "resume")}
        flat.append(dict(leaves(OmegaConf.create(kept))))
    a, b = flat
    return [key for key in dict.fromkeys([*a, *b]) if repr(a.get(key)) != repr(b.get(key))][:5]


class CellSweeper(BasicSweeper):
    """Hydra's grid of overrides; then says which cells failed, and leaves with a status."""

    def setup(self, *, config: DictConfig, **kwargs: Any) -> None:
        """Take the configuration of the sweep."""
        self.folder = Path(config.hydra.sweep.dir)
        self.launcher_name = config.hydra.launcher._target_.rpartition(".")[2]
        if self.launcher_name == "JoblibLauncher" and not config.hydra.launcher.verbose:
            config.hydra.launcher.verbose = _LINES
        super().setup(config=config, **kwargs)

    def sweep(self, arguments: list[str]) -> Any:
        """Run every cell; words of the command line win over ``hydra.sweeper.params``."""
        apart = self.launcher_name != "BasicLauncher"
        return run_sweep(lambda: super(CellSweeper, self).sweep(arguments), self.folder, apart)


def run_sweep(sweep: Callable[[], Sequence[Sequence[JobReturn]]], folder: Path, apart: bool) -> Any:
    """Run a sweep to its end, or until Ctrl-C or SIGTERM, and leave with a status: 1, 130 or 143.

    ``apart``: whether cells run in processes of their own.
    """
    file = folder.absolute() / f".stop-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"`hydra.sweep.dir` must be a folder to write to: {error}") from error
    os.environ[STOP_FILE] = str(file)
    if apart:  # the cells' processes must find the recipe; no bars among lines
        path = os.pathsep.join(filter(None, [_RECIPES, os.environ.get("PYTHONPATH")]))
        os.environ.update(PYTHONPATH=path, TQDM_DISABLE="1")
    try:
        with stop_request(file) as stop:
            batches = sweep()
    except EXPECTED:
        raise
    except Exception as error:  # of a launcher: a process of it was ended from outside
        raise UserError(
            f"the sweep ended before its cells: {one_line(error)}. The same command goes on."
        ) from error
    finally:
        file.unlink(missing_ok=True)
    results = [result.return_value for batch in batches for result in batch]
    lacking = {name: line for name, line in results if line}
    log_line(f"{len(results) - len(lacking)} of {len(results)} cells are done: {folder}")
    for name, line in lacking.items():
        log_line(f"stopped: {name}" if line == STOPPED else f"failed: {name}: {line}")
    if stop:
        log_line("stopped and saved; the same command goes on")
        sys.exit(stop.exit_code)
    if lacking:
        sys.exit(_FAILED)
    return batches


def _file_name(*parts: object) -> str:
    """Join what distinguishes a cell to the name of its folder."""
    texts = [re.sub(r"[^A-Za-z0-9._+-]+", "-", str(part)).strip("-.") for part in parts]
    return "-".join(filter(None, texts))[:200]


OmegaConf.register_new_resolver("file_name", _file_name, replace=True)
