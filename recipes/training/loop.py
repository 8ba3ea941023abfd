"""Training: collect, value, update; one path for every belief module and algorithm."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import torch
from algorithms import Algorithm, build_algorithm
from beliefs import Belief, build_belief
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.objectives.value import GAE

from training.agent import COMPLETE, Agent, add_primers
from training.config import Settings
from training.envs import make_environment, task_dims
from training.errors import UserError
from training.rollout import (
    add_advantages,
    explained_variance,
    log_likelihood_per_entry,
    make_gae,
    realised_missing_ratio,
)

_RECENT_EPISODES = 100


@dataclass
class Progress:
    """Counters of a run.

    Attributes:
        frames: environment steps so far.
        episodes: finished episodes so far.
        returns: raw returns of the latest finished episodes.
        train_seconds: time in collection and update.
        evaluated_frames: frames at the last evaluation; -1 before the first one.
    """

    frames: int = 0
    episodes: int = 0
    returns: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT_EPISODES))
    train_seconds: float = 0.0
    evaluated_frames: int = -1


@dataclass
class Training:
    """Everything that changes while a run trains."""

    belief: Belief
    agent: Agent
    env: TransformedEnv
    collector: Collector
    gae: GAE
    algorithm: Algorithm
    progress: Progress


def assemble(settings: Settings) -> Training:
    """Build everything a run needs, from its seed.

    The global generator of torch is seeded here: initial weights and sampled actions come from it.

    Args:
        settings: of the run.

    Returns:
        The parts, before the first frame.

    Raises:
        UserError: if the environment or the belief refuses its settings.
    """
    torch.manual_seed(settings.seed)
    belief, agent = make_agent(settings)
    env = make_environment(
        settings.env,
        settings.missingness,
        settings.noise,
        settings.normalisation,
        num_envs=settings.collector.num_envs,
        num_threads=settings.collector.num_threads,
        gamma=settings.loss.gamma,
        seed=settings.seed,
        after_normalisation=belief.transforms(),
        complete=COMPLETE in agent.critic.in_keys,
    )
    add_primers(env, agent)
    collector = Collector(
        env,
        agent.policy,
        frames_per_batch=settings.collector.frames,
        total_frames=-1,
        track_traj_ids=False,
        use_buffers=True,
        auto_register_policy_transforms=False,
    )
    return Training(
        belief=belief,
        agent=agent,
        env=env,
        collector=collector,
        gae=make_gae(settings.loss),
        algorithm=build_algorithm(settings, agent),
        progress=Progress(),
    )


def make_agent(settings: Settings) -> tuple[Belief, Agent]:
    """Build belief module and heads, with weights from torch's global generator.

    Args:
        settings: of the run.

    Returns:
        The belief and the agent around it.
    """
    obs_dim, action_dim = task_dims(settings.env)
    belief = build_belief(
        settings.belief,
        obs_dim=obs_dim,
        action_dim=action_dim,
        normalize=settings.loss.normalize,
    )
    return belief, Agent(belief, obs_dim, action_dim, settings.heads)


def train_rollout(
    training: Training, settings: Settings
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Collect one rollout and learn from it.

    Args:
        training: changed in place.
        settings: of the run.

    Returns:
        What there is to log, see :func:`metric_columns`, where the times are left to the caller;
        and ``frames``, ``return`` (raw) and ``length`` of each episode that finished.
    """
    progress = training.progress
    remaining = max(0.0, 1 - progress.frames / settings.total_frames)
    # The collector writes every rollout into the same tensors; what is entered here is not its own.
    data = training.collector.rollout().copy()
    add_advantages(data, training.agent, training.gae)
    progress.frames += data.numel()
    finished = _finished_episodes(data, progress.frames)
    progress.episodes += len(finished)
    progress.returns.extend(episode["return"] for episode in finished)
    row = {
        "frames": progress.frames,
        "episodes": progress.episodes,
        "return": _mean(progress.returns),
        "missing_ratio": realised_missing_ratio(data),
        "log_likelihood": log_likelihood_per_entry(data),
        "explained_variance": explained_variance(data),
        "action_std": data.get("scale").mean().item(),
        **training.belief.summary(),
    }
    # The rollout's own log-likelihood, of data not yet learned from, goes before the update's.
    return training.algorithm.update(data, remaining) | row, finished


