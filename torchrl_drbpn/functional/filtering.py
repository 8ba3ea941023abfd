"""A whole sequence through the belief filter, and one step of it.

Two forms give the same numbers. The PyTorch form here is plain autograd on any device and under
every transformation; :mod:`.native` is one operator on the CPU. :func:`.unsupported_reason` is the
rule which runs.

Where Q is constant, predicted covariances depend on the episode starts alone, so that the gains of
a whole minibatch are one batched computation ahead of the mean recurrence. Where they are
propagated by one Jacobian they depend on masks and episode starts: their recursion runs before,
without gradient. The gain comes from what is cheaper to factorise: S = H P H' + R, obs x obs, or
the precision inv(P) + H' inv(R) H, state x state (diagonal R, obs > state). A Q or a Jacobian that
depends on the state, or a model of the mask, takes :mod:`.kalman` step by step.
"""

from __future__ import annotations

import functools
import math
import warnings
from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchrl_drbpn.functional import native
from torchrl_drbpn.functional.gaussian import (
    LOG_2PI,
    Belief,
    masked_cov,
    rounded_cov,
    without_autocast,
    zero_missing,
)
from torchrl_drbpn.functional.informative import update_by_mask
from torchrl_drbpn.functional.kalman import log_likelihood, update
from torchrl_drbpn.functional.state_space import StateSpace, predict_step, propagate

__all__ = ["FilterOutput", "filter_sequence", "filter_step", "filtered_cov"]

Form = Literal["auto", "pytorch", "native"]
# observation, observed, action, reset, use_stored_state, stored_mean as (batch, time, ...), the
# mean (batch, state) before; stored_cov and the cov before where it is propagated; weight.
Sequence = tuple[
    Tensor, Tensor, Tensor, Tensor, Tensor | None, Tensor | None, Tensor, Tensor | None,
    Tensor | None, Tensor | None,
]  # fmt: skip
# Chooses what belongs to P_0 or to Q, of shape (2, ...) in this order, for every step; leaves alone
# what is there for every step.
Choose = Callable[[Tensor], Tensor]
Gains = tuple[Tensor, Callable[[Tensor, list[Tensor]], Tensor]]


class FilterOutput(NamedTuple):
    """Hold what the filter returns.

    Args:
        mean: filtered mean, shape ``(*batch, [time,] state)``.
        cov: filtered covariance, shape ``(*batch, [time,] state, state)``. Where it is propagated
            it is always there, without gradient unless asked for; else None where not asked for.
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


def filter_step(
    model: StateSpace,
    mean: Tensor,
    previous_action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    *,
    cov: Tensor | None = None,
    weight: Tensor | None = None,
    return_cov: bool = False,
    form: Form = "auto",
) -> FilterOutput:
    """Filter one step for any batch of beliefs: a sequence of one.

    Eq. (8), (10), (12) [DRBPN]. Arguments, result and errors are those of
    :func:`filter_sequence`, without the dimension of time.

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
    steps = tuple(reset.shape)
    model.check_inputs(
        steps, steps, mean, previous_action, observation, observed, reset, cov=cov, weight=weight
    )
    out = _filter(
        model,
        (observation.unsqueeze(-2), observed.unsqueeze(-2), previous_action.unsqueeze(-2),
         reset.unsqueeze(-1), None, None, mean, None, cov,
         None if weight is None else weight.unsqueeze(-2)),
        return_cov, form,
    )  # fmt: skip
    filtered = None if out.cov is None else out.cov.squeeze(-3)
    return FilterOutput(out.mean.squeeze(-2), filtered, out.log_likelihood.squeeze(-1))


