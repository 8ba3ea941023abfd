"""The four forms of the filter over a sequence; :func:`.filter_sequence` says which runs when.

All but the one in C take and give time-major tensors, ``(time, batch, ...)``, as the loops run.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import LOG_2PI, zero_missing
from torchrl_drbpn.functional.kalman import log_likelihood, update
from torchrl_drbpn.functional.model import (
    Following,
    StateSpace,
    choose_form,
    constant_cov,
    predict_step,
)
from torchrl_drbpn.functional.native import NativeRecurrence, filter_rows
from torchrl_drbpn.functional.recurrence import (
    InformationRecurrence,
    InnovationRecurrence,
    MeanNetwork,
)

__all__ = [
    "gain_precision",
    "information_likelihood",
    "run_information",
    "run_innovation",
    "run_loop",
    "run_native",
]


def run_loop(
    model: StateSpace,
    mean: Tensor,
    action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    restart: Tensor | None,
    stored: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Run :mod:`.kalman` step by step, time-major; any transition, any covariance."""
    H, R = model.emission_matrix, model.full_emission_cov()
    offset = model.offset(action)
    means, covs, lls = [], [], []
    for t in range(len(action)):
        if restart is not None and stored is not None:
            mean = torch.where(restart[t], stored[t], mean)
        predicted = predict_step(model, mean, action[t], reset[t].squeeze(-1))
        filtered = update(predicted, observation[t], observed[t], H, R, offset[t])
        lls.append(log_likelihood(predicted, observation[t], observed[t], H, R, offset[t]))
        mean = filtered.mean
        means.append(mean)
        covs.append(filtered.cov)
    return torch.stack(means), torch.stack(covs), torch.stack(lls)


