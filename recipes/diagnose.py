"""Diagnose beliefs: ``python recipes/diagnose.py 'run=runs/*' out=results/<study>``.

How far is what an agent believes of its sensors from what complete, noiseless ones would have
shown, and is it as sure as it should be? The last checkpoint of each run acts; precision.csv,
calibration.csv and reliability.csv hold a row a class of entries, the figures show them by the
steps since a sensor was last seen.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import hydra
import torch
from analysis.calibration import Tally, class_names, diagnose, pool
from analysis.calibration_figures import (
    Series,
    draw_outages,
    outage_figure,
    precision_figure,
    read_outages,
    reliability_figure,
)
from analysis.calibration_tables import calibration_rows, precision_rows, reliability_rows
from analysis.runs import find_folders, write_table
from evaluation.conditions import Point, check_reduction_seed, removed_sensors
from evaluation.grid import parse_points
from evaluation.trained import TrainedAgent, load_trained_agent, with_checkpoint
from omegaconf import DictConfig
from rendering.belief_figure import save_figure
from training.config import check_mode, missingness_name
from training.console import say, start
from training.errors import UserError
from training.methods import training_labels

from torchrl_drbpn import BeliefDivergedError

_FIGURES = ("precision.png", "outages.png", "reliability.png")


def run(config: dict[str, Any]) -> int:
    """Diagnose and write tables and figures.

    Args:
        config: see conf/diagnose.yaml.

    Returns:
        The exit status.
    """
    if config["redraw"] is not None:
        return _redraw(Path(config["redraw"]))
    if config["run"] is None:
        raise UserError("`run` must name run folders: run=<folder> or 'run=runs/*'.")
    check_mode(config["mode"])
    class_names(config["bins"])
    if config["episodes"] < 1:
        raise UserError(f"`episodes` must be positive, got {config['episodes']}.")
    if config["resamples"] < 2:
        raise UserError(f"`resamples` must be 2 or more, got {config['resamples']}.")
    check_reduction_seed(config["reduction_seed"])
    if not config["points"]:
        raise UserError("`points` must hold at least one, such as trained or mcar:0.5.")
    folders = find_folders(config["run"])
    if config["out"] is None and len(folders) > 1:
        raise UserError("`out` must be given for several runs: out=results/<study>.")
    out = Path(config["out"] or folders[0])
    if out.exists() and not out.is_dir():
        raise UserError(f"`out` must be a folder, {out} is a file.")
    folders = with_checkpoint(folders)
    torch.set_num_threads(config["threads"])
    options = {"resamples": config["resamples"], "seed": config["seed"]}
    precision: list[dict[str, Any]] = []
    calibration: list[dict[str, Any]] = []
    reliability: list[dict[str, Any]] = []
    series: dict[tuple[str, str, str, str, float], list[Tally]] = {}
    for folder, trained, point, tally in _diagnoses(folders, config):
        common = _common(folder, trained, point, config["mode"], tally)
        precision += [common | row for row in precision_rows(tally, **options)]
        calibration += [common | row for row in calibration_rows(tally, **options)]
        reliability += [common | row for row in reliability_rows(tally)]
        sigma = trained.settings.noise.sigma
        kind = (common["task"], common["point"], common["method"], common["trained_on"], sigma)
        series.setdefault(kind, []).append(tally)
    if not precision:
        raise UserError("no point is left: every belief diverged, see above. Name other `points`.")
    out.mkdir(parents=True, exist_ok=True)
    write_table(out / "precision.csv", precision)
    for name, rows in (("calibration.csv", calibration), ("reliability.csv", reliability)):
        if rows:
            write_table(out / name, rows)
        else:
            (out / name).unlink(missing_ok=True)  # of an earlier diagnosis, no longer true
    pooled = _pooled(series)
    figures = (
        precision_figure(pooled, **options),
        outage_figure(pooled, **options),
        reliability_figure(pooled),
    )
    for name, figure in zip(_FIGURES, figures, strict=True):
        if figure is None:
            (out / name).unlink(missing_ok=True)
        else:
            save_figure(figure, out / name, dpi=100)
    say(f"{len(folders)} run{'s' if len(folders) > 1 else ''}, written: {out}")
    return 0


def _redraw(folder: Path) -> int:
    """Draw the outage figure of a diagnosis anew from its table."""
    table, path = folder / "calibration.csv", folder / _FIGURES[1]
    if not table.is_file():
        raise UserError(
            f"`redraw` must be the folder of a diagnosis, {folder} has no {table.name}."
        )
    figure = draw_outages(read_outages(table))
    if figure is None:
        raise UserError(f"`{table}` holds no reading that was held against a forecast.")
    save_figure(figure, path, dpi=100)
    say(f"written: {path}")
    return 0


def _pooled(series: Mapping[tuple[str, str, str, str, float], list[Tally]]) -> list[Series]:
    """Put the runs of one task, point, method and kind of training together."""
    # What it was trained on is told by the figures; sigma is told here where it differs.
    labels = training_labels((method, "", sigma) for *_, method, _, sigma in series)
    return [
        Series(task, point, labels[method, "", sigma], trained_on, len(tallies), pool(tallies))
        for (task, point, method, trained_on, sigma), tallies in series.items()
    ]


def _diagnoses(
    folders: list[Path], config: dict[str, Any]
) -> Iterator[tuple[Path, TrainedAgent, Point, Tally]]:
    """Yield a tally for each run and point, and say in a line what it came to."""
    for folder in folders:
        trained = load_trained_agent(folder)
        if trained.belief.observing is None:
            name = trained.settings.belief.get("name")
            say(
                f"{folder.name}: belief={name} keeps no estimate of its sensors; the rows are "
                "those of the last value and the running mean"
            )
        texts = [str(point) for point in config["points"]]
        for point in parse_points(texts, trained.settings, float(config["spike_std"])):
            removed = removed_sensors(
                point,
                trained,
                episodes=config["episodes"],
                reduction_seed=config["reduction_seed"],
            )
            try:
                tally = diagnose(
                    trained,
                    point.missingness,
                    noise=point.noise,
                    removed=removed,
                    episodes=config["episodes"],
                    mode=config["mode"],
                    seed=config["seed"],
                    bins=config["bins"],
                )
            except BeliefDivergedError as error:
                say(f"{folder.name}, {point.name}: no rows, {error}")
                continue
            say(_summary(folder, point, tally))
            yield folder, trained, point, tally


def _summary(folder: Path, point: Point, tally: Tally) -> str:
    """Return a line: the error of each estimate where sensors are missing, NIS over entries."""
    parts = [f"{folder.name}, {point.name}, missing {tally.missing_ratio:.3f}"]
    for row in precision_rows(tally, resamples=2, seed=0):
        if row["entries"] == "missing" and row["steps_since_seen"] == "all":
            parts.append(f"{row['estimate']} {row['rmse']:.3f}")
    for row in calibration_rows(tally, resamples=2, seed=0):
        if row["held_against"] == "reading" and row["steps_since_seen"] == "all":
            parts.append(f"NIS/entries {row['nis_per_dof']:.2f}")
    return "; ".join([parts[0], "RMSE of missing sensors", *parts[1:]])


def _common(
    folder: Path, trained: TrainedAgent, point: Point, mode: str, tally: Tally
) -> dict[str, Any]:
    """Return the columns that all rows of a run at a point have."""
    settings = trained.settings
    return {
        "run": folder.name,
        "task": settings.env.env_id,
        "belief": str(settings.belief.get("name", "")),
        "method": trained.method,
        "training_seed": settings.seed,
        "trained_on": missingness_name(settings.missingness),
        "point": point.name,
        "missing_ratio": tally.missing_ratio,
        "mode": mode,
        "episodes": len(tally.lengths),
    }


@hydra.main(version_base="1.3", config_path="../conf", config_name="diagnose")
def main(config: DictConfig) -> None:
    """Start from the command line."""
    start(run, config)


if __name__ == "__main__":
    main()