def filter_sequence(
    model: StateSpace,
    mean: Tensor,
    previous_action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    *,
    cov: Tensor | None = None,
    use_stored_state: Tensor | None = None,
    stored_mean: Tensor | None = None,
    stored_cov: Tensor | None = None,
    weight: Tensor | None = None,
    return_cov: bool = False,
    form: Form = "auto",
) -> FilterOutput:
    """Filter whole sequences, episode starts inside them included.

    Eq. (8), (10), (12) [DRBPN] at every step.

    Args:
        model: the state-space model.
        mean: filtered mean of the step before the first, shape ``(*batch, state)``.
        previous_action: shape ``(*batch, time, action)``.
        observation: shape ``(*batch, time, obs)``; missing entries may hold anything.
        observed: bool, shape ``(*batch, time, obs)``.
        reset: bool, shape ``(*batch, time)``; True starts from the initial belief at this step.

    Keyword Args:
        cov: filtered covariance of the step before the first, shape ``(*batch, state, state)``;
            needed, and read, where the model propagates it.
        use_stored_state: bool, shape ``(*batch, time)``; True takes the belief of the step before
            from ``stored_mean`` (and ``stored_cov``) instead of from the sequence.
        stored_mean: shape ``(*batch, time, state)``; read where ``use_stored_state`` is True.
        stored_cov: shape ``(*batch, time, state, state)``; as ``cov``.
        weight: w in [0, 1], shape ``(*batch, time, obs)``: reading i has the variance r_i / w_i
            on the diagonal of R; 0 is missing. It gets no gradient.
        return_cov: whether the filtered covariances are wanted, with their gradient.
        form: "auto" runs the native form where it can; "pytorch" and "native" force one.

    Returns:
        :class:`FilterOutput` of shapes ``(*batch, time, ...)``.

    Raises:
        ValueError: for a wrong shape or dtype, a weight outside [0, 1], a propagated covariance
            that is missing, if form="native" cannot run, or one of ``use_stored_state`` and
            ``stored_mean`` is given without the other.

    Example:
        >>> import torch
        >>> from torchrl_drbpn.functional import TransitionMLP
        >>> f = TransitionMLP((torch.zeros(2, 3),), (torch.zeros(2),), True, "relu")
        >>> eye = torch.eye(2)
        >>> model = StateSpace(f, eye, eye, torch.ones(2), torch.zeros(2, 1), torch.zeros(2),
        ...                    torch.zeros(2), eye)
        >>> seen = torch.rand(4, 10, 2) < 0.7
        >>> out = filter_sequence(model, torch.zeros(4, 2), torch.zeros(4, 10, 1),
        ...                       torch.randn(4, 10, 2), seen, torch.zeros(4, 10, dtype=torch.bool))
        >>> out.mean.shape, out.log_likelihood.shape
        (torch.Size([4, 10, 2]), torch.Size([4, 10]))
    """
    if (use_stored_state is None) != (stored_mean is None):
        raise ValueError(
            "`use_stored_state` and `stored_mean` come together: the one says where, the other "
            "from which belief."
        )
    steps = tuple(reset.shape)
    model.check_inputs(
        steps, steps[:-1], mean, previous_action, observation, observed, reset, use_stored_state,
        stored_mean, stored_cov, cov, weight,
    )  # fmt: skip
    return _filter(
        model, (observation, observed, previous_action, reset, use_stored_state, stored_mean, mean,
                stored_cov, cov, weight),
        return_cov, form,
    )  # fmt: skip


