"""Draw an agent's belief: ``python recipes/plot_belief.py run=<folder> point=mcar:0.5``.

The last checkpoint of the run acts for one episode. For the sensors that miss most, the figure
shows what complete sensors would have shown, what arrived, and the belief with its 95 % interval
(diagonal of H P H'), under pictures of the robot where this machine can draw them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra
import numpy as np
import torch
from evaluation.conditions import read_point
from evaluation.trained import load_trained_agent
from omegaconf import DictConfig
from rendering.belief_figure import chosen_sensors, draw_belief, frame_steps, save_figure
from rendering.frames import render_or_say
from rendering.trajectory import Recording, record_episode
from training.config import check_mode
from training.console import say, start
from training.errors import UserError

_FRAME_HEIGHT = 330  # pixels


def run(config: dict[str, Any]) -> int:
    """Record an episode and draw it.

    Args:
        config: see conf/plot_belief.yaml.

    Returns:
        The exit status.
    """
    if config["run"] is None:
        raise UserError("`run` must name a run folder: run=runs/<folder>.")
    if config["steps"] < 2 or config["start"] < 0 or config["frames"] < 0:
        raise UserError("`steps` must be 2 or more, `start` and `frames` 0 or more.")
    check_mode(config["mode"])
    torch.set_num_threads(config["threads"])
    folder = Path(config["run"])
    trained = load_trained_agent(folder)
    out = Path(config["out"] or folder / "belief.png")
    if not out.parent.is_dir():
        raise UserError(f"`out` must lie in an existing folder, got {out}.")
    missingness = read_point(str(config["point"]), trained.settings.missingness)
    recording = record_episode(
        trained,
        missingness,
        mode=config["mode"],
        seed=config["seed"],
        start=config["start"],
        steps=config["steps"],
    )
    if recording.told != "estimate" or np.isnan(recording.std).any():
        raise UserError(
            f"`belief={trained.settings.belief.get('name')}` keeps no Gaussian belief to draw: "
            "take a run with belief=drbpn, or recipes/play.py."
        )
    sensors = chosen_sensors(recording, config["sensors"])
    frames = _frames(recording, config["frames"])
    figure = draw_belief(
        recording,
        sensors,
        frames,
        title=f"{recording.task} after {trained.frames:,} training steps, {config['mode']} actions",
    )
    save_figure(figure, out, dpi=120)
    say(
        f"steps {config['start']} to {config['start'] + len(recording.poses) - 1}, missing "
        f"{recording.missing_ratio:.3f}, the 95 % intervals hold {100 * recording.coverage:.1f} % "
        f"of the missing entries; written: {out}"
    )
    return 0


def _frames(recording: Recording, count: int) -> list[Any]:
    """Draw the robot, where that can be done."""
    if not count:
        return []
    steps = frame_steps(min(count, len(recording.poses)), len(recording.poses))
    return render_or_say(
        recording.model,
        recording.task,
        [recording.poses[step] for step in steps],
        width=_FRAME_HEIGHT * 3 // 4,
        height=_FRAME_HEIGHT,
    )


@hydra.main(version_base="1.3", config_path="../conf", config_name="plot_belief")
def main(config: DictConfig) -> None:
    """Start from the command line."""
    start(run, config)


if __name__ == "__main__":
    main()
