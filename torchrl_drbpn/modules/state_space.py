"""The learned state-space model: how the state moves, and what the sensors make of it."""

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from numbers import Integral
from typing import Literal

import torch
from torch import Tensor, nn

from torchrl_drbpn.functional import Belief, TransitionMLP
from torchrl_drbpn.functional.gaussian import full_cov, inverse_softplus, positive_std
from torchrl_drbpn.functional.smoothing import row_jacobian

CovKind = Literal["diag", "full"]
Function = Callable[[Tensor, Tensor], Tensor]


def check_dim(name: str, value: int) -> int:
    """Return a dimension as int, NumPy's integers included; ValueError where it is none."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
        raise ValueError(f"`{name}` must be an int of at least 1, got {value!r}.")
    return int(value)


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Raise ValueError unless ``value`` is one of ``choices``."""
    if value not in choices:
        raise ValueError(f"`{name}` must be one of {', '.join(choices)}, got {value!r}.")


def _tensors(layers: Iterable[nn.Module]) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Return the weights and the biases of linear layers."""
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    return tuple(layer.weight for layer in linear), tuple(layer.bias for layer in linear)


def _compact(raw: Tensor, kind: CovKind, min_std: float) -> Tensor:
    """Map free numbers to the variances of a diagonal covariance, or to a full one."""
    return positive_std(raw, min_std).square() if kind == "diag" else full_cov(raw, min_std)


class LearnedCovariance(nn.Module):
    """A learned covariance, diagonal or full, whose standard deviations have a floor."""

    def __init__(
        self,
        dim: int,
        kind: CovKind,
        init_std: float,
        min_std: float,
        device: torch.device | str | None,
        dtype: torch.dtype | None,
        name: str = "cov",
    ) -> None:
        super().__init__()
        check_choice(name, kind, ("diag", "full"))
        if not 0 < min_std < init_std:
            raise ValueError(
                "`min_std` and `init_std` must satisfy 0 < min_std < init_std, got "
                f"min_std={min_std} and init_std={init_std}: the floor keeps the likelihood "
                "bounded, and the start must lie above it."
            )
        self.kind, self.init_std, self.min_std = kind, init_std, min_std
        shape = (dim,) if kind == "diag" else (dim, dim)
        self.raw = nn.Parameter(torch.empty(shape, device=device, dtype=dtype))
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Put the standard deviations to ``init_std``."""
        start, floor = self.init_std, self.min_std
        if self.kind == "diag":
            self.raw.copy_(inverse_softplus(self.raw.new_tensor(start - floor)))
        else:
            spread = self.raw.new_tensor(start**2 - floor**2).sqrt()
            self.raw.copy_(torch.diag_embed(inverse_softplus(spread).expand(len(self.raw))))

    def compact(self) -> Tensor:
        """Return the variances (dim,) of a diagonal covariance, the matrix (dim, dim) of a full."""
        return _compact(self.raw, self.kind, self.min_std)

    def forward(self) -> Tensor:
        """Return the covariance, shape (dim, dim)."""
        cov = self.compact()
        return cov.diag() if self.kind == "diag" else cov