def _filter(model: StateSpace, given: Sequence, return_cov: bool, form: Form) -> FilterOutput:
    """Choose the form, and filter checked inputs as rows."""
    if form not in ("auto", "pytorch", "native"):
        raise ValueError(f"`form` must be 'auto', 'pytorch' or 'native', got {form!r}.")
    F = model.transition_jacobian
    needed = (("stored_cov", given[7], given[4] is not None), ("cov", given[8], True))
    for name, value, always in needed if F is not None else ():
        if always and value is None:
            raise ValueError(
                f"`{name}` is None, but this model propagates its covariance: pass the filtered "
                "covariance beside the mean."
            )
    if F is None:
        given = (*given[:7], None, None, given[9])
    if (weight := given[9]) is not None:
        observed = given[1] & (weight != 0)
        given = (given[0], observed, *given[2:9], torch.where(observed, weight.detach(), 1.0))
    *batch, time = given[3].shape

    def rows(x: Tensor | None) -> Tensor | None:  # not -1: there may be no step at all
        return None if x is None else x.reshape(math.prod(batch), *x.shape[len(batch) :])

    sequence: Sequence = tuple(map(rows, given))  # type: ignore[assignment]
    reason: str | None = "PyTorch was asked for"
    if form != "pytorch":
        reason = native.unsupported_reason(model, given[0], given[2], *given[5:9])
        reason = "it takes no weights" if reason is None and weight is not None else reason
        if reason is not None and form == "native":
            raise ValueError(f"`form` 'native' cannot run here: {reason}. Use form='auto'.")
        if not torch.compiler.is_compiling() and reason and reason == native.native_status():
            _warn_once(reason)
    with without_autocast(given[6]):
        cov: Tensor | None
        if not isinstance(model.transition_cov, Tensor) or callable(F) or model.mask_model:
            filtered, cov, ll = _run_step_by_step(model, *sequence)
        else:
            if reason is None:
                filtered, cov, ll = native.filter_rows(model, *sequence[:9])
            else:
                filtered, cov, ll = run_in_pytorch(model, *sequence)
            if return_cov and cov is None:
                cov = filtered_cov(model, sequence[1], sequence[3], sequence[9])
            elif return_cov and cov is not None:
                cov = _differentiable_cov(model, sequence, cov)
    if cov is not None and not return_cov:
        cov = None if F is None else cov.detach()
    cov = None if cov is None else cov.reshape(*batch, *cov.shape[1:])
    return FilterOutput(
        filtered.reshape(*batch, time, model.state_dim), cov, ll.reshape(*batch, time)
    )


@functools.cache
def _warn_once(reason: str) -> None:
    warnings.warn(f"the filter runs in PyTorch, several times slower: {reason}.", stacklevel=2)


