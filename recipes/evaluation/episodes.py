"""Evaluation: the first episode of each environment of a batch, with frozen statistics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from beliefs import Belief
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from training.agent import Agent, add_primers
from training.config import MissingnessSettings, NoiseSettings, Settings
from training.envs import copy_statistics, make_environment

from torchrl_drbpn import SensorReduction, seed_env

_KINDS = {"sampled": ExplorationType.RANDOM, "mean": ExplorationType.DETERMINISTIC}


@dataclass(frozen=True)
class Episodes:
    """Whole episodes of one policy under one corruption.

    Attributes:
        returns: sum of raw rewards of each episode.
        lengths: steps of each episode.
        missing_ratios: share of entries that did not arrive in each, over all components.
        log_likelihoods: nats per observed entry in each, normalised units; None without a model.
        diverged: whether the belief left the range of its numbers and the robot was stopped.
    """

    returns: list[float]
    lengths: list[int]
    missing_ratios: list[float]
    log_likelihoods: list[float] | None
    diverged: list[bool]

    @property
    def mean_return(self) -> float:
        """Return the mean of the returns."""
        return sum(self.returns) / len(self.returns)

    @property
    def std_return(self) -> float:
        """Return the standard deviation of the returns between episodes; 0 for one episode."""
        if len(self.returns) < 2:
            return 0.0
        return torch.tensor(self.returns, dtype=torch.float64).std().item()

    @property
    def missing_ratio(self) -> float:
        """Return the share of entries that did not arrive, over all steps and components."""
        steps = sum(self.lengths)
        return sum(r * n for r, n in zip(self.missing_ratios, self.lengths, strict=True)) / steps

    @property
    def log_likelihood(self) -> float | None:
        """Return the nats per observed entry over all steps; None without a model, or diverged.

        0 where nothing arrived.
        """
        if self.log_likelihoods is None or any(self.diverged):
            return None
        ratios = zip(self.missing_ratios, self.lengths, strict=True)
        weights = [(1 - ratio) * length for ratio, length in ratios]
        total = sum(v * w for v, w in zip(self.log_likelihoods, weights, strict=True))
        # The weights are counts over the number of components: one entry of many is below 1.
        return total / max(sum(weights), 1e-12)


def make_evaluation_environment(
    settings: Settings,
    belief: Belief,
    agent: Agent,
    *,
    episodes: int,
    missingness: MissingnessSettings | None = None,
    noise: NoiseSettings | None = None,
    complete: bool = False,
    removed: Tensor | None = None,
) -> TransformedEnv:
    """Build an environment like the training one, one simulator an episode.

    Args:
        settings: of the run.
        belief: whose transforms are needed.
        agent: whose recurrent state is carried.
        episodes: number of episodes.
        missingness: what does not arrive; None: as in training.
        noise: what is added; None: as in training.
        complete: whether to write ``complete_observation`` too, for measurements alone.
        removed: components that never arrive, on top of ``missingness``: bool of shape
            ``(episodes, obs)``; None: there are none.

    Returns:
        The environment. Its statistics are empty: see
        :func:`training.envs.copy_statistics`.
    """
    reduction = [] if removed is None else [SensorReduction(removed)]
    env = make_environment(
        settings.env,
        missingness or settings.missingness,
        noise or settings.noise,
        settings.normalisation,
        num_envs=episodes,
        num_threads=settings.collector.num_threads,
        gamma=settings.loss.gamma,
        seed=settings.evaluation.seed,
        complete=complete,
        before_normalisation=reduction,
        after_normalisation=belief.transforms(),
    )
    add_primers(env, agent)
    return env


def evaluate(
    policy: TensorDictModuleBase,
    env: TransformedEnv,
    *,
    mode: str,
    seed: int,
    statistics: TransformedEnv | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Episodes | None:
    """Run the first episode of each environment of a batch.

    Only first episodes count, so that short episodes are not over-represented. The global
    generator is left as it was found.

    Args:
        policy: belief module and policy head.
        env: batch size ``(episodes,)``.
        mode: ``sampled`` actions or ``mean`` actions.
        seed: of episodes, corruption and sampled actions.
        statistics: environment whose normalisation is used, frozen; None: that of ``env``.
        stop: asked at every step; if it returns True the evaluation is given up.

    Returns:
        The episodes, or None if it was given up.
    """
    if statistics is not None:
        copy_statistics(statistics, env)
    with torch.random.fork_rng(devices=[]), torch.no_grad(), set_exploration_type(_KINDS[mode]):
        torch.manual_seed(seed)
        seed_env(env, seed)
        return _first_episodes(policy, env, stop)


def leave_standing(root: TensorDictBase, running: Tensor) -> TensorDictBase:
    """Let the beliefs of episodes that are over begin anew at every step.

    Such a row is not simulated: the policy sees its last observation again and again, with actions
    that nobody carries out, and a belief that goes on with that may leave the range of its numbers.

    Args:
        root: of the next step; changed in place.
        running: bool of shape ``(episodes, 1)``.

    Returns:
        The same tensordict.
    """
    if running.all():
        return root
    root.set("is_init", root.get("is_init") | ~running)
    carried = root.get("recurrent", None)
    if carried is not None:
        root.set("recurrent", carried.apply(lambda value: only_rows(running, value)))
    return root


def only_rows(rows: Tensor, value: Tensor) -> Tensor:
    """Put zeros into the other rows.

    Args:
        rows: bool of shape ``(episodes, 1)``.
        value: shape ``(episodes, ...)``.

    Returns:
        Shape and dtype of ``value``.
    """
    return torch.where(rows.reshape(-1, *(1,) * (value.ndim - 1)), value, torch.zeros_like(value))


def _first_episodes(
    policy: TensorDictModuleBase, env: TransformedEnv, stop: Callable[[], bool]
) -> Episodes | None:
    """Step each environment until it has finished once; those that have are left standing."""
    count = env.batch_size[0]
    running = torch.ones(count, 1, dtype=torch.bool)
    returns = torch.zeros(count, 1, dtype=torch.float64)
    lengths = torch.zeros(count, 1, dtype=torch.int64)
    observed = torch.zeros(count, 1, dtype=torch.int64)
    log_likelihood = torch.zeros(count, 1, dtype=torch.float64)
    diverged = torch.zeros(count, 1, dtype=torch.bool)
    components, has_model = 0, False
    root = env.reset()
    while running.any():
        if stop():
            return None
        # An episode that is over costs no simulation; its row of the batch changes no other row.
        stepped = env.step(policy(root).set("_step", running))
        mask = stepped.get("observed")
        components = mask.shape[-1]
        observed += mask.sum(-1, keepdim=True) * running
        value = stepped.get(("belief", "log_likelihood"), None)
        if value is not None:
            has_model = True
            log_likelihood += value.reshape(count, 1) * running
        stopped = stepped.get("diverged", None)
        if stopped is not None:
            diverged |= stopped & running
        returns += stepped.get(("next", "reward")) * running
        lengths += running
        running = running & ~stepped.get(("next", "done"))
        root = leave_standing(env.step_mdp(stepped), running)
    missing = 1 - observed / (lengths * components).double()
    per_entry = log_likelihood / observed.clamp_min(1)
    return Episodes(
        returns.squeeze(-1).tolist(),
        lengths.squeeze(-1).tolist(),
        missing.squeeze(-1).tolist(),
        per_entry.squeeze(-1).tolist() if has_model else None,
        diverged.squeeze(-1).tolist(),
    )
