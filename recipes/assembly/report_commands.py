"""The commands that make a study's runs again, from the configurations that the runs left."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Sequence
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
        "algo": str(s.algo.get("name", "")),
        "missingness": s.missingness.mechanism,
        "noise": "gaussian" if s.noise.sigma > 0 else "none",
    }
    try:
        defaults = _composed()
        chosen = {
            "belief": defaults["belief"].get("name"),
            "algo": defaults["algo"].get("name"),
            "missingness": defaults["missingness"]["mechanism"],
            "noise": "gaussian" if defaults["noise"]["sigma"] > 0 else "none",
        }
        groups += [f"{group}={name}" for group, name in choices.items() if name != chosen[group]]
        base = flat(_composed(*groups))
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
        ``python recipes/evaluate.py`` with points, modes and episodes, of all cells where the run
        is a cell of a study; None where it was not run.
    """
    rows = [row for row in run.evaluations if row["source"] == "points"]
    if not rows:
        return None
    points = sorted({row["point"] for row in rows}, key=point_order)
    present = {row["mode"] for row in rows}
    modes = [mode for mode in ("sampled", "mean") if mode in present]
    episodes = max(int(row["episodes"]) for row in rows)
    words = [f"points=[{','.join(points)}]", f"episodes={episodes}"]
    if len(modes) < 2:
        words.append(f"modes=[{','.join(modes)}]")
    options = " ".join(shlex.quote(word) for word in words)
    if run.study is None:
        return f"python recipes/evaluate.py {shlex.quote(f'run=runs/{run.name}')} {options}"
    # One table in each run folder; of several runs at once evaluate.py makes one beside them.
    folders = f"$(dirname runs/{run.study}/*/config.yaml)"
    return f"for run in {folders}; do python recipes/evaluate.py run=$run {options}; done"


def commands_from_nothing(
    runs: Sequence[StudyRun], name: str, options: Sequence[str] = ()
) -> list[str]:
    """Return the commands that train, evaluate and report, from the repository's root.

    Args:
        runs: of the study.
        name: of the folder of the report.
        options: further arguments of ``recipes/report.py``.

    Returns:
        Commands. Cells of a study are trained by the study's own.
    """
    alone = [run for run in runs if run.study is None]
    studies = list(dict.fromkeys(run.study for run in runs if run.study is not None))
    commands = [f"python recipes/study.py study={study}" for study in studies]
    commands += [training_command(run) for run in alone]
    evaluations = [evaluation_command(run) for run in runs]
    commands += list(dict.fromkeys(command for command in evaluations if command is not None))
    folders = [f"runs/{study}/*" for study in studies]
    folders += sorted(f"runs/{run.name}" for run in alone)
    listed = folders[0] if len(folders) == 1 else f"[{','.join(folders)}]"
    words = [f"run={listed}", f"out=results/{name}", *options]
    return [*commands, " ".join(["python recipes/report.py", *(shlex.quote(w) for w in words)])]


def rebuild_command(name: str) -> str:
    """Return the command that makes the tables again from the run folders beside them.

    Args:
        name: of the folder of the report.

    Returns:
        The command.
    """
    return f"python recipes/report.py out=results/{name}"


@functools.cache
def _composed(*groups: str) -> dict[str, Any]:
    """Compose once what all seeds of a task and method share; to be read only."""
    return composed_config(groups)


def _value(value: Any) -> str:
    """Write a value in Hydra's grammar."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (list, tuple)):
        return f"[{','.join(_value(item) for item in value)}]"
    return str(value)
