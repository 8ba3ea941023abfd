"""A whole sequence through the belief filter, and one step of it.

:func:`.unsupported_reason` is the rule which of two forms runs, :mod:`.native` or
:mod:`.pytorch_form`; they give the same numbers. A Q or a Jacobian that depends on the state, or a
model of the mask, is filtered step by step.
"""

import functools
import math
import warnings
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchrl_drbpn.functional import native
from torchrl_drbpn.functional.gaussian import Belief, without_autocast
from torchrl_drbpn.functional.kalman import update
from torchrl_drbpn.functional.pytorch_form import (
    run_in_pytorch,
    run_step_by_step,
    weighted_noise,
)
from torchrl_drbpn.functional.state_space import FilterInputs, StateSpace, propagate

Form = Literal["auto", "pytorch", "native"]


class FilterOutput(NamedTuple):
    """Hold what the filter returns.

    Args:
        mean: filtered mean, shape ``(*batch, [time,] state)``.
        cov: filtered covariance, shape ``(*batch, [time,] state, state)``, without gradient unless
            asked for; None where it is neither propagated nor asked for.
        log_likelihood: of each step, shape ``(*batch, [time])``, nats.
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
        >>> from torchrl_drbpn import BeliefFilter
        >>> model, mean = BeliefFilter(obs_dim=2, action_dim=1).state_space(), torch.ones(5, 2)
        >>> action, nothing = torch.zeros(5, 1), torch.zeros(5, 2, dtype=torch.bool)
        >>> out = filter_step(model, mean, action, mean, nothing, nothing[:, 0])
        >>> torch.allclose(out.mean, model.transition(mean, action), atol=1e-5)
        True
    """
    given = FilterInputs(
        observation, observed, previous_action, reset, None, None, mean, None, cov, weight
    )
    model.check_inputs(given, reset.shape)
    given = given._replace(
        observation=observation.unsqueeze(-2),
        observed=observed.unsqueeze(-2),
        previous_action=previous_action.unsqueeze(-2),
        reset=reset.unsqueeze(-1),
        weight=None if weight is None else weight.unsqueeze(-2),
    )
    out = _filter(model, given, return_cov, form)
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
        observed: bool, shape ``(*batch, time, obs)``, True = arrived.
        reset: bool, shape ``(*batch, time)``; True starts from the initial belief at this step.
        cov: filtered covariance of the step before the first, shape ``(*batch, state, state)``;
            needed, and read, where the model propagates it.
        use_stored_state: bool, shape ``(*batch, time)``; True takes the belief of the step before
            from ``stored_mean`` (and ``stored_cov``) instead of from the sequence.
        stored_mean: shape ``(*batch, time, state)``, needed beside ``use_stored_state``.
        stored_cov: shape ``(*batch, time, state, state)``; as ``cov``.
        weight: w in [0, 1], shape ``(*batch, time, obs)``: reading i has the variance r_i / w_i
            on the diagonal of R; 0 is missing. It gets no gradient.
        return_cov: whether the filtered covariances are wanted, with their gradient.
        form: "auto" runs the native form where it can; "pytorch" and "native" force one.

    Raises:
        ValueError: for a wrong shape or dtype, a weight outside [0, 1], a belief that is not whole,
            or form="native" where it cannot run.

    Example:
        >>> from torchrl_drbpn import BeliefFilter
        >>> model = BeliefFilter(obs_dim=2, action_dim=1).state_space()
        >>> x, seen, reset = torch.randn(4, 9, 2), torch.rand(4, 9, 2) < 0.7, torch.zeros(4, 9) > 0
        >>> out = filter_sequence(model, torch.zeros(4, 2), torch.zeros(4, 9, 1), x, seen, reset)
        >>> out.mean.shape, out.log_likelihood.shape
        (torch.Size([4, 9, 2]), torch.Size([4, 9]))
    """
    if (use_stored_state is None) != (stored_mean is None):
        raise ValueError(
            "`use_stored_state` and `stored_mean` come together: the one says where, the other "
            "from which belief."
        )
    given = FilterInputs(
        observation, observed, previous_action, reset, use_stored_state, stored_mean, mean,
        stored_cov, cov, weight,
    )  # fmt: skip
    model.check_inputs(given, reset.shape[:-1])
    return _filter(model, given, return_cov, form)


def _filter(model: StateSpace, given: FilterInputs, return_cov: bool, form: Form) -> FilterOutput:
    """Choose the form, and filter checked inputs as rows."""
    if form not in ("auto", "pytorch", "native"):
        raise ValueError(f"`form` must be 'auto', 'pytorch' or 'native', got {form!r}.")
    if (F := model.transition_jacobian) is None:
        given = given._replace(cov=None, stored_cov=None)
    elif given.cov is None or (given.use_stored_state is not None and given.stored_cov is None):
        raise ValueError(
            f"`{'cov' if given.cov is None else 'stored_cov'}` is None, but this model propagates "
            "its covariance: pass the filtered covariance beside the mean."
        )
    if (weight := given.weight) is not None:
        observed = given.observed & (weight != 0)
        weight = torch.where(observed, weight.detach(), 1.0)
        given = given._replace(observed=observed, weight=weight)
    *batch, time = given.reset.shape
    # Not -1: there may be no step at all.
    rows = FilterInputs(*(
        None if x is None else x.reshape(math.prod(batch), *x.shape[len(batch) :]) for x in given
    ))  # type: ignore[arg-type]  # fmt: skip
    reason: str | None = "PyTorch was asked for"
    if form != "pytorch":
        floats = given.observation, given.previous_action, *given[5:9]
        reason = native.unsupported_reason(model, *floats, weight=weight)
        if reason is not None and form == "native":
            raise ValueError(f"`form` 'native' cannot run here: {reason}. Use form='auto'.")
        if not torch.compiler.is_compiling() and reason and reason == native.native_status():
            _warn_once(reason)
    with without_autocast(given.mean):
        cov: Tensor | None
        if not isinstance(model.transition_cov, Tensor) or callable(F) or model.mask_model:
            filtered, cov, ll = run_step_by_step(model, rows)
        else:
            run = run_in_pytorch if reason is not None else native.filter_rows
            filtered, cov, ll = run(model, rows)
            if return_cov:
                cov = _filtered_cov(model, rows, cov)
    if cov is not None and not return_cov:
        cov = None if F is None else cov.detach()
    cov = None if cov is None else cov.reshape(*batch, *cov.shape[1:])
    return FilterOutput(
        filtered.reshape(*batch, time, model.state_dim), cov, ll.reshape(*batch, time)
    )


@functools.cache
def _warn_once(reason: str) -> None:
    warnings.warn(f"the filter runs in PyTorch, several times slower: {reason}.", stacklevel=2)


def _filtered_cov(model: StateSpace, rows: FilterInputs, filtered: Tensor | None) -> Tensor:
    """Return covariances with the gradient of one step: a propagated one before is a constant."""
    first, F, P = rows.reset[..., None, None], model.transition_jacobian, model.constant_cov()
    if filtered is not None and rows.cov is not None and isinstance(F, Tensor):
        before = torch.cat([rows.cov.unsqueeze(1), filtered], 1)[:, :-1]
        if rows.use_stored_state is not None and rows.stored_cov is not None:
            before = torch.where(rows.use_stored_state[..., None, None], rows.stored_cov, before)
        P = propagate(F, before.masked_fill(first, 0.0)) + P
    P = torch.where(first, model.full_initial_cov().to(P.dtype), P).to(model.initial_mean.dtype)
    zero = torch.zeros((), dtype=P.dtype, device=P.device)
    predicted, noise = Belief(zero.expand(P.shape[:-1]), P), weighted_noise(model, rows.weight)
    reading = zero.expand(rows.observed.shape)
    return update(predicted, reading, rows.observed, model.emission_matrix, noise).cov
