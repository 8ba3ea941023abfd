"""One episode of a trained agent, with everything that a picture of its belief needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import torch
from beliefs import ESTIMATE, ESTIMATE_VARIANCE, FORECAST, FORECAST_COV
from evaluation.episodes import make_evaluation_environment
from evaluation.trained import TrainedAgent
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.envs import ExplorationType, set_exploration_type
from training.config import MissingnessSettings, NoiseSettings
from training.envs import copy_statistics
from training.errors import UserError
from training.sensors import sensor_names

from torchrl_drbpn import seed_env
from torchrl_drbpn.functional import zero_missing

INTERVAL_95 = 1.959964  # half width of a normal's central 95 %, in standard deviations
# What a belief says of the sensors: their values after looking, the readings before, or nothing.
Told = Literal["estimate", "forecast", "nothing"]
_MODES = {"sampled": ExplorationType.RANDOM, "mean": ExplorationType.DETERMINISTIC}


@dataclass(frozen=True)
class Recording:
    """Part of an episode, step by step; sensor values in normalised units.

    Attributes:
        task: Gymnasium id.
        names: of the sensor components.
        first_step: of the episode that is in here.
        complete: what complete, noiseless sensors would have shown, shape ``(time, obs)``.
        arrived: what arrived, 0 where nothing did, shape ``(time, obs)``.
        observed: bool, True where something arrived, shape ``(time, obs)``.
        estimate: what the belief says of every sensor, shape ``(time, obs)``; NaN where it says
            nothing.
        std: its standard deviation, of the belief filter the root of the diagonal of H P H', shape
            ``(time, obs)``; NaN where the belief has none.
        poses: simulator positions and velocities at each step.
        rewards: raw, shape ``(time,)``.
        model: the simulator's MuJoCo model.
        told: what ``estimate`` is: the sensor's value by what arrived until this step, the reading
            foreseen from the step before, or nothing.
    """

    task: str
    names: list[str]
    first_step: int
    complete: NDArray[np.float64]
    arrived: NDArray[np.float64]
    observed: NDArray[np.bool_]
    estimate: NDArray[np.float64]
    std: NDArray[np.float64]
    poses: list[tuple[NDArray[np.float64], NDArray[np.float64]]]
    rewards: NDArray[np.float64]
    model: Any
    told: Told = "estimate"

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


def record_episode(
    trained: TrainedAgent,
    missingness: MissingnessSettings,
    *,
    mode: str,
    seed: int,
    start: int,
    steps: int,
    noise: NoiseSettings | None = None,
    removed: torch.Tensor | None = None,
) -> Recording:
    """Let a trained agent act and write down what it saw, missed and believed.

    Args:
        trained: the agent.
        missingness: what does not arrive.
        mode: ``sampled`` actions or ``mean`` actions.
        seed: of the episode, the corruption and sampled actions.
        start: steps of the episode to leave out.
        steps: steps to keep; fewer where the episode ends before.
        noise: what is added to what arrives; None: as in training.
        removed: components that never arrive, on top of ``missingness``: bool of shape
            ``(1, obs)``; None: there are none.

    Returns:
        The recording.

    Raises:
        UserError: if the task is not MuJoCo's, or the episode is over before ``start``.
    """
    # Poses are read from Gymnasium's simulators, whatever the agent was trained on.
    task = replace(trained.settings.env, backend="gymnasium")
    settings = replace(trained.settings, env=task)
    make = trained.belief.observing
    belief = trained.agent.belief if make is None else make()
    policy = TensorDictSequential(belief, trained.agent.actor)
    env = make_evaluation_environment(
        settings,
        trained.belief,
        trained.agent,
        episodes=1,
        missingness=missingness,
        noise=noise,
        complete=True,
        removed=removed,
    )
    copy_statistics(trained.statistics, env)
    simulator = env.base_env.envs[0].unwrapped
    if not hasattr(simulator, "data"):
        raise UserError(f"`{settings.env.env_id}` is not a MuJoCo task: its poses are not known.")
    rows: list[tuple[torch.Tensor, ...]] = []
    poses, rewards = [], []
    with torch.random.fork_rng(devices=[]), torch.no_grad(), set_exploration_type(_MODES[mode]):
        torch.manual_seed(seed)
        seed_env(env, seed)
        data = env.reset()
        for step in range(start + steps):
            pose = simulator.data.qpos.copy(), simulator.data.qvel.copy()
            data = policy(data)
            if step >= start:
                poses.append(pose)
                rows.append(_sensors(data))
                told = _told(data)
            data = env.step(data)
            if step >= start:
                rewards.append(data["next", "reward"].item())
            if data["next", "done"].item():
                break
            data = env.step_mdp(data)
    if not rows:
        raise UserError(f"`start` must lie inside the episode, which ended after {step + 1} steps.")
    columns = (torch.stack(column).numpy() for column in zip(*rows, strict=True))
    complete, arrived, observed, estimate, std = columns
    out = Recording(
        settings.env.env_id,
        sensor_names(settings.env.id, settings.env.version, complete.shape[-1]),
        start,
        complete,
        arrived,
        observed,
        estimate,
        std,
        poses,
        np.array(rewards),
        simulator.model,
        told,
    )
    env.close()
    return out


def _told(data: TensorDictBase) -> Told:
    """Say what the belief has written of the sensors; what it says after looking goes first."""
    keys = data.keys(include_nested=True)
    if ESTIMATE in keys:
        return "estimate"
    return "forecast" if FORECAST in keys else "nothing"


def _sensors(data: TensorDictBase) -> tuple[torch.Tensor, ...]:
    """Return complete, arrived, observed, estimate and its deviation, shape (obs,) each."""
    data = data[0]
    complete, observed = data["complete_observation"].double(), data["observed"].clone()
    unknown = torch.full_like(complete, torch.nan)
    estimate, variance = data.get(ESTIMATE, None), data.get(ESTIMATE_VARIANCE, None)
    if estimate is None:
        estimate, cov = data.get(FORECAST, unknown), data.get(FORECAST_COV, None)
        variance = None if cov is None else cov.diagonal()
    return (
        complete,
        zero_missing(data["observation"], observed).double(),
        observed,
        estimate.double(),
        unknown if variance is None else variance.double().clamp_min(0).sqrt(),
    )
