"""Draw what beliefs learned about their sensors: ``python recipes/plot_sensors.py 'run=runs/*'``.

From the last checkpoint of each run: which sensors tell most about the state by the learned H, P
and R (sensor_ranking.png, sensor_ranking.csv), and the covariance H P H' + R of what they read in
one step (observation_covariance.png). Runs of one task, method and training corruption are drawn
together; runs that have not learned these are left out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import hydra
import torch
from analysis.sensor_figures import covariance_figure, ranking_figure
from evaluation.folders import find_folders, with_checkpoint
from evaluation.sensor_choice import SensorModel, learned_sensors
from evaluation.trained import TrainedAgent, load_trained_agent
from omegaconf import DictConfig
from rendering.belief_figure import save_figure
from training.config import missingness_name
from training.console import say, start
from training.envs import env_name
from training.errors import UserError
from training.run_folder import write_table

_Run = tuple[TrainedAgent, SensorModel]


def run(config: dict[str, Any]) -> int:
    """Read the runs and draw them.

    Args:
        config: see conf/plot_sensors.yaml.

    Returns:
        The exit status.
    """
    if config["run"] is None:
        raise UserError("`run` must name run folders: run=runs/<folder> or 'run=runs/*'.")
    if config["orders"] < 20 or config["dpi"] < 1:
        raise UserError("`orders` must be 20 or more, for a band of 5 to 95 %, `dpi` 1 or more.")
    folders = find_folders(config["run"])
    if config["out"] is None and len(folders) > 1:
        raise UserError(f"`out` must name a folder for the pictures of {len(folders)} runs.")
    out = Path(config["out"] or folders[0])
    if out.exists() and not out.is_dir():
        raise UserError(f"`out` must be a folder, {out} is a file.")
    folders = with_checkpoint(folders)
    torch.set_num_threads(1)  # many small matrices
    agents = [(folder, load_trained_agent(folder)) for folder in folders]
    groups: dict[str, list[_Run]] = {}
    for folder, trained in agents:
        try:
            model = learned_sensors(trained)
        except UserError as error:
            if len(folders) == 1:
                raise
            say(f"{folder.name}: left out; {error}")
            continue
        groups.setdefault(_title(trained), []).append((trained, model))
    if not groups:
        raise UserError("`run` must name runs that have learned H, P and R; none of these has.")
    for members in groups.values():
        members.sort(key=lambda member: member[1].seed)
    models = {title: [model for _, model in members] for title, members in groups.items()}
    ranking = ranking_figure(models, orders=config["orders"], seed=config["seed"])
    covariance = covariance_figure(models, correlation=config["correlation"])
    out.mkdir(parents=True, exist_ok=True)
    members = [member for group in groups.values() for member in group]
    write_table(
        out / "sensor_ranking.csv",
        [row for member in members for row in ranking_rows(*member)],
    )
    save_figure(ranking, out / "sensor_ranking.png", dpi=config["dpi"], palette=True)
    save_figure(covariance, out / "observation_covariance.png", dpi=config["dpi"], palette=True)
    runs = f"{len(members)} run{'s' if len(members) > 1 else ''}"
    say(f"{runs}, written: {out}/sensor_ranking.png, .csv, observation_covariance.png")
    return 0


def _title(trained: TrainedAgent) -> str:
    """Name what the runs of one column have in common."""
    settings = trained.settings
    what = f"trained on {missingness_name(settings.missingness)}, sigma {settings.noise.sigma:g}"
    return f"{env_name(settings)}, {trained.method}\n{what}"


def ranking_rows(trained: TrainedAgent, model: SensorModel) -> list[dict[str, Any]]:
    """Return one row a criterion and place.

    Args:
        trained: the agent.
        model: what it has learned about its sensors.

    Returns:
        Columns and values. ``information``: nats that the sensors up to this place tell about the
        state; ``variance_left``: the share of tr H P H' that they leave; ``learned_noise_std`` and
        ``added_noise_std``: what R says of the sensor's noise and what the noise was, in running
        standard deviations of the sensor. Six digits: the rest differs between machines.
    """
    settings = trained.settings
    common = {
        "env": env_name(settings),
        "method": trained.method,
        "trained_on": missingness_name(settings.missingness),
        "noise_sigma": settings.noise.sigma,
        "training_seed": settings.seed,
        "frames": trained.frames,
    }
    criteria: tuple[Literal["D", "A"], ...] = ("D", "A")
    learned_std = model.emission_cov.diagonal().sqrt()
    rows = []
    for criterion in criteria:
        order = model.ranking(criterion)
        columns = (x.tolist() for x in (order, *model.along(order)))
        for place, (sensor, information, left) in enumerate(zip(*columns, strict=True), 1):
            rows.append(
                common
                | {
                    "criterion": criterion,
                    "place": place,
                    "component": sensor,
                    "sensor": model.names[sensor],
                    "information": f"{information:.6g}",
                    "variance_left": f"{left:.6g}",
                    "learned_noise_std": f"{learned_std[sensor].item():.6g}",
                    "added_noise_std": f"{model.added_std[sensor].item():.6g}",
                }
            )
    return rows


@hydra.main(version_base="1.3", config_path="../conf", config_name="plot_sensors")
def main(config: DictConfig) -> None:
    """Start from the command line."""
    start(run, config)


if __name__ == "__main__":
    main()
