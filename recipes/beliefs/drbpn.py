"""The deep recurrent belief propagation network as the belief module of a recipe."""

from collections.abc import Mapping
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor

from beliefs import (
    ESTIMATE,
    ESTIMATE_VARIANCE,
    FORECAST,
    FORECAST_COV,
    NOISE_VARIANCE,
    OBSERVATION,
    Belief,
)
from torchrl_drbpn import (
    BeliefFilter,
    BeliefFilterModule,
    GaussianTransition,
    LinearGaussianEmission,
)
from torchrl_drbpn.functional.robust import Robust

_READ = {"observation": OBSERVATION}


def observing(module: BeliefFilterModule) -> TensorDictSequential:
    """Make the filter write everything that it knows of the sensors."""
    cov = ("belief", "cov")
    wanted = ["features", ("belief", "mean"), ("belief", "log_likelihood"), cov]
    wanted += [ESTIMATE, FORECAST, FORECAST_COV]
    filtering = BeliefFilterModule(
        module.filter, in_keys=_READ, policy_input=module.policy_input, out_keys=wanted
    )
    emission = module.filter.emission

    def variances(cov: Tensor) -> tuple[Tensor, Tensor]:
        """Return the diagonals of H P H' and R, ``(*, obs)``, of P, ``(*, state, state)``."""
        variance = ((emission.matrix @ cov) * emission.matrix).sum(-1)
        return variance, emission.cov().diagonal().expand_as(variance)

    written = [ESTIMATE_VARIANCE, NOISE_VARIANCE]
    return TensorDictSequential(
        filtering, TensorDictModule(variances, in_keys=[cov], out_keys=written)
    )


def build(
    *,
    obs_dim: int,
    action_dim: int,
    state_dim: int | None,
    policy_input: Literal["mean", "mean_cov"],
    transition: Mapping[str, Any],
    emission: Mapping[str, Any],
    initial: Mapping[str, Any],
    covariance: Literal["constant", "propagated"] = "constant",  # of runs that do not name it
    pretrained: str | None = None,
    robust: Robust | None = None,
    robust_threshold: float = 4.0,
    mask_model: bool = False,
) -> Belief:
    """Build the belief filter, see conf/belief/drbpn.yaml."""
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
        covariance=covariance,
        robust=robust,
        robust_threshold=robust_threshold,
        mask_model=mask_model,
        **initial,
    )
    module = BeliefFilterModule(belief_filter, in_keys=_READ, policy_input=policy_input)

    def summary() -> dict[str, float]:
        with torch.no_grad():
            std = belief_filter.emission.cov().diagonal().sqrt()
        return {"emission_noise_std": std.mean().item()}

    def after_rollout(data: TensorDictBase) -> None:
        if covariance == "propagated":
            following = data.get("next")
            belief_filter.refresh_jacobian(
                following.get(("recurrent", "mean")), following.get("previous_action")
            )

    return Belief(
        module,
        module.feature_dim,
        summary=summary,
        observing=lambda: observing(module),
        after_rollout=after_rollout,
        pretrained=pretrained,
    )
