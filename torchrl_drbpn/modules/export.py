"""One decision on plain tensors: what runs on the robot, for torch.export and AOTInductor."""

from __future__ import annotations

import copy
from dataclasses import fields

import torch
from torch import Tensor, nn

from torchrl_drbpn.functional import (
    StateSpace,
    TransitionMLP,
    filter_step,
    filtered_cov,
    saturate_innovation,
    tril_to_vector,
    zero_missing,
)
from torchrl_drbpn.functional.robust import bounded, reading_variance
from torchrl_drbpn.modules.belief_filter_module import BeliefFilterModule

__all__ = ["PolicyStep"]

_MATRICES = [field.name for field in fields(StateSpace)][1:]


class PolicyStep(nn.Module):
    r"""Decide once: update the belief with what arrived, act on it; tensors in, tensors out.

    .. math::
        m_t = m^-_t + K_t (x_t - H m^-_t - B a_{t-1} - d), \qquad a_t = \mu(m_t)

    The same numbers as the belief module followed by the policy's mean action: the equations are
    those of :class:`~torchrl_drbpn.BeliefFilter`. It is a frozen copy: later training does not
    reach it. What the parameters alone determine is computed once, here, and kept in buffers: Q H',
    P_0 H' and both innovation covariances H P H' + R, or in the information form (diagonal R,
    obs > state) the precisions and the products h_i h_i'. A step is left with one small
    factorisation, the transition network and the head. A transition of the user's own, or a Q that
    is a network, is evaluated as it is at every step. A ``gate`` of the belief module is kept.

    It has no TensorDict and no branch on values, so ``torch.export.export`` takes it, with a
    dynamic batch too, and ``torch._inductor.aoti_compile_and_package`` compiles it ahead of time.
    Observations are those that the belief module reads, normalised if the training's were.

    Args:
        belief: the belief module.
        head: maps ``features`` ``(*batch, features)`` to the action ``(*batch, action)``, or to a
            tuple that begins with it, such as (loc, scale).

    Keyword Args:
        action_low: smallest action, shape ``(action,)``, action units; None: no limit.
        action_high: largest action.

    Raises:
        TypeError: if ``belief`` is no :class:`~torchrl_drbpn.BeliefFilterModule`.
        ValueError: if only one of the two limits is given.

    Example:
        >>> import torch
        >>> from torchrl_drbpn import BeliefFilter, BeliefFilterModule
        >>> belief = BeliefFilterModule(BeliefFilter(obs_dim=5, action_dim=2))
        >>> step = PolicyStep(belief, torch.nn.Linear(5, 2))
        >>> mean, age = step.initial_state(3)
        >>> nothing = torch.zeros(3, 5, dtype=torch.bool)
        >>> first = torch.ones(3, 1, dtype=torch.bool)
        >>> zeros = torch.zeros(3, 5), nothing, torch.zeros(3, 2)
        >>> action, mean, age = step(*zeros, first, mean, age)
        >>> torch.equal(mean, belief.filter.initial_mean.expand(3, 5)), age.flatten().tolist()
        (True, [1, 1, 1])

    See also :class:`torchrl_drbpn.BeliefFilterModule`, the same with TensorDict keys.
    """

    action_low: Tensor | None
    action_high: Tensor | None

    def __init__(
        self,
        belief: BeliefFilterModule,
        head: nn.Module,
        *,
        action_low: Tensor | None = None,
        action_high: Tensor | None = None,
    ) -> None:
        super().__init__()
        if not isinstance(belief, BeliefFilterModule):
            raise TypeError(
                f"`belief` must be a BeliefFilterModule, got {type(belief).__name__}: other belief "
                "modules have recurrent states of their own."
            )
        if (action_low is None) != (action_high is None):
            raise ValueError("`action_low` and `action_high` must be given together or not at all.")
        self.policy_input, self.gate = belief.policy_input, belief.gate
        self.head = copy.deepcopy(head).requires_grad_(False)
        filter = copy.deepcopy(belief.filter).requires_grad_(False)
        with torch.no_grad():
            model = filter.state_space()
        self.form = "information" if model.information_form else "innovation"
        if not isinstance(model.transition, TransitionMLP) or not isinstance(
            model.transition_cov, Tensor
        ):
            self.form = "loop"
        self.filter = filter if self.form == "loop" else None
        self.state_dim = filter.state_dim
        for name, limit in (("action_low", action_low), ("action_high", action_high)):
            self.register_buffer(name, None if limit is None else limit.detach().clone())
        if self.form != "loop":
            self._keep_model(model)
        self.eval()

    # ------------------------------------------------------------------ what is computed once
    def _keep_model(self, model: StateSpace) -> None:
        """Put the model, and what follows from it, into buffers."""
        transition = model.transition
        assert isinstance(transition, TransitionMLP)  # the form says so; for the type checker
        self.residual, self.activation = transition.residual, transition.activation
        self.layers = len(transition.weights)
        for i, (weight, bias) in enumerate(zip(transition.weights, transition.biases, strict=True)):
            self._keep(f"weight_{i}", weight)
            self._keep(f"bias_{i}", bias)
        matrices = [getattr(model, name) for name in _MATRICES]
        for name, value in zip(_MATRICES, matrices, strict=True):
            self._keep(name, value)
        # H m + B a + d as one product with (m, a).
        self._keep("expectation", torch.cat([model.emission_matrix, model.action_matrix], -1))
        # float64, as in the belief module: what is factorised loses most digits in float32 where R
        # is small.
        given = (model.emission_matrix, model.constant_cov(), model.full_initial_cov())
        H, Q, P0 = (value.double() for value in given)
        self._keep("wide_matrix", H)
        if self.gate is not None:
            for name, P in (("deviation", Q), ("initial_deviation", P0)):
                deviation = reading_variance(H, P, model.emission_cov.double()).sqrt()
                self._keep(name, deviation.to(self.get_buffer("expectation").dtype))
        if self.form == "innovation":
            R = model.full_emission_cov().double()
            self._keep("cross", H @ Q)
            self._keep("initial_cross", H @ P0)
            self._keep("innovation_cov", H @ Q @ H.mT + R)
            self._keep("initial_innovation_cov", H @ P0 @ H.mT + R)
            self._keep("eye", torch.eye(H.shape[0], dtype=H.dtype, device=H.device))
        else:
            self._keep("inverse_noise", 1.0 / model.emission_cov.double())
            self._keep("outer", (H.unsqueeze(-1) * H.unsqueeze(-2)).flatten(-2))
            self._keep("precision", torch.linalg.inv(Q))
            self._keep("initial_precision", torch.linalg.inv(P0))

    def _keep(self, name: str, value: Tensor) -> None:
        self.register_buffer(name, value.detach().clone())

    def _model(self) -> StateSpace:
        """Return the kept model."""
        weights = tuple(self.get_buffer(f"weight_{i}") for i in range(self.layers))
        biases = tuple(self.get_buffer(f"bias_{i}") for i in range(self.layers))
        network = TransitionMLP(weights, biases, self.residual, self.activation)
        return StateSpace(network, *(self.get_buffer(name) for name in _MATRICES))

    # ------------------------------------------------------------------ one decision
    def initial_state(self, batch: int) -> tuple[Tensor, Tensor]:
        """Return mean and age before the first step, zeros, as the primer does.

        Args:
            batch: number of robots.

        Returns:
            mean ``(batch, state)`` and age int64 ``(batch, 1)``.
        """
        first = self.get_buffer("initial_mean") if self.filter is None else self.filter.initial_mean
        mean = first.new_zeros(batch, self.state_dim)
        return mean, torch.zeros(batch, 1, dtype=torch.int64, device=first.device)

    def forward(
        self,
        observation: Tensor,
        observed: Tensor,
        previous_action: Tensor,
        is_init: Tensor,
        mean: Tensor,
        age: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return the action and the state of the next step.

        Args:
            observation: shape ``(batch, obs)``; missing entries may hold anything.
            observed: bool, shape ``(batch, obs)``, True = arrived.
            previous_action: shape ``(batch, action)``, zero at the first step.
            is_init: bool, shape ``(batch, 1)``, True at the first step of an episode.
            mean: filtered mean of the step before, shape ``(batch, state)``.
            age: updates since the reset, int64, shape ``(batch, 1)``; an episode starts where
                ``is_init`` and ``age == 0``.

        Returns:
            action ``(batch, action)``, filtered mean ``(batch, state)``, ``age + 1``.
        """
        reset = is_init & (age == 0)
        if self.filter is not None:
            wants_cov = self.policy_input == "mean_cov"
            model, row = self.filter.state_space(), reset.squeeze(-1)
            if self.gate is not None:
                observation = saturate_innovation(
                    model, mean, previous_action, observation, observed, row, self.gate
                )
            out = filter_step(
                model, mean, previous_action, observation, observed, row, return_cov=wants_cov
            )
            filtered, cov = out.mean, out.cov
        else:
            filtered = self._update(observation, observed, previous_action, reset, mean)
            cov = None
            if self.policy_input == "mean_cov":
                cov = filtered_cov(self._model(), observed, reset.squeeze(-1))
        features = filtered if cov is None else torch.cat([filtered, tril_to_vector(cov)], -1)
        out_head = self.head(features)
        action = out_head[0] if isinstance(out_head, tuple) else out_head
        if self.action_low is not None and self.action_high is not None:
            action = torch.clamp(action, self.action_low, self.action_high)
        return action, filtered, age + 1

    def _update(
        self,
        observation: Tensor,
        observed: Tensor,
        previous_action: Tensor,
        reset: Tensor,
        mean: Tensor,
    ) -> Tensor:
        """Return the filtered mean of a constant-Q model; reset has shape (batch, 1)."""
        model = self._model()
        m = torch.where(reset, model.initial_mean, model.transition(mean, previous_action))
        expected = nn.functional.linear(
            torch.cat([m, previous_action], -1), self.get_buffer("expectation"),
            model.emission_offset,
        )  # fmt: skip
        if self.gate is not None:
            deviation = torch.where(
                reset, self.get_buffer("initial_deviation"), self.get_buffer("deviation")
            )
            observation = bounded(observation, observed, expected, deviation, self.gate)
        wide = self.get_buffer("wide_matrix").dtype  # float64, unless the module has been cast
        residual = zero_missing(observation - expected, observed).to(wide)
        row = reset.unsqueeze(-1)
        # cholesky_ex: its plain form looks at a value on the host to raise.
        if self.form == "innovation":
            both = observed.unsqueeze(-1) & observed.unsqueeze(-2)
            S = torch.where(
                row, self.get_buffer("initial_innovation_cov"), self.get_buffer("innovation_cov")
            )
            A = torch.where(both, S, self.get_buffer("eye"))
            factor, _ = torch.linalg.cholesky_ex(A)
            z = torch.cholesky_solve(residual.unsqueeze(-1), factor).squeeze(-1)
            pull = torch.where(
                reset, z @ self.get_buffer("initial_cross"), z @ self.get_buffer("cross")
            )
            return m + pull.to(m.dtype)
        weight = observed * self.get_buffer("inverse_noise")
        state = m.shape[-1]
        gathered = (weight @ self.get_buffer("outer")).view(*weight.shape[:-1], state, state)
        prior = torch.where(row, self.get_buffer("initial_precision"), self.get_buffer("precision"))
        factor, _ = torch.linalg.cholesky_ex(gathered + prior)
        evidence = (weight * residual) @ self.get_buffer("wide_matrix")
        return m + torch.cholesky_solve(evidence.unsqueeze(-1), factor).squeeze(-1).to(m.dtype)