def filtered_cov(
    model: StateSpace, observed: Tensor, reset: Tensor, weight: Tensor | None = None
) -> Tensor:
    r"""Return the filtered covariance of a constant-Q model: of the masks and weights alone.

    .. math:: P^+ = (I - K H) P (I - K H)' + K R K'

    Eq. (10) [DRBPN] in Joseph's form; P is Q, or P_0 where an episode starts.

    Args:
        model: the state-space model, its transition_cov a tensor.
        observed: bool, shape ``(*batch, obs)``.
        reset: bool, shape ``(*batch,)``.
        weight: in (0, 1], shape ``(*batch, obs)``, see :func:`filter_sequence`.

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
    if model.transition_jacobian is not None or model.mask_model is not None:
        raise ValueError(
            "`model` has a covariance that depends on the whole past: ask "
            "filter_sequence or filter_step for it."
        )
    P = torch.where(reset[..., None, None], model.full_initial_cov(), model.constant_cov())
    return _updated_cov(model, P, observed, weight)


def _updated_cov(model: StateSpace, P: Tensor, observed: Tensor, weight: Tensor | None) -> Tensor:
    zero = torch.zeros((), dtype=P.dtype, device=P.device)
    predicted = Belief(zero.expand(P.shape[:-1]), P)
    H, R = model.emission_matrix, _weighted_noise(model, weight)
    return update(predicted, zero.expand(observed.shape), observed, H, R).cov


def _added_noise(R: Tensor, weight: Tensor) -> Tensor:
    """Return what weights add to the diagonal of R, float64; exactly 0 for a weight of 1."""
    return (R if R.ndim == 1 else R.diagonal()).double() * (1.0 / weight.double() - 1.0)


def _weighted_noise(model: StateSpace, weight: Tensor | None) -> Tensor:
    """Return R, or of every step the matrix that its weights make of it."""
    R = model.emission_cov
    if weight is None:
        return R
    return model.full_emission_cov() + torch.diag_embed(_added_noise(R, weight))


def _differentiable_cov(model: StateSpace, sequence: Sequence, filtered: Tensor) -> Tensor:
    """Return propagated covariances with the gradient of one step: that before is a constant."""
    _, observed, _, reset, use_stored_state, _, _, stored_cov, cov, weight = sequence
    F = model.transition_jacobian
    assert isinstance(F, Tensor) and cov is not None  # noqa: PT018  for the type checker
    before = torch.cat([cov.unsqueeze(1), filtered], 1)[:, :-1]
    if use_stored_state is not None and stored_cov is not None:
        before = torch.where(use_stored_state[..., None, None], stored_cov, before)
    first = reset[..., None, None]
    moved = propagate(F, before.masked_fill(first, 0.0)) + model.constant_cov()
    P = torch.where(first, model.full_initial_cov().double(), moved)
    return _updated_cov(model, P.to(filtered.dtype), observed, weight)


# ------------------------------------------------------------------ the PyTorch form
def run_in_pytorch(
    model: StateSpace,
    observation: Tensor,
    observed: Tensor,
    action: Tensor,
    reset: Tensor,
    use_stored_state: Tensor | None,
    stored_mean: Tensor | None,
    mean: Tensor,
    stored_cov: Tensor | None = None,
    cov: Tensor | None = None,
    weight: Tensor | None = None,
) -> tuple[Tensor, Tensor | None, Tensor]:
    """Filter rows ``(batch, time, ...)``; return means, propagated covariances, log-likelihoods.

    In float64 but for the transition: with R at its floor float32 loses most digits of a gain.
    """
    H, R, dtype = model.emission_matrix.double(), model.emission_cov.double(), mean.dtype
    added = None if weight is None else _added_noise(R, weight)
    covs = torch.stack([model.full_initial_cov(), model.constant_cov()]).double()

    def choose(pair: Tensor) -> Tensor:
        first = reset.view(*reset.shape, *(1,) * (pair.ndim - 1))
        return torch.where(first, pair[0], pair[1])

    filtered_covs = None
    if model.transition_jacobian is not None:
        own = choose(covs)
        covs, filtered_covs = _run_covariances(
            model, own, observed, added, reset, use_stored_state, stored_cov, cov
        )
        filtered_covs = rounded_cov(filtered_covs, dtype)

        def choose(pair: Tensor) -> Tensor:
            return pair

    gains = _information if model.information_form else _innovation
    gain, likelihood = gains(H, R, covs, choose, observed, added)
    # Filling before any arithmetic keeps a NaN under a False mask out of values and gradients.
    y = zero_missing(observation, observed).double() - model.offset(action).double()
    innovations, moves, filtered, H_t = [], [], [], H.mT
    steps = (y, gain, action, reset.unsqueeze(-1), use_stored_state, stored_mean)
    for y_t, gain_t, action_t, reset_t, use_t, stored_t in zip(
        *((None,) * reset.shape[1] if x is None else x.unbind(1) for x in steps), strict=True
    ):
        if use_t is not None:
            mean = torch.where(use_t.unsqueeze(-1), stored_t, mean)
        m = model.predicted_mean(mean, action_t, reset_t).double()
        v = torch.addmm(y_t, m, H_t, alpha=-1)
        move = torch.bmm(gain_t, v.unsqueeze(-1)).squeeze(-1)
        mean = (m + move).to(dtype)
        innovations.append(v)
        moves.append(move)
        filtered.append(mean)
    if not filtered:
        return mean.unsqueeze(1)[:, :0], filtered_covs, y.sum(-1).to(dtype)
    residual = zero_missing(torch.stack(innovations, 1), observed)
    ll = torch.where(observed.any(-1), likelihood(residual, moves), 0.0).to(dtype)
    return torch.stack(filtered, 1), filtered_covs, ll


def _run_covariances(
    model: StateSpace,
    own: Tensor,
    observed: Tensor,
    added: Tensor | None,
    reset: Tensor,
    use_stored_state: Tensor | None,
    stored_cov: Tensor | None,
    cov: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """Propagate and update covariances ahead of the means; ``own`` is Q or P_0 of each step.

    Returns:
        The predicted ones, with the gradient by ``own`` alone, and the filtered ones, without;
        float64, ``(batch, time, state, state)``.
    """
    F, time = model.transition_jacobian, reset.shape[1]
    assert isinstance(F, Tensor) and cov is not None  # noqa: PT018  for the type checker
    H, R = model.emission_matrix.detach().double(), model.emission_cov.detach().double()
    if R.ndim == 2 or not model.information_form:
        R = model.full_emission_cov().detach().double()
    if added is not None:
        R = R + (added if R.ndim == 1 else torch.diag_embed(added)).detach()
    value, sigma = own.detach(), cov.detach().double()
    predicted, filtered = [], []
    # The state before a step that starts anew, or from what is stored, comes from here.
    given, ahead = reset, torch.zeros_like(value)
    if use_stored_state is not None and stored_cov is not None:
        given = reset | use_stored_state
        ahead = stored_cov.detach().masked_fill(reset[..., None, None], 0.0).double()
    if model.information_form:
        weight = observed / R
        outer = (H.unsqueeze(-1) * H.unsqueeze(-2)).flatten(-2)
        gained = (weight @ outer).view(value.shape)
    else:
        rows = zero_missing(H, observed.unsqueeze(-1))  # M'M H
        noise = masked_cov(R, observed)
    for t in range(time):
        sigma = torch.where(given[:, t, None, None], ahead[:, t], sigma)
        P = propagate(F, sigma) + value[:, t]
        if model.information_form:
            precision = torch.cholesky_inverse(torch.linalg.cholesky_ex(P)[0]) + gained[:, t]
            sigma = torch.cholesky_inverse(torch.linalg.cholesky_ex(precision)[0])
        else:
            h = rows[:, t]
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
    factor, log_det = _factor(masked_cov(S, observed))
    gain = torch.cholesky_solve(zero_missing(choose(cross), observed.unsqueeze(-1)), factor).mT

    def likelihood(residual: Tensor, moves: list[Tensor]) -> Tensor:
        del moves
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
    prior_factor, prior_log_det = _factor(covs)
    prior = choose(torch.cholesky_inverse(prior_factor))
    factor, log_det = _factor((weight @ outer).view(prior.shape) + prior)
    gain = torch.cholesky_solve((weight.unsqueeze(-1) * H).mT, factor)

    def likelihood(residual: Tensor, moves: list[Tensor]) -> Tensor:
        move = torch.stack(moves, 1)
        left = zero_missing(residual - move @ H.mT, observed)
        by_prior = (prior @ move.unsqueeze(-1)).squeeze(-1)
        quadratic = (weight * left.square()).sum(-1) + (move * by_prior).sum(-1)
        log_noise = (observed * (R.log() + LOG_2PI)).sum(-1)
        return -0.5 * (quadratic + log_noise + log_det + choose(prior_log_det))

    return gain, likelihood


def _factor(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Return Cholesky factor and log-determinant; NaN for a matrix that has none, by itself."""
    factor, info = torch.linalg.cholesky_ex(matrix)
    spoilt = torch.where(info == 0, 0.0, torch.nan).to(matrix.dtype)[..., None, None]
    factor = factor + spoilt
    return factor, 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def _run_step_by_step(
    model: StateSpace,
    observation: Tensor,
    observed: Tensor,
    action: Tensor,
    reset: Tensor,
    use_stored_state: Tensor | None,
    stored_mean: Tensor | None,
    mean: Tensor,
    stored_cov: Tensor | None,
    cov: Tensor | None,
    weight: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Filter by :mod:`.kalman` at every step; return means, covariances, log-likelihoods."""
    H, R, offset = model.emission_matrix, _weighted_noise(model, weight), model.offset(action)
    means, covs, lls = [], [], []
    for t in range(reset.shape[1]):
        if use_stored_state is not None and stored_mean is not None:
            use = use_stored_state[:, t, None]
            mean = torch.where(use, stored_mean[:, t], mean)
            if stored_cov is not None and cov is not None:
                cov = torch.where(use.unsqueeze(-1), stored_cov[:, t], cov)
        predicted = predict_step(model, mean, action[:, t], reset[:, t], cov)
        noise = R if weight is None else R[:, t]
        step = (observation[:, t], observed[:, t], H, noise, offset[:, t])
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
