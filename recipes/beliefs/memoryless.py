"""No belief: the heads read the observation as it arrived, or with its gaps filled (FA-PPO)."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from beliefs import ESTIMATE, OBSERVATION, Belief


class ObservationFeatures(nn.Module):
    """Hand on what arrived; a missing entry is 0, the running mean.

    Args:
        with_mask: whether to append which entries arrived.
    """

    def __init__(self, with_mask: bool) -> None:
        super().__init__()
        self.with_mask = with_mask

    def forward(self, observation: Tensor, observed: Tensor) -> Tensor:
        """Return the features.

        Args:
            observation: shape ``(*, obs)``, normalised; 0 where nothing arrived.
            observed: bool of the same shape.

        Returns:
            Features, shape ``(*, obs)`` or ``(*, 2 * obs)``.
        """
        if self.with_mask:
            return torch.cat([observation, observed.to(observation.dtype)], -1)
        return observation


def build(*, obs_dim: int, action_dim: int, with_mask: bool, filled: bool) -> Belief:
    """Build the absence of a belief.

    Args:
        obs_dim: components of an observation.
        action_dim: components of an action; unused.
        with_mask: whether the heads also read which entries arrived.
        filled: whether what arrives had its gaps filled: that is what is held of each sensor.
    """
    del action_dim
    module = TensorDictModule(
        ObservationFeatures(with_mask), in_keys=[OBSERVATION, "observed"], out_keys=["features"]
    )
    held = TensorDictModule(nn.Identity(), in_keys=[OBSERVATION], out_keys=[ESTIMATE])
    return Belief(
        module,
        obs_dim * (2 if with_mask else 1),
        observing=(lambda: TensorDictSequential(module, held)) if filled else None,
    )
