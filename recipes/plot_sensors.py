"""Draw what beliefs learned about their sensors: ``python recipes/plot_sensors.py 'run=runs/*'``.

From the last checkpoint of each run: which sensors hold most information on the state by the
learned H, P and R (sensor_ranking.png, .csv), and the covariance H P H' + R of what they read in
one step (observation_covariance.png). Runs that have not learned these are left out.
"""

from math import inf
from typing import Any, Literal

import torch
from analysis.sensor_figures import covariance_figure, ranking_figure
from evaluation.folders import find_folders, output_folder, with_checkpoint
from evaluation.sensor_choice import SensorModel, learned_sensors
from evaluation.trained import TrainedAgent, load_trained_agent
from rendering.style import save_figure
from training.config import check_limits, command
from training.console import log_line
from training.errors import UserError
from training.run_folder import write_table


def run(config: dict[str, Any]) -> int:
    """Read the runs and draw them; see conf/plot_sensors.yaml."""
    check_limits(config, {"orders": (20, inf), "dpi": (1, inf)}, whole=True)  # a band of 5 to 95 %
    folders = find_folders(config["run"])
    out, folders = output_folder(config["out"], folders), with_checkpoint(folders)
    torch.set_num_threads(1)  # many small matrices
    members: list[tuple[TrainedAgent, SensorModel]] = []
    for folder in folders:
        trained = load_trained_agent(folder)
        try:
            members.append((trained, learned_sensors(trained)))
        except UserError as error:
            if len(folders) == 1:
                raise
            log_line(f"{folder.name}: left out; {error}")
    if not members:
        raise UserError("`run` must name runs that have learned H, P and R; none of these has.")
    groups: dict[str, list[SensorModel]] = {}
    for trained, model in sorted(members, key=lambda member: member[1].seed):
        groups.setdefault(title(trained), []).append(model)
    out.mkdir(parents=True, exist_ok=True)
    rows = [row for member in members for row in ranking_rows(*member)]
    write_table(out / "sensor_ranking.csv", rows)
    figures = {
        "sensor_ranking": ranking_figure(groups, orders=config["orders"], seed=config["seed"]),
        "observation_covariance": covariance_figure(groups, correlation=config["correlation"]),
    }
    for name, figure in figures.items():
        save_figure(figure, out / f"{name}.png", dpi=config["dpi"], palette=True)
    runs = f"{len(members)} run{'s' if len(members) > 1 else ''}"
    log_line(f"{runs}, written: {out}/sensor_ranking.png, .csv, observation_covariance.png")
    return 0


def title(trained: TrainedAgent) -> str:
    """Name what the runs of one column have in common."""
    own = trained.columns()
    what = f"trained on {own['trained_on']}, sigma {own['noise_sigma']:g}"
    return f"{own['task']}, {own['method']}\n{what}"


def ranking_rows(trained: TrainedAgent, model: SensorModel) -> list[dict[str, Any]]:
    """Return one row a criterion and place; noise is in running standard deviations.

    ``information``: nats that the sensors up to this place hold on the state; ``variance_left``:
    the share of tr H P H' that they leave.
    """
    criteria: tuple[Literal["D", "A"], ...] = ("D", "A")
    learned_std = model.emission_cov.diagonal().sqrt().tolist()
    rows = []
    for criterion in criteria:
        order = model.ranking(criterion)
        columns = (x.tolist() for x in (order, *model.along(order)))
        for place, (sensor, information, left) in enumerate(zip(*columns, strict=True), 1):
            row = {
                "criterion": criterion,
                "place": place,
                "component": sensor,
                "sensor": model.names[sensor],
                "information": information,
                "variance_left": left,
                "learned_noise_std": learned_std[sensor],
                "added_noise_std": model.added_std[sensor].item(),
            }
            rows.append(trained.columns() | row)
    return rows


if __name__ == "__main__":
    command("plot_sensors", run)
