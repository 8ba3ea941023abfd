"""Diagnose beliefs: ``python recipes/diagnose.py 'run=runs/*' out=results/<study>``.

How far is what an agent believes of its sensors from what complete, noiseless ones would have
shown, and is it as sure as it should be? The last checkpoint of each run acts; precision.csv,
calibration.csv and reliability.csv hold a row a class of entries, the figures show them by the
steps since a sensor was last seen.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import hydra
import pandas as pd
import torch
from analysis.calibration import Tally, class_names, diagnose, pool
from analysis.calibration_figures import outage_figure, precision_figure, reliability_figure
from analysis.calibration_tables import calibration_rows, precision_rows, reliability_rows
from evaluation.conditions import parse_conditions, removed_sensors
from evaluation.folders import find_folders, with_checkpoint
from evaluation.trained import load_trained_agent
from omegaconf import DictConfig
from rendering.belief_figure import save_figure
from training.config import check_mode, missingness_name
from training.console import say, start
from training.envs import env_name
from training.errors import UserError
from training.run_folder import write_whole

from torchrl_drbpn import BeliefDivergedError

_FIGURES = {
    "precision": ("precision.png", precision_figure),
    "calibration": ("outages.png", outage_figure),
    "reliability": ("reliability.png", reliability_figure),
}
_KIND = ("task", "method", "trained_on", "noise_sigma", "point")


def run(config: dict[str, Any]) -> int:
    """Diagnose and write tables and figures, or draw these anew.

    Args:
        config: see conf/diagnose.yaml.

    Returns:
        The exit status.
    """
    if config["redraw"] is not None:
        return _draw(Path(config["redraw"]))
    check_mode(config["mode"])
    class_names(config["bins"])
    for name, least in (("episodes", 1), ("resamples", 2)):
        if config[name] < least:
            raise UserError(f"`{name}` must be {least} or more, got {config[name]}.")
    if not config["points"]:
        raise UserError("`points` must hold at least one, such as trained or mcar:0.5.")
    folders = find_folders(config["run"])
    if config["out"] is None and len(folders) > 1:
        raise UserError("`out` must be given for several runs: out=results/<study>.")
    out = Path(config["out"] or folders[0])
    if out.exists() and not out.is_dir():
        raise UserError(f"`out` must be a folder, {out} is a file.")
    torch.set_num_threads(config["threads"])
    groups: dict[tuple[Any, ...], list[tuple[dict[str, Any], Tally]]] = {}
    for common, tally in _diagnoses(with_checkpoint(folders), config):
        groups.setdefault(tuple(common[name] for name in _KIND), []).append((common, tally))
    if not groups:
        raise UserError("no point is left: every belief diverged, see above. Name other `points`.")
    tables: dict[str, list[dict[str, Any]]] = {name: [] for name in _FIGURES}
    for members in groups.values():
        if len(members) > 1:  # and all of them together
            together = pool([tally for _, tally in members])
            common = members[0][0] | {"run": "all", "training_seed": None, "runs": len(members)}
            members.append((common | _sizes(together), together))
        for common, tally in members:
            options = {"resamples": config["resamples"], "seed": config["seed"]}
            tables["precision"] += [common | row for row in precision_rows(tally, **options)]
            tables["calibration"] += [common | row for row in calibration_rows(tally, **options)]
            tables["reliability"] += [common | row for row in reliability_rows(tally)]
    out.mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        if rows:
            text = pd.DataFrame(rows).to_csv(index=False, float_format="%.6g")
            write_whole(out / f"{name}.csv", text)
        else:
            (out / f"{name}.csv").unlink(missing_ok=True)  # of an earlier diagnosis
    return _draw(out)


def _draw(folder: Path) -> int:
    """Draw the figures of the tables in a folder."""
    if not (folder / "precision.csv").is_file():
        raise UserError(f"`redraw` must be the folder of a diagnosis, {folder} has no tables.")
    for table, (name, draw) in _FIGURES.items():
        path = folder / f"{table}.csv"
        figure = draw(pd.read_csv(path)) if path.is_file() else None
        if figure is None:
            (folder / name).unlink(missing_ok=True)
        else:
            save_figure(figure, folder / name, dpi=100)
    say(f"written: {folder}")
    return 0


def _diagnoses(
    folders: list[Path], config: dict[str, Any]
) -> Iterator[tuple[dict[str, Any], Tally]]:
    """Yield the columns and the tally of each run and point, and print a line of each."""
    options = {name: config[name] for name in ("episodes", "mode", "seed", "bins")}
    for folder in folders:
        trained = load_trained_agent(folder)
        settings = trained.settings
        belief = str(settings.belief.get("name", ""))
        if trained.agent.observing is None:
            say(
                f"{folder.name}: belief={belief} keeps no estimate of its sensors; the rows are "
                "those of the last value and the running mean"
            )
        spike_std = float(config["spike_std"])
        for condition in parse_conditions(config["points"], settings, spike_std=spike_std):
            removed = removed_sensors(
                condition,
                trained,
                episodes=config["episodes"],
                reduction_seed=config["reduction_seed"],
            )
            try:
                tally = diagnose(trained, condition, removed, **options)
            except BeliefDivergedError as error:
                say(f"{folder.name}, {condition.name}: no rows, {error}")
                continue
            say(_summary(folder, condition.name, tally))
            yield (
                {
                    "run": folder.name,
                    "task": env_name(settings),
                    "belief": belief,
                    "method": trained.method,
                    "training_seed": settings.seed,
                    "trained_on": missingness_name(settings.missingness),
                    "noise_sigma": settings.noise.sigma,
                    "point": condition.name,
                    "mode": config["mode"],
                    "runs": 1,
                }
                | _sizes(tally),
                tally,
            )


def _sizes(tally: Tally) -> dict[str, Any]:
    return {"missing_ratio": tally.missing_ratio, "episodes": len(tally.lengths)}


def _summary(folder: Path, point: str, tally: Tally) -> str:
    """Return a line: the error of each estimate where sensors are missing, NIS over entries."""
    parts = [f"{folder.name}, {point}, missing {tally.missing_ratio:.3f}; RMSE of missing sensors"]
    for row in precision_rows(tally, resamples=2, seed=0):
        if row["entries"] == "missing" and row["steps_since_seen"] == "all":
            parts.append(f"{row['estimate']} {row['rmse']:.3f}")
    for row in calibration_rows(tally, resamples=2, seed=0):
        if row["held_against"] == "reading" and row["steps_since_seen"] == "all":
            parts.append(f"NIS/entries {row['nis_per_dof']:.2f}")
    return "; ".join(parts)


@hydra.main(version_base="1.3", config_path="../conf", config_name="diagnose")
def main(config: DictConfig) -> None:
    """Start from the command line."""
    start(run, config)


if __name__ == "__main__":
    main()
