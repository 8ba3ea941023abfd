"""Which settings a resumed run takes from its folder, and which from the command line."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from training.errors import UserError
from training.run_folder import read_config

_MAY_CHANGE = ("total_frames", "logger", "evaluation")


def resumed_config(
    composed: Mapping[str, Any], overrides: Sequence[str], folder: Path
) -> dict[str, Any]:
    """Return the configuration of a run that is continued.

    A larger ``total_frames`` also stretches what is left of the linear learning rate schedule: the
    run then differs from one that was given the larger number from the start.

    Args:
        composed: the configuration that the command line gives.
        overrides: the words of the command line, such as ``total_frames=2_000_000``.
        folder: the run folder.

    Returns:
        The folder's configuration with the overrides that are allowed.

    Raises:
        UserError: if the folder is no run folder, or another setting was given.
    """
    config = copy.deepcopy(read_config(folder))
    for word in overrides:
        name = word.split("=", 1)[0].lstrip("+~")
        group = name.split(".", 1)[0]
        if name == "hydra.run.dir":
            raise UserError(f"`resume` names the run folder already; leave out {word!r}.")
        if group in ("resume", "hydra"):
            continue
        if group not in _MAY_CHANGE:
            raise UserError(
                f"`resume` continues a run with its own settings; only {', '.join(_MAY_CHANGE)} "
                f"may be given with it, got {word!r}."
            )
        target: Any = config
        source: Any = composed
        *path, last = name.split(".")
        try:
            for part in path:
                target, source = target[part], source[part]
            target[last] = source[last]
        except (KeyError, TypeError) as error:
            raise UserError(f"`{name}` is no setting of {folder}.") from error
    config["resume"] = str(folder)
    return config
