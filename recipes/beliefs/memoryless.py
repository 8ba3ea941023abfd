"""No belief: the heads read the observation as it arrived, or with its gaps filled (FA-PPO)."""

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from beliefs import ESTIMATE, OBSERVATION, Belief


def _features(observation: Tensor, observed: Tensor) -> Tensor:
    """Hand on what arrived; a missing entry is 0, the running mean."""
    del observed
    return observation


def _features_and_mask(observation: Tensor, observed: Tensor) -> Tensor:
    return torch.cat([observation, observed.to(observation.dtype)], -1)


def build(*, obs_dim: int, action_dim: int, with_mask: bool, filled: bool) -> Belief:
    """Build the absence of a belief; ``filled``: what arrives is what is held of each sensor."""
    del action_dim
    module = TensorDictModule(
        _features_and_mask if with_mask else _features,
        in_keys=[OBSERVATION, "observed"],
        out_keys=["features"],
    )
    held = TensorDictModule(nn.Identity(), in_keys=[OBSERVATION], out_keys=[ESTIMATE])
    return Belief(
        module,
        obs_dim * (2 if with_mask else 1),
        observing=(lambda: TensorDictSequential(module, held)) if filled else None,
    )
