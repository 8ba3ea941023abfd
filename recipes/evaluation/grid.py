"""The grid of an evaluation: which points, which of them are done, and doing the rest.

A point of a run is the unit: its episodes are in the table whole or not at all, and the table is
written anew after each, so that an evaluation killed at any moment goes on where it was.
"""

from __future__ import annotations

import csv
import multiprocessing
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, NoReturn

import torch
from training.config import Settings
from training.errors import UserError
from training.run_folder import write_table

from evaluation.conditions import Point, episode_rows, evaluate_points, parse_point
from evaluation.trained import TrainedAgent, gated, load_trained_agent

Row = Mapping[str, Any]

# A table without one of these was written by an earlier version, or by another command.
_COLUMNS = {
    *("run", "env", "belief", "method", "training_seed", "frames", "trained_on"),
    *("trained_noise_sigma", "point", "removed_by", "mode", "episode", "seed", "reduction_seed"),
}
_AGAIN = "name another `output`, or overwrite=true begins anew."


@dataclass(frozen=True)
class Grid:
    """Levels of the default grid; see conf/evaluate.yaml."""

    ratios: list[float]
    outage_ratios: list[float]
    outage_lengths: list[float]
    outage_groups: list[str]
    noise_sigmas: list[float]
    spike_probabilities: list[float]


@dataclass(frozen=True)
class Protocol:
    """How every point is evaluated; see conf/evaluate.yaml."""

    episodes: int
    modes: list[str]
    seed: int
    spike_std: float
    reduction_seed: int
    threads: int
    gate: float | None


# Which points ---------------------------------------------------------------------------------


def grid_points(grid: Grid, *, full: bool, model: bool) -> list[str]:
    """Return the points of the default grid.

    Args:
        grid: its levels. Ratio 0 is the same in every family: ``none:0``, once.
        full: whether to go beyond MCAR, MAR and sensor reduction.
        model: whether the agent has a model that can choose sensors.

    Returns:
        Points as text, in the order of evaluation.
    """
    ratios = [ratio for ratio in grid.ratios if ratio > 0]
    points = ["none:0"] if len(ratios) < len(grid.ratios) else []
    families = ("mcar", "mar", "nmar") if full else ("mcar", "mar")
    points += [f"{family}:{ratio:g}" for family in families for ratio in ratios]
    selections = ("model", "random") if model else ("random",)
    points += [f"reduction:{ratio:g}:{by}" for by in selections for ratio in ratios]
    if full:
        points += [
            f"outages:{ratio:g}:{length:g}:{by}"
            for ratio in grid.outage_ratios
            for by in grid.outage_groups
            for length in grid.outage_lengths
            # there is no chain that is off so much of the time and comes back so soon
            if ratio < 1 and length >= max(1.0, ratio / (1 - ratio) - 1e-9)
        ]
        points += [f"noise:{sigma:g}" for sigma in grid.noise_sigmas]
        points += [f"spikes:{probability:g}" for probability in grid.spike_probabilities]
    return points


def parse_points(texts: Sequence[str], settings: Settings, spike_std: float) -> list[Point]:
    """Read points; one that comes twice, under two names perhaps, is one.

    Args:
        texts: see conf/evaluate.yaml.
        settings: of the run.
        spike_std: deviation of spikes where the text gives none, raw units.

    Returns:
        Different points.

    Raises:
        UserError: if one can't be read.
    """
    points = [parse_point(text, settings, spike_std=spike_std) for text in texts]
    return list({point.name: point for point in points}.values())


# What is done ---------------------------------------------------------------------------------


