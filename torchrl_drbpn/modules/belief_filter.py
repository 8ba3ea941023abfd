"""The belief filter on tensors: a learned state-space model and its Kalman update."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn

from torchrl_drbpn.functional import (
    Belief,
    FilterOutput,
    StateSpace,
    filter_sequence,
    filter_step,
    predict_step,
    saturate_innovation,
)
from torchrl_drbpn.functional.gaussian import without_autocast
from torchrl_drbpn.modules.state_space import (
    CovKind,
    GaussianTransition,
    LinearGaussianEmission,
    check_dim,
    initial_covariance,
    transition_functions,
)

__all__ = ["BeliefDivergedError", "BeliefFilter"]

_MAX_DEFAULT_STATE = 32


class BeliefDivergedError(ValueError):
    """Report that the learned model left the range of its numbers; the input was sound.

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
        covariance: "constant": the predicted covariance is Q whatever came before (eq. 8).
        validate: look at values too, not only at shapes: a NaN or inf that the mask calls
            observed raises ValueError. Needs a value on the host, so it is skipped while
            compiling or exporting; switch it off under ``vmap``.
        device: of the parameters.
        dtype: of the parameters.

    Raises:
        ValueError: for a dimension under 1, parts whose dimensions disagree, an emission that is
            not affine, a covariance that is not positive definite, or another ``covariance``.

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
        covariance: Literal["constant"] = "constant",
        validate: bool = True,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        if covariance != "constant":
            raise ValueError(f"`covariance` must be 'constant', got {covariance!r}.")
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
        self.covariance, self.validate = covariance, validate
        self.transition = transition
        self.emission = emission
        self.initial_mean = nn.Parameter(torch.zeros(state_dim, device=device, dtype=dtype))
        self.initial_noise = initial_covariance(state_dim, initial_cov, initial_std, device, dtype)
        self._check_model()

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
        with without_autocast(self.initial_mean):
            mean, cov = transition_functions(self.transition)
            matrix, action_matrix, offset = self.emission.affine()
            R, initial_cov = self.emission.compact_cov(), self.initial_noise.compact()
        return StateSpace(
            mean, cov, matrix, R, action_matrix, offset, self.initial_mean, initial_cov
        )

    @torch.no_grad()
    def _check_model(self) -> None:
        """Raise on a first model that cannot be: an emission not affine, a covariance not SPD."""
        model, like = self.state_space(), self.initial_mean
        if like.is_meta:
            return
        state = like.new_full((1, self.state_dim), 2.0)
        action = like.new_full((1, self.action_dim), -3.0)
        expected = state @ model.emission_matrix.mT + model.offset(action)
        if not torch.allclose(self.emission(state, action), expected, rtol=1e-3, atol=1e-4):
            raise ValueError(
                "`emission` must be affine, H s + B a + d: its forward at (2, -3) is not what its "
                "values at 0 and at unit vectors say."
            )
        Q = model.transition_cov
        covs = {
            "transition, Q": Q if isinstance(Q, Tensor) else Q(0 * state, 0 * action),
            "emission, R": model.emission_cov,
            "initial_cov": model.initial_cov,
        }
        for name, cov in covs.items():
            full = cov.diag() if cov.ndim == 1 else cov
            _, info = torch.linalg.cholesky_ex(full.double())
            if bool((info != 0).any()) or not torch.equal(full, full.mT):
                raise ValueError(
                    f"the covariance of `{name}` is not symmetric positive definite: raise its "
                    "standard deviations, or mend its module."
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
        model = self.state_space()
        believed = observation
        if gate is not None:
            believed = saturate_innovation(
                model, mean, previous_action, observation, observed, reset, gate
            )
        # The error is about the readings as they arrived, not as they were moved.
        given = (mean, previous_action, observation, observed)
        try:
            out = filter_step(
                model, mean, previous_action, believed, observed, reset, return_cov=return_cov
            )
        except ValueError:  # a covariance network of NaN gives no covariance
            self._check_values(None, *given)
            raise
        self._check_values(out, *given)
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
        use_stored_state: Tensor | None = None,
        stored_mean: Tensor | None = None,
        return_cov: bool = False,
    ) -> FilterOutput:
        """Filter sequences, episode starts inside them included.

        Args:
            mean: filtered mean of the step before the first, shape ``(*batch, state)``.
            cov: its covariance; not read by this model, see :meth:`step`.
            previous_action: shape ``(*batch, time, action)``.
            observation: shape ``(*batch, time, obs)``; missing entries may hold anything.
            observed: bool, shape ``(*batch, time, obs)``, True = arrived.
            reset: bool, shape ``(*batch, time)``, True = start from the initial belief.

        Keyword Args:
            use_stored_state: bool, shape ``(*batch, time)``; True takes the belief of the step
                before from ``stored_mean`` instead of from the sequence.
            stored_mean: shape ``(*batch, time, state)``.
            return_cov: whether the filtered covariances are wanted.

        Returns:
            :class:`~torchrl_drbpn.functional.FilterOutput` with shapes ``(*batch, time, ...)``.

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
        given = (mean, previous_action, observation, observed)
        try:
            out = filter_sequence(
                self.state_space(), mean, previous_action, observation, observed, reset,
                use_stored_state=use_stored_state, stored_mean=stored_mean, return_cov=return_cov,
            )  # fmt: skip
        except ValueError:  # a covariance network of NaN gives no covariance
            self._check_values(None, *given)
            raise
        self._check_values(out, *given)
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
        with without_autocast(mean):
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

    def _check_values(
        self,
        out: FilterOutput | None,
        mean: Tensor,
        previous_action: Tensor,
        observation: Tensor,
        observed: Tensor,
    ) -> None:
        """Raise if the output is not finite, or there is none, and name the input that caused it.

        The mean is looked at too: where nothing was observed the likelihood is 0 whatever it is.
        """
        if not self.validate or torch.compiler.is_compiling() or observation.is_meta:
            return
        try:
            if out is not None and bool(
                (out.log_likelihood.detach().sum() + out.mean.detach().sum()).isfinite()
            ):
                return
        except RuntimeError:  # under vmap no number reaches the host
            return
        refuse_readings(observation, observed)
        for name, value in (("previous_action", previous_action), ("mean", mean)):
            if not bool(torch.isfinite(value).all()):
                raise ValueError(
                    f"`{name}` holds NaN or inf: the filter cannot start from it. Was it written "
                    "by a policy or a filter that had diverged?"
                )
        if out is None:
            return
        raise BeliefDivergedError(
            "the belief is no longer finite although every observed entry is: the learned model "
            "diverged. Lower the learning rate, or use residual=False where state > obs."
        )


def refuse_readings(observation: Tensor, observed: Tensor) -> None:
    """Raise if readings that arrived are no numbers that a filter can compute with.

    Args:
        observation: shape ``(*batch, obs)``.
        observed: bool, the same shape.

    Raises:
        ValueError: for NaN, infinite or too large readings; says which components.
    """
    largest = torch.finfo(observation.dtype).max ** 0.5
    for bad, what, remedy in (
        (observation.isnan(), "NaN", "mark them missing, for example with ObservedFromNaN"),
        (
            observation.isinf(),
            "infinite readings",
            "a sensor or a division has overflowed; set `observed` to False there "
            "(ObservedFromNaN marks NaN alone)",
        ),
        (
            observation.abs() > largest,
            f"readings over {largest:.1e}, whose squares overflow",
            "standardise them with MaskedObservationNorm, which clips, or mark them missing",
        ),
    ):
        at = (bad & observed).reshape(-1, observation.shape[-1]).any(0).nonzero().flatten().tolist()
        if at:
            raise ValueError(
                f"`observation` holds {what} in entries that `observed` calls arrived "
                f"(components {at}): {remedy}."
            )


def _describe(value: Tensor) -> str:
    return f"{str(value.dtype).removeprefix('torch.')} {tuple(value.shape)}"
