"""The filter in PyTorch operations: any device, every transformation, differentiable again.

Where predicted covariances do not depend on the mean, the gains of a whole minibatch are one
batched computation ahead of the mean recurrence, from what is cheaper to factorise: S, obs x obs,
or the precision, state x state. Everything is float64 but the transition: with R at its floor
float32 loses most digits of a gain.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import (
    LOG_2PI,
    masked_cov,
    rounded_cov,
    zero_missing,
)
from torchrl_drbpn.functional.kalman import log_likelihood, update, update_by_mask
from torchrl_drbpn.functional.state_space import (
    FilterInputs,
    StateSpace,
    predict_step,
    propagate,
)

# Chooses what belongs to P_0 or to Q, of shape (2, ...) in this order, for every step; leaves alone
# what is there for every step.
Choose = Callable[[Tensor], Tensor]
Gains = tuple[Tensor, Callable[[Tensor], Tensor]]
Filtered = tuple[Tensor, Tensor | None, Tensor]  # means, covariances, log-likelihoods


def _added_noise(R: Tensor, weight: Tensor) -> Tensor:
    """Return what weights add to the diagonal of R, float64; exactly 0 for a weight of 1."""
    return (R if R.ndim == 1 else R.diagonal()).double() * (1.0 / weight.double() - 1.0)


def weighted_noise(model: StateSpace, weight: Tensor | None) -> Tensor:
    """Return R, or of every step the matrix that its weights make of it."""
    R = model.emission_cov
    if weight is None:
        return R
    return model.full_emission_cov() + torch.diag_embed(_added_noise(R, weight))


def run_in_pytorch(model: StateSpace, rows: FilterInputs) -> Filtered:
    """Filter where predicted covariances do not depend on the mean; return them if propagated."""
    observed, reset, action, mean = rows.observed, rows.reset, rows.previous_action, rows.mean
    H, R, dtype = model.emission_matrix.double(), model.emission_cov.double(), mean.dtype
    added = None if rows.weight is None else _added_noise(R, rows.weight)
    covs = torch.stack([model.full_initial_cov(), model.constant_cov()]).double()
    which = (~reset).long().flatten()

    def choose(pair: Tensor) -> Tensor:
        return pair.index_select(0, which).view(*reset.shape, *pair.shape[1:])

    filtered_covs = None
    if isinstance(F := model.transition_jacobian, Tensor) and rows.cov is not None:
        covs, filtered_covs = _run_covariances(model, rows, F, rows.cov, choose(covs), added)
        filtered_covs = rounded_cov(filtered_covs, dtype)

        def choose(pair: Tensor) -> Tensor:
            return pair

    gains = _information if model.information_form else _innovation
    gain, likelihood = gains(H, R, covs, choose, observed, added)
    # Filling before any arithmetic keeps a NaN under a False mask out of values and gradients.
    y = zero_missing(rows.observation, observed).double() - model.offset(action).double()
    innovations, filtered, H_t = [], [], H.mT
    steps = zip(*(x.unbind(1) for x in (y, gain, action, reset.unsqueeze(-1))), strict=True)
    for t, (y_t, gain_t, action_t, reset_t) in enumerate(steps):
        mean, _ = rows.before(t, mean, None)
        m = model.predicted_mean(mean, action_t, reset_t).double()
        v = torch.addmm(y_t, m, H_t, alpha=-1)
        updated = torch.baddbmm(m.unsqueeze(-1), gain_t, v.unsqueeze(-1)).squeeze(-1)
        mean = updated.to(dtype)
        innovations.append(v)
        filtered.append(mean)
    if not filtered:
        return mean.unsqueeze(1)[:, :0], filtered_covs, y.sum(-1).to(dtype)
    residual = zero_missing(torch.stack(innovations, 1), observed)
    ll = torch.where(observed.any(-1), likelihood(residual), 0.0).to(dtype)
    return torch.stack(filtered, 1), filtered_covs, ll


def _run_covariances(
    model: StateSpace,
    rows: FilterInputs,
    F: Tensor,
    cov: Tensor,
    own: Tensor,
    added: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Return predicted covariances, with the gradient by ``own`` alone, and filtered ones."""
    given, observed = rows.reset, rows.observed
    H, R = model.emission_matrix.detach().double(), model.emission_cov.detach().double()
    if not model.information_form:
        R = model.full_emission_cov().detach().double()
    if added is not None:
        R = R + (added if R.ndim == 1 else torch.diag_embed(added)).detach()
    value, sigma = own.detach(), cov.detach().double()
    predicted, filtered = [], []
    # The state before a step that starts anew, or from what is stored, comes from here.
    ahead = torch.zeros_like(value)
    if rows.use_stored_state is not None and rows.stored_cov is not None:
        ahead = rows.stored_cov.detach().masked_fill(given[..., None, None], 0.0).double()
        given = given | rows.use_stored_state
    if model.information_form:
        weight = observed / R
        outer = (H.unsqueeze(-1) * H.unsqueeze(-2)).flatten(-2)
        gained = (weight @ outer).view(value.shape)
    else:
        arrived = zero_missing(H, observed.unsqueeze(-1))  # M'M H
        noise = masked_cov(R, observed)
    for t in range(observed.shape[1]):
        sigma = torch.where(given[:, t, None, None], ahead[:, t], sigma)
        P = propagate(F, sigma) + value[:, t]
        if model.information_form:
            precision = torch.cholesky_inverse(torch.linalg.cholesky_ex(P)[0]) + gained[:, t]
            sigma = torch.cholesky_inverse(torch.linalg.cholesky_ex(precision)[0])
        else:
            h = arrived[:, t]
            cross = h @ P
            factor, _ = torch.linalg.cholesky_ex(torch.baddbmm(noise[:, t], cross, h.mT))
            white = torch.linalg.solve_triangular(factor, cross, upper=False)
            sigma = torch.baddbmm(P, white.mT, white, alpha=-1)
        predicted.append(P)
        filtered.append(sigma)
    if not predicted:
        return own, value
    return torch.stack(predicted, 1) + (own - value), torch.stack(filtered, 1)


