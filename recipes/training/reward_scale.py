"""Rewards over the running deviation of the discounted return, once a rollout."""

from typing import NamedTuple, Self

import torch
from torch import Tensor

from torchrl_drbpn.functional.running_moments import (
    RunningMoments,
    masked_moments,
    merge_moments,
    spread,
)


class ReturnStatistics(NamedTuple):
    """Hold count, mean and variance of the discounted returns seen, float64 ``(1,)``.

    ``discounted``: the returns so far of the episodes that go on, ``(environments, 1)``.
    """

    n: Tensor
    mean: Tensor
    var: Tensor
    discounted: Tensor

    @classmethod
    def start(cls, environments: int) -> Self:
        """Return those of a run that begins."""
        zero = torch.zeros(1, dtype=torch.float64)
        return cls(zero, zero, zero, torch.zeros(environments, 1))


@torch.no_grad()
def scale_reward(
    reward: Tensor,
    done: Tensor,
    statistics: ReturnStatistics,
    *,
    gamma: float,
    clip: float = 10.0,
    eps: float = 1e-8,
) -> tuple[Tensor, ReturnStatistics]:
    """Divide the rewards of a rollout by the running deviation of the discounted return.

    With R_t = gamma R_{t-1} + r_t, R = 0 at the start of an episode, and var the variance of every
    R up to the end of this rollout: scaled = clip(r / sqrt(var + eps), -clip, clip). One scale for
    the whole rollout. The mean is not subtracted: that would change which policy is best. Reward
    scaling of [Engstrom et al. 2020, Implementation matters in deep policy gradients].

    The rewards, ``(environments, time, 1)``, are finite: ``collect`` of ppo_drbpn.py has checked.
    """
    discounted, returns = statistics.discounted.to(reward), []
    for r, over in zip(reward.unbind(1), done.unbind(1), strict=True):
        discounted = gamma * discounted + r
        returns.append(discounted)
        discounted = torch.where(over, 0.0, discounted)
    before = RunningMoments(*(part.to(reward.device) for part in statistics[:3]))
    after = merge_moments(before, masked_moments(torch.cat(returns)))
    scaled = (reward / spread(after, eps)).clamp(-clip, clip)
    return scaled.to(reward.dtype), ReturnStatistics(*after, discounted)
