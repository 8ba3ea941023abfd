"""The deep recurrent belief propagation network as the belief module of a recipe."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch

from assembly.beliefs import Belief
from torchrl_drbpn import (
    BeliefFilter,
    BeliefFilterModule,
    BeliefModelLoss,
    GaussianTransition,
    LinearGaussianEmission,
)


def build(
    *,
    obs_dim: int,
    action_dim: int,
    normalize: Literal["entry", "step"],
    state_dim: int | None,
    policy_input: Literal["mean", "mean_cov"],
    transition: Mapping[str, Any],
    emission: Mapping[str, Any],
    initial: Mapping[str, Any],
) -> Belief:
    """Build the belief filter.

    Args:
        obs_dim: components of an observation.
        action_dim: components of an action.
        normalize: what the likelihood is divided by, ``entry`` or ``step``.
        state_dim: components of the latent state; None: as many as the observation, at most 32.
        policy_input: what the heads read, ``mean`` or ``mean_cov``.
        transition: arguments of ``GaussianTransition``; ``residual`` None: where state <= obs.
        emission: arguments of ``LinearGaussianEmission``.
        initial: arguments of the belief before the first observation.

    Returns:
        The belief.
    """
    state = min(obs_dim, 32) if state_dim is None else state_dim
    moves = dict(transition)
    if moves["residual"] is None:
        # Directions that no sensor sees become integrators under a residual transition.
        moves["residual"] = state <= obs_dim
    belief_filter = BeliefFilter(
        obs_dim,
        action_dim,
        state,
        transition=GaussianTransition(state, action_dim, **moves),
        emission=LinearGaussianEmission(obs_dim, state, action_dim, **emission),
        **initial,
    )
    module = BeliefFilterModule(belief_filter, policy_input=policy_input)

    def summary() -> dict[str, float]:
        with torch.no_grad():
            std = belief_filter.emission.cov().diagonal().sqrt()
        return {"emission_noise_std": std.mean().item()}

    covariance = state * (state + 1) // 2 if policy_input == "mean_cov" else 0
    return Belief(module, state + covariance, BeliefModelLoss(normalize=normalize), summary=summary)
