"""Weights of readings that contradict the belief and the other readings: a robust Kalman update."""

import math
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import (
    as_matrix,
    check_observed,
    masked_cov,
    rounded_cov,
    without_autocast,
    zero_missing,
)
from torchrl_drbpn.functional.state_space import FilterInputs, StateSpace, predict_step

Robust = Literal["huber", "imq"]

_NORMAL_MEDIAN = 0.6744897501960817  # of |z|, z standard normal: it turns a median into a deviation
_PASSES = 2


def innovation_weights(
    residual: Tensor,
    innovation_cov: Tensor,
    noise: Tensor,
    observed: Tensor,
    robust: Robust,
    threshold: float,
) -> Tensor:
    r"""Weigh each reading by how far it lies from what the others and the prediction say.

    With z_i the leave-one-out score of a reading, sigma_i^2 its leave-one-out variance:

    .. math::
        z_i = \frac{[A^{-1} v]_i}{[A^{-1}]_{ii}\, \sigma_i}, \quad
        \sigma_i^2 = \frac{1}{[A^{-1}]_{ii}} - q_i, \quad A = S + \mathrm{diag}(q), \quad
        q_i \leftarrow \sigma_i^2 \begin{cases} \max(1, |z_i| / c_i) - 1 & \text{huber} \\
        z_i^2 / (2 c_i)^2 & \text{imq} \end{cases}, \quad w_i = \frac{r_i}{r_i + q_i}

    over the entries that arrived. q starts from the marginal deviations,
    :math:`S_{ii} (\max(1, |v_i| / (c_i \sqrt{S_{ii}})) - 1)`, and is computed twice: else a reading
    that is far off lowers the weights of those that agree with each other. c_i is ``threshold``,
    times what the median of the other readings says S is too small by,
    :math:`\max(1, \mathrm{med}_{j \ne i} |v_j| / \sqrt{S_{jj}} / .6745)`.

    In the update that follows :math:`R_w = R + \mathrm{diag}(r_i / w_i - r_i)`: in the mean a
    reading counts as if it lay c_i deviations off (huber), or is forgotten as it goes on (imq, the
    inverse multiquadric [Duran-Martin et al. 2024]).

    Args:
        residual: v, shape ``(*batch, obs)``, 0 where nothing arrived.
        innovation_cov: S, float64, shape ``(*batch, obs, obs)``, or ``(obs,)`` for its diagonal.
        noise: r, the diagonal of R, shape ``(obs,)`` or ``(*batch, obs)``.
        observed: bool, shape ``(*batch, obs)``, True = arrived.
        robust: "huber" or "imq".
        threshold: c, standard deviations.

    Returns:
        Weights in [0, 1], shape ``(*batch, obs)``, 1 where nothing arrived.

    Example:
        >>> S = torch.ones(5, 5).double() + 0.01 * torch.eye(5).double()  # five that agree
        >>> v = torch.tensor([2.5, 0.0, 0.0, 0.0, 0.0]).double()  # 25 noise deviations, 2.5 of S
        >>> w = innovation_weights(v, S, 0.01 * torch.ones(5), torch.ones(5) > 0, "huber", 3.0)
        >>> bool(w[0] < 0.15), w[1:].tolist()
        (True, [1.0, 1.0, 1.0, 1.0])
    """
    check_observed(residual, observed)
    # (obs,) first: the other comparison would bar an exported batch from being as large as obs.
    if noise.shape not in (residual.shape[-1:], residual.shape):
        raise ValueError(
            f"`noise` must be the variances (obs,) or (*batch, obs) of a diagonal R, (*batch, obs) "
            f"= {tuple(residual.shape)}, got {tuple(noise.shape)}."
        )
    innovation_cov = as_matrix("innovation_cov", innovation_cov, residual.shape[-1])
    variance = innovation_cov.diagonal(dim1=-2, dim2=-1)
    marginal = residual.abs() / variance.sqrt()
    # Of n that arrived, the lower median of the n - 1 others is sorted[k], or the next one where
    # the reading itself is among the first k + 1.
    arrived = torch.where(observed, marginal, torch.inf)
    ranked = torch.nn.functional.pad(arrived, (0, 1), value=torch.inf).sort(-1).values
    k = ((observed.sum(-1, keepdim=True) - 2) // 2).clamp_min(0)
    low, high = ranked.gather(-1, k), ranked.gather(-1, k + 1)
    median = torch.where(marginal > low, low, high)
    # No other reading: S is taken for what it says.
    excess = torch.where(median.isfinite(), median / _NORMAL_MEDIAN, 1.0).clamp_min(1.0)
    bound = threshold * excess
    held = variance * ((marginal / bound).clamp_min(1.0) - 1.0)
    for _ in range(_PASSES):
        A = masked_cov(innovation_cov + torch.diag_embed(held), observed)
        inverse = torch.cholesky_inverse(torch.linalg.cholesky_ex(A)[0])
        total = 1.0 / inverse.diagonal(dim1=-2, dim2=-1)
        # What is held back by far cancels here; no forecast is surer than the sensor's own noise.
        forecast = torch.maximum(total - held, noise)
        error = (inverse @ residual.unsqueeze(-1)).squeeze(-1) * total
        score = error.abs() / forecast.sqrt() / bound
        off = score.clamp_min(1.0) - 1.0 if robust == "huber" else (0.5 * score).square()
        held = forecast * off
    return torch.where(observed, noise / (noise + held), 1.0)


@torch.no_grad()
def robust_sequence_weights(
    model: StateSpace,
    mean: Tensor,
    previous_action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    *,
    robust: Robust,
    threshold: float = 4.0,
    cov: Tensor | None = None,
    use_stored_state: Tensor | None = None,
    stored_mean: Tensor | None = None,
    stored_cov: Tensor | None = None,
) -> Tensor:
    """Weigh the readings of a sequence, step by step: each from the belief that the last one left.

    Arguments are those of :func:`filter_sequence`, and ``robust``, "huber" or "imq", with its
    ``threshold`` c, standard deviations. The weights are its ``weight``, without gradient.

    Raises:
        ValueError: for a wrong shape or dtype, another ``robust``, a ``threshold`` that is not
            positive and finite, a model with a ``mask_model``.

    Example:
        >>> from torchrl_drbpn import BeliefFilter
        >>> model, x = BeliefFilter(2, 1).state_space(), torch.zeros(4, 10, 2)
        >>> start = torch.zeros(4, 2), torch.zeros(4, 10, 1)
        >>> w = robust_sequence_weights(model, *start, x, x == 0, x[..., 0] == 0, robust="imq")
        >>> torch.equal(w, torch.ones_like(x))  # each as it was expected
        True
    """
    check_robust(robust, threshold, model.mask_model)
    given = FilterInputs(
        observation, observed, previous_action, reset, use_stored_state, stored_mean, mean,
        stored_cov, cov,
    )  # fmt: skip
    model.check_inputs(given, reset.shape[:-1])
    with without_autocast(mean):
        H, R = model.emission_matrix.double(), model.full_emission_cov().double()
        noise, offset = R.diagonal(), model.offset(previous_action).double()
        filled = zero_missing(observation, observed).double()
        cov, weights = None if model.transition_jacobian is None else cov, []
        for t in range(reset.shape[-1]):
            mean, cov = given.before(t, mean, cov)
            action, seen = previous_action[..., t, :], observed[..., t, :]
            m, P = (x.double() for x in predict_step(model, mean, action, reset[..., t], cov))
            cross = H @ P
            S = cross @ H.mT + R
            v = zero_missing(filled[..., t, :] - m @ H.mT - offset[..., t, :], seen)
            weights.append(innovation_weights(v, S, noise, seen, robust, threshold).to(mean.dtype))
            if t + 1 == reset.shape[-1]:
                break
            A = masked_cov(S + torch.diag_embed(noise / weights[-1] - noise), seen)
            cross = zero_missing(cross, seen.unsqueeze(-1))
            solved = torch.cholesky_solve(cross, torch.linalg.cholesky_ex(A)[0])
            mean = (m + (v.unsqueeze(-2) @ solved).squeeze(-2)).to(mean.dtype)
            cov = None if cov is None else rounded_cov(P - cross.mT @ solved, mean.dtype)
    return torch.stack(weights, -2) if weights else torch.ones_like(observation)


def check_robust(robust: Any, threshold: Any, mask_model: Any) -> None:
    """Raise unless the update is one of those there are, its threshold a positive number."""
    if robust is not None and robust not in get_args(Robust):
        raise ValueError(
            f"`robust` must be one of {', '.join(get_args(Robust))}, or None to believe every "
            f"reading, got {robust!r}."
        )
    if robust is not None and mask_model is not None:
        raise ValueError(
            "`robust` must be None with a `mask_model`: weights are of readings that arrived alone."
        )
    number = isinstance(threshold, (int, float)) and not isinstance(threshold, bool)
    if not number or not 0 < threshold < math.inf:
        raise ValueError(
            "`robust_threshold` must be a positive, finite number of standard deviations, got "
            f"{threshold!r}; 4 is usual."
        )
