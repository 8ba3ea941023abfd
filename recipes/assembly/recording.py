"""One episode of a trained agent, with everything that a picture of its belief needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import ExplorationType, set_exploration_type

from assembly.environment import copy_statistics
from assembly.errors import UserError
from assembly.evaluation import make_evaluation_environment
from assembly.sensors import sensor_names
from assembly.settings import MissingnessSettings
from assembly.trained import TrainedAgent
from torchrl_drbpn import BeliefFilterModule, SensorReduction, seed_env

INTERVAL_95 = 1.959964  # half width of a normal's central 95 %, in standard deviations
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
        estimate: every sensor's value by the filtered belief, shape ``(time, obs)``.
        std: its standard deviation by the filtered covariance, root of the diagonal of H P H',
            shape ``(time, obs)``.
        noise_std: standard deviation of the learned sensor noise R, shape ``(obs,)``.
        poses: simulator positions and velocities at each step.
        rewards: raw, shape ``(time,)``.
        model: the simulator's MuJoCo model.
    """

    task: str
    names: list[str]
    first_step: int
    complete: NDArray[np.float64]
    arrived: NDArray[np.float64]
    observed: NDArray[np.bool_]
    estimate: NDArray[np.float64]
    std: NDArray[np.float64]
    noise_std: NDArray[np.float64]
    poses: list[tuple[NDArray[np.float64], NDArray[np.float64]]]
    rewards: NDArray[np.float64]
    model: Any

    @property
    def missing_ratio(self) -> float:
        """Return the share of entries that did not arrive."""
        return float(1 - self.observed.mean())

    @property
    def coverage(self) -> float:
        """Return the share of missing entries inside their 95 % interval; NaN for none missing."""
        missing = ~self.observed
        if not missing.any():
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
) -> Recording:
    """Let a trained agent act and write down what it saw, missed and believed.

    Args:
        trained: the agent; its belief must be the belief filter.
        missingness: what does not arrive.
        mode: ``sampled`` actions or ``mean`` actions.
        seed: of the episode, the corruption and sampled actions.
        start: steps of the episode to leave out.
        steps: steps to keep; fewer where the episode ends before.

    Returns:
        The recording.

    Raises:
        UserError: if the agent keeps no Gaussian belief, the task is not MuJoCo's, or the
            episode is over before ``start``.
    """
    # Poses are read from Gymnasium's simulators, whatever the agent was trained on.
    task = replace(trained.settings.env, backend="gymnasium")
    settings = replace(trained.settings, env=task)
    policy = TensorDictSequential(_observing_belief(trained), trained.agent.actor)
    env = make_evaluation_environment(
        settings, trained.belief, trained.agent, episodes=1, missingness=missingness
    )
    # Takes nothing away: it stands before every corruption and writes down what it sees.
    env.insert_transform(0, SensorReduction([], complete_key="complete_observation"))
    copy_statistics(trained.statistics, env)
    simulator = env.base_env.envs[0].unwrapped
    if not hasattr(simulator, "data"):
        raise UserError(f"`{settings.env.env_id}` is not a MuJoCo task: its poses are not known.")
    emission = trained.agent.belief.filter.emission
    rows: list[tuple[torch.Tensor, ...]] = []
    poses, rewards = [], []
    with torch.random.fork_rng(devices=[]), torch.no_grad(), set_exploration_type(_MODES[mode]):
        torch.manual_seed(seed)
        seed_env(env, seed)
        H, noise = emission.matrix.double(), emission.cov().double()
        data = env.reset()
        for step in range(start + steps):
            pose = simulator.data.qpos.copy(), simulator.data.qvel.copy()
            data = policy(data)
            if step >= start:
                poses.append(pose)
                rows.append(_sensors(data, H))
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
        noise.diagonal().sqrt().numpy(),
        poses,
        np.array(rewards),
        simulator.model,
    )
    env.close()
    return out


def _observing_belief(trained: TrainedAgent) -> TensorDictModule:
    """Return the agent's belief module, asked for covariance and sensor estimates as well."""
    module = trained.agent.belief
    if not isinstance(module, BeliefFilterModule):
        raise UserError(
            f"`belief={trained.settings.belief.get('name')}` keeps no Gaussian belief to draw: "
            "take a run with belief=drbpn."
        )
    wanted = ("features", "mean", "log_likelihood", "cov", "observation")
    return BeliefFilterModule(
        module.filter,
        policy_input=module.policy_input,
        out_keys=[name if name == "features" else ("belief", name) for name in wanted],
    )


def _sensors(data: TensorDictBase, H: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Return complete, arrived, observed, estimate and its deviation, shape (obs,) each."""
    data = data[0]
    cov = H @ data["belief", "cov"].double() @ H.mT
    return (
        data["complete_observation"].double(),
        data["observation"].double(),
        data["observed"].clone(),
        data["belief", "observation"].double(),
        cov.diagonal().clamp_min(0).sqrt(),
    )
