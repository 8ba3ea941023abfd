"""The state-space model as plain tensors, and its prediction."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import Belief
from torchrl_drbpn.functional.recurrence import MeanNetwork

__all__ = ["Following", "Form", "StateSpace", "choose_form", "constant_cov", "predict_step"]

Form = Literal["auto", "innovation", "information", "native", "loop"]


class StateSpace(NamedTuple):
    r"""Hold the tensors of a linear-Gaussian-emission state-space model (eq. 2, 3, 8 [DRBPN]).

    .. math::
        s_t = f(s_{t-1}, a_{t-1}) + N(0, Q), \qquad
        x_t = H s_t + B a_{t-1} + d + N(0, R), \qquad
        s_1 \sim N(m_0, P_0)

    Args:
        transition: f; a :class:`MeanNetwork` opens the fast forms, any callable of
            (mean, action) goes through the loop.
        transition_cov: Q, shape ``(state, state)``, or a callable of (mean, action) that returns
            ``(*batch, state, state)``.
        emission_matrix: H, shape ``(obs, state)``.
        emission_cov: R, shape ``(obs, obs)``, or ``(obs,)`` for the variances of a diagonal R.
        action_matrix: B, shape ``(obs, action)``.
        emission_offset: d, shape ``(obs,)``.
        initial_mean: m_0, shape ``(state,)``.
        initial_cov: P_0, shape ``(state, state)``.

    Example:
        >>> import torch
        >>> eye = torch.eye(2)
        >>> model = StateSpace(
        ...     lambda m, a: m, eye, eye, torch.ones(2), torch.zeros(2, 1), torch.zeros(2),
        ...     torch.zeros(2), eye)
        >>> model.full_emission_cov().shape
        torch.Size([2, 2])
    """

    transition: MeanNetwork | Callable[[Tensor, Tensor], Tensor]
    transition_cov: Tensor | Callable[[Tensor, Tensor], Tensor]
    emission_matrix: Tensor
    emission_cov: Tensor
    action_matrix: Tensor
    emission_offset: Tensor
    initial_mean: Tensor
    initial_cov: Tensor

    def double(self) -> StateSpace:
        """Return the same model in float64; a function keeps its own dtype."""
        Q = self.transition_cov
        wide_Q = Q.double() if isinstance(Q, Tensor) else Q
        return StateSpace(self.transition, wide_Q, *(x.double() for x in self[2:]))

    def full_emission_cov(self) -> Tensor:
        """Return R as a matrix, shape ``(obs, obs)``."""
        return self.emission_cov.diag() if self.emission_cov.ndim == 1 else self.emission_cov

    def offset(self, previous_action: Tensor) -> Tensor:
        """Return B a + d, shape ``(*batch, obs)``."""
        return torch.nn.functional.linear(previous_action, self.action_matrix, self.emission_offset)


class Following(NamedTuple):
    """Hold observations that come after some steps of a sequence and are no steps of it.

    Where an episode ends, the next step of the sequence is another episode's first: the last
    observation lies beside it. Its likelihood is that of a step which goes on from there.

    Args:
        step: int64, shape ``(count,)``, the steps before: places in ``(*batch, time)`` flattened.
        previous_action: shape ``(count, action)``.
        observation: shape ``(count, obs)``; missing entries may hold anything.
        observed: bool, shape ``(count, obs)``.

    Example:
        >>> import torch
        >>> after = Following(torch.tensor([9]), torch.zeros(1, 1), torch.zeros(1, 2),
        ...                   torch.ones(1, 2, dtype=torch.bool))
        >>> len(after.step)
        1
    """

    step: Tensor
    previous_action: Tensor
    observation: Tensor
    observed: Tensor


def choose_form(model: StateSpace) -> Literal["innovation", "information", "loop"]:
    """Choose the cheapest exact form of a model.

    Args:
        model: the state-space model.

    Returns:
        "loop" unless the transition is a :class:`MeanNetwork` with a constant Q; otherwise
        "information" where R is diagonal and obs exceeds state, else "innovation".

    Example:
        >>> import torch
        >>> f = MeanNetwork((torch.zeros(2, 3),), (torch.zeros(2),), True, "relu")
        >>> eye, H = torch.eye(2), torch.zeros(9, 2)
        >>> model = StateSpace(f, eye, H, torch.ones(9), torch.zeros(9, 1), torch.zeros(9),
        ...                    torch.zeros(2), eye)
        >>> choose_form(model), choose_form(model._replace(emission_cov=torch.eye(9)))
        ('information', 'innovation')
    """
    if not isinstance(model.transition_cov, Tensor) or not isinstance(
        model.transition, MeanNetwork
    ):
        return "loop"
    obs, state = model.emission_matrix.shape
    return "information" if model.emission_cov.ndim == 1 and obs > state else "innovation"


def checked_form(model: StateSpace, form: Form) -> str:
    """Return the form to run, or say why the asked one cannot be."""
    best = choose_form(model)
    if form == "auto":
        return best
    if form not in ("innovation", "information", "native", "loop"):
        raise ValueError(
            f"`form` must be 'auto', 'innovation', 'information', 'native' or 'loop', got {form!r}."
        )
    if best == "loop" and form != "loop":
        raise ValueError(
            f"`form` {form!r} needs a MeanNetwork transition with a constant transition_cov; "
            "this model has a transition or covariance of another kind: use form='loop'."
        )
    if form == "information" and model.emission_cov.ndim != 1:
        raise ValueError(
            "`form` 'information' needs a diagonal emission covariance (variances of shape (obs,)),"
            f" got a full one of shape {tuple(model.emission_cov.shape)}: use form='innovation'."
        )
    return form


def initial_belief(model: StateSpace, reset: Tensor, mean: Tensor, cov: Tensor) -> Belief:
    """Put the initial belief where an episode starts. reset: (*batch, 1)."""
    return Belief(
        torch.where(reset, model.initial_mean, mean),
        torch.where(reset.unsqueeze(-1), model.initial_cov, cov),
    )


def predict_step(model: StateSpace, mean: Tensor, previous_action: Tensor, reset: Tensor) -> Belief:
    r"""Predict one step, or start an episode from the initial belief.

    .. math:: m^- = f(m, a), \; P^- = Q; \qquad \text{at a reset } m^- = m_0, \; P^- = P_0

    Eq. (8) [DRBPN].

    Args:
        model: the state-space model.
        mean: filtered mean of the step before, shape ``(*batch, state)``.
        previous_action: shape ``(*batch, action)``.
        reset: bool, shape ``(*batch,)``.

    Returns:
        The predicted belief.

    Example:
        >>> import torch
        >>> eye = torch.eye(2)
        >>> model = StateSpace(
        ...     lambda m, a: m + 1, eye, eye, torch.ones(2), torch.zeros(2, 1), torch.zeros(2),
        ...     torch.zeros(2), eye)
        >>> reset = torch.tensor([True, False])
        >>> predict_step(model, torch.ones(2, 2), torch.zeros(2, 1), reset).mean.tolist()
        [[0.0, 0.0], [2.0, 2.0]]
    """
    cov = model.transition_cov
    if not isinstance(cov, Tensor):
        cov = cov(mean, previous_action)
    return initial_belief(model, reset.unsqueeze(-1), model.transition(mean, previous_action), cov)


def constant_cov(model: StateSpace) -> Tensor:
    """Return Q where it is one matrix for every step.

    Args:
        model: the state-space model.

    Returns:
        Shape ``(state, state)``.

    Raises:
        ValueError: if transition_cov depends on the state.
    """
    if not isinstance(model.transition_cov, Tensor):
        raise ValueError(
            "`transition_cov` depends on the state here, so the covariance depends on the whole "
            "past: ask filter_sequence or filter_step for it with return_cov=True."
        )
    return model.transition_cov