def _finished_episodes(data: TensorDictBase, frames: int) -> list[dict[str, Any]]:
    """Return the episodes that ended in a rollout, in the order of time."""
    # Time first, so that the order does not depend on the environment's place in the batch.
    done, returns, lengths = (
        data.get(("next", key)).squeeze(-1).transpose(0, 1)
        for key in ("done", "episode_reward", "step_count")
    )
    pairs = zip(returns[done].tolist(), lengths[done].tolist(), strict=True)
    return [{"frames": frames, "return": value, "length": length} for value, length in pairs]


_COLUMNS = (
    "frames",
    "episodes",
    "return",
    "missing_ratio",
    "log_likelihood",
    "loss_objective",
    "loss_critic",
    "loss_entropy",
    "loss_model",
    "kl",
    "clip_fraction",
    "ess",
    "explained_variance",
    "grad_norm",
    "action_std",
    "lr",
)


def metric_columns(training: Training) -> list[str]:
    """Return the columns of metrics.csv.

    Args:
        training: whose belief may add its own.

    Returns:
        Their names, frames first, times last.
    """
    return [*_COLUMNS, *training.belief.summary(), "steps_per_second", "wall_time"]


def _mean(values: deque[float]) -> float | None:
    return sum(values) / len(values) if values else None


def training_state(training: Training) -> dict[str, Any]:
    """Return everything that a checkpoint holds.

    Args:
        training: between two rollouts.

    Returns:
        Tensors, numbers, texts, and containers of them.
    """
    progress, keeps = training.progress, training.env.base_env.supports_state
    return {
        "agent": training.agent.state_dict(),
        **training.algorithm.state_dict(),
        "transforms": training.env.state_dict(),
        # None where the simulators keep their state to themselves: new episodes start then.
        "simulators": training.env.base_env.state_dict() if keeps else None,
        # Collector has no public way to its carry-over (the root step from which the next rollout
        # goes on): its own state_dict leaves it out and starts new episodes.
        "carrier": training.collector._carrier.to_dict() if keeps else None,
        "torch_generator": torch.get_rng_state(),
        "progress": {
            "frames": progress.frames,
            "episodes": progress.episodes,
            "returns": list(progress.returns),
            "train_seconds": progress.train_seconds,
            "evaluated_frames": progress.evaluated_frames,
        },
    }


def restore(training: Training, state: dict[str, Any], source: str) -> None:
    """Put a run back to where a checkpoint was written.

    Args:
        training: freshly assembled from the same settings; changed in place.
        state: from :func:`training_state`.
        source: where it came from, for the error.

    Raises:
        UserError: if it belongs to another run: another task, another belief, other sizes.
    """
    try:
        training.agent.load_state_dict(state["agent"])
        training.algorithm.load_state_dict(state)
        training.env.load_state_dict(state["transforms"])
        if state["simulators"] is not None:
            training.env.base_env.load_state_dict(state["simulators"])
            carrier = TensorDict.from_dict(state["carrier"], batch_size=training.env.batch_size)
            training.collector._carrier = carrier
        kept = dict(state["progress"])
        kept["returns"] = deque(kept["returns"], maxlen=_RECENT_EPISODES)
        training.progress = Progress(**kept)
        torch.set_rng_state(state["torch_generator"])
        if state["simulators"] is None:
            # A seed of this point of the run: that of the run would repeat its first episodes.
            training.env.base_env.set_seed(int(torch.randint(2**31, ())))
            training.collector.reset()
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise UserError(
            f"`{source}` does not fit the settings of this run (another task, belief or size?): "
            f"{reason[:300]}"
        ) from error
