"""No belief: the heads read the observation as it arrived, or with its gaps filled (FA-PPO)."""

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn

from beliefs import ESTIMATE, OBSERVATION, Belief


def build(*, obs_dim: int, action_dim: int, with_mask: bool, filled: bool) -> Belief:
    """Build the absence of a belief; ``filled``: what arrives is what is held of each sensor."""
    del action_dim

    def features(observation: Tensor, observed: Tensor) -> Tensor:
        """Hand on what arrived; a missing entry is 0, the running mean."""
        parts = [observation, observed.to(observation.dtype)]
        return torch.cat(parts, -1) if with_mask else observation

    in_keys = [OBSERVATION, "observed"]
    module = TensorDictModule(features, in_keys=in_keys, out_keys=["features"])
    held = TensorDictModule(nn.Identity(), in_keys=[OBSERVATION], out_keys=[ESTIMATE])
    return Belief(
        module,
        obs_dim * (2 if with_mask else 1),
        observing=(lambda: TensorDictSequential(module, held)) if filled else None,
    )
