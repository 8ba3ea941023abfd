"""Diagnose beliefs: ``python recipes/diagnose.py 'run=runs/*' out=results/<study>``.

How far are an agent's estimates of its sensors from what complete, noiseless ones would have
shown, and are the deviations that it claims right? The last checkpoint of each run acts;
precision.csv, calibration.csv and reliability.csv hold a row a class of entries, the figures show
them by the steps since a sensor was last seen.
"""

from collections.abc import Iterator
from math import inf
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from analysis.calibration import Tally, class_names, diagnose, pool
from analysis.calibration_figures import outage_figure, precision_figure, reliability_figure
from analysis.calibration_tables import calibration_rows, precision_rows, reliability_rows
from evaluation.conditions import parse_conditions, removed_sensors
from evaluation.folders import find_folders, output_folder, with_checkpoint
from evaluation.trained import load_trained_agent
from rendering.style import write_or_remove
from training.config import check_limits, check_mode, command
from training.console import log_line
from training.errors import UserError

from torchrl_drbpn import BeliefDivergedError

FIGURES = {
    "precision": ("precision.png", precision_figure),
    "calibration": ("outages.png", outage_figure),
    "reliability": ("reliability.png", reliability_figure),
}
_KIND = ["task", "method", "trained_on", "noise_sigma", "point"]


def run(config: dict[str, Any]) -> int:
    """Diagnose and write tables and figures, or draw these anew; see conf/diagnose.yaml."""
    if config["redraw"] is not None:
        return _draw(Path(config["redraw"]))
    check_mode("mode", config["mode"])
    class_names(config["bins"])
    check_limits(config, {"episodes": (1, inf), "resamples": (2, inf)}, whole=True)
    folders = find_folders(config["run"])
    out = output_folder(config["out"], folders)
    torch.set_num_threads(config["threads"])
    groups: dict[tuple[Any, ...], list[tuple[dict[str, Any], Tally]]] = {}
    for common, tally in _diagnoses(with_checkpoint(folders), config):
        groups.setdefault(tuple(common[name] for name in _KIND), []).append((common, tally))
    if not groups:
        raise UserError("no point is left: every belief diverged, see above. Name other `points`.")
    tables: dict[str, list[dict[str, Any]]] = {name: [] for name in FIGURES}
    options = {"resamples": config["resamples"], "seed": config["seed"]}
    for members in groups.values():
        if len(members) > 1:  # and all of them together
            common = members[0][0] | {"run": "all", "training_seed": None, "runs": len(members)}
            members.append((common, pool([tally for _, tally in members])))
        for common, tally in members:
            common |= {"missing_ratio": tally.missing_ratio, "episodes": len(tally.lengths)}
            tables["precision"] += [common | row for row in precision_rows(tally, **options)]
            tables["calibration"] += [common | row for row in calibration_rows(tally, **options)]
            tables["reliability"] += [common | row for row in reliability_rows(tally)]
    out.mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        write_or_remove(out / f"{name}.csv", rows or None)
    return _draw(out)


def _draw(folder: Path) -> int:
    """Draw the figures of the tables in a folder."""
    if not (folder / "precision.csv").is_file():
        raise UserError(f"`redraw` must be the folder of a diagnosis, {folder} has no tables.")
    for table, (name, draw) in FIGURES.items():
        path = folder / f"{table}.csv"
        figure = draw(pd.read_csv(path)) if path.is_file() else None
        write_or_remove(folder / name, figure, dpi=100)
    log_line(f"written: {folder}")
    return 0


def _diagnoses(
    folders: list[Path], config: dict[str, Any]
) -> Iterator[tuple[dict[str, Any], Tally]]:
    """Yield the columns and the tally of each run and point, and print a line of each."""
    options = {name: config[name] for name in ("episodes", "mode", "seed", "bins")}
    for folder in folders:
        trained = load_trained_agent(folder)
        columns = {"run": folder.name} | trained.columns()
        if trained.agent.observing is None:
            log_line(
                f"{folder.name}: belief={columns['belief']} keeps no estimate of its sensors; the "
                "rows are those of the last value and the running mean"
            )
        for condition in parse_conditions(config["points"], trained.settings):
            drawn = {name: config[name] for name in ("episodes", "reduction_seed")}
            removed = removed_sensors(condition, trained, **drawn)
            try:
                tally = diagnose(trained, condition, removed, **options)
            except BeliefDivergedError as error:
                log_line(f"{folder.name}, {condition.name}: no rows, {error}")
                continue
            log_line(f"{folder.name}, {condition.name}, {_summary(tally)}")
            yield (columns | {"point": condition.name, "mode": config["mode"], "runs": 1}, tally)


def _summary(tally: Tally) -> str:
    """Return the error of each estimate where sensors are missing, and NIS over entries."""
    parts = [f"missing {tally.missing_ratio:.3f}; RMSE of missing sensors"]
    for row in precision_rows(tally, resamples=2, seed=0):
        if row["entries"] == "missing" and row["steps_since_seen"] == "all":
            parts.append(f"{row['estimate']} {row['rmse']:.3f}")
    for row in calibration_rows(tally, resamples=2, seed=0):
        if row["held_against"] == "reading" and row["steps_since_seen"] == "all":
            parts.append(f"NIS/entries {row['nis_per_dof']:.2f}")
    return "; ".join(parts)


if __name__ == "__main__":
    command("diagnose", run)
