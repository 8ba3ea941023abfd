"""A whole sequence through the belief filter: fast forms, and the generic loop behind them.

Four ways give the same numbers; :func:`filter_sequence` chooses:

- *innovation form* (constant Q): factorises obs x obs, A = M (H Q H' + R) M' for every mask of the
  minibatch in one batched call; any R;
- *information form* (constant Q, diagonal R): factorises state x state,
  inv(cov) = inv(Q) + sum_i m_i / r_i h_i h_i'; the cheaper one where obs exceeds state;
- *native*: the cheaper one of these two in C (:mod:`.native`), where a C compiler is found, on the
  CPU;
- *loop*: :mod:`.kalman` at every step, for any transition and for a Q that depends on the state.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import (
    LOG_2PI,
    check_observed,
    masked_cov,
    zero_missing,
)
from torchrl_drbpn.functional.kalman import log_likelihood, update
from torchrl_drbpn.functional.model import (
    Form,
    StateSpace,
    checked_form,
    choose_form,
    constant_cov,
    initial_belief,
    predict_step,
)
from torchrl_drbpn.functional.native import NativeRecurrence, native_refusal
from torchrl_drbpn.functional.precision import outside_autocast
from torchrl_drbpn.functional.recurrence import (
    InformationRecurrence,
    InnovationRecurrence,
    MeanNetwork,
)

__all__ = ["FilterOutput", "filter_sequence", "filter_step", "filtered_cov"]


class FilterOutput(NamedTuple):
    """Hold what the filter returns.

    Args:
        mean: filtered mean, shape ``(*batch, [time,] state)``.
        cov: filtered covariance, shape ``(*batch, [time,] state, state)``; None where not asked
            for.
        log_likelihood: of each step, shape ``(*batch, [time])``, nats.

    Example:
        >>> import torch
        >>> out = FilterOutput(torch.zeros(2), None, torch.zeros(()))
        >>> out.cov is None
        True
    """

    mean: Tensor
    cov: Tensor | None
    log_likelihood: Tensor


@outside_autocast
def filter_step(
    model: StateSpace,
    mean: Tensor,
    previous_action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    *,
    return_cov: bool = False,
    form: Form = "auto",
) -> FilterOutput:
    """Filter one step for any batch of beliefs.

    Eq. (8), (10), (12) [DRBPN].

    Args:
        model: the state-space model.
        mean: filtered mean of the step before, shape ``(*batch, state)``.
        previous_action: shape ``(*batch, action)``.
        observation: shape ``(*batch, obs)``; missing entries may hold anything.
        observed: bool, shape ``(*batch, obs)``.
        reset: bool, shape ``(*batch,)``; True starts from the initial belief.

    Keyword Args:
        return_cov: whether the filtered covariance is wanted.
        form: see :func:`filter_sequence`.

    Returns:
        :class:`FilterOutput` of shapes ``(*batch, ...)``.

    Example:
        >>> import torch
        >>> eye = torch.eye(2)
        >>> model = StateSpace(
        ...     lambda m, a: m, eye, eye, torch.ones(2), torch.zeros(2, 1), torch.zeros(2),
        ...     torch.zeros(2), eye)
        >>> nothing = torch.zeros(5, 2, dtype=torch.bool)
        >>> out = filter_step(model, torch.ones(5, 2), torch.zeros(5, 1), torch.zeros(5, 2),
        ...                   nothing, torch.zeros(5, dtype=torch.bool))
        >>> bool((out.mean == 1).all()), bool((out.log_likelihood == 0).all())
        (True, True)
    """
    check_observed(observation, observed)
    chosen = checked_form(model, form)
    if (
        chosen != "loop"
        and form == "auto"
        and not torch.is_grad_enabled()  # with a gradient, one that can be differentiated again
        and native_refusal(model, mean, previous_action, observation) is None
    ):
        x, seen = observation.unsqueeze(reset.ndim), observed.unsqueeze(reset.ndim)
        action, start = previous_action.unsqueeze(reset.ndim), reset.unsqueeze(-1)
        m, ll = _native(model, mean, action, x, seen, start, None, None)
        cov = filtered_cov(model, observed, reset) if return_cov else None
        return FilterOutput(m.squeeze(-2), cov, ll.squeeze(-1))
    predicted = predict_step(model, mean, previous_action, reset)
    H, offset = model.emission_matrix, model.offset(previous_action)
    if chosen == "loop":
        R = model.full_emission_cov()
        filtered = update(predicted, observation, observed, H, R, offset)
        ll = log_likelihood(predicted, observation, observed, H, R, offset)
        return FilterOutput(filtered.mean, filtered.cov if return_cov else None, ll)

    # Constant Q: the innovation covariances exist twice only, for ordinary and for first steps.
    m = predicted.mean
    residual = zero_missing(zero_missing(observation, observed) - (offset + m @ H.mT), observed)
    row = reset.unsqueeze(-1)
    if chosen == "information":
        # In float64, as in the sequence: the two must agree to the rounding of their own dtype.
        wide = model.double()
        residual = residual.double()
        weight = observed / wide.emission_cov
        precision, log_det_prior = _precision(wide, weight, row)
        factor = torch.linalg.cholesky(precision)
        pull = (weight * residual) @ wide.emission_matrix
        step = torch.cholesky_solve(pull.unsqueeze(-1), factor).squeeze(-1)
        log_det = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) + log_det_prior
        ll = _information_likelihood(wide, step, residual, weight, observed, log_det, row)
        step, ll = step.to(m.dtype), ll.to(m.dtype)
    else:
        wide = model.double()
        wide_H, Q, R = wide.emission_matrix, constant_cov(wide), wide.full_emission_cov()
        residual = residual.to(R.dtype)
        cross, initial_cross = Q @ wide_H.mT, wide.initial_cov @ wide_H.mT
        S = torch.where(row.unsqueeze(-1), wide_H @ initial_cross + R, wide_H @ cross + R)
        factor = torch.linalg.cholesky(masked_cov(S, observed))
        z = torch.cholesky_solve(residual.unsqueeze(-1), factor).squeeze(-1)
        step = torch.where(row, z @ initial_cross.mT, z @ cross.mT).to(m.dtype)
        log_det = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        count = observed.sum(-1).to(R.dtype)  # an integer times a float would be float32
        ll = (-0.5 * ((z * residual).sum(-1) + log_det + count * LOG_2PI)).to(m.dtype)
    ll = torch.where(observed.any(-1), ll, 0.0)
    cov = filtered_cov(model, observed, reset) if return_cov else None
    return FilterOutput(m + step, cov, ll)


def filtered_cov(model: StateSpace, observed: Tensor, reset: Tensor) -> Tensor:
    r"""Return the filtered covariance of a constant-Q model; it depends on the masks alone.

    .. math:: P^+ = (I - K H) P (I - K H)' + K R K'

    Eq. (10) [DRBPN] in Joseph's form; P is Q, or P_0 where an episode starts.

    Args:
        model: the state-space model, its transition_cov a tensor.
        observed: bool, shape ``(*batch, obs)``.
        reset: bool, shape ``(*batch,)``.

    Returns:
        Shape ``(*batch, state, state)``, symmetric positive definite.

    Raises:
        ValueError: if transition_cov depends on the state.

    Example:
        >>> import torch
        >>> eye = torch.eye(2)
        >>> model = StateSpace(
        ...     lambda m, a: m, eye, eye, 3 * torch.ones(2), torch.zeros(2, 1), torch.zeros(2),
        ...     torch.zeros(2), eye)
        >>> seen = torch.tensor([True, False])
        >>> cov = filtered_cov(model, seen, torch.tensor(False))
        >>> torch.allclose(cov, torch.diag(torch.tensor([0.75, 1.0])))
        True
    """
    zeros = torch.zeros_like(model.initial_mean).expand(*reset.shape, -1)
    prior = initial_belief(model, reset.unsqueeze(-1), zeros, constant_cov(model))
    nothing = torch.zeros((), dtype=zeros.dtype, device=zeros.device).expand(observed.shape)
    H, R = model.emission_matrix, model.full_emission_cov()
    return update(prior, nothing, observed, H, R).cov


@outside_autocast
def filter_sequence(
    model: StateSpace,
    mean: Tensor,
    previous_action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    *,
    restart: Tensor | None = None,
    restart_mean: Tensor | None = None,
    return_cov: bool = False,
    form: Form = "auto",
) -> FilterOutput:
    """Filter whole sequences, episode starts inside them included.

    Eq. (8), (10), (12) [DRBPN] at every step. The fast forms equal the loop in values and
    gradients; their own gradients cannot be differentiated again.

    Args:
        model: the state-space model.
        mean: filtered mean of the step before the first, shape ``(*batch, state)``.
        previous_action: shape ``(*batch, time, action)``.
        observation: shape ``(*batch, time, obs)``; missing entries may hold anything.
        observed: bool, shape ``(*batch, time, obs)``.
        reset: bool, shape ``(*batch, time)``; True starts from the initial belief at this step.

    Keyword Args:
        restart: bool, shape ``(*batch, time)``; True takes the belief of the step before from
            ``restart_mean`` instead of from the sequence.
        restart_mean: shape ``(*batch, time, state)``; read where ``restart`` is True.
        return_cov: whether the filtered covariances are wanted.
        form: "auto" chooses by dimension (:func:`choose_form`), in C where that runs;
            "innovation", "information" (both in PyTorch), "native" (in C) and "loop" force one.

    Returns:
        :class:`FilterOutput` of shapes ``(*batch, time, ...)``.

    Raises:
        ValueError: if the asked form does not fit the model or the machine, or one of ``restart``
            and ``restart_mean`` is given without the other.

    Example:
        >>> import torch
        >>> f = MeanNetwork((torch.zeros(2, 3),), (torch.zeros(2),), True, "relu")
        >>> eye = torch.eye(2)
        >>> model = StateSpace(f, eye, eye, torch.ones(2), torch.zeros(2, 1), torch.zeros(2),
        ...                    torch.zeros(2), eye)
        >>> seen = torch.rand(4, 10, 2) < 0.7
        >>> out = filter_sequence(model, torch.zeros(4, 2), torch.zeros(4, 10, 1),
        ...                       torch.randn(4, 10, 2), seen, torch.zeros(4, 10, dtype=torch.bool))
        >>> out.mean.shape, out.log_likelihood.shape
        (torch.Size([4, 10, 2]), torch.Size([4, 10]))
    """
    chosen = checked_form(model, form)
    check_observed(observation, observed)
    if (restart is None) != (restart_mean is None):
        raise ValueError(
            "`restart` and `restart_mean` come together: restart says where, restart_mean says "
            "from which belief."
        )
    batch, time = reset.shape[:-1], reset.shape[-1]
    mean = mean.expand(*batch, mean.shape[-1])

    if chosen == "native" or (chosen != "loop" and form == "auto"):
        refusal = native_refusal(model, mean, previous_action, observation, restart_mean)
        if refusal is None:
            filtered, ll = _native(
                model, mean, previous_action, observation, observed, reset, restart, restart_mean
            )
            return FilterOutput(
                filtered, filtered_cov(model, observed, reset) if return_cov else None, ll
            )
        if chosen == "native":
            raise ValueError(f"`form` 'native' cannot run here: {refusal}. Use form='auto'.")

    def time_major(x: Tensor) -> Tensor:
        """[*batch, time, dim] -> [time, batch, dim]."""
        return x.reshape(-1, time, x.shape[-1]).transpose(0, 1)

    def batch_major(x: Tensor) -> Tensor:
        return x.transpose(0, 1).reshape(*batch, time, *x.shape[2:])

    # Filling before any arithmetic keeps a NaN under a False mask out of values and gradients.
    x, a, seen = (
        time_major(v) for v in (zero_missing(observation, observed), previous_action, observed)
    )
    first = time_major(reset.unsqueeze(-1))
    again = None if restart is None else time_major(restart.unsqueeze(-1))
    stored = None if restart_mean is None else time_major(restart_mean)
    start = mean.reshape(-1, mean.shape[-1])

    if chosen == "loop":
        filtered, cov, ll = _loop(model, start, a, x, seen, first, again, stored)
        return FilterOutput(
            batch_major(filtered), batch_major(cov) if return_cov else None, batch_major(ll)
        )
    run = _innovation if chosen == "innovation" else _information
    filtered, ll = run(model, start, a, x, seen, first, again, stored)
    ll = torch.where(seen.any(-1), ll, 0.0)
    covs = filtered_cov(model, observed, reset) if return_cov else None
    return FilterOutput(batch_major(filtered), covs, batch_major(ll))


def _loop(
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


def _native(
    model: StateSpace,
    start: Tensor,
    action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    restart: Tensor | None,
    stored: Tensor | None,
) -> tuple[Tensor, Tensor]:
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
    mean, ll = NativeRecurrence.apply(  # type: ignore[no-untyped-call]
        information, f.residual, f.activation,
        *map(rows, (observation, observed, action, reset, restart, stored)),
        start if start.stride(-1) == 1 else start.contiguous(),
        *(x.contiguous() for x in parameters),
    )  # fmt: skip
    ll = ll.view(*batch, time)
    if information:
        ll = ll - 0.5 * torch.where(reset, log_det[1], log_det[0])
        ll = torch.where(observed.any(-1), ll, 0.0)
    return mean.view(*batch, time, state), ll.to(dtype)


def _network(model: StateSpace, action: Tensor) -> tuple[MeanNetwork, Tensor, list[Tensor]]:
    """Split the first layer: its action part for all steps at once, its weights on the mean."""
    f = model.transition
    assert isinstance(f, MeanNetwork)  # choose_form saw to it; for the type checker
    state = model.emission_matrix.shape[-1]
    drive = torch.nn.functional.linear(action, f.weights[0][:, state:], f.biases[0])
    rest = [p for pair in zip(f.weights[1:], f.biases[1:], strict=True) for p in pair]
    return f, drive, [f.weights[0][:, :state], *rest]


def _innovation(
    model: StateSpace,
    start: Tensor,
    action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    restart: Tensor | None,
    stored: Tensor | None,
) -> tuple[Tensor, Tensor]:
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


def _precision(model: StateSpace, weight: Tensor, reset: Tensor) -> tuple[Tensor, Tensor]:
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


def _information_likelihood(
    model: StateSpace,
    step: Tensor,
    residual: Tensor,
    weight: Tensor,
    observed: Tensor,
    log_det: Tensor,
    reset: Tensor,
) -> Tensor:
    r"""Evaluate eq. (12) [DRBPN] without an obs x obs matrix.

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


def _information(
    model: StateSpace,
    start: Tensor,
    action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    restart: Tensor | None,
    stored: Tensor | None,
) -> tuple[Tensor, Tensor]:
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
