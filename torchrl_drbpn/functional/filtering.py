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

from torchrl_drbpn.functional.forms import (
    gain_precision,
    information_likelihood,
    run_information,
    run_innovation,
    run_loop,
    run_native,
)
from torchrl_drbpn.functional.gaussian import (
    LOG_2PI,
    check_observed,
    masked_cov,
    zero_missing,
)
from torchrl_drbpn.functional.kalman import log_likelihood, update
from torchrl_drbpn.functional.model import (
    Following,
    Form,
    StateSpace,
    checked_form,
    constant_cov,
    initial_belief,
    predict_step,
)
from torchrl_drbpn.functional.native import native_refusal
from torchrl_drbpn.functional.precision import outside_autocast

__all__ = [
    "FilterOutput",
    "FollowedOutput",
    "filter_followed",
    "filter_sequence",
    "filter_step",
    "filtered_cov",
]


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


class FollowedOutput(NamedTuple):
    """Hold what the filter returns where observations follow.

    Args:
        mean: as in :class:`FilterOutput`.
        cov: as there.
        log_likelihood: as there.
        following_log_likelihood: of the observations that follow, shape ``(count,)``, nats.

    Example:
        >>> import torch
        >>> out = FollowedOutput(torch.zeros(2), None, torch.zeros(()), torch.zeros(3))
        >>> len(out.following_log_likelihood)
        3
    """

    mean: Tensor
    cov: Tensor | None
    log_likelihood: Tensor
    following_log_likelihood: Tensor


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
        m, ll, _ = run_native(model, mean, action, x, seen, start, None, None)
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
        precision, log_det_prior = gain_precision(wide, weight, row)
        factor = torch.linalg.cholesky(precision)
        pull = (weight * residual) @ wide.emission_matrix
        step = torch.cholesky_solve(pull.unsqueeze(-1), factor).squeeze(-1)
        log_det = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1) + log_det_prior
        ll = information_likelihood(wide, step, residual, weight, observed, log_det, row)
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
        >>> from torchrl_drbpn.functional import MeanNetwork
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
    out, _ = _filter(
        model, mean, previous_action, observation, observed, reset, restart, restart_mean, None,
        return_cov, form,
    )  # fmt: skip
    return out


def filter_followed(
    model: StateSpace,
    mean: Tensor,
    previous_action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    following: Following,
    *,
    restart: Tensor | None = None,
    restart_mean: Tensor | None = None,
    return_cov: bool = False,
    form: Form = "auto",
) -> FollowedOutput:
    """Filter sequences, and evaluate observations that follow some of their steps.

    The same as :func:`filter_sequence`, and then one more step from the filtered means that
    ``following`` names, in one pass where the C form runs.

    Args:
        model: the state-space model.
        mean: filtered mean of the step before the first, shape ``(*batch, state)``.
        previous_action: shape ``(*batch, time, action)``.
        observation: shape ``(*batch, time, obs)``; missing entries may hold anything.
        observed: bool, shape ``(*batch, time, obs)``.
        reset: bool, shape ``(*batch, time)``; True starts from the initial belief at this step.
        following: observations that come after some of the steps and are no steps themselves.

    Keyword Args:
        restart: see :func:`filter_sequence`.
        restart_mean: see there.
        return_cov: see there.
        form: see there.

    Returns:
        :class:`FollowedOutput`.

    Raises:
        ValueError: as :func:`filter_sequence`.

    Example:
        >>> import torch
        >>> from torchrl_drbpn.functional import MeanNetwork
        >>> f = MeanNetwork((torch.zeros(2, 3),), (torch.zeros(2),), True, "relu")
        >>> eye = torch.eye(2)
        >>> model = StateSpace(f, eye, eye, torch.ones(2), torch.zeros(2, 1), torch.zeros(2),
        ...                    torch.zeros(2), eye)
        >>> seen = torch.rand(4, 10, 2) < 0.7
        >>> last = Following(
        ...     torch.tensor([9, 39]), torch.zeros(2, 1), torch.randn(2, 2), seen[0, :2])
        >>> out = filter_followed(model, torch.zeros(4, 2), torch.zeros(4, 10, 1),
        ...                       torch.randn(4, 10, 2), seen, torch.zeros(4, 10, dtype=torch.bool),
        ...                       last)
        >>> out.following_log_likelihood.shape
        torch.Size([2])
    """
    out, after = _filter(
        model, mean, previous_action, observation, observed, reset, restart, restart_mean,
        following, return_cov, form,
    )  # fmt: skip
    if after is None:  # it is no part of a longer pass: sequences of one step that go on
        before = out.mean.reshape(-1, out.mean.shape[-1]).index_select(0, following.step)
        action, x, seen = (value.unsqueeze(1) for value in following[1:])
        goes_on = seen.new_zeros(len(before), 1)
        after = out.log_likelihood.new_zeros(0)
        if len(before):
            last, _ = _filter(
                model, before, action, x, seen, goes_on, None, None, None, False, form
            )
            after = last.log_likelihood.squeeze(1)
    return FollowedOutput(*out, after)


@outside_autocast
def _filter(
    model: StateSpace,
    mean: Tensor,
    previous_action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    restart: Tensor | None,
    restart_mean: Tensor | None,
    following: Following | None,
    return_cov: bool,
    form: Form,
) -> tuple[FilterOutput, Tensor | None]:
    """Run the chosen form; what follows is evaluated where it can go along, else None."""
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
            joined = following if _goes_along(following, observation) else None
            filtered, ll, after = run_native(
                model, mean, previous_action, observation, observed, reset, restart, restart_mean,
                joined,
            )  # fmt: skip
            cov = filtered_cov(model, observed, reset) if return_cov else None
            return FilterOutput(filtered, cov, ll), after
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

    covs: Tensor | None
    if chosen == "loop":
        filtered, covs, ll = run_loop(model, start, a, x, seen, first, again, stored)
        covs = batch_major(covs) if return_cov else None
    else:
        run = run_innovation if chosen == "innovation" else run_information
        filtered, ll = run(model, start, a, x, seen, first, again, stored)
        ll = torch.where(seen.any(-1), ll, 0.0)
        covs = filtered_cov(model, observed, reset) if return_cov else None
    return FilterOutput(batch_major(filtered), covs, batch_major(ll)), None


def _goes_along(following: Following | None, observation: Tensor) -> bool:
    """Tell whether the C form takes it in the same call: no gradient reaches it there."""
    return (
        following is not None
        and len(following.step) > 0
        and all(
            value.dtype == observation.dtype
            and value.device == observation.device
            and not value.requires_grad
            for value in (following.observation, following.previous_action)
        )
    )
