"""Evaluate a trained agent: ``python recipes/evaluate.py run=<folder> points=[none:0,mcar:0.5]``.

The last checkpoint of the run acts under each kind of missingness, with frozen normalisation and
the noise of its training. One row an episode goes to a CSV file, written whole or not at all.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any, cast

import hydra
import torch
from assembly.console import run_or_explain, say
from assembly.errors import UserError
from assembly.points import episode_rows, evaluate_points
from assembly.run_folder import write_table
from assembly.trained import load_trained_agent
from omegaconf import DictConfig, OmegaConf


def run(config: dict[str, Any]) -> int:
    """Evaluate and write the table.

    Args:
        config: see conf/evaluate.yaml.

    Returns:
        The exit status.
    """
    if config["run"] is None:
        raise UserError("`run` must name a run folder: run=runs/<folder>.")
    torch.set_num_threads(config["threads"])
    folder = Path(config["run"])
    output = Path(config["output"] or folder / "points.csv")
    if not output.parent.is_dir():
        raise UserError(f"`output` must lie in an existing folder, got {output}.")
    trained = load_trained_agent(folder)
    rows: list[dict[str, Any]] = []
    for missingness, mode, result in evaluate_points(
        trained,
        [str(point) for point in config["points"]],
        episodes=config["episodes"],
        modes=config["modes"],
        seed=config["seed"],
    ):
        rows += episode_rows(trained, missingness, mode, result)
        say(
            f"{missingness.mechanism} eta {missingness.eta:g}, missing "
            f"{result.missing_ratio:.3f}, {mode} actions: return {result.mean_return:.1f} "
            f"+- {result.std_return:.1f} over {len(result.returns)} episodes"
        )
    if rows:
        write_table(output, rows)
        say(f"written: {output}")
    return 0


@hydra.main(version_base="1.3", config_path="../conf", config_name="evaluate")
def main(config: DictConfig) -> None:
    """Start from the command line."""
    plain = cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))
    status = run_or_explain(lambda: run(plain))
    if status:
        sys.exit(status)


if __name__ == "__main__":
    main()
