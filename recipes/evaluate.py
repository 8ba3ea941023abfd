"""Evaluate trained agents: ``python recipes/evaluate.py run=<run folder>``.

The last checkpoint of each run acts under other gaps, outages, noise and spikes than it was trained
with, with frozen normalisation. One row an episode goes to a CSV file that is written whole after
every point: the same command goes on where an evaluation was stopped. The figures show the mean
with its 95 % interval over the nominal and the realised missing ratio.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
import pandas as pd
from analysis.figures import draw_evaluation
from analysis.runs import EPISODE_TABLES, find_folders
from evaluation.conditions import Point, check_reduction_seed, identity
from evaluation.grid import (
    Grid,
    Protocol,
    Results,
    evaluate_tasks,
    grid_points,
    parse_points,
)
from evaluation.sensor_choice import kept_sensors
from evaluation.trained import TrainedAgent, gated, load_trained_agent, with_checkpoint
from omegaconf import DictConfig
from rendering.belief_figure import save_figure
from training.config import check_mode
from training.console import say, start
from training.errors import UserError
from training.sensor_groups import have_names
from training.sensors import sensor_names

from torchrl_drbpn.functional.robust import check_gate


def run(config: dict[str, Any]) -> int:
    """Evaluate what is not yet in the table, write it, and draw it.

    Args:
        config: see conf/evaluate.yaml.

    Returns:
        The exit status.
    """
    folders, protocol = _folders(config), _protocol(config)
    output = _output(config, folders)
    folders = with_checkpoint(folders)
    agents = {folder: gated(load_trained_agent(folder), protocol.gate) for folder in folders}
    wanted = [(f, point) for f in folders for point in _points(config, f.name, agents[f])]
    results = Results(
        output,
        protocol,
        {folder.name: identity(agent) for folder, agent in agents.items()},
        overwrite=config["overwrite"],
    )
    lacking = [(folder, point, results.lacks(folder.name, point)) for folder, point in wanted]
    tasks = [task for task in lacking if task[2]]
    if len(tasks) < len(wanted):
        say(f"{len(wanted) - len(tasks)} of {len(wanted)} points are in {output} already")
    order = [(folder.name, point.name) for folder, point in wanted]
    processes = config["processes"] or _cores()
    for done, (folder, point, rows) in enumerate(evaluate_tasks(tasks, protocol, processes), 1):
        results.add(folder.name, point.name, rows)
        say(f"{done}/{len(tasks)} {folder.name} {point.name}: {_summary(rows)}")
    results.arrange(order)
    results.write()
    say(f"written: {output}")
    if config["figures"]:
        for task, figure in draw_evaluation(pd.read_csv(output)).items():
            path = output.with_name(f"{output.stem}-{task}.png")
            save_figure(figure, path, dpi=120)
            say(f"written: {path}")
    return 0


def _cores() -> int:
    """Return how many cores this process may use; all of them where the system does not tell."""
    allowed = getattr(os, "sched_getaffinity", None)  # not on macOS
    return len(allowed(0)) if allowed else os.cpu_count() or 1


def _folders(config: dict[str, Any]) -> list[Path]:
    if config["run"] is None:
        raise UserError("`run` must name a run folder: run=runs/<folder>.")
    folders = find_folders(config["run"])
    names = [folder.name for folder in folders]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise UserError(
            f"`run` must name folders with different names, {', '.join(twice)} comes twice: "
            "evaluate them by themselves."
        )
    return folders


def _protocol(config: dict[str, Any]) -> Protocol:
    for name in ("episodes", "threads", "processes"):
        value = config[name]
        if (value is not None or name != "processes") and (
            not isinstance(value, int) or isinstance(value, bool) or value < 1
        ):
            raise UserError(f"`{name}` must be a whole number of at least 1, got {value!r}.")
    check_reduction_seed(config["reduction_seed"])
    if config["gate"] is not None:
        try:
            check_gate(config["gate"])
        except ValueError as error:
            raise UserError(str(error)) from error
    if not config["modes"]:
        raise UserError("`modes` must hold sampled, mean or both, got none.")
    for mode in config["modes"]:
        check_mode(mode)
    return Protocol(
        episodes=config["episodes"],
        modes=list(config["modes"]),
        seed=config["seed"],
        spike_std=float(config["spike_std"]),
        reduction_seed=config["reduction_seed"],
        threads=config["threads"],
        gate=config["gate"],
    )


def _output(config: dict[str, Any], folders: Sequence[Path]) -> Path:
    name, gate = Path(EPISODE_TABLES[config["points"] is not None]), config["gate"]
    place = folders[0] if len(folders) == 1 else Path()
    if gate is not None:
        # Reports read the tables of these names as those of the agent as it was trained.
        name = name.with_name(f"{name.stem}-gate{gate:g}{name.suffix}")
        if config["output"] and Path(config["output"]).name in EPISODE_TABLES:
            raise UserError(
                f"`output` must not be called {Path(config['output']).name} with a gate, as "
                f"reports would read it as without: take {name} or another name."
            )
    output = Path(config["output"] or place / name)
    if not output.parent.is_dir():
        raise UserError(f"`output` must lie in an existing folder, got {output}.")
    return output


def _points(config: dict[str, Any], name: str, trained: TrainedAgent) -> list[Point]:
    """Return the points that a run is evaluated at."""
    texts = config["points"]
    if texts is None:
        try:
            kept_sensors(trained, 0)
            model = True
        except UserError as error:
            model = False
            say(f"{name}: sensors are removed at random only; {error}")
        grid = Grid(**config["grid"])
        if config["full"] and not have_names(_sensor_names(trained)):
            grid = dataclasses.replace(grid, outage_groups=["sensor"])
            say(
                f"{name}: outages of single sensors only; those of {trained.settings.env.env_id} "
                "have no names to group them by"
            )
        texts = grid_points(grid, full=config["full"], model=model)
    texts = [str(text) for text in ([texts] if isinstance(texts, str) else texts)]
    return parse_points(texts, trained.settings, float(config["spike_std"]))


def _sensor_names(trained: TrainedAgent) -> list[str]:
    env = trained.settings.env
    shape = trained.statistics.observation_spec["observation"].shape
    return sensor_names(env.id, env.version, shape[-1])


def _summary(rows: Sequence[dict[str, Any]]) -> str:
    steps = sum(row["length"] for row in rows)
    missing = sum(row["missing_ratio"] * row["length"] for row in rows) / steps
    parts = [f"missing {missing:.3f}"]
    for mode in dict.fromkeys(row["mode"] for row in rows):
        returns = [row["return"] for row in rows if row["mode"] == mode]
        parts.append(f"{mode} {sum(returns) / len(returns):.1f}")
    if stopped := sum(row["diverged"] for row in rows):
        parts.append(f"belief diverged in {stopped} of {len(rows)} episodes")
    return ", ".join(parts)


@hydra.main(version_base="1.3", config_path="../conf", config_name="evaluate")
def main(config: DictConfig) -> None:
    """Start from the command line."""
    start(run, config)


if __name__ == "__main__":
    main()
