"""The table of an evaluation, which goes on where it was killed: it holds whole conditions."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
import torch
from joblib import Parallel, delayed
from training.errors import UserError
from training.run_folder import write_table

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
    robust: str | None
    robust_threshold: float


class Table:
    """One row an episode, as text; what the file holds is kept unless ``overwrite`` begins anew.

    ``agents`` are by the names of their run folders: a table of another one is refused.
    """

    def __init__(
        self, path: Path, protocol: Protocol, agents: Mapping[str, TrainedAgent], *, overwrite: bool
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
            wanted = _identity(agents[run]) if run in agents else {}
            wanted |= {"seed": protocol.seed, "episodes": protocol.episodes}
            if part["removed_by"].iloc[0] == "random":
                wanted["reduction_seed"] = protocol.reduction_seed
            part = part.assign(episodes=str(len(part)))
            for name, value in wanted.items():
                found = ", ".join(sorted(set(part[name]))) if name in part else ""
                if found != str(value):
                    raise UserError(
                        f"`{path}` holds {run} at {point} with {name} {found or 'none'}, and "
                        f"{value} is asked for: {_AGAIN}"
                    )
        self.rows = rows

    def lacks(self, run: str, condition: Condition, modes: Sequence[str]) -> list[str]:
        """Return the kinds of action, of those asked for, that a condition of a run lacks."""
        rows = self.rows[(self.rows["run"] == run) & (self.rows["point"] == condition.name)]
        return [mode for mode in modes if mode not in set(rows["mode"])]

    def add(self, rows: pd.DataFrame) -> None:
        """Enter the episodes of a condition and write the table."""
        new = rows.map(lambda v: "" if pd.isna(v) else str(v))
        self.rows = pd.concat([self.rows, new], ignore_index=True) if len(self.rows) else new
        self.write()

    def arrange(self, order: Sequence[tuple[str, str]]) -> None:
        """Put runs and conditions into an order, others first, sampled actions before mean ones."""
        keys = self.rows["run"] + "\n" + self.rows["point"]
        ranks = {f"{run}\n{point}": rank for rank, (run, point) in enumerate(order)}
        rank, first = keys.map(ranks).fillna(-1), pd.factorize(keys)[0]
        self.rows = self.rows.iloc[np.lexsort([self.rows["mode"] != "sampled", first, rank])]

    def write(self) -> None:
        """Write the table whole."""
        write_table(self.path, self.rows)


def _identity(trained: TrainedAgent) -> dict[str, Any]:
    """Return the columns that identify an agent; the noise of the condition has a column too."""
    names = {"task": "env", "noise_sigma": "trained_noise_sigma"}
    return {names.get(name, name): value for name, value in trained.columns().items()}


def evaluate_condition(
    trained: TrainedAgent,
    condition: Condition,
    modes: Sequence[str],
    protocol: Protocol,
    *,
    run: str = "",
) -> pd.DataFrame:
    """Evaluate an agent under a condition: one row an episode and kind of action (``modes``)."""
    removed = removed_sensors(
        condition, trained, episodes=protocol.episodes, reduction_seed=protocol.reduction_seed
    )
    make_env = trained.environments(condition.missingness, condition.noise, removed)
    policy = StoppingPolicy(trained.agent)
    how: Any = {"episodes": protocol.episodes, "seed": protocol.seed}
    drawn = {"reduction_seed": protocol.reduction_seed if condition.selection == "random" else None}
    tables = []
    for mode in modes:
        result = evaluate(policy, make_env, mode=mode, **how)
        columns = {"run": run} | _identity(trained) | condition.columns()
        columns |= {"mode": mode, "episode": range(protocol.episodes)} | dict(cast(Any, result))
        tables.append(pd.DataFrame(columns | {"seed": protocol.seed} | drawn, dtype=object))
    return pd.concat(tables, ignore_index=True)


def _evaluate_task(task: Task, protocol: Protocol) -> tuple[Task, pd.DataFrame]:
    torch.set_num_threads(protocol.threads)
    folder, condition, modes = task
    trained = load_trained_agent(folder, protocol.robust, protocol.robust_threshold)
    return task, evaluate_condition(trained, condition, modes, protocol, run=folder.name)


def evaluate_tasks(
    tasks: Sequence[Task], protocol: Protocol, processes: int
) -> Iterator[tuple[Task, pd.DataFrame]]:
    """Yield tasks and their rows as they come, several at a time; the numbers are the same."""
    jobs = (delayed(_evaluate_task)(task, protocol) for task in tasks)
    count = max(1, min(processes, len(tasks)))
    yield from Parallel(count, return_as="generator_unordered", batch_size=1)(jobs)
