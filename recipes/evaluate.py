"""Evaluate trained agents: ``python recipes/evaluate.py run=<run folder>``.

The last checkpoint of each run acts under other gaps, outages, noise and spikes than it was trained
with, with frozen normalisation. One row an episode goes to a CSV file that is written whole after
every condition: the same command goes on where an evaluation was stopped. The figures show the mean
with its 95 % interval over the nominal and the realised missing ratio.
"""

from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import Any

import joblib
import pandas as pd
from analysis.figures import draw_evaluation
from analysis.runs import EPISODE_TABLES
from evaluation.conditions import Condition, default_conditions, parse_conditions
from evaluation.episodes import over_episodes
from evaluation.folders import find_folders, with_checkpoint
from evaluation.sensor_choice import kept_sensors
from evaluation.table import Protocol, Table, evaluate_tasks
from evaluation.trained import TrainedAgent, load_trained_agent
from rendering.style import save_figure
from training.config import check_limits, check_mode, command
from training.console import log_line
from training.errors import UserError
from training.sensors import named_sensors


def run(config: dict[str, Any]) -> int:
    """Evaluate what is not yet in the table, write it, and draw it; see conf/evaluate.yaml."""
    folders, protocol = find_folders(config["run"]), _protocol(config)
    modes = config["modes"] if isinstance(config["modes"], list) else [config["modes"]]
    check_mode("modes", *modes)
    names = [folder.name for folder in folders]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise UserError(
            f"`run` must name folders with different names, {', '.join(twice)} comes twice: "
            "evaluate each of them by itself."
        )
    output, folders = _output(config, folders), with_checkpoint(folders)
    agents = {f: load_trained_agent(f, protocol.robust, protocol.robust_threshold) for f in folders}
    wanted = [(f, condition) for f in folders for condition in _conditions(config, f, agents[f])]
    named = {folder.name: agent for folder, agent in agents.items()}
    table = Table(output, protocol, named, overwrite=config["overwrite"])
    lacking = [(f, c, table.lacks(f.name, c, modes)) for f, c in wanted]
    tasks = [task for task in lacking if task[2]]
    if len(tasks) < len(wanted):
        log_line(f"{len(wanted) - len(tasks)} of {len(wanted)} points are in {output} already")
    processes = config["processes"] or joblib.cpu_count()
    for done, (task, rows) in enumerate(evaluate_tasks(tasks, protocol, processes), 1):
        table.add(rows)
        log_line(f"{done}/{len(tasks)} {task[0].name} {task[1].name}: {_summary(rows)}")
    table.arrange([(folder.name, condition.name) for folder, condition in wanted])
    table.write()
    log_line(f"written: {output}")
    if config["figures"]:
        for env_id, figure in draw_evaluation(pd.read_csv(output)).items():
            path = output.with_name(f"{output.stem}-{env_id}.png")
            save_figure(figure, path, dpi=120)
            log_line(f"written: {path}")
    return 0


def _protocol(config: dict[str, Any]) -> Protocol:
    check_limits(config, dict.fromkeys(("episodes", "processes"), (1, inf)), whole=True)
    names = ("episodes", "seed", "reduction_seed", "threads", "robust", "robust_threshold")
    return Protocol(**{name: config[name] for name in names})


def _output(config: dict[str, Any], folders: Sequence[Path]) -> Path:
    name = Path(EPISODE_TABLES[config["points"] is not None])
    given = config["output"] and Path(config["output"])
    if config["robust"] is not None:
        update = f"{config['robust']}{config['robust_threshold']}"
        name = name.with_name(f"{name.stem}-{update}{name.suffix}")
        # Reports read the tables of these names as those of the agent as it was trained.
        if given and given.name in EPISODE_TABLES:
            raise UserError(
                f"`output` must not be called {given.name} with robust=, as reports would read it "
                f"as without: take {name} or another name."
            )
    output: Path = given or (folders[0] if len(folders) == 1 else Path()) / name
    if not output.parent.is_dir():
        raise UserError(f"`output` must lie in an existing folder, got {output}.")
    return output


def _conditions(config: dict[str, Any], folder: Path, trained: TrainedAgent) -> list[Condition]:
    """Return what a run is evaluated under."""
    settings = trained.settings
    if config["points"] is not None:
        return parse_conditions(config["points"], settings)
    model, levels = True, dict(config["grid"])
    try:
        kept_sensors(trained, 0)
    except UserError as error:
        model = False
        log_line(f"{folder.name}: sensors are removed at random only; {error}")
    if config["full"] and not named_sensors(settings.env.id, settings.env.version):
        levels["outage_groups"] = ["sensor"]
        log_line(f"{folder.name}: outages of single sensors only, these have no names to group by")
    return parse_conditions(default_conditions(levels, full=config["full"], model=model), settings)


def _summary(rows: pd.DataFrame) -> str:
    found = over_episodes(rows.infer_objects(), ["point", "mode"])
    missing = 1 - found.arrived.sum() / found.steps.sum()
    means = zip(found["mode"], found.return_mean, strict=True)
    parts = [f"missing {missing:.3f}", *(f"{mode} {mean:.1f}" for mode, mean in means)]
    if stopped := rows.diverged.sum():
        parts.append(f"belief diverged in {stopped} of {len(rows)} episodes")
    return ", ".join(parts)


if __name__ == "__main__":
    command("evaluate", run)
