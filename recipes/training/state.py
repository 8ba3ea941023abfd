"""Everything that changes while a run trains, saved and restored."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv
from torchrl.objectives.value import GAE

from training.agent import Agent
from training.checkpoint import carry_over, fitting, set_carry_over
from training.reward_scale import ReturnStatistics

_RECENT_EPISODES = 100


class Algorithm(Protocol):
    """What training asks of an algorithm."""

    def update(self, data: TensorDictBase, remaining: float) -> dict[str, float]:
        """Change the agent's parameters after one rollout; return numbers for metrics.csv."""

    def state_dict(self) -> dict[str, Any]:
        """Return entries of the checkpoint, by name."""

    def load_state_dict(self, state: Any) -> None:
        """Take up the entries of :meth:`state_dict`, out of a whole checkpoint."""


@dataclass
class Training:
    """The parts of a run and its counters.

    ``returns``: raw, of the latest finished episodes; ``seconds``: in collection and update;
    ``evaluated_frames``: at the last evaluation, -1 before the first one.
    """

    env: TransformedEnv
    agent: Agent
    collector: Collector
    gae: GAE
    algorithm: Algorithm
    scale_reward: Callable[..., tuple[Tensor, ReturnStatistics]]
    reward_statistics: ReturnStatistics
    frames: int = 0
    episodes: int = 0
    returns: deque[float] = field(default_factory=lambda: deque(maxlen=_RECENT_EPISODES))
    seconds: float = 0.0
    evaluated_frames: int = -1

    def state_dict(self, *, simulators: bool = True) -> dict[str, Any]:
        """Return everything that a checkpoint holds; ``simulators``: not those that have failed."""
        keeps = simulators and self.keeps_simulators
        return {
            "agent": self.agent.state_dict(),
            **self.algorithm.state_dict(),
            "reward_statistics": dict(self.reward_statistics._asdict()),
            "transforms": self.env.state_dict(),
            # None where the simulators keep their state to themselves: new episodes start then.
            "simulators": self.env.base_env.state_dict() if keeps else None,
            "carrier": carry_over(self.collector) if keeps else None,
            "torch_generator": torch.get_rng_state(),
            "progress": {
                "frames": self.frames,
                "episodes": self.episodes,
                "returns": list(self.returns),
                "train_seconds": self.seconds,
                "evaluated_frames": self.evaluated_frames,
            },
        }

    def load_state_dict(self, state: dict[str, Any], source: str) -> None:
        """Put a run back to where a checkpoint was written; ``source`` names it in errors."""
        with fitting(source):
            self.agent.load_state_dict(state["agent"])
            self.algorithm.load_state_dict(state)
            self.reward_statistics = ReturnStatistics(**state["reward_statistics"])
            self.env.load_state_dict(state["transforms"])
            if state["simulators"] is not None:
                self.env.base_env.load_state_dict(state["simulators"])
                set_carry_over(self.collector, state["carrier"])
            progress = state["progress"]
            self.frames, self.episodes = progress["frames"], progress["episodes"]
            self.returns = deque(progress["returns"], maxlen=_RECENT_EPISODES)
            self.seconds = progress["train_seconds"]
            self.evaluated_frames = progress["evaluated_frames"]
            torch.set_rng_state(state["torch_generator"])
            if state["simulators"] is None:
                # A seed of this point of the run: that of the run would repeat its first episodes.
                self.env.base_env.set_seed(int(torch.randint(2**31, ())))
                self.start_episodes()

    @property
    def keeps_simulators(self) -> bool:
        """Return whether a checkpoint holds the simulators: those of this process, if they can."""
        return isinstance(self.collector, Collector) and bool(
            getattr(self.env.base_env, "supports_state", False)
        )

    @property
    def engine_resets(self) -> int:
        """Return how many episodes a physics engine has cut off by resetting itself."""
        here = isinstance(self.collector, Collector)
        counter = self.env.base_env if here else self.collector
        return int(getattr(counter, "engine_resets", torch.zeros(1)).sum())

    def start_episodes(self) -> None:
        """Begin new episodes in every environment."""
        self.collector.reset()
        discounted = torch.zeros_like(self.reward_statistics.discounted)
        self.reward_statistics = self.reward_statistics._replace(discounted=discounted)
