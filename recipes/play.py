"""Film an agent at work: ``python recipes/play.py run=<folder> point=mcar:0.5``.

The last checkpoint of the run acts for one episode. Each frame shows the robot, which of its
sensors arrive at that step and, for some of them, the latest steps: the true value, what arrived,
the gaps, and the belief with its 95 % interval. An agent without a belief is shown with its sensors
alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import hydra
import torch
from evaluation.conditions import check_reduction_seed, parse_point, removed_sensors
from evaluation.trained import load_trained_agent
from omegaconf import DictConfig
from rendering.belief_figure import chosen_sensors
from rendering.film import Film, Frame, robot_size
from rendering.frames import render_or_say
from rendering.trajectory import Recording, record_episode
from rendering.video_file import check_video, write_video
from training.config import check_mode, missingness_name
from training.console import say, start
from training.errors import UserError

_WIDTHS = (240, 1920)  # pixels
_COLOURS = (8, 256)


def run(config: dict[str, Any]) -> int:
    """Record an episode and film it.

    Args:
        config: see conf/play.yaml.

    Returns:
        The exit status.
    """
    out = _check(config)
    torch.set_num_threads(config["threads"])
    trained = load_trained_agent(Path(config["run"]))
    point = parse_point(str(config["point"]), trained.settings, spike_std=config["spike_std"])
    # Panels of the first frame look back too.
    begin = max(0, config["start"] - config["window"] + 1)
    recording = record_episode(
        trained,
        point.missingness,
        noise=point.noise,
        removed=removed_sensors(
            point, trained, episodes=1, reduction_seed=config["reduction_seed"]
        ),
        mode=config["mode"],
        seed=config["seed"],
        start=begin,
        steps=config["start"] - begin + config["steps"],
    )
    steps = range(config["start"] - begin, len(recording.poses), config["every"])
    if not steps:
        raise UserError(
            "`start` must lie inside the episode, which ended after "
            f"{begin + len(recording.poses)} steps."
        )
    sensors = chosen_sensors(recording, config["sensors"])
    shown = point.name
    if str(config["point"]) == "trained":
        shown = f"{missingness_name(trained.settings.missingness)}, as in training"
    film = Film(
        recording,
        sensors,
        _robot(recording, steps, config["size"]) if config["robot"] else [],
        steps=steps,
        window=config["window"],
        width=config["size"],
        title=f"{recording.task}  {trained.settings.belief.get('name')}  {shown}",
    )
    write_video(out, film, fps=config["fps"], colours=config["colours"])
    missing = 1 - recording.observed[steps.start :].mean()
    say(
        f"{len(film)} frames of {film.width} x {film.height}, steps {config['start']} to "
        f"{begin + steps[-1]}, missing {missing:.3f}; written: {out} "
        f"({out.stat().st_size / 1e6:.2f} MB)"
    )
    return 0


def _check(config: dict[str, Any]) -> Path:
    """Refuse what can't be filmed, before an agent is loaded; return where the film goes."""
    if config["run"] is None:
        raise UserError("`run` must name a run folder: run=runs/<folder>.")
    for name, least in (("steps", 1), ("every", 1), ("window", 2), ("start", 0)):
        if config[name] < least:
            raise UserError(f"`{name}` must be {least} or more, got {config[name]}.")
    for name, (least, most) in (("size", _WIDTHS), ("colours", _COLOURS)):
        if not least <= config[name] <= most:
            raise UserError(f"`{name}` must be in [{least}, {most}], got {config[name]}.")
    check_mode(config["mode"])
    check_reduction_seed(config["reduction_seed"])
    out = Path(config["out"] or Path(config["run"]) / "play.gif")
    if not Path(config["run"]).is_dir():
        raise UserError(f"`run` must be a run folder, got {config['run']}.")
    check_video(out, config["fps"])
    return out


def _robot(recording: Recording, steps: range, size: int) -> list[Frame]:
    """Draw the robot at each step, where that can be done."""
    width, height = robot_size(size)
    poses = [recording.poses[step] for step in steps]
    return render_or_say(recording.model, recording.task, poses, width=width, height=height)


@hydra.main(version_base="1.3", config_path="../conf", config_name="play")
def main(config: DictConfig) -> None:
    """Start from the command line."""
    start(run, config)


if __name__ == "__main__":
    main()