def _innovation(
    H: Tensor, R: Tensor, covs: Tensor, choose: Choose, observed: Tensor, added: Tensor | None
) -> Gains:
    """Return the gains K = P H' M' inv(M S M') M and the log-likelihood, obs x obs factorised."""
    full_R = R.diag() if R.ndim == 1 else R
    cross = H @ covs
    S = choose(cross @ H.mT + full_R)
    S = S if added is None else S + torch.diag_embed(added)
    factor, log_det, nan = _factor(masked_cov(S, observed))
    gain = torch.cholesky_solve(choose(cross) * (observed + nan).unsqueeze(-1), factor).mT

    def likelihood(residual: Tensor) -> Tensor:
        white = torch.linalg.solve_triangular(factor, residual.unsqueeze(-1), upper=False)
        count = observed.sum(-1).to(residual.dtype)  # an integer times a float would be float32
        return -0.5 * (white.squeeze(-1).square().sum(-1) + log_det + count * LOG_2PI)

    return gain, likelihood


def _information(
    H: Tensor, R: Tensor, covs: Tensor, choose: Choose, observed: Tensor, added: Tensor | None
) -> Gains:
    r"""Return the gains K = inv(inv(P) + H' W H) H' W and the log-likelihood, W = diag(m / r).

    .. math::
        v' S^{-1} v = (v - H \delta)' W (v - H \delta) + \delta' P^{-1} \delta, \qquad
        \log|S| = \textstyle\sum_i m_i \log r_i + \log|P| + \log|P^{-1} + H' W H|

    with :math:`\delta = K v` and r plus what is added to it. Both terms of the quadratic form are
    sums of squares, so that nothing cancels where R is small.
    """
    R = R if added is None else R + added
    weight = observed / R
    outer = (H.unsqueeze(-1) * H.unsqueeze(-2)).flatten(-2)
    prior_factor, prior_log_det, nan = _factor(covs)
    prior = choose(torch.cholesky_inverse(prior_factor) + nan.unsqueeze(-1))
    factor, log_det, nan = _factor((weight @ outer).view(prior.shape) + prior)
    gain = torch.cholesky_solve(((weight + nan).unsqueeze(-1) * H).mT, factor)

    def likelihood(residual: Tensor) -> Tensor:
        move = (gain @ residual.unsqueeze(-1)).squeeze(-1)
        left = zero_missing(residual - move @ H.mT, observed)
        by_prior = (prior @ move.unsqueeze(-1)).squeeze(-1)
        quadratic = (weight * left.square()).sum(-1) + (move * by_prior).sum(-1)
        log_noise = (observed * (R.log() + LOG_2PI)).sum(-1)
        return -0.5 * (quadratic + log_noise + log_det + choose(prior_log_det))

    return gain, likelihood


def _factor(matrix: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return Cholesky factors, log-determinants, and ``(..., 1)`` 0, NaN for one that has none."""
    factor, info = torch.linalg.cholesky_ex(matrix)
    nan = torch.where(info == 0, 0.0, torch.nan).to(matrix.dtype).unsqueeze(-1)
    log_det = 2.0 * (factor.diagonal(dim1=-2, dim2=-1).log() + nan).sum(-1)
    return factor, log_det, nan


def run_step_by_step(model: StateSpace, rows: FilterInputs) -> Filtered:
    """Filter by :mod:`.kalman` at every step; the covariances too have their gradient."""
    offset, noise = model.offset(rows.previous_action), weighted_noise(model, rows.weight)
    means, covs, lls, mean, cov = [], [], [], rows.mean, rows.cov
    for t in range(rows.reset.shape[1]):
        mean, cov = rows.before(t, mean, cov)
        predicted = predict_step(model, mean, rows.previous_action[:, t], rows.reset[:, t], cov)
        R = noise if rows.weight is None else noise[:, t]
        step = (rows.observation[:, t], rows.observed[:, t], model.emission_matrix, R, offset[:, t])
        lls.append(log_likelihood(predicted, *step))
        belief = update(predicted, *step)
        if model.mask_model is not None:
            belief, ll = update_by_mask(belief, *step, model.mask_model)
            lls[-1] = lls[-1] + ll
        mean, cov = belief
        means.append(mean)
        covs.append(cov)
    if not means:
        nothing = mean.unsqueeze(1)[:, :0]
        return nothing, nothing.unsqueeze(-1) * nothing.unsqueeze(-2), nothing.sum(-1)
    return torch.stack(means, 1), torch.stack(covs, 1), torch.stack(lls, 1)
