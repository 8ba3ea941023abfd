"""Beliefs about the past given all readings, and about the future given none: for logged data.

Both propagate the covariance, exactly for a linear transition, else as the extended Kalman filter
does. A Q that was trained without propagation holds the share of the past already, which makes the
covariances too wide: train with ``covariance="propagated"`` for these.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import Belief, factorise, without_autocast
from torchrl_drbpn.functional.kalman import update, update_by_mask
from torchrl_drbpn.functional.state_space import FilterInputs, StateSpace, TransitionMLP

# F, shape (state, state), or a function of (mean, action) that returns (*batch, state, state).
Jacobian = Tensor | Callable[[Tensor, Tensor], Tensor]


class Forecast(NamedTuple):
    """Hold beliefs of the steps ahead, ``(*batch, ahead, ...)``, and of their noisy readings."""

    state: Belief
    observation: Belief


def smooth_sequence(
    model: StateSpace,
    mean: Tensor,
    cov: Tensor | None,
    previous_action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    *,
    jacobian: Jacobian | None = None,
    emission_cov: Tensor | None = None,
) -> Belief:
    r"""Return the beliefs given the readings of the whole sequence, later ones included.

    .. math::
        G_t = P_t F_{t+1}' (P^-_{t+1})^{-1}, \quad
        m^s_t = m_t + G_t (m^s_{t+1} - m^-_{t+1}), \quad
        P^s_t = P_t + G_t (P^s_{t+1} - P^-_{t+1}) G_t'

    with :math:`P^-_{t+1} = F_{t+1} P_t F_{t+1}' + Q`: the Rauch-Tung-Striebel smoother, §8.2
    [Särkkä 2013], extended by the Jacobian F (§9.1) where f is not linear. The covariance is
    computed as :math:`(I - G F) P (I - G F)' + G (P^s + Q) G'`, equal and always positive definite.
    Nothing passes an episode start. In float64 but for the transition; differentiable.

    Arguments are those of :func:`filter_sequence`, but for these: ``cov`` None is 0, so that the
    first predicted covariance is Q. ``jacobian`` is F, ``(state, state)``, or a function of (mean,
    action); None: the model's, and where it has none that of the transition at the filtered mean of
    every row. ``emission_cov`` is R of every step, ``(*batch, time, obs, obs)``; None: the model's.

    Raises:
        ValueError: for a wrong shape or dtype, or a covariance that is not positive definite.

    Example:
        >>> from torchrl_drbpn import BeliefFilter
        >>> model, x = BeliefFilter(1, 1).state_space(), torch.zeros(3, 1)
        >>> seen, reset = torch.tensor([[True], [False], [True]]), torch.zeros(3) > 0
        >>> belief = smooth_sequence(model, x[0], None, x, x, seen, reset)
        >>> bool(belief.cov[1] > belief.cov[0])  # in the gap less is known
        True
    """
    belief = _start(model, mean, cov)
    inputs = FilterInputs(observation, observed, previous_action, reset, None, None, mean)
    model.check_inputs(inputs, reset.shape[:-1])
    H, offset, dtype = model.emission_matrix, model.offset(previous_action), mean.dtype
    each = (*reset.shape, model.obs_dim, model.obs_dim)
    if emission_cov is None:
        emission_cov = model.full_emission_cov().expand(each)
    if emission_cov.shape != each:
        raise ValueError(
            "`emission_cov` must be R of every step, (*batch, time, obs, obs) = "
            f"{each}, got {tuple(emission_cov.shape)}."
        )
    with without_autocast(mean):
        filtered, predictions = [], []
        for t in range(reset.shape[-1]):
            R = emission_cov[..., t, :, :]
            given = previous_action[..., t, :], jacobian, reset[..., t]
            predictions.append(_predict(model, belief, *given))
            arrived = (observation[..., t, :], observed[..., t, :], H, R, offset[..., t, :])
            belief = update(predictions[-1][0], *arrived)
            if model.mask_model is not None:
                belief, _ = update_by_mask(belief, *arrived, model.mask_model)
            filtered.append(belief)
        smoothed = filtered[-1:]
        for (m, P), (after, F, Q) in zip(filtered[-2::-1], predictions[:0:-1], strict=True):
            factor = factorise("the predicted covariance", after.cov)
            G = torch.cholesky_solve(F @ P, factor).mT
            ahead = smoothed[-1]
            kept = torch.eye(P.shape[-1], dtype=P.dtype, device=P.device) - G @ F
            back = kept @ P @ kept.mT + G @ (ahead.cov + Q) @ G.mT
            move = (G @ (ahead.mean - after.mean).unsqueeze(-1)).squeeze(-1)
            smoothed.append(Belief(m + move, 0.5 * (back + back.mT)))
        return _stacked(smoothed[::-1], belief, dtype)


def forecast(
    model: StateSpace,
    mean: Tensor,
    cov: Tensor | None,
    action: Tensor,
    *,
    jacobian: Jacobian | None = None,
) -> Forecast:
    r"""Predict the steps ahead, of which nothing was read; differentiable.

    .. math::
        m_{j} = f(m_{j-1}, a_{j}), \quad P_{j} = F_{j} P_{j-1} F_{j}' + Q, \qquad
        x_j \sim N(H m_j + B a_j + d,\; H P_j H' + R)

    §4.1 [Särkkä 2013], extended by the Jacobian (§5.2) where f is not linear. A ValueError for a
    wrong shape.

    Args:
        model: the state-space model.
        mean: filtered mean, shape ``(*batch, state)``.
        cov: its covariance, shape ``(*batch, state, state)``; None: 0, so that the first predicted
            covariance is Q, as the filter with a constant covariance has it.
        action: the actions ahead, ``(*batch, ahead, action)``; entry j leads to step j.
        jacobian: see :func:`smooth_sequence`.

    Example:
        >>> from torchrl_drbpn import BeliefFilter
        >>> model = BeliefFilter(1, 1).state_space()
        >>> ahead = forecast(model, torch.zeros(1), None, torch.zeros(9, 1), jacobian=torch.eye(1))
        >>> torch.allclose(ahead.state.cov[-1], 9 * model.transition_cov)
        True
    """
    start, dtype, H = tuple(mean.shape[:-1]), mean.dtype, model.emission_matrix
    if action.shape[:-2] != start or action.shape[-1:] != (model.action_dim,) or action.ndim < 2:
        raise ValueError(
            f"`action` must have shape (*batch, ahead, action), *batch = {start} and action = "
            f"{model.action_dim}, got {tuple(action.shape)}: one action for each step ahead."
        )
    with without_autocast(mean):
        belief = _start(model, mean, cov)
        never, steps = torch.zeros(start, dtype=torch.bool, device=mean.device), []
        for a in action.unbind(-2):
            belief, *_ = _predict(model, belief, a, jacobian, never)
            steps.append(belief)
        state = _stacked(steps, belief, dtype)
        readings = state.mean @ H.mT + model.offset(action)
        return Forecast(state, Belief(readings, H @ state.cov @ H.mT + model.full_emission_cov()))


def row_jacobian(
    transition: TransitionMLP | Callable[[Tensor, Tensor], Tensor], mean: Tensor, action: Tensor
) -> Tensor:
    """Differentiate a transition by the mean, each row by itself; a network in closed form.

    Of f of (mean, action), row by row, mean ``(*batch, state)`` and action ``(*batch, action)``;
    F, shape ``(*batch, state, state)``, differentiable again.

    Example:
        >>> F = row_jacobian(lambda m, a: m * a, torch.ones(2, 3), torch.full((2, 3), 5.0))
        >>> torch.equal(F, 5 * torch.eye(3).expand(2, 3, 3))
        True
    """
    if isinstance(transition, TransitionMLP):
        return transition.jacobian(mean, action)
    state = mean.shape[-1]
    # Rows do not mix, so the derivative of their sum holds that of each.
    by_row = torch.func.jacrev(lambda m: transition(m, action).reshape(-1, state).sum(0))(mean)
    return by_row.movedim(0, -2)


def _predict(
    model: StateSpace, belief: Belief, action: Tensor, jacobian: Jacobian | None, reset: Tensor
) -> tuple[Belief, Tensor, Tensor]:
    """Return the predicted belief, float64, and F, Q; F = 0 at a reset, which nothing passes."""
    row, dtype = reset.unsqueeze(-1), model.emission_matrix.dtype
    mean = belief.mean.masked_fill(row, 0.0).to(dtype)
    F = model.transition_jacobian if jacobian is None else jacobian
    if F is None:
        F = row_jacobian(model.transition, mean, action)
    elif not isinstance(F, Tensor):
        F = F(mean, action)
    Q, block = model.predicted_cov(mean, action).double(), row.unsqueeze(-1)
    F = torch.where(block, 0.0, F.double())
    moved = F @ belief.cov.masked_fill(block, 0.0) @ F.mT
    cov = torch.where(block, model.full_initial_cov().double(), 0.5 * (moved + moved.mT) + Q)
    return Belief(model.predicted_mean(mean, action, row).double(), cov), F, Q


def _start(model: StateSpace, mean: Tensor, cov: Tensor | None) -> Belief:
    """Check the belief before the first step, and return it in float64."""
    state = model.state_dim
    if mean.shape[-1:] != (state,) or (cov is not None and cov.shape != (*mean.shape, state)):
        raise ValueError(
            f"`mean` and `cov` must have shapes (*batch, {state}) and (*batch, {state}, {state}), "
            f"got {tuple(mean.shape)} and {None if cov is None else tuple(cov.shape)}."
        )
    zero = torch.zeros(*mean.shape, state, dtype=torch.float64, device=mean.device)
    return Belief(mean.double(), zero if cov is None else cov.double())


def _stacked(beliefs: list[Belief], like: Belief, dtype: torch.dtype) -> Belief:
    """Stack beliefs over time; there may be no step at all."""
    if not beliefs:
        return Belief(
            like.mean.to(dtype).unsqueeze(-2)[..., :0, :],
            like.cov.to(dtype).unsqueeze(-3)[..., :0, :, :],
        )
    means, covs = zip(*beliefs, strict=True)
    return Belief(torch.stack(means, -2).to(dtype), torch.stack(covs, -3).to(dtype))
