"""The commands that make a study's runs again, from the configurations that the runs left."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from assembly.composition import composed_config
from assembly.errors import UserError
from assembly.report_runs import StudyRun, flat, point_order

# Always written out: a reader looks for them.
_SHOWN = ("env.version", "seed", "total_frames")
# Where a run was made and what it printed does not belong to what it computed.
_LEFT_OUT = ("resume", "logger", "checkpoint", "threads")


def training_command(run: StudyRun) -> str:
    """Return a command line that gives a run's configuration in this checkout.

    Args:
        run: the run.

    Returns:
        ``python recipes/ppo_drbpn.py`` with groups, what is always shown, and every setting that
        differs from the defaults of conf/.

    Raises:
        UserError: if conf/ has no such group any more.
    """
    config, s = run.config, run.settings
    groups = [f"env={s.env.name}"]
    choices = {
        "belief": str(s.belief.get("name", "")),
        "missingness": s.missingness.mechanism,
        "noise": "gaussian" if s.noise.sigma > 0 else "none",
    }
    try:
        defaults = composed_config([])
        chosen = {
            "belief": defaults["belief"].get("name"),
            "missingness": defaults["missingness"]["mechanism"],
            "noise": "gaussian" if defaults["noise"]["sigma"] > 0 else "none",
        }
        groups += [f"{group}={name}" for group, name in choices.items() if name != chosen[group]]
        base = flat(composed_config(groups))
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(
            f"`{run.name}` can't be put into a command, conf/ lacks a group of "
            f"{' '.join(groups)}: {' '.join(str(error).split())[:200]}"
        ) from error
    own = flat(config)
    words = list(groups)
    words += [f"{key}={_value(own[key])}" for key in _SHOWN]
    for key in sorted(own):
        if key in _SHOWN or key.split(".")[0] in _LEFT_OUT:
            continue
        if key not in base or base[key] != own[key]:
            words.append(f"{'' if key in base else '+'}{key}={_value(own[key])}")
    words.append(f"hydra.run.dir=runs/{run.name}")
    return " ".join(["python recipes/ppo_drbpn.py", *(shlex.quote(word) for word in words)])


def evaluation_command(run: StudyRun) -> str | None:
    """Return the command that evaluated a run's last checkpoint at several points.

    Args:
        run: the run.

    Returns:
        ``python recipes/evaluate.py`` with points, modes and episodes; None where it was not run.
    """
    rows = [row for row in run.evaluations if row["source"] == "points"]
    if not rows:
        return None
    points = sorted({row["point"] for row in rows}, key=point_order)
    present = {row["mode"] for row in rows}
    modes = [mode for mode in ("sampled", "mean") if mode in present]
    episodes = max(int(row["episodes"]) for row in rows)
    words = [f"run=runs/{run.name}", f"points=[{','.join(points)}]", f"episodes={episodes}"]
    if len(modes) < 2:
        words.append(f"modes=[{','.join(modes)}]")
    return " ".join(["python recipes/evaluate.py", *(shlex.quote(word) for word in words)])


def report_command(runs: Sequence[StudyRun], out: Path, options: Sequence[str] = ()) -> str:
    """Return the command that makes the report, from the repository's root.

    Args:
        runs: of the study.
        out: its folder.
        options: further arguments.

    Returns:
        The command; runs are looked for in ``runs/``, as where the other commands put them.
    """
    names = sorted(run.name for run in runs)
    listed = ",".join(f"runs/{name}" for name in names)
    words = [f"run=[{listed}]", f"out=results/{out.name}", *options]
    return " ".join(["python recipes/report.py", *(shlex.quote(word) for word in words)])


def _value(value: Any) -> str:
    """Write a value in Hydra's grammar."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return f"[{','.join(_value(item) for item in value)}]"
    return str(value)
