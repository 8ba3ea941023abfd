"""Many runs by one command: ``python recipes/ppo_drbpn.py --multirun study=robust``.

A cell is a run in a folder of its own. One that is done is left as it is, one that was cut off goes
on, one that was killed before its first checkpoint starts anew; the same command therefore also
continues. A cell that fails ends no other.
"""

from __future__ import annotations

import os
import re
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn
from omegaconf import DictConfig, OmegaConf

from training.checkpoint import checkpoint_frames
from training.config import expected, explain, one_line
from training.console import STOP_FILE, StopRequest, say
from training.errors import UserError
from training.run_folder import MAY_CHANGE, is_evaluated, load_config, locked

_RECIPES = str(Path(__file__).parents[1])
STOPPED = "stopped"
_FAILED = 1


# A cell ---------------------------------------------------------------------------------------


def run_cell(job: Callable[[], int], folder: Path) -> tuple[str, str]:
    """Run a cell; whatever happens in it, those after it have their turn.

    Args:
        job: returns an exit status.
        folder: of the cell.

    Returns:
        Its name, and why it is not done in one line: empty where it is.
    """
    with StopRequest() as stop:
        if stop:
            return folder.name, STOPPED
        try:
            status = job()
        except expected() as error:
            line = explain(error)
        except Exception as error:  # a fault of ours, or of a library
            traceback.print_exc()
            line = f"{type(error).__name__}: {one_line(error)}"
        else:
            return folder.name, STOPPED if stop else f"status {status}" if status else ""
    sys.stderr.write(f"{folder.name}: error: {line}\n")
    return folder.name, line


def continued(config: DictConfig, folder: Path) -> DictConfig | None:
    """Return how a cell goes on with what its folder holds.

    Args:
        config: of the cell; its ``resume`` becomes the folder where there is a checkpoint.
        folder: of the cell.

    Returns:
        The configuration, or None where the cell is done.

    Raises:
        UserError: if the folder holds a run with other settings, or one that has not ended.
    """
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
            say(f"{folder.name}: done already, left as it is")
            return None
    say(f"{folder.name}: going on at {frames:,} steps")
    config.resume = str(folder)
    return config


def _differing(first: DictConfig, second: DictConfig) -> list[str]:
    """Name the settings in which two runs differ, of those that ``resume=`` does not let change."""
    flat = []
    for config in (first, second):
        plain: Any = OmegaConf.to_container(config, resolve=True)
        kept = {key: plain[key] for key in plain if key not in (*MAY_CHANGE, "resume")}
        flat.append(dict(_leaves(kept)))
    a, b = flat
    return [key for key in dict.fromkeys([*a, *b]) if repr(a.get(key)) != repr(b.get(key))][:5]


def _leaves(node: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _leaves(value, f"{name}.{key}" if name else str(key))
    else:
        yield name, node


# All of them ----------------------------------------------------------------------------------


def run_sweep(
    sweep: Callable[[], Sequence[Sequence[JobReturn]]], folder: Path, *, apart: bool
) -> Any:
    """Run a sweep to its end, or until Ctrl-C or SIGTERM; say what failed.

    Args:
        sweep: runs every cell.
        folder: of the sweep.
        apart: whether cells run in processes of their own.

    Returns:
        What ``sweep`` returned.

    Raises:
        UserError: if a launcher fails.
        SystemExit: 1 if a cell failed; 130 or 143 if a signal stopped the sweep, its cells saved.
    """
    file = folder.absolute() / f".stop-{os.getpid()}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(f"`hydra.sweep.dir` must be a folder to write to: {error}") from error
    with StopRequest(file) as stop, _environment(file, apart=apart):
        try:
            batches = sweep()
        except expected():
            raise
        except Exception as error:  # of a launcher: a process of it was ended from outside
            raise UserError(
                f"the sweep ended before its cells: {one_line(error)}. The same command goes on."
            ) from error
    results = [result.return_value for batch in batches for result in batch]
    lacking = {name: line for name, line in results if line}
    say(f"{len(results) - len(lacking)} of {len(results)} cells are done: {folder}")
    for name, line in lacking.items():
        say(f"stopped: {name}" if line == STOPPED else f"failed: {name}: {line}")
    if stop:
        say("stopped and saved; the same command goes on")
        sys.exit(stop.exit_code)
    if lacking:
        sys.exit(_FAILED)
    return batches


@contextmanager
def _environment(stop_file: Path, *, apart: bool) -> Iterator[None]:
    """Tell the cells' processes where the recipe lies and what stops them; no bars among lines."""
    changed = {STOP_FILE: str(stop_file)}
    if apart:
        path = os.pathsep.join(filter(None, [_RECIPES, os.environ.get("PYTHONPATH")]))
        changed |= {"PYTHONPATH": path, "TQDM_DISABLE": "1"}
    before = {name: os.environ.get(name) for name in changed}
    os.environ.update(changed)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        stop_file.unlink(missing_ok=True)


# Names ----------------------------------------------------------------------------------------


def _file_name(*parts: object) -> str:
    """Join what distinguishes a cell to the name of its folder."""
    texts = [re.sub(r"[^A-Za-z0-9._+-]+", "-", str(part)).strip("-.") for part in parts]
    return "-".join(filter(None, texts))[:200]


OmegaConf.register_new_resolver("file_name", _file_name, replace=True)
