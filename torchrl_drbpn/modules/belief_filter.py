"""The belief filter on tensors: a learned state-space model and its Kalman update."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_drbpn.functional import (
    Belief,
    FilterOutput,
    FollowedOutput,
    Following,
    MeanNetwork,
    StateSpace,
    filter_followed,
    filter_sequence,
    filter_step,
    predict_step,
    saturate_innovation,
)
from torchrl_drbpn.functional.model import Form, checked_form
from torchrl_drbpn.functional.precision import outside_autocast
from torchrl_drbpn.modules.state_space import (
    CovKind,
    GaussianTransition,
    LinearGaussianEmission,
    check_dim,
    initial_covariance,
)

__all__ = ["BeliefDivergedError", "BeliefFilter"]

_MAX_DEFAULT_STATE = 32


class BeliefDivergedError(ValueError):
    """Say that the learned model left the range of its numbers; the input was sound.

    Example:
        >>> issubclass(BeliefDivergedError, ValueError)
        True
    """


class BeliefFilter(nn.Module):
    r"""Filter partial, noisy observations into a Gaussian belief over a learned state.

    .. math::
        m^- = f(m, a), \; P = Q; \quad
        S = H P H' + R; \quad K = P H' M' (M S M')^{-1} M; \quad
        m^+ = m^- + K (x - H m^- - B a - d)

    Eq. (8), (10), (12) [DRBPN]. M selects the entries that arrived, so any subset of the sensors
    may be missing at any step. At the first step of an episode the predicted belief is a learned
    one, N(initial_mean, initial_cov).

    Args:
        obs_dim: number of sensor components.
        action_dim: number of action components.
        state_dim: number of latent components; default ``min(obs_dim, 32)``.

    Keyword Args:
        transition: a module of (mean, action) that returns the predicted (mean, cov); default
            :class:`GaussianTransition`, residual where state <= obs.
        emission: default :class:`LinearGaussianEmission`.
        initial_std: standard deviation that initial_cov starts from, state units.
        initial_cov: "diag" or "full".
        form: how sequences are computed, see :func:`torchrl_drbpn.functional.filter_sequence`.
        validate: look at values too, not only at shapes: a NaN or inf that the mask calls
            observed raises ValueError. Needs a value on the host, so it is skipped while
            compiling or exporting; switch it off under ``vmap``.
        device: of the parameters.
        dtype: of the parameters.

    Raises:
        ValueError: for a dimension under 1, parts whose dimensions disagree, or a ``form`` that
            does not fit them.

    Example:
        >>> import torch
        >>> filter = BeliefFilter(obs_dim=5, action_dim=2)
        >>> observed = torch.rand(3, 10, 5) < 0.7
        >>> out = filter(torch.zeros(3, 5), None, torch.zeros(3, 10, 2), torch.randn(3, 10, 5),
        ...              observed, torch.zeros(3, 10, dtype=torch.bool))
        >>> out.mean.shape, out.cov, out.log_likelihood.shape
        (torch.Size([3, 10, 5]), None, torch.Size([3, 10]))

    See also :class:`torchrl_drbpn.BeliefFilterModule`, the same with TensorDict keys.
    """

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        state_dim: int | None = None,
        *,
        transition: nn.Module | None = None,
        emission: LinearGaussianEmission | None = None,
        initial_std: float = 1.0,
        initial_cov: CovKind = "diag",
        form: Form = "auto",
        validate: bool = True,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        obs_dim, action_dim = check_dim("obs_dim", obs_dim), check_dim("action_dim", action_dim)
        if state_dim is None:
            given = getattr(transition, "state_dim", None) or getattr(emission, "state_dim", None)
            state_dim = given or min(obs_dim, _MAX_DEFAULT_STATE)
        state_dim = check_dim("state_dim", state_dim)
        if transition is None:
            transition = GaussianTransition(
                state_dim,
                action_dim,
                residual=state_dim <= obs_dim,
                device=device,
                dtype=dtype,
            )
        if emission is None:
            emission = LinearGaussianEmission(
                obs_dim, state_dim, action_dim, device=device, dtype=dtype
            )
        for part, module in (("transition", transition), ("emission", emission)):
            for name, mine in (
                ("obs_dim", obs_dim),
                ("action_dim", action_dim),
                ("state_dim", state_dim),
            ):
                its = getattr(module, name, mine)
                if its != mine:
                    raise ValueError(
                        f"`{part}` has {name}={its}, the filter {name}={mine}: build both with "
                        "the same dimensions."
                    )
        self.obs_dim, self.action_dim, self.state_dim = obs_dim, action_dim, state_dim
        self.form, self.validate = form, validate
        self.transition = transition
        self.emission = emission
        self.initial_mean = nn.Parameter(torch.zeros(state_dim, device=device, dtype=dtype))
        self.initial_noise = initial_covariance(state_dim, initial_cov, initial_std, device, dtype)
        self._shared: StateSpace | None = None
        checked_form(self.state_space(), form)

    def reset_parameters(self) -> None:
        """Start again, the parts included where they know how."""
        nn.init.zeros_(self.initial_mean)
        for part in self.children():
            reset = getattr(part, "reset_parameters", None)
            if callable(reset):
                reset()

    # ------------------------------------------------------------------ the model as tensors
    @property
    def initial_cov(self) -> Tensor:
        """Covariance of the belief before the first observation, shape ``(state, state)``."""
        return self.initial_noise()

    def state_space(self) -> StateSpace:
        """Return the model's tensors, built from the parameters (differentiable)."""
        return self._state_space() if self._shared is None else self._shared

    @contextmanager
    def shared_state_space(self) -> Iterator[StateSpace]:
        """Build the model's tensors once for all calls inside the block.

        For a loss that calls the filter several times: the parameters must not change inside.

        Yields:
            What :meth:`state_space` returns until the block ends.

        Example:
            >>> filter = BeliefFilter(obs_dim=5, action_dim=2)
            >>> with filter.shared_state_space() as model:
            ...     filter.state_space() is model
            True
        """
        before, self._shared = self._shared, self.state_space()
        try:
            yield self._shared
        finally:
            self._shared = before

    @outside_autocast
    def _state_space(self) -> StateSpace:
        transition = self.transition
        mean: MeanNetwork | Callable[[Tensor, Tensor], Tensor]
        cov: Tensor | Callable[[Tensor, Tensor], Tensor]
        if isinstance(transition, GaussianTransition):
            mean = transition.mean_network()
            cov = transition.cov() if transition.constant_cov else transition.cov
        else:
            mean, cov = lambda m, a: transition(m, a)[0], lambda m, a: transition(m, a)[1]
        emission = self.emission
        return StateSpace(
            mean,
            cov,
            emission.matrix,
            emission.compact_cov(),
            emission.action_matrix,
            emission.offset,
            self.initial_mean,
            self.initial_cov,
        )

    # ------------------------------------------------------------------ one step
    def step(
        self,
        mean: Tensor,
        cov: Tensor | None,
        previous_action: Tensor,
        observation: Tensor,
        observed: Tensor,
        reset: Tensor,
        *,
        return_cov: bool = False,
        model: StateSpace | None = None,
        gate: float | None = None,
    ) -> FilterOutput:
        """Filter one step.

        Args:
            mean: filtered mean of the step before, shape ``(*batch, state)``.
            cov: its covariance, shape ``(*batch, state, state)``; not read by this model, whose
                predicted covariance is Q whatever came before (eq. 8 [DRBPN]).
            previous_action: shape ``(*batch, action)``.
            observation: shape ``(*batch, obs)``; missing entries may hold anything.
            observed: bool, shape ``(*batch, obs)``, True = arrived.
            reset: bool, shape ``(*batch,)``, True = start from the initial belief.

        Keyword Args:
            return_cov: whether the filtered covariance is wanted.
            model: what :meth:`state_space` returned, for many steps with the same parameters; it
                is built anew by default.
            gate: readings further than about this many standard deviations from their forecast
                are filtered as if they lay at that distance, and the likelihood is that of these,
                see :func:`torchrl_drbpn.functional.saturate_innovation`; None: believe them all.

        Returns:
            :class:`~torchrl_drbpn.functional.FilterOutput`: mean, cov (None where not asked
            for), log_likelihood.

        Raises:
            ValueError: for a shape, a dtype, a gate or an observed value that cannot be.
        """
        del cov
        self._check_shapes(mean, previous_action, observation, observed, reset)
        model = self.state_space() if model is None else model
        believed = observation
        if gate is not None:
            believed = saturate_innovation(
                model, mean, previous_action, observation, observed, reset, gate
            )
        out = filter_step(
            model,
            mean,
            previous_action,
            believed,
            observed,
            reset,
            return_cov=return_cov,
            form=self.form,
        )
        # What arrived, not what a belief gone astray has made of it: the error names the cause.
        self._check_values(out, mean, previous_action, observation, observed)
        return out

    # ------------------------------------------------------------------ a sequence
    def forward(
        self,
        mean: Tensor,
        cov: Tensor | None,
        previous_action: Tensor,
        observation: Tensor,
        observed: Tensor,
        reset: Tensor,
        *,
        restart: Tensor | None = None,
        restart_mean: Tensor | None = None,
        following: Following | None = None,
        return_cov: bool = False,
    ) -> FilterOutput | FollowedOutput:
        """Filter sequences, episode starts inside them included.

        Args:
            mean: filtered mean of the step before the first, shape ``(*batch, state)``.
            cov: its covariance; not read by this model, see :meth:`step`.
            previous_action: shape ``(*batch, time, action)``.
            observation: shape ``(*batch, time, obs)``; missing entries may hold anything.
            observed: bool, shape ``(*batch, time, obs)``, True = arrived.
            reset: bool, shape ``(*batch, time)``, True = start from the initial belief.

        Keyword Args:
            restart: bool, shape ``(*batch, time)``; True takes the belief of the step before
                from ``restart_mean`` instead of from the sequence.
            restart_mean: shape ``(*batch, time, state)``.
            following: observations that come after some of the steps and are no steps themselves,
                whose likelihood is wanted.
            return_cov: whether the filtered covariances are wanted.

        Returns:
            :class:`~torchrl_drbpn.functional.FilterOutput` with shapes ``(*batch, time, ...)``;
            with ``following`` a :class:`~torchrl_drbpn.functional.FollowedOutput`.

        Raises:
            ValueError: for a shape, a dtype or an observed value that cannot be.
        """
        del cov
        self._check_shapes(None, previous_action, observation, observed, reset)
        if mean.shape[-1:] != (self.state_dim,) or mean.shape[:-1] != reset.shape[:-1]:
            raise ValueError(
                "`mean` must be the belief before the first step, of shape (*batch, state) = "
                f"{(*reset.shape[:-1], self.state_dim)}, got {tuple(mean.shape)}."
            )
        if following is not None:
            self._check_following(following, previous_action.dtype)
        sequence = (mean, previous_action, observation, observed, reset)
        how: dict[str, Any] = {
            "restart": restart,
            "restart_mean": restart_mean,
            "return_cov": return_cov,
            "form": self.form,
        }
        out: FilterOutput | FollowedOutput
        if following is None:
            out = filter_sequence(self.state_space(), *sequence, **how)
        else:
            out = filter_followed(self.state_space(), *sequence, following, **how)
        self._check_values(out, mean, previous_action, observation, observed, following)
        return out

    def predict(self, mean: Tensor, previous_action: Tensor, reset: Tensor) -> Belief:
        """Return the predicted belief, shapes as in :meth:`step`.

        Args:
            mean: filtered mean of the step before, shape ``(*batch, state)``.
            previous_action: shape ``(*batch, action)``.
            reset: bool, shape ``(*batch,)``.

        Returns:
            The belief before the observation of this step.
        """
        return predict_step(self.state_space(), mean, previous_action, reset)

    # ------------------------------------------------------------------ checks
    def _check_shapes(
        self,
        mean: Tensor | None,
        previous_action: Tensor,
        observation: Tensor,
        observed: Tensor,
        reset: Tensor,
    ) -> None:
        batch = tuple(reset.shape)
        if observed.dtype is not torch.bool or observed.shape != (*batch, self.obs_dim):
            raise ValueError(
                f"`observed` must be bool of shape (*batch, obs) = {(*batch, self.obs_dim)}, got "
                f"{_describe(observed)}: one entry per sensor component, True where it arrived."
            )
        if reset.dtype is not torch.bool:
            raise ValueError(f"`reset` must be bool of shape (*batch,), got {_describe(reset)}.")
        wanted = [
            ("observation", observation, self.obs_dim, "obs"),
            ("previous_action", previous_action, self.action_dim, "action"),
        ]
        if mean is not None:
            wanted.append(("mean", mean, self.state_dim, "state"))
        for name, value, dim, word in wanted:
            if value.shape != (*batch, dim):
                raise ValueError(
                    f"`{name}` must have shape (*batch, {word}) = {(*batch, dim)}, got "
                    f"{_describe(value)}. Was the filter built for another environment?"
                )
        dtype = self.initial_mean.dtype
        for name, value, _, _ in wanted:
            if value.dtype != dtype:
                raise ValueError(
                    f"`{name}` is {value.dtype}, the filter's parameters are {dtype}: add "
                    "TorchRL's DoubleToFloat to the environment, or build the filter with dtype=."
                )

    def _check_following(self, following: Following, dtype: torch.dtype) -> None:
        """Raise on shapes or dtypes of what follows that cannot be."""
        step, action, x, observed = following
        count = len(step) if step.ndim == 1 else -1
        wanted = (
            ("step", step, (count,), torch.int64),
            ("previous_action", action, (count, self.action_dim), dtype),
            ("observation", x, (count, self.obs_dim), dtype),
            ("observed", observed, (count, self.obs_dim), torch.bool),
        )
        for name, value, shape, kind in wanted:
            if value.shape != shape or value.dtype != kind:
                raise ValueError(
                    f"`following.{name}` must be {str(kind).removeprefix('torch.')} of shape "
                    f"{shape if count >= 0 else '(count,)'}, got {_describe(value)}: one row for "
                    "every place in (*batch, time) flattened after which an observation follows."
                )

    def _check_values(
        self,
        out: FilterOutput | FollowedOutput,
        mean: Tensor,
        previous_action: Tensor,
        observation: Tensor,
        observed: Tensor,
        following: Following | None = None,
    ) -> None:
        """Raise on a value that cannot be; a few sums and one number on the host tell.

        The mean is looked at too: where nothing was observed the likelihood is 0 whatever it is.
        """
        if not self.validate or torch.compiler.is_compiling():
            return
        total = out.log_likelihood.detach().sum() + out.mean.detach().sum()
        if isinstance(out, FollowedOutput):
            total = total + out.following_log_likelihood.detach().sum()
        if bool(torch.isfinite(total)):
            return
        bad = observed & ~torch.isfinite(observation)
        actions = [previous_action]
        if following is not None:
            beside = following.observed & ~torch.isfinite(following.observation)
            bad = torch.cat([bad.flatten(0, -2), beside])
            actions.append(following.previous_action)
        if bool(bad.any()):
            components = bad.flatten(0, -2).any(0).nonzero().flatten().tolist()
            raise ValueError(
                "`observation` holds NaN or inf in entries that `observed` calls arrived "
                f"(components {components}): mark them missing, for example with "
                "ObservedFromNaN."
            )
        for name, value in (*(("previous_action", action) for action in actions), ("mean", mean)):
            if not bool(torch.isfinite(value).all()):
                raise ValueError(
                    f"`{name}` holds NaN or inf: the filter cannot start from it. Was it written "
                    "by a policy or a filter that had diverged?"
                )
        raise BeliefDivergedError(
            "the belief is no longer finite although every observed entry is: the learned model "
            "diverged. Lower the learning rate, or use residual=False where state > obs."
        )


def _describe(value: Tensor) -> str:
    return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