def run_native(
    model: StateSpace,
    start: Tensor,
    action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    restart: Tensor | None,
    stored: Tensor | None,
    following: Following | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Run :mod:`.native`, batch first; the last result is the log-likelihood of what follows."""
    f, dtype, (*batch, time) = model.transition, start.dtype, reset.shape
    assert isinstance(f, MeanNetwork)  # choose_form saw to it; for the type checker
    state = model.emission_matrix.shape[-1]
    information = choose_form(model) == "information"
    covs = constant_cov(model), model.initial_cov
    if information:
        prior, log_det = _prior_precision(model.double())
        covs = prior[0], prior[1]

    def rows(x: Tensor | None) -> Tensor | None:
        return None if x is None else x.reshape(-1, *x.shape[len(batch) :]).contiguous()

    start = start.reshape(-1, state)
    parameters = (
        *covs, model.emission_cov, model.emission_matrix, model.action_matrix,
        model.emission_offset, model.initial_mean,
        *(p for pair in zip(f.weights, f.biases, strict=True) for p in pair),
    )  # fmt: skip
    sequence = (
        *map(rows, (observation, observed, action, reset, restart, stored)),
        start if start.stride(-1) == 1 else start.contiguous(),
    )
    model_tensors = [x.contiguous() for x in parameters]
    settings = (information, f.residual, f.activation)
    after: Tensor | None = None
    if following is None and not torch.is_grad_enabled():
        mean, ll = filter_rows(settings, sequence, model_tensors)
    else:
        mean, ll, after = NativeRecurrence.apply(  # type: ignore[no-untyped-call]
            *settings, following, *sequence, *model_tensors
        )
    ll = ll.view(*batch, time)
    if information:
        ll = ll - 0.5 * torch.where(reset, log_det[1], log_det[0])
        ll = torch.where(observed.any(-1), ll, 0.0)
        if following is not None and after is not None:
            after = torch.where(following.observed.any(-1), after - 0.5 * log_det[0], 0.0)
    return mean.view(*batch, time, state), ll.to(dtype), None if after is None else after.to(dtype)


def _network(model: StateSpace, action: Tensor) -> tuple[MeanNetwork, Tensor, list[Tensor]]:
    """Split the first layer: its action part for all steps at once, its weights on the mean."""
    f = model.transition
    assert isinstance(f, MeanNetwork)  # choose_form saw to it; for the type checker
    state = model.emission_matrix.shape[-1]
    drive = torch.nn.functional.linear(action, f.weights[0][:, state:], f.biases[0])
    rest = [p for pair in zip(f.weights[1:], f.biases[1:], strict=True) for p in pair]
    return f, drive, [f.weights[0][:, :state], *rest]


def run_innovation(
    model: StateSpace,
    start: Tensor,
    action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    restart: Tensor | None,
    stored: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Run the innovation form in PyTorch."""
    f, drive, weights = _network(model, action)
    wide = model.double()  # see InnovationRecurrence
    H, Q, R = wide.emission_matrix, constant_cov(wide), wide.full_emission_cov()
    cross, initial_cross = Q @ H.mT, wide.initial_cov @ H.mT
    y = zero_missing(observation - model.offset(action), observed)
    _, mean, ll = InnovationRecurrence.apply(  # type: ignore[no-untyped-call]
        f.residual, f.activation, y, observed, reset, restart, stored, start, drive,
        model.initial_mean, model.emission_matrix, H @ cross + R, H @ initial_cross + R, cross,
        initial_cross, *weights,
    )  # fmt: skip
    return mean, ll - (0.5 * LOG_2PI) * observed.sum(-1).to(ll.dtype)


def gain_precision(model: StateSpace, weight: Tensor, reset: Tensor) -> tuple[Tensor, Tensor]:
    """Return inv(P) + sum_i w_i h_i h_i' and log|P|, P of the step (Q, or P_0 at a reset)."""
    gathered = _gathered(model, weight)
    prior, log_det = _prior_precision(model)
    at_reset = reset.squeeze(-1)
    both = torch.where(reset.unsqueeze(-1), prior[1], prior[0])
    return gathered + both, torch.where(at_reset, log_det[1], log_det[0])


def _prior_precision(model: StateSpace) -> tuple[Tensor, Tensor]:
    """Return the inverses and log-determinants of (Q, P_0): two small matrices a call."""
    factor = torch.linalg.cholesky(torch.stack([constant_cov(model), model.initial_cov]))
    log_det = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    return torch.cholesky_inverse(factor), log_det


def _gathered(model: StateSpace, weight: Tensor) -> Tensor:
    """Return N = sum_i w_i h_i h_i' for every step: one matrix product over all of them."""
    H = model.emission_matrix
    state = H.shape[-1]
    outer = (H.unsqueeze(-1) * H.unsqueeze(-2)).flatten(-2)
    return (weight @ outer).view(*weight.shape[:-1], state, state)


def information_likelihood(
    model: StateSpace,
    step: Tensor,
    residual: Tensor,
    weight: Tensor,
    observed: Tensor,
    log_det: Tensor,
    reset: Tensor,
) -> Tensor:
    r"""Evaluate the likelihood of a step without an obs x obs matrix.

    .. math::
        v' S^{-1} v = (v - H \delta)' W (v - H \delta) + \delta' P^{-1} \delta, \qquad
        \log|S| = \textstyle\sum_i m_i \log r_i + \log|P| + \log|P^{-1} + H' W H|

    with :math:`\delta = m^+ - m^-` and W = diag(m / r). Both terms of the quadratic form are sums
    of squares, so nothing cancels in float32 when R is small.
    """
    fit = residual - observed * (step @ model.emission_matrix.mT)
    prior, _ = _prior_precision(model)
    by_prior = torch.where(reset, step @ prior[1], step @ prior[0])
    quadratic = (weight * fit.square()).sum(-1) + (step * by_prior).sum(-1)
    log_noise = observed.to(step.dtype) @ (model.emission_cov.log() + LOG_2PI)
    return -0.5 * (quadratic + log_noise + log_det)


def run_information(
    model: StateSpace,
    start: Tensor,
    action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    restart: Tensor | None,
    stored: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Run the information form in PyTorch; nothing observed is no special case here."""
    f, drive, weights = _network(model, action)
    y = zero_missing(observation - model.offset(action), observed)
    wide = model.double()  # see InformationRecurrence
    prior, log_det = _prior_precision(wide)
    mean, ll = InformationRecurrence.apply(  # type: ignore[no-untyped-call]
        f.residual, f.activation, y, observed, wide.emission_matrix, wide.emission_cov, prior[0],
        prior[1], reset, restart, stored, start, drive, model.initial_mean, *weights,
    )  # fmt: skip
    ll = ll - 0.5 * torch.where(reset.squeeze(-1), log_det[1], log_det[0])
    return mean, ll.to(mean.dtype)
