"""The belief filter on tensors: a learned state-space model and its Kalman update."""

import functools
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor, nn

from torchrl_drbpn.functional import (
    Belief,
    FilterOutput,
    Forecast,
    MaskModel,
    StateSpace,
    filter_sequence,
    filter_step,
    forecast,
    predict_step,
    robust_sequence_weights,
    smooth_sequence,
)
from torchrl_drbpn.functional.gaussian import without_autocast
from torchrl_drbpn.functional.robust import Robust, check_robust
from torchrl_drbpn.modules.belief_checks import checked, refuse_readings
from torchrl_drbpn.modules.state_space import (
    CovKind,
    GaussianTransition,
    LearnedCovariance,
    LinearGaussianEmission,
    check_choice,
    check_dim,
    jacobian_of,
    transition_functions,
)

_MAX_DEFAULT_STATE, _MIN_INITIAL_STD = 32, 1e-3


class BeliefFilter(nn.Module):
    r"""Filter partial, noisy observations into a Gaussian belief over a learned state.

    .. math::
        m^- = f(m, a), \; P = Q; \quad
        S = H P H' + R; \quad K = P H' M' (M S M')^{-1} M; \quad
        m^+ = m^- + K (x - H m^- - B a - d)

    Eq. (8), (10), (12) [DRBPN]. M selects the entries that arrived. At the first step of an episode
    the predicted belief is a learned one, N(initial_mean, initial_cov).

    Args:
        obs_dim, action_dim: components of an observation, of an action.
        state_dim: number of latent components; default ``min(obs_dim, 32)``.
        transition: a module of (mean, action) that returns the predicted (mean, cov); default
            :class:`GaussianTransition`, residual where state <= obs.
        emission: default :class:`LinearGaussianEmission`.
        initial_std: standard deviation that initial_cov starts from, state units.
        initial_cov: "diag" or "full".
        covariance: "constant": the predicted covariance is Q whatever came before (eq. 8);
            "propagated": it is F cov F' + Q, with F the derivative of the transition, so that it
            grows while nothing arrives. Train as you act: each kind learns a Q of its own.
        jacobian: what F is: "mean", the buffer that :meth:`refresh_jacobian` sets (of a new
            filter the derivative at initial_mean), so that all steps of a batch are filtered at
            once; "row", the derivative at each belief, step by step.
        robust: "huber" or "imq" gives a reading that contradicts the prediction and the other
            readings a weight under 1 (:func:`~torchrl_drbpn.functional.innovation_weights`), in
            acting and in training alike; None, as a ``mask_model`` needs it, believes every
            reading. May be set later.
        robust_threshold: standard deviations off at which the weights begin to fall.
        mask_model: whether to learn :class:`~torchrl_drbpn.functional.MaskModel` too: the
            likelihood is then that of readings and mask, the belief learns from what did not
            arrive, and the filter runs step by step.
        validate: look at values too: a NaN or inf that the mask calls observed raises ValueError.
            Needs a value on the host, so it is skipped while compiling, while exporting and under
            ``vmap``; :meth:`smooth` needs it off there.
        device, dtype: of the parameters.

    Raises:
        ValueError: for a dimension under 1, parts whose dimensions disagree, an emission that is
            not affine, a covariance that is not positive definite, or another ``covariance``.

    Example:
        >>> filter = BeliefFilter(obs_dim=5, action_dim=2)
        >>> observed, reset = torch.rand(3, 10, 5) < 0.7, torch.zeros(3, 10, dtype=torch.bool)
        >>> action, x = torch.zeros(3, 10, 2), torch.randn(3, 10, 5)
        >>> out = filter(torch.zeros(3, 5), None, action, x, observed, reset)
        >>> out.mean.shape, out.cov, out.log_likelihood.shape
        (torch.Size([3, 10, 5]), None, torch.Size([3, 10]))
    """

    mean_jacobian: Tensor

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
        covariance: Literal["constant", "propagated"] = "constant",
        jacobian: Literal["mean", "row"] = "mean",
        robust: Robust | None = None,
        robust_threshold: float = 4.0,
        mask_model: bool = False,
        validate: bool = True,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        check_choice("covariance", covariance, ("constant", "propagated"))
        check_choice("jacobian", jacobian, ("mean", "row"))
        self.obs_dim = check_dim("obs_dim", obs_dim)
        self.action_dim = check_dim("action_dim", action_dim)
        if state_dim is None:
            given = getattr(transition, "state_dim", None) or getattr(emission, "state_dim", None)
            state_dim = given or min(obs_dim, _MAX_DEFAULT_STATE)
        self.state_dim = check_dim("state_dim", state_dim)
        if not initial_std > _MIN_INITIAL_STD:
            raise ValueError(
                f"`initial_std` must be above its floor of {_MIN_INITIAL_STD}, got {initial_std}."
            )
        place: dict[str, Any] = {"device": device, "dtype": dtype}
        self.transition = transition or GaussianTransition(
            state_dim, action_dim, residual=state_dim <= obs_dim, **place
        )
        self.emission = emission or LinearGaussianEmission(obs_dim, state_dim, action_dim, **place)
        for part in ("transition", "emission"):
            for name in ("obs_dim", "action_dim", "state_dim"):
                mine = getattr(self, name)
                its = getattr(getattr(self, part), name, mine)
                if its != mine:
                    raise ValueError(
                        f"`{part}` has {name}={its}, the filter {name}={mine}: build both with "
                        "the same dimensions."
                    )
        self.covariance, self.jacobian, self.validate = covariance, jacobian, validate
        self.robust, self.robust_threshold = robust, robust_threshold
        if covariance == "propagated":
            self.register_buffer("mean_jacobian", torch.empty(state_dim, state_dim, **place))
        self.initial_mean = nn.Parameter(torch.zeros(state_dim, **place))
        self.initial_noise = LearnedCovariance(
            state_dim, initial_cov, initial_std, _MIN_INITIAL_STD, name="initial_cov", **place
        )
        self.mask_model: nn.Parameter | None = None
        if mask_model:  # intercepts, slopes
            self.mask_model = nn.Parameter(torch.zeros(2, obs_dim, **place))
        check_robust(robust, robust_threshold, self.mask_model)
        self._start_jacobian()
        self._check_model()

    def reset_parameters(self) -> None:
        """Start again, the parts included where they know how."""
        nn.init.zeros_(self.initial_mean)
        if self.mask_model is not None:
            nn.init.zeros_(self.mask_model)
        for part in self.children():
            reset = getattr(part, "reset_parameters", None)
            if callable(reset):
                reset()
        self._start_jacobian()

    def _start_jacobian(self) -> None:
        if self.covariance == "propagated":
            start = self.initial_mean.detach()
            self.refresh_jacobian(start, start.new_zeros(self.action_dim))

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
        F: Tensor | Callable[[Tensor, Tensor], Tensor] | None = None
        if self.covariance == "propagated" and self.jacobian == "mean":
            F = self.mean_jacobian
        elif self.covariance == "propagated":
            F = functools.partial(jacobian_of, self.transition)
        mask_model = None if self.mask_model is None else MaskModel(*self.mask_model)
        return StateSpace(
            mean, cov, matrix, R, action_matrix, offset, self.initial_mean, initial_cov, F,
            mask_model,
        )  # fmt: skip

    @torch.no_grad()
    def refresh_jacobian(self, mean: Tensor, previous_action: Tensor) -> None:
        """Set ``mean_jacobian`` to the mean derivative of the transition over a batch of beliefs.

        Call it once a rollout, after the epochs: in between it stays, so that what was collected
        is filtered alike in the loss. ``mean`` are filtered means, ``(*batch, state)``, and
        ``previous_action`` what followed them. A ValueError if the covariance is constant.
        """
        if self.covariance != "propagated":
            raise ValueError("`refresh_jacobian` needs a filter with covariance='propagated'.")
        self.mean_jacobian.copy_(jacobian_of(self.transition, mean, previous_action, average=True))

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
    ) -> FilterOutput:
        """Filter one step; arguments, result and errors as in :meth:`forward`, without time."""
        given = (mean, previous_action, observation, observed, reset)
        return self._run(filter_step, _weigh_step, given, {"cov": cov}, return_cov)

    def _run(
        self,
        filter: Callable[..., FilterOutput],
        weigh: Callable[..., Tensor],
        given: tuple[Tensor, ...],
        start: dict[str, Tensor | None],
        return_cov: bool,
    ) -> FilterOutput:
        """Filter, by weighted readings where the update is robust, and check what comes out."""
        model = self.state_space()

        def run() -> FilterOutput:
            weight = None
            if self.robust is not None:
                by = {"robust": self.robust, "threshold": self.robust_threshold}
                weight = weigh(model, *given, **start, **by)
            return filter(model, *given, **start, weight=weight, return_cov=return_cov)

        mean, action, *readings, _ = given
        return checked(run, self.validate, *readings, previous_action=action, mean=mean, **start)

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
        stored_cov: Tensor | None = None,
        return_cov: bool = False,
    ) -> FilterOutput:
        """Filter sequences, episode starts inside them included.

        Arguments, result and errors are those of :func:`~torchrl_drbpn.functional.filter_sequence`;
        ``cov`` may be None, and is not read, where it is constant.
        """
        given = (mean, previous_action, observation, observed, reset)
        start = {
            "cov": cov, "use_stored_state": use_stored_state, "stored_mean": stored_mean,
            "stored_cov": stored_cov,
        }  # fmt: skip
        return self._run(filter_sequence, robust_sequence_weights, given, start, return_cov)

    def predict(
        self, mean: Tensor, previous_action: Tensor, reset: Tensor, cov: Tensor | None = None
    ) -> Belief:
        """Return the belief before the observation of a step, shapes as in :meth:`step`."""
        with without_autocast(mean):
            return predict_step(self.state_space(), mean, previous_action, reset, cov)

    def smooth(
        self,
        mean: Tensor,
        cov: Tensor | None,
        previous_action: Tensor,
        observation: Tensor,
        observed: Tensor,
        reset: Tensor,
        **options: Any,
    ) -> Belief:
        """Return the beliefs given the whole sequence, see :func:`functional.smooth_sequence`."""
        if self.validate:
            refuse_readings(observation, observed)
        cov = cov if self.covariance == "propagated" else None
        return smooth_sequence(
            self.state_space(), mean, cov, previous_action, observation, observed, reset, **options
        )

    def forecast(
        self, mean: Tensor, cov: Tensor | None, action: Tensor, **options: Any
    ) -> Forecast:
        """Predict the steps ahead, see :func:`functional.forecast`."""
        cov = cov if self.covariance == "propagated" else None
        return forecast(self.state_space(), mean, cov, action, **options)


def _weigh_step(
    model: StateSpace, mean: Tensor, *inputs: Tensor, cov: Tensor | None, **options: Any
) -> Tensor:
    """Weigh the readings of one step: a sequence of one."""
    time = [x.unsqueeze(mean.ndim - 1) for x in inputs]
    return robust_sequence_weights(model, mean, *time, cov=cov, **options).squeeze(-2)
