"""One episode of a trained agent, with everything that a picture of its belief needs."""

import os
import sys
from dataclasses import dataclass, replace
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from beliefs import ESTIMATE, ESTIMATE_VARIANCE, FORECAST, FORECAST_COV
from evaluation.conditions import Condition
from evaluation.episodes import run_episodes
from evaluation.trained import TrainedAgent
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from training.config import one_line
from training.console import log_line
from training.envs import env_name
from training.errors import UserError

from torchrl_drbpn.functional import zero_missing

INTERVAL_95 = 1.959964  # half width of a normal's central 95 %, in standard deviations
# Of a belief: the sensors' values after the observation, the readings before it, or nothing.
Kind = Literal["estimate", "forecast", "nothing"]
Picture = NDArray[np.uint8]
_FAR = 0.9999  # depth of what is not there, 1 at the far end of the scene


@dataclass(frozen=True)
class Recording:
    """Part of an episode, step by step; sensor values in normalised units, ``(time, obs)`` each.

    ``complete`` is what complete, noiseless sensors would have shown; ``arrived`` holds 0 where
    nothing did. ``estimate`` is, by ``kind``, each sensor's value by what arrived until this step,
    the reading predicted from the step before, or NaN; ``std`` its deviation, or NaN.
    """

    kind: Kind
    task: str
    names: list[str]
    first_step: int
    pictures: list[Picture]
    complete: NDArray[np.float64]
    arrived: NDArray[np.float64]
    observed: NDArray[np.bool_]
    estimate: NDArray[np.float64]
    std: NDArray[np.float64]

    @property
    def steps(self) -> NDArray[np.int64]:
        """Return the number of each step in its episode."""
        return self.first_step + np.arange(len(self.observed))

    @property
    def missing_ratio(self) -> float:
        """Return the share of entries that did not arrive."""
        return float(1 - self.observed.mean())

    @property
    def coverage(self) -> float:
        """Return the share of missing entries inside their 95 % interval; NaN if there is none."""
        missing = ~self.observed
        if not missing.any() or np.isnan(self.std).any():
            return float("nan")
        inside = np.abs(self.complete - self.estimate) < INTERVAL_95 * self.std
        return float(inside[missing].mean())


class Camera:
    """Draw the state of a simulator by Gymnasium's ``rgb_array``, in a twin that is put into it."""

    def __init__(self, env_id: str, size: tuple[int, int]) -> None:
        if sys.platform.startswith("linux"):
            os.environ.setdefault("MUJOCO_GL", "egl")  # no display is needed
        options: dict[str, Any] = {"render_mode": "rgb_array", "disable_env_checker": True}
        # Gymnasium's own choice is a camera that stays where the robot started.
        tracking: Any = {"width": size[0], "height": size[1], "camera_name": "track"}
        try:
            made = gymnasium.make(env_id, **tracking, **options)
        except TypeError:
            made = gymnasium.make(env_id, **options)
        made.reset(seed=0)
        self.twin: Any = made.unwrapped

    def picture(self, simulator: Any) -> Picture:
        """Return a picture ``(height, width, 3)`` of an unwrapped environment of the same task."""
        if hasattr(simulator, "data") and hasattr(self.twin, "set_state"):
            self.twin.set_state(simulator.data.qpos, simulator.data.qvel)
            picture = np.array(self.twin.render())
            # White where there is nothing, as on the page around it.
            depth = self.twin.mujoco_renderer.render("depth_array")
            picture[np.asarray(depth) >= _FAR] = 255
            return picture
        if getattr(simulator, "state", None) is None:
            raise RuntimeError(f"the state of {type(simulator).__name__} can't be set")
        self.twin.state = simulator.state
        return np.array(self.twin.render())


def record_episode(
    trained: TrainedAgent,
    condition: Condition,
    removed: Tensor | None = None,
    *,
    mode: str,
    seed: int,
    start: int,
    steps: int,
    picture_size: tuple[int, int] | None = None,
) -> Recording:
    """Let a trained agent act and record what it saw, missed and believed.

    The episode is the first of an evaluation with the same seed; the ``steps`` from ``start`` on
    are kept. Without ``picture_size`` (width and height in pixels) there are no pictures.
    """
    # States are read from Gymnasium's simulators, whatever the agent was trained on.
    local = trained.settings.copy()
    if "backend" in local.env:
        local.env.backend = "gymnasium"
    task, env = env_name(local), None
    make = replace(trained, settings=local).environments(
        condition.missingness, condition.noise, removed, complete=True
    )
    camera: Camera | None = None
    rows: list[tuple[Tensor, ...]] = []
    pictures: list[Picture] = []
    kind: Kind = "nothing"
    done = 0

    def make_env(block: int) -> TransformedEnv:
        nonlocal env
        env = make(block)
        return env

    def policy(data: TensorDictBase) -> TensorDictBase:
        nonlocal camera, picture_size
        if picture_size and env is not None and done >= start:
            try:
                camera = camera or Camera(task, picture_size)
                pictures.append(camera.picture(env.base_env.envs[0].unwrapped))
            except Exception as error:  # each OpenGL back end fails in its own way
                log_line(
                    f"no pictures of the robot, off-screen rendering failed: {one_line(error)}"
                )
                picture_size = None
        return observing(data)

    def watch(_: slice, data: TensorDictBase, __: Tensor) -> None:
        nonlocal done, kind
        if done >= start:
            kind, row = _sensors(data[0])
            rows.append(row)
        done += 1

    observing = trained.observing_policy
    run_episodes(
        policy, make_env, episodes=1, mode=mode, seed=seed, watch=watch,
        stop=lambda: done >= start + steps,
    )  # fmt: skip
    if not rows:
        raise UserError(f"`start` must lie inside the episode, which ended after {done} steps.")
    columns: Any = (torch.stack(column).numpy() for column in zip(*rows, strict=True))
    if len(pictures) < len(rows):  # drawing failed on the way
        pictures = []
    return Recording(kind, task, trained.sensors, start, pictures, *columns)


def _sensors(data: TensorDictBase) -> tuple[Kind, tuple[Tensor, ...]]:
    """Return the kind of the belief's estimate, and the arrays of a recording, ``(obs,)`` each."""
    complete, observed = data["normalized_complete_observation"].double(), data["observed"].clone()
    unknown = torch.full_like(complete, torch.nan)
    kind: Kind = "estimate"
    estimate, variance = data.get(ESTIMATE, None), data.get(ESTIMATE_VARIANCE, None)
    if estimate is None:
        estimate, cov = data.get(FORECAST, None), data.get(FORECAST_COV, None)
        kind = "nothing" if estimate is None else "forecast"
        variance = None if cov is None else cov.diagonal()
    return kind, (
        complete,
        zero_missing(data["normalized_observation"], observed).double(),
        observed,
        unknown if estimate is None else estimate.double(),
        unknown if variance is None else variance.double().clamp_min(0).sqrt(),
    )
