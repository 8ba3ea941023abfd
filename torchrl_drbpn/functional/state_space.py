"""The state-space model as plain tensors, checked once, and its prediction."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import Belief, as_matrix
from torchrl_drbpn.functional.kalman import MaskModel

# Of a propagated variance, state units: under a transition that expands, what no sensor has seen
# for thousands of steps would leave the range of float32. The correlations stay.
MAX_VARIANCE = 1e6


class TransitionMLP(NamedTuple):
    r"""Describe the transition mean f(mean, action) as plain tensors.

    .. math:: f(m, a) = [m +] \; W_k \, \sigma(\dots \sigma(W_1 (m, a) + b_1)) + b_k

    Eq. (8) [DRBPN]. Its weights are what the native form of the filter reads.

    Args:
        weights: of each layer, shape ``(out, in)``; the first layer's ``in`` is state + action,
            in this order.
        biases: of each layer, shape ``(out,)``.
        residual: whether the mean is added to the output.
        activation: "relu" or "tanh", between the layers.

    Example:
        >>> f = TransitionMLP((torch.zeros(3, 5),), (torch.zeros(3),), True, "relu")
        >>> torch.equal(f(torch.ones(4, 3), torch.zeros(4, 2)), torch.ones(4, 3))
        True
    """

    weights: tuple[Tensor, ...]
    biases: tuple[Tensor, ...]
    residual: bool
    activation: str

    def __call__(self, mean: Tensor, action: Tensor) -> Tensor:
        """Return f, shape ``(*batch, state)``, of ``(*batch, state)`` and ``(*batch, action)``."""
        hidden = torch.cat([mean, action], -1)
        last = len(self.weights) - 1
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            hidden = torch.nn.functional.linear(hidden, weight, bias)
            if i < last:
                hidden = hidden.relu() if self.activation == "relu" else hidden.tanh()
        return mean + hidden if self.residual else hidden

    def jacobian(self, mean: Tensor, action: Tensor, *, average: bool = False) -> Tensor:
        r"""Return the derivative of f by the mean, of each row or its mean over all rows.

        .. math::
            J_r = [I +] \; W_k D_r^{k-1} W_{k-1} \dots D_r^1 W_1, \qquad
            \frac1N \sum_r W_3 D_r^2 W_2 D_r^1 W_1
            = W_3 \left(\tfrac1N d_2' d_1 \circ W_2\right) W_1

        :math:`D_r^i` is the diagonal of the activation's derivatives :math:`d_i`, ``(N, width)``.
        Shape ``(*batch, state, state)``, or ``(state, state)`` of the average.
        """
        state = mean.shape[-1]
        hidden, slopes = torch.cat([mean, action], -1), []
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            before = torch.nn.functional.linear(hidden, weight, bias)
            hidden = before.relu() if self.activation == "relu" else before.tanh()
            slope = (before > 0).to(mean.dtype) if self.activation == "relu" else 1 - hidden**2
            slopes.append(slope.reshape(-1, slope.shape[-1]))
        first, last = self.weights[0][:, :state], len(slopes)
        if average and last == 2:
            both = slopes[1].mT @ slopes[0] / len(slopes[0])
            found = self.weights[2] @ (both * self.weights[1]) @ first
        else:
            found = first.expand(mean[..., 0].numel(), -1, -1)
            for slope, weight in zip(slopes, self.weights[1:], strict=True):
                found = weight @ (slope.unsqueeze(-1) * found)
            found = found.mean(0) if average else found.reshape(*mean.shape, state)
        if not self.residual:
            return found
        return found + torch.eye(state, dtype=mean.dtype, device=mean.device)


class FilterInputs(NamedTuple):
    """Hold the arguments of :func:`filter_sequence`, in the order of the native operator."""

    observation: Tensor
    observed: Tensor
    previous_action: Tensor
    reset: Tensor
    use_stored_state: Tensor | None
    stored_mean: Tensor | None
    mean: Tensor
    stored_cov: Tensor | None = None
    cov: Tensor | None = None
    weight: Tensor | None = None

    def before(self, t: int, mean: Tensor, cov: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Return the belief that step t starts from: the one before, or what is stored."""
        if self.use_stored_state is None or self.stored_mean is None:
            return mean, cov
        use = self.use_stored_state[..., t, None]
        if cov is not None and self.stored_cov is not None:
            cov = torch.where(use.unsqueeze(-1), self.stored_cov[..., t, :, :], cov)
        return torch.where(use, self.stored_mean[..., t, :], mean), cov


@dataclass(eq=False)
class StateSpace:
    r"""Hold the tensors of a linear-Gaussian-emission state-space model (eq. 2, 3, 8 [DRBPN]).

    .. math::
        s_t = f(s_{t-1}, a_{t-1}) + N(0, Q), \qquad
        x_t = H s_t + B a_{t-1} + d + N(0, R), \qquad
        s_1 \sim N(m_0, P_0)

    A covariance is a matrix ``(n, n)`` or its diagonal, the variances ``(n,)``. All tensors have
    one floating dtype and one device; a ValueError for a field of another, or of another shape.

    Args:
        transition: f; any callable of (mean, action). The native form takes
            :class:`TransitionMLP` alone.
        transition_cov: Q, ``(state, state)`` or ``(state,)``; or a callable of (mean, action) that
            returns ``(*batch, state, state)``.
        emission_matrix: H, shape ``(obs, state)``.
        emission_cov: R, ``(obs, obs)`` or ``(obs,)``.
        action_matrix: B, shape ``(obs, action)``.
        emission_offset: d, shape ``(obs,)``.
        initial_mean: m_0, shape ``(state,)``.
        initial_cov: P_0, ``(state, state)`` or ``(state,)``.
        transition_jacobian: F, the derivative of f by the mean, ``(state, state)`` of every step
            alike; or a callable of (mean, action) that returns ``(*batch, state, state)``. It
            propagates the covariance: P = F cov F' + Q. None: P = Q (eq. 8).
        mask_model: why entries are missing, each field ``(obs,)``; None: it is ignored.

    Example:
        >>> eye = torch.eye(2)
        >>> model = StateSpace(
        ...     lambda m, a: m, eye, eye, torch.ones(2), torch.zeros(2, 1), torch.zeros(2),
        ...     torch.zeros(2), eye)
        >>> model.obs_dim, model.state_dim, model.action_dim
        (2, 2, 1)
    """

    transition: TransitionMLP | Callable[[Tensor, Tensor], Tensor]
    transition_cov: Tensor | Callable[[Tensor, Tensor], Tensor]
    emission_matrix: Tensor
    emission_cov: Tensor
    action_matrix: Tensor
    emission_offset: Tensor
    initial_mean: Tensor
    initial_cov: Tensor
    transition_jacobian: Tensor | Callable[[Tensor, Tensor], Tensor] | None = None
    mask_model: MaskModel | None = None

    def __post_init__(self) -> None:
        """Check every field."""
        H, B = self.emission_matrix, self.action_matrix
        if H.ndim != 2 or B.ndim != 2 or not H.is_floating_point():
            raise ValueError(
                "`emission_matrix` must be floating point of shape (obs, state), `action_matrix` "
                f"of shape (obs, action), got {H.dtype} {tuple(H.shape)} and {tuple(B.shape)}."
            )
        (obs, state), action = H.shape, B.shape[1]
        fields: list[tuple[str, Tensor, tuple[int, ...]]] = [
            ("action_matrix", B, (obs, action)),
            ("emission_offset", self.emission_offset, (obs,)),
            ("initial_mean", self.initial_mean, (state,)),
            ("emission_cov", self.emission_cov, (obs, obs)),
            ("initial_cov", self.initial_cov, (state, state)),
        ]
        if not callable(self.transition):
            raise ValueError(
                "`transition` must be a function of (mean, action), got "
                f"{type(self.transition).__name__}."
            )
        if not callable(self.transition_cov):
            fields.append(("transition_cov", self.transition_cov, (state, state)))
        for name, value in (self.mask_model._asdict() if self.mask_model else {}).items():
            fields.append((f"mask_model.{name}", value, (obs,)))
        if self.transition_jacobian is not None and not callable(self.transition_jacobian):
            fields.append(("transition_jacobian", self.transition_jacobian, (state, state)))
        if isinstance(self.transition, TransitionMLP):
            weights, biases = self.transition.weights, self.transition.biases
            if not len(weights) == len(biases) > 0:
                raise ValueError(
                    "`transition` must have at least one layer and as many biases as weights, got "
                    f"{len(biases)} and {len(weights)}."
                )
            if self.transition.activation not in ("relu", "tanh"):
                raise ValueError(
                    "`transition.activation` must be 'relu' or 'tanh', got "
                    f"{self.transition.activation!r}: pass a function of (mean, action) for others."
                )
            widths = [state + action, *(len(bias) for bias in biases[:-1]), state]
            for i, (fan_in, fan_out) in enumerate(pairwise(widths)):
                fields.append((f"transition.weights[{i}]", weights[i], (fan_out, fan_in)))
                fields.append((f"transition.biases[{i}]", biases[i], (fan_out,)))
        for name, value, shape in fields:
            if not isinstance(value, Tensor):
                raise ValueError(f"`{name}` must be a tensor, got {type(value).__name__}.")
            diagonal = name.endswith("cov") and value.shape == shape[1:]
            if value.shape != shape and not diagonal:
                either = f" or {shape[1:]}, its diagonal" if name.endswith("cov") else ""
                raise ValueError(
                    f"`{name}` must have shape {shape}{either}, got {tuple(value.shape)}: "
                    f"`emission_matrix` says (obs, state) = {(obs, state)}."
                )
            if value.dtype != H.dtype or value.device != H.device:
                raise ValueError(
                    f"`{name}` is {value.dtype} on {value.device}, `emission_matrix` {H.dtype} on "
                    f"{H.device}: all fields must agree."
                )

    def check_inputs(self, given: FilterInputs, start: tuple[int, ...]) -> None:
        """Raise unless mean and cov are ``(*start, n)``, others as reset is, of the own dtype."""
        obs, state, action = self.obs_dim, self.state_dim, self.action_dim
        own, flag, steps = self.emission_matrix.dtype, torch.bool, tuple(given.reset.shape)
        wanted: dict[str, tuple[torch.dtype, str, tuple[int, ...]]] = {
            "reset": (flag, "", steps),
            "observation": (own, " obs", (*steps, obs)),
            "observed": (flag, " obs", (*steps, obs)),
            "previous_action": (own, " action", (*steps, action)),
            "mean": (own, " state", (*start, state)),
            "use_stored_state": (flag, "", steps),
            "stored_mean": (own, " state", (*steps, state)),
            "weight": (own, " obs", (*steps, obs)),
            "cov": (own, " state, state", (*start, state, state)),
            "stored_cov": (own, " state, state", (*steps, state, state)),
        }
        for name, (dtype, word, shape) in wanted.items():
            value: Tensor | None = getattr(given, name)
            if value is None or (value.shape == shape and value.dtype == dtype):
                continue
            hint = "Was the model built for another environment? `reset` says the batch."
            if dtype is flag:
                hint = "One entry for each component, or for each step: True where it is so."
            elif value.dtype != dtype:
                hint = "Add TorchRL's DoubleToFloat to the environment, or build with dtype=."
            kinds = [str(x).removeprefix("torch.") for x in (dtype, value.dtype)]
            raise ValueError(
                f"`{name}` must be {kinds[0]} of shape (*batch,{word}) = {shape}, got {kinds[1]} "
                f"{tuple(value.shape)}. {hint}"
            )
        weight = given.weight
        if weight is None or torch.compiler.is_compiling() or weight.is_meta:
            return
        try:
            outside = bool(((weight < 0) | (weight > 1)).any())
        except RuntimeError:  # under vmap no number reaches the host
            return
        if outside:
            raise ValueError(
                f"`weight` must lie in [0, 1], got {weight.min():.3g} to {weight.max():.3g}: 1 "
                "believes a reading, 0 drops it."
            )

    @property
    def obs_dim(self) -> int:
        """Number of sensor components."""
        return self.emission_matrix.shape[0]

    @property
    def state_dim(self) -> int:
        """Number of latent components."""
        return self.emission_matrix.shape[1]

    @property
    def action_dim(self) -> int:
        """Number of action components."""
        return self.action_matrix.shape[1]

    @property
    def information_form(self) -> bool:
        """Whether a gain costs least in the information form: R diagonal and obs > state."""
        return self.emission_cov.ndim == 1 and self.obs_dim > self.state_dim

    def constant_cov(self) -> Tensor:
        """Return Q, shape ``(state, state)``; ValueError if it depends on the state."""
        if not isinstance(self.transition_cov, Tensor):
            raise ValueError(
                "`transition_cov` depends on the state here, so the covariance depends on the "
                "whole past: ask filter_sequence or filter_step for it with return_cov=True."
            )
        return as_matrix("transition_cov", self.transition_cov, self.state_dim)

    def full_emission_cov(self) -> Tensor:
        """Return R as a matrix, shape ``(obs, obs)``."""
        return as_matrix("emission_cov", self.emission_cov, self.obs_dim)

    def full_initial_cov(self) -> Tensor:
        """Return P_0 as a matrix, shape ``(state, state)``."""
        return as_matrix("initial_cov", self.initial_cov, self.state_dim)

    def offset(self, previous_action: Tensor) -> Tensor:
        """Return B a + d, shape ``(*batch, obs)``."""
        return torch.nn.functional.linear(previous_action, self.action_matrix, self.emission_offset)

    def predicted_mean(self, mean: Tensor, previous_action: Tensor, reset: Tensor) -> Tensor:
        """Return f(mean, action), or m_0 where an episode starts; reset: ``(*batch, 1)``."""
        # A NaN before an episode start would reach the transition's weights as 0 * NaN.
        mean = mean.masked_fill(reset, 0.0)
        moved = self.transition(mean, previous_action)
        if moved.shape != mean.shape:
            raise ValueError(
                f"`transition` must return means like its own, {tuple(mean.shape)}, got "
                f"{tuple(moved.shape)}."
            )
        return torch.where(reset, self.initial_mean, moved)

    def predicted_cov(self, mean: Tensor, previous_action: Tensor) -> Tensor:
        """Return Q at a mean, shape ``(state, state)`` or ``(*batch, state, state)``."""
        if isinstance(self.transition_cov, Tensor):
            return self.constant_cov()
        cov = self.transition_cov(mean, previous_action)
        if cov.shape != (*mean.shape, self.state_dim):
            raise ValueError(
                "`transition_cov` must return (*batch, state, state) = "
                f"{(*mean.shape, self.state_dim)}, got {tuple(cov.shape)}."
            )
        return cov


def propagate(jacobian: Tensor, cov: Tensor) -> Tensor:
    r"""Carry a covariance over a linear map, :math:`F \Sigma F'`, as a constant of autograd.

    float64, symmetric, and no variance over 1e6: rows and columns that would have one are scaled
    down, which leaves a covariance with the same correlations.

    Example:
        >>> propagate(2 * torch.eye(2), torch.eye(2)).diagonal().tolist()
        [4.0, 4.0]
    """
    F = jacobian.detach().double()
    moved = F @ cov.detach().double() @ F.mT
    moved = 0.5 * (moved + moved.mT)
    scale = (MAX_VARIANCE / moved.diagonal(dim1=-2, dim2=-1)).clamp(max=1.0).sqrt()
    return moved * scale.unsqueeze(-1) * scale.unsqueeze(-2)


def predict_step(
    model: StateSpace,
    mean: Tensor,
    previous_action: Tensor,
    reset: Tensor,
    cov: Tensor | None = None,
) -> Belief:
    r"""Predict one step, or start an episode from the initial belief.

    .. math::
        m^- = f(m, a), \; P^- = [F \Sigma F' +] Q; \qquad
        \text{at a reset } m^- = m_0, \; P^- = P_0

    Eq. (8) [DRBPN]; differs from the paper: with a ``transition_jacobian`` F the covariance is
    propagated, as in the extended Kalman filter (§5.2 [Särkkä 2013]). F and the covariance before
    are constants of autograd. Arguments are those of :func:`filter_step`.

    Example:
        >>> from torchrl_drbpn import BeliefFilter
        >>> model, reset = BeliefFilter(2, 1).state_space(), torch.tensor([True, False])
        >>> belief = predict_step(model, torch.ones(2, 2), torch.zeros(2, 1), reset)
        >>> torch.equal(belief.cov, torch.stack([model.full_initial_cov(), model.constant_cov()]))
        True
    """
    row = reset.unsqueeze(-1)
    predicted = model.predicted_mean(mean, previous_action, row)
    mean = mean.masked_fill(row, 0.0)
    after, F = model.predicted_cov(mean, previous_action), model.transition_jacobian
    if F is not None:
        if cov is None:
            raise ValueError("`cov` is None, but this model propagates its covariance.")
        F = F if isinstance(F, Tensor) else F(mean, previous_action)
        moved = propagate(F, cov.masked_fill(row.unsqueeze(-1), 0.0))
        after = after + moved.to(after.dtype)
    return Belief(predicted, torch.where(row.unsqueeze(-1), model.full_initial_cov(), after))
