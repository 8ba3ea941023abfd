"""Show an agent at work: ``python recipes/play.py run=<folder> point=mcar:0.5 out=video.gif``.

The video of an episode, or the picture with ``out=belief.png``, shows the robot, which of its
sensors arrive at each step and, for some of them, the true value, what arrived, the gaps, and the
belief, if there is one, with its 95 % interval.
"""

import importlib.util
from math import inf
from pathlib import Path
from typing import Any

import torch
from evaluation.conditions import parse_condition, removed_sensors
from evaluation.trained import load_trained_agent
from rendering.belief_figure import chosen_sensors, draw_belief
from rendering.style import save_figure
from rendering.trajectory import record_episode
from rendering.video import Video, robot_size, write_video
from training.config import check_limits, check_mode, command
from training.console import log_line
from training.errors import UserError

_LIMITS = {
    "start": (0, inf),
    "steps": (1, inf),
    "every": (1, inf),
    "window": (2, inf),
    "frames": (0, inf),
    "size": (240, 1920),
    "colours": (8, 256),
}
_STRIP = (248, 330)  # pixels of a picture of the robot above the panels of a figure


def run(config: dict[str, Any]) -> int:
    """Record an episode and show it; see conf/play.yaml."""
    out, first = _check(config), config["start"]
    torch.set_num_threads(config["threads"])
    trained = load_trained_agent(Path(config["run"]))
    text = str(config["point"])
    condition = parse_condition(text, trained.settings)
    still = out.suffix == ".png"
    # Panels of the first frame of a video look back too.
    begin = first if still else max(0, first - config["window"] + 1)
    seed = config["reduction_seed"]
    size = _STRIP if still else robot_size(config["size"])
    recording = record_episode(
        trained,
        condition,
        removed_sensors(condition, trained, episodes=1, reduction_seed=seed),
        mode=config["mode"],
        seed=config["seed"],
        start=begin,
        steps=first - begin + config["steps"],
        picture_size=size if config["robot"] else None,
    )
    steps = range(first - begin, len(recording.steps), config["every"])
    if not steps:
        raise UserError(
            "`start` must lie inside the episode, which ended after "
            f"{begin + len(recording.steps)} steps."
        )
    sensors = chosen_sensors(recording, config["sensors"])
    shown = f"{condition.name}{', as in training' if text == 'trained' else ''}"
    title = f"{recording.task}, {trained.settings.belief.get('name')}, {shown}"
    if still:
        title += f", after {trained.frames:,} training steps, {config['mode']} actions"
        figure = draw_belief(recording, sensors, pictures=config["frames"], title=title)
        save_figure(figure, out, dpi=120)
        coverage = 100 * recording.coverage
        what = "one figure"
        if recording.kind == "estimate" and coverage >= 0:
            what = f"the 95 % intervals hold {coverage:.1f} % of the missing entries"
    else:
        look = {"window": config["window"], "width": config["size"], "title": title}
        video = Video(recording, sensors, steps=steps, **look)
        write_video(out, video, fps=config["fps"], colours=config["colours"])
        what = f"{len(video)} frames of {video.width} x {video.height}"
    missing = 1 - recording.observed[steps.start :].mean()
    log_line(
        f"steps {first} to {begin + steps[-1]}, missing {missing:.3f}, {what}; written: {out} "
        f"({out.stat().st_size / 1e6:.2f} MB)"
    )
    return 0


def _check(config: dict[str, Any]) -> Path:
    """Refuse what can't be shown, before an agent is loaded; return where it goes."""
    if config["run"] is None or not Path(config["run"]).is_dir():
        raise UserError(f"`run` must name a run folder: run=runs/<folder>, got {config['run']}.")
    check_limits(config, _LIMITS, whole=True)
    check_limits(config, {"fps": (1, 50)})  # a GIF counts in hundredths of a second
    check_mode("mode", config["mode"])
    out = Path(config["out"] or Path(config["run"]) / "play.gif")
    if not out.parent.is_dir():
        raise UserError(f"`out` must lie in an existing folder, got {out}.")
    if out.suffix not in (".gif", ".mp4", ".png"):
        raise UserError(f"`out` must end in .gif, .mp4 or .png, got {out.name}.")
    if out.suffix == ".mp4" and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise UserError(
            "`out` as .mp4 needs imageio-ffmpeg: pip install imageio-ffmpeg, or take "
            f"{out.with_suffix('.gif').name}."
        )
    return out


if __name__ == "__main__":
    command("play", run)
