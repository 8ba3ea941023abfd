"""Filling: a missing entry holds what its sensor delivered last (FA-PPO)."""

from __future__ import annotations

from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn

from beliefs import ESTIMATE, Belief
from beliefs.none import ObservationFeatures
from torchrl_drbpn import FillLastObserved


def build(*, obs_dim: int, action_dim: int, normalize: str, with_mask: bool) -> Belief:
    """Build a feed-forward policy on filled observations.

    Args:
        obs_dim: components of an observation.
        action_dim: components of an action; unused.
        normalize: unused, there is no model.
        with_mask: whether the heads also read which entries arrived.

    Returns:
        The belief; its transform fills normalised observations, so that an entry which has not
        arrived in this episode yet reads 0, its running mean, as it does for ``belief=none``.
    """
    del action_dim, normalize
    module = TensorDictModule(
        ObservationFeatures(with_mask), in_keys=["observation", "observed"], out_keys=["features"]
    )
    width = obs_dim * (2 if with_mask else 1)
    # What it holds of a missing sensor is what it was filled with.
    filled = TensorDictModule(nn.Identity(), in_keys=["observation"], out_keys=[ESTIMATE])
    return Belief(
        module,
        width,
        transforms=lambda: [FillLastObserved()],
        observing=lambda: TensorDictSequential(module, filled),
    )
