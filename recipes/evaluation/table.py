"""The table of an evaluation: whole conditions, written whole after each.

A condition of a run is the unit: its episodes are in the table whole or not at all, so that an
evaluation killed at any moment goes on where it was.
"""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from training.config import missingness_name
from training.envs import env_name
from training.errors import UserError
from training.run_folder import write_whole

from evaluation.conditions import Condition, removed_sensors
from evaluation.episodes import StoppingPolicy, evaluate
from evaluation.trained import TrainedAgent, load_trained_agent

_KEY = ["run", "point", "mode"]
# A table without one of these was written by another command.
_COLUMNS = {*_KEY, "env", "method", "training_seed", "frames", "seed", "reduction_seed"}
_AGAIN = "name another `output`, or overwrite=true begins anew."

Task = tuple[Path, Condition, Sequence[str]]  # run folder, condition, kinds of action


@dataclass(frozen=True)
class Protocol:
    """How every condition is evaluated; see conf/evaluate.yaml."""

    episodes: int
    seed: int
    reduction_seed: int
    threads: int
    gate: float | None


class Table:
    """One row an episode, as text.

    Args:
        path: CSV file; what it holds is kept.
        protocol: how conditions are evaluated.
        agents: :func:`identity` of each run, by the name of its folder.
        overwrite: begin anew instead.

    Raises:
        UserError: if the file can't be continued: it is of another kind, of other settings, or
            of another agent or checkpoint.
    """

    def __init__(
        self,
        path: Path,
        protocol: Protocol,
        agents: Mapping[str, Mapping[str, Any]],
        *,
        overwrite: bool,
    ) -> None:
        self.path, self.rows = path, pd.DataFrame(columns=_KEY)
        if overwrite or not path.is_file():
            return
        try:
            rows = pd.read_csv(path, dtype=str, keep_default_na=False)
        except (ValueError, OSError) as error:  # pandas' errors of parsing are ValueErrors
            raise UserError(f"`{path}` can't be read as a table: {_AGAIN}") from error
        if not set(rows) >= _COLUMNS:
            raise UserError(f"`{path}` is no table of this command, or of an earlier one: {_AGAIN}")
        for (run, point, _), part in rows.groupby(_KEY, sort=False):
            wanted = {**agents.get(run, {}), "seed": protocol.seed}
            if part["removed_by"].iloc[0] == "random":
                wanted["reduction_seed"] = protocol.reduction_seed
            found = {name: ", ".join(sorted(set(part[name]))) for name in wanted if name in part}
            found["episodes"] = str(len(part))
            for name, value in _as_text(wanted | {"episodes": protocol.episodes}).items():
                if found.get(name, "") != value:
                    raise UserError(
                        f"`{path}` holds {run} at {point} with {name} {found.get(name) or 'none'}, "
                        f"and {value or 'none'} is asked for: {_AGAIN}"
                    )
        self.rows = rows

    def lacks(self, run: str, condition: Condition, modes: Sequence[str]) -> list[str]:
        """Return the kinds of action, of those asked for, that a condition lacks.

        Args:
            run: name of its folder.
            condition: the condition.
            modes: kinds of action.
        """
        rows = self.rows[(self.rows["run"] == run) & (self.rows["point"] == condition.name)]
        return [mode for mode in modes if mode not in set(rows["mode"])]

    def add(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Enter the episodes of a condition and write the table.

        Args:
            rows: of :func:`evaluate_condition`.
        """
        new = pd.DataFrame([_as_text(row) for row in rows])
        self.rows = pd.concat([self.rows, new], ignore_index=True) if len(self.rows) else new
        self.write()

    def arrange(self, order: Sequence[tuple[str, str]]) -> None:
        """Put conditions into an order, so that the table does not tell in which they came.

        Args:
            order: runs and conditions; others that the table holds come first, as they are. Of a
                condition, sampled actions come before mean ones.
        """
        keys = list(zip(self.rows["run"], self.rows["point"], strict=True))
        first = {key: place for place, key in reversed(list(enumerate(keys)))}
        ranks = {key: (rank, 0) for rank, key in enumerate(order)}
        place = [
            (*ranks.get(key, (-1, first[key])), mode != "sampled", row)
            for row, (key, mode) in enumerate(zip(keys, self.rows["mode"], strict=True))
        ]
        self.rows = self.rows.iloc[[row for *_, row in sorted(place)]].reset_index(drop=True)

    def write(self) -> None:
        """Write the table whole, if there is anything to write."""
        if len(self.rows):
            write_whole(self.path, self.rows.fillna("").to_csv(index=False, lineterminator="\n"))


def _as_text(row: Mapping[str, Any]) -> dict[str, str]:
    return {name: "" if value is None else str(value) for name, value in row.items()}


def identity(trained: TrainedAgent) -> dict[str, Any]:
    """Return the columns that tell agents apart, whatever their folders are called.

    Args:
        trained: the agent.

    Returns:
        Columns and values.
    """
    settings = trained.settings
    return {
        "env": env_name(settings),
        "belief": settings.belief.get("name", ""),
        "method": trained.method,
        "training_seed": settings.seed,
        "frames": trained.frames,
        "trained_on": missingness_name(settings.missingness),
        "trained_noise_sigma": settings.noise.sigma,
    }


def evaluate_condition(
    trained: TrainedAgent,
    condition: Condition,
    modes: Sequence[str],
    protocol: Protocol,
    *,
    run: str = "",
) -> list[dict[str, Any]]:
    """Evaluate an agent under a condition.

    Args:
        trained: the agent.
        condition: what does not arrive or is wrong.
        modes: kinds of action: ``sampled``, ``mean``.
        protocol: how.
        run: name of the agent's folder.

    Returns:
        One row an episode and kind of action; None where a column says nothing.
    """
    episodes, policy = protocol.episodes, StoppingPolicy(trained.agent)
    removed = removed_sensors(
        condition, trained, episodes=episodes, reduction_seed=protocol.reduction_seed
    )
    make_env = trained.environments(condition.missingness, condition.noise, removed)
    common = {"run": run, **identity(trained), **condition.columns()}
    at_random = condition.selection == "random"
    rows = []
    for mode in modes:
        result = evaluate(policy, make_env, episodes=episodes, mode=mode, seed=protocol.seed)
        assert result is not None
        likelihoods: Sequence[float | None] = result.log_likelihoods or [None] * episodes
        rows += [
            common
            | {
                "mode": mode,
                "episode": episode,
                "return": result.returns[episode],
                "length": result.lengths[episode],
                "missing_ratio": result.missing_ratios[episode],
                "log_likelihood": None if result.diverged[episode] else likelihoods[episode],
                "diverged": int(result.diverged[episode]),
                "seed": protocol.seed,
                "reduction_seed": protocol.reduction_seed if at_random else None,
            }
            for episode in range(episodes)
        ]
    return rows


# Several at a time ----------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _agent(folder: Path, gate: float | None) -> TrainedAgent:
    """Return a run's agent; the conditions of a run come one after the other and share it."""
    return load_trained_agent(folder, gate)


def _evaluate_task(task: Task, protocol: Protocol) -> list[dict[str, Any]]:
    torch.set_num_threads(protocol.threads)
    folder, condition, modes = task
    trained = _agent(folder, protocol.gate)
    return evaluate_condition(trained, condition, modes, protocol, run=folder.name)


def evaluate_tasks(
    tasks: Sequence[Task], protocol: Protocol, processes: int
) -> Iterator[tuple[Task, list[dict[str, Any]]]]:
    """Evaluate conditions of runs, several at a time; the numbers do not depend on how many.

    Args:
        tasks: run folders, conditions and kinds of action.
        protocol: how.
        processes: at a time; 1: in this process.

    Yields:
        Task and rows, as they come.
    """
    if min(processes, len(tasks)) <= 1:
        _agent.cache_clear()  # the folder may have got another checkpoint since
        for task in tasks:
            yield task, _evaluate_task(task, protocol)
        return
    # A fresh interpreter each: a fork would inherit torch's threads and half-held locks.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        min(processes, len(tasks)), context, initializer=_end_with_parent
    ) as pool:
        futures = {pool.submit(_evaluate_task, task, protocol): task for task in tasks}
        try:
            for future in as_completed(futures):
                yield futures[future], future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _end_with_parent() -> None:
    """End this process when its parent is gone, even one that was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:

        def watch() -> None:
            wait([parent.sentinel])
            os._exit(1)

        threading.Thread(target=watch, daemon=True).start()