class Results:
    """The table of an evaluation: whole points, written whole after each.

    Args:
        path: CSV file; the points in it are kept.
        protocol: how points are evaluated.
        agents: :func:`evaluation.conditions.identity` of each run, by the name of its folder.
        overwrite: begin anew instead.

    Raises:
        UserError: if the file can't be continued: it is of another kind, of other settings, or
            of another agent or checkpoint.
    """

    def __init__(
        self, path: Path, protocol: Protocol, agents: Mapping[str, Row], *, overwrite: bool
    ) -> None:
        self.path, self.protocol = path, protocol
        self._points: dict[tuple[str, str, str], list[Row]] = {}
        if overwrite or not path.is_file():
            return
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        if rows and not rows[0].keys() >= _COLUMNS:
            raise UserError(f"`{path}` is no table of this command, or of an earlier one: {_AGAIN}")
        for row in rows:
            row.setdefault("diverged", "0")  # earlier tables had no room for such episodes
            key = row["run"], row["point"], row["mode"]
            self._points.setdefault(key, []).append(row)
        for (run, point, _), found in self._points.items():
            self._check(run, point, found, agents.get(run, {}))

    def _check(self, run: str, point: str, found: Sequence[Row], agent: Row) -> None:
        """Refuse episodes that another agent, or this one in another way, has made."""
        wanted: dict[str, Any] = dict(agent) | {"seed": self.protocol.seed}
        if found[0]["removed_by"] == "random":
            wanted["reduction_seed"] = self.protocol.reduction_seed
        wanted = {name: "" if value is None else str(value) for name, value in wanted.items()}
        for name, value in wanted.items():
            others = sorted({row[name] for row in found} - {value})
            if others:
                self._refuse(run, point, name, ", ".join(others) or "none", value or "none")
        if len(found) != self.protocol.episodes:
            self._refuse(run, point, "episodes", str(len(found)), str(self.protocol.episodes))

    def _refuse(self, run: str, point: str, what: str, given: str, wanted: str) -> NoReturn:
        raise UserError(
            f"`{self.path}` holds {run} at {point} with {what} {given}, and {wanted} is asked "
            f"for: {_AGAIN}"
        )

    def lacks(self, run: str, point: Point) -> list[str]:
        """Return the kinds of action with which a point of a run is to be evaluated.

        Args:
            run: name of its folder.
            point: the point.

        Returns:
            Those asked for that are not in the table.
        """
        modes = self.protocol.modes
        return [mode for mode in modes if (run, point.name, mode) not in self._points]

    def add(self, run: str, point: str, rows: Sequence[Row]) -> None:
        """Enter the episodes of a point and write the table.

        Args:
            run: name of its folder.
            point: its name.
            rows: of one kind of action or more; those of others stay.
        """
        for mode in dict.fromkeys(row["mode"] for row in rows):
            self._points[run, point, mode] = [row for row in rows if row["mode"] == mode]
        self.write()

    def arrange(self, order: Sequence[tuple[str, str]]) -> None:
        """Put points into an order, so that the table does not tell in which they came.

        Args:
            order: runs and points; others that the table holds come first, as they are. Of a
                point, sampled actions come before mean ones.
        """
        ranks = {key: rank for rank, key in enumerate(order)}
        places = {key[:2]: place for place, key in reversed(list(enumerate(self._points)))}
        keys = sorted(
            self._points,
            key=lambda key: (ranks.get(key[:2], -1), places[key[:2]], key[2] != "sampled"),
        )
        self._points = {key: self._points[key] for key in keys}

    def write(self) -> None:
        """Write the table whole, if there is anything to write."""
        if rows := self.rows:
            write_table(self.path, rows)

    @property
    def rows(self) -> list[Row]:
        """Return one row an episode."""
        return [row for rows in self._points.values() for row in rows]


# Doing the rest -------------------------------------------------------------------------------


def evaluate_point(
    folder: Path, point: Point, modes: Sequence[str], protocol: Protocol
) -> list[dict[str, Any]]:
    """Evaluate one run at one point.

    Args:
        folder: the run folder.
        point: the point.
        modes: kinds of action, of those of the protocol.
        protocol: how.

    Returns:
        One row an episode and kind of action.
    """
    torch.set_num_threads(protocol.threads)
    trained = agent_of(folder, protocol.gate)
    drawn = {"reduction_seed": protocol.reduction_seed if point.selection == "random" else None}
    rows = []
    for _, mode, result in evaluate_points(
        trained,
        [point],
        episodes=protocol.episodes,
        modes=modes,
        seed=protocol.seed,
        reduction_seed=protocol.reduction_seed,
    ):
        found = episode_rows(trained, point, mode, result, run=folder.name)
        rows += [row | {"seed": protocol.seed} | drawn for row in found]
    return rows


@lru_cache(maxsize=1)
def agent_of(folder: Path, gate: float | None) -> TrainedAgent:
    """Return a run's agent; the points of a run come one after the other and share it.

    Args:
        folder: the run folder.
        gate: see :func:`evaluation.trained.gated`.

    Returns:
        Its last checkpoint.
    """
    return gated(load_trained_agent(folder), gate)


def evaluate_tasks(
    tasks: Sequence[tuple[Path, Point, Sequence[str]]], protocol: Protocol, processes: int
) -> Iterator[tuple[Path, Point, list[dict[str, Any]]]]:
    """Evaluate points of runs, several at a time; the numbers do not depend on how many.

    Args:
        tasks: run folders, points and kinds of action.
        protocol: how.
        processes: at a time; 1: in this process.

    Yields:
        Folder, point and rows, as they come.
    """
    processes = min(processes, len(tasks))
    if processes <= 1:
        agent_of.cache_clear()  # the folder may have got another checkpoint since
        for folder, point, modes in tasks:
            yield folder, point, evaluate_point(folder, point, modes, protocol)
        return
    # A fresh interpreter each: a fork would inherit torch's threads and half-held locks.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, initializer=_end_with_parent) as pool:
        futures = {pool.submit(evaluate_point, *task, protocol): task for task in tasks}
        try:
            for future in as_completed(futures):
                folder, point, _ = futures[future]
                yield folder, point, future.result()
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