class GaussianTransition(nn.Module):
    r"""Predict the next latent state from the last one and the action.

    .. math:: s_t \sim N(f^\mu(s_{t-1}, a_{t-1}), Q)

    Eq. (2) and (8) [DRBPN]. f is a network of (mean, action), added to the mean where
    ``residual``. Q is a free parameter (the paper's runs) or a network of (mean, action)
    (eq. 8), which makes the filter run step by step.

    Args:
        state_dim, action_dim: components of the state, of an action.
        hidden_sizes: widths of the hidden layers of f (and of the network Q).
        activation: "relu" or "tanh".
        residual: whether f predicts the change of the mean. With state > obs the directions
            that no sensor sees become integrators and diverge: use False there, as
            :class:`~torchrl_drbpn.BeliefFilter` does by default.
        cov: "diag" or "full".
        cov_network: whether Q is a network of (mean, action).
        init_std: standard deviation Q starts from, state units.
        min_std: floor of the standard deviation, state units.
        device, dtype: of the parameters.

    Raises:
        ValueError: for a dimension under 1, an unknown choice, or a floor above the start.

    Example:
        >>> transition = GaussianTransition(state_dim=3, action_dim=2)
        >>> belief = transition(torch.zeros(5, 3), torch.zeros(5, 2))
        >>> belief.mean.shape, belief.cov.shape
        (torch.Size([5, 3]), torch.Size([5, 3, 3]))
    """

    def __init__(
        self,
        state_dim: int,
        action_dim: int,
        *,
        hidden_sizes: Sequence[int] = (64, 64),
        activation: str = "relu",
        residual: bool = True,
        cov: CovKind = "diag",
        cov_network: bool = False,
        init_std: float = 0.3,
        min_std: float = 1e-3,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        self.state_dim = check_dim("state_dim", state_dim)
        self.action_dim = check_dim("action_dim", action_dim)
        check_choice("activation", activation, ("relu", "tanh"))
        self.residual, self.activation = residual, activation
        self.cov_kind, self.init_std, self.min_std = cov, init_std, min_std

        def network(out_features: int) -> nn.ModuleList:
            sizes = [state_dim + action_dim, *hidden_sizes, out_features]
            return nn.ModuleList(
                nn.Linear(i, o, device=device, dtype=dtype) for i, o in pairwise(sizes)
            )

        self.layers = network(state_dim)
        self.cov_layers: nn.ModuleList | None = None
        start = LearnedCovariance(state_dim, cov, init_std, min_std, device, dtype)
        self.noise: LearnedCovariance | None = None if cov_network else start
        if cov_network:
            self.cov_layers = network(start.raw.numel())
            self._start_from_init_std()

    @torch.no_grad()
    def _start_from_init_std(self) -> None:
        """Make the network Q begin as the constant init_std: its last layer as the bias alone."""
        weights, biases = _tensors(self.cov_layers or ())
        start = LearnedCovariance(
            self.state_dim, self.cov_kind, self.init_std, self.min_std, biases[-1].device,
            biases[-1].dtype,
        )  # fmt: skip
        weights[-1].zero_()
        biases[-1].copy_(start.raw.flatten())

    def reset_parameters(self) -> None:
        """Start again: new weights for f, the covariance from ``init_std``."""
        for module in self.modules():
            if isinstance(module, nn.Linear | LearnedCovariance):
                module.reset_parameters()
        if self.cov_layers is not None:
            self._start_from_init_std()

    def mean_network(self) -> TransitionMLP:
        """Return f as tensors, as the native filter reads it."""
        return TransitionMLP(*_tensors(self.layers), self.residual, self.activation)

    def cov(self, mean: Tensor | None = None, action: Tensor | None = None) -> Tensor:
        """Return Q; where it is a network, of both arguments, ``(*batch, state, state)``."""
        if self.noise is not None:
            return self.noise()
        if mean is None or action is None or self.cov_layers is None:
            raise ValueError("`mean` and `action` are needed: this Q is a network of both.")
        raw = TransitionMLP(*_tensors(self.cov_layers), False, self.activation)(mean, action)
        if self.cov_kind == "full":
            raw = raw.view(*raw.shape[:-1], self.state_dim, self.state_dim)
        cov = _compact(raw, self.cov_kind, self.min_std)
        return torch.diag_embed(cov) if self.cov_kind == "diag" else cov

    def forward(self, mean: Tensor, action: Tensor) -> Belief:
        """Return the predicted belief, of ``(*batch, state)`` and ``(*batch, action)``."""
        predicted = self.mean_network()(mean, action)
        cov = self.cov(mean, action)
        return Belief(predicted, cov.expand(*predicted.shape, self.state_dim))


def jacobian_of(
    transition: nn.Module, mean: Tensor, action: Tensor, *, average: bool = False
) -> Tensor:
    """Return the derivative of a transition's mean by the mean, of each row or the average."""
    f = transition_functions(transition)[0]
    if average and isinstance(f, TransitionMLP):
        return f.jacobian(mean, action, average=True)
    rows = row_jacobian(f, mean, action)
    return rows.reshape(-1, *rows.shape[-2:]).mean(0) if average else rows


def transition_functions(
    transition: nn.Module,
) -> tuple[TransitionMLP | Function, Tensor | Function]:
    """Return f and Q as StateSpace takes them; a ``forward`` that a subclass has counts."""
    if (
        not isinstance(transition, GaussianTransition)
        or type(transition).forward is not GaussianTransition.forward
    ):
        return (lambda m, a: transition(m, a)[0]), (lambda m, a: transition(m, a)[1])
    if transition.noise is None:
        return transition.mean_network(), transition.cov
    return transition.mean_network(), transition.cov()


class LinearGaussianEmission(nn.Module):
    r"""Say what the sensors read when the state is s and the last action was a.

    .. math:: x_t = H s_t + B a_{t-1} + d + \epsilon, \qquad \epsilon \sim N(0, R)

    Eq. (3) [DRBPN]. H starts as the identity (its first columns or rows where the dimensions
    differ), B and d at zero. R's standard deviations have a floor, so that the likelihood is
    bounded: on clean data R shrinks without end otherwise.

    Args:
        obs_dim, state_dim, action_dim: components of an observation, the state, an action.
        cov: "diag" or "full", the kind of R. A diagonal R opens the information form.
        init_std: standard deviation R starts from, observation units.
        min_std: floor of the standard deviation, observation units.
        fixed_matrix: keep H = [I 0]; loses no generality where state >= obs, and keeps the
            state's units those of the observation.
        device, dtype: of the parameters.

    Raises:
        ValueError: for a dimension under 1, an unknown choice, a floor above the start, or
            ``fixed_matrix`` with state < obs.

    Example:
        >>> emission = LinearGaussianEmission(obs_dim=4, state_dim=3, action_dim=2)
        >>> emission(torch.zeros(5, 3), torch.zeros(5, 2)).shape
        torch.Size([5, 4])
    """

    def __init__(
        self,
        obs_dim: int,
        state_dim: int,
        action_dim: int,
        *,
        cov: CovKind = "diag",
        init_std: float = 0.1,
        min_std: float = 1e-2,
        fixed_matrix: bool = False,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        self.obs_dim = check_dim("obs_dim", obs_dim)
        self.state_dim = check_dim("state_dim", state_dim)
        self.action_dim = check_dim("action_dim", action_dim)
        if fixed_matrix and state_dim < obs_dim:
            raise ValueError(
                "`fixed_matrix` needs state_dim >= obs_dim, since H = [I 0] must reach every "
                f"sensor; got state_dim={state_dim}, obs_dim={obs_dim}."
            )
        matrix = torch.eye(obs_dim, state_dim, device=device, dtype=dtype)
        self.matrix: Tensor
        if fixed_matrix:
            self.register_buffer("matrix", matrix)
        else:
            self.matrix = nn.Parameter(matrix)
        self.action_matrix = nn.Parameter(matrix.new_zeros(obs_dim, action_dim))
        self.offset = nn.Parameter(matrix.new_zeros(obs_dim))
        self.noise = LearnedCovariance(obs_dim, cov, init_std, min_std, device, dtype)

    def reset_parameters(self) -> None:
        """Start again: H = [I 0], B and d zero, R from ``init_std``."""
        nn.init.eye_(self.matrix)
        nn.init.zeros_(self.action_matrix)
        nn.init.zeros_(self.offset)
        self.noise.reset_parameters()

    def affine(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return H, B and d; a ``forward`` of a subclass counts, evaluated at the unit vectors."""
        if type(self).forward is LinearGaussianEmission.forward:
            return self.matrix, self.action_matrix, self.offset
        units = torch.eye(
            1 + self.state_dim + self.action_dim, dtype=self.matrix.dtype, device=self.matrix.device
        )
        state, action = units[:, 1 : 1 + self.state_dim], units[:, 1 + self.state_dim :]
        values = self(state, action)
        offset, columns = values[0], (values[1:] - values[0]).mT
        return columns[:, : self.state_dim], columns[:, self.state_dim :], offset

    def cov(self) -> Tensor:
        """Return R, shape ``(obs, obs)``."""
        return self.noise()

    def compact_cov(self) -> Tensor:
        """Return the variances ``(obs,)`` of a diagonal R, the matrix ``(obs, obs)`` of a full."""
        return self.noise.compact()

    def forward(self, state: Tensor, previous_action: Tensor) -> Tensor:
        """Return the expected observation, of ``(*batch, state)`` and ``(*batch, action)``."""
        offset = nn.functional.linear(previous_action, self.action_matrix, self.offset)
        return state @ self.matrix.mT + offset
