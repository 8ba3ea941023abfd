"""One decision on plain tensors: what runs on the robot, for torch.export and AOTInductor."""

import copy

import torch
from torch import Tensor, nn

from torchrl_drbpn.functional import (
    Belief,
    innovation_weights,
    propagate,
    sequential_update,
    zero_missing,
)
from torchrl_drbpn.functional.gaussian import masked_cov, rounded_cov, tril_to_vector
from torchrl_drbpn.modules.belief_filter_module import BeliefFilterModule
from torchrl_drbpn.modules.normalization import MaskedObservationNorm
from torchrl_drbpn.modules.state_space import GaussianTransition, jacobian_of


class PolicyStep(nn.Module):
    r"""Decide once: update the belief with what arrived, act on it; tensors in, tensors out.

    .. math::
        m_t = m^-_t + K_t (x_t - H m^-_t - B a_{t-1} - d), \qquad a_t = \mu(m_t)

    A frozen copy of the policy's modules, one step at a time, with the mean action. It has no
    TensorDict and no branch on values, so ``torch.export.export`` takes it, with a dynamic batch
    too, and ``torch._inductor.aoti_compile_and_package`` compiles it ahead of time; its
    ``inductor_configs`` "freezing" and "max_autotune" compile the matrix products too.

    Args:
        belief: the belief module; its filter's ``robust`` is kept.
        head: maps ``features`` ``(*batch, features)`` to the action ``(*batch, action)``, or to a
            tuple that begins with it, such as (loc, scale).
        norm: standardises the observations first, where the belief reads standardised ones.
        action_low, action_high: limits of an action, shape ``(action,)``, action units; None: none.
        sequential: take the readings one by one, which needs no Cholesky factor: for ONNX.

    Raises:
        TypeError: if ``belief`` is no :class:`~torchrl_drbpn.BeliefFilterModule`.
        ValueError: if only one of the two limits is given, if the filter has a ``mask_model``, or
            for ``sequential`` with a full R or a robust update.

    Example:
        >>> from torchrl_drbpn import BeliefFilter
        >>> belief = BeliefFilterModule(BeliefFilter(obs_dim=5, action_dim=2))
        >>> step, first = PolicyStep(belief, nn.Linear(5, 2)), torch.ones(3, 1) > 0
        >>> reading = torch.zeros(3, 5), torch.zeros(3, 5) > 0, torch.zeros(3, 2)
        >>> action, mean, age, chosen, rejected = step(*reading, first, *step.initial_state(3))
        >>> torch.equal(mean, belief.filter.initial_mean.expand(3, 5)), age.flatten().tolist()
        (True, [1, 1, 1])
    """

    def __init__(
        self,
        belief: BeliefFilterModule,
        head: nn.Module,
        *,
        norm: MaskedObservationNorm | None = None,
        action_low: Tensor | None = None,
        action_high: Tensor | None = None,
        sequential: bool = False,
    ) -> None:
        super().__init__()
        if not isinstance(belief, BeliefFilterModule):
            raise TypeError(
                f"`belief` must be a BeliefFilterModule, got {type(belief).__name__}: other belief "
                "modules have recurrent states of their own."
            )
        if belief.filter.mask_model is not None:
            raise ValueError("`belief` has a `mask_model`, which PolicyStep does not read.")
        if (action_low is None) != (action_high is None):
            raise ValueError("`action_low` and `action_high` must be given together or not at all.")
        self.policy_input = belief.policy_input
        self.norm, self.filter, self.head = copy.deepcopy((norm, belief.filter, head))
        self.requires_grad_(False)
        limits = [
            x if x is None else nn.Buffer(x.detach().clone()) for x in (action_low, action_high)
        ]
        self.action_low, self.action_high = limits
        model = self.filter.state_space()
        # float64, as in the belief module: what is factorised loses most digits in float32 where R
        # is small. Of a pair the first serves within an episode, the second at its first step.
        H, R = model.emission_matrix.double().clone(), model.full_emission_cov().double()
        P0, self.constant = model.full_initial_cov(), isinstance(model.transition_cov, Tensor)
        self.propagated = model.transition_jacobian is not None
        if sequential and (model.emission_cov.ndim == 2 or self.filter.robust is not None):
            raise ValueError(
                "`sequential` needs a diagonal emission covariance and `robust` None: readings "
                "taken one by one must be independent, and a robust update compares them."
            )
        self.sequential, form = sequential, model.information_form and not sequential
        self.information = self.constant and form and not self.propagated
        P = torch.stack([model.constant_cov() if self.constant else P0, P0]).double()
        self.matrix, self.noise, self.prior = nn.Buffer(H), nn.Buffer(R), nn.Buffer(P)
        self.cross, self.innovation_cov = nn.Buffer(H @ P), nn.Buffer(H @ P @ H.mT + R)
        # H m + B a + d as one product with (m, a).
        affine = torch.cat([model.emission_matrix, model.action_matrix], -1)
        self.expectation = nn.Buffer(affine.clone())
        self.offset = nn.Buffer(model.emission_offset.clone())
        if self.information:
            self.precision, self.weight = nn.Buffer(P.inverse()), nn.Buffer(1 / R.diagonal())
            self.outer = nn.Buffer((H.unsqueeze(-1) * H.unsqueeze(-2)).flatten(-2))
        self.eval()

    def initial_state(self, batch: int) -> tuple[Tensor, ...]:
        """Return mean, age and, if propagated, cov before the first step of ``batch`` robots."""
        mean = self.filter.initial_mean.new_zeros(batch, self.filter.state_dim)
        age = torch.zeros(batch, 1, dtype=torch.int64, device=mean.device)
        cov = mean.new_zeros(batch, self.filter.state_dim, self.filter.state_dim)
        return (mean, age, cov) if self.propagated else (mean, age)

    def forward(
        self,
        observation: Tensor,
        observed: Tensor,
        previous_action: Tensor,
        is_init: Tensor,
        mean: Tensor,
        age: Tensor,
        cov: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Return the action, and what the next step reads.

        Args:
            observation: shape ``(*batch, obs)``; missing entries may hold anything. A NaN or an
                infinity that is called observed counts as missing.
            observed: bool, shape ``(*batch, obs)``, True = arrived.
            previous_action: shape ``(*batch, action)``, zero at the first step.
            is_init: bool, shape ``(*batch, 1)``, True starts from the initial belief.
            mean: filtered mean of the step before, shape ``(*batch, state)``.
            age: updates since the reset, int64, shape ``(*batch, 1)``.
            cov: filtered covariance of the step before, ``(*batch, state, state)``, where it is
                propagated.

        Returns:
            the action within its limits ``(*batch, action)``; the next ``mean`` and ``age``; the
            action as it was chosen, which is the next ``previous_action``; how many readings were
            called observed and were no finite number, int64 ``(*batch, 1)``; the next ``cov``,
            where it is propagated. A ValueError for another shape or a mask that is not bool.
        """
        filter, batch = self.filter, observation.shape[:-1]
        for name, value, width in (
            ("observation", observation, filter.obs_dim), ("observed", observed, filter.obs_dim),
            ("previous_action", previous_action, filter.action_dim), ("is_init", is_init, 1),
            ("mean", mean, filter.state_dim), ("age", age, 1),
        ):  # fmt: skip
            kind = torch.bool if name in ("observed", "is_init") else value.dtype
            if value.shape != (*batch, width) or value.dtype != kind:
                raise ValueError(
                    f"`{name}` must be {kind} of shape (*batch, {width}) with the batch of "
                    f"`observation` {tuple(batch)}, got {value.dtype} {tuple(value.shape)}."
                )
        if self.propagated and (cov is None or cov.shape != (*mean.shape, filter.state_dim)):
            given = None if cov is None else tuple(cov.shape)
            raise ValueError(
                f"`cov` must have shape {(*mean.shape, filter.state_dim)} here, where the "
                f"covariance is propagated, got {given}."
            )
        seen = observed & (observation.abs() < torch.inf)  # False for NaN too
        x = observation if self.norm is None else self.norm.normalize(observation, seen)
        x, H, first = x.to(mean.dtype), self.matrix, is_init.unsqueeze(-1)
        P = None  # of each row, where it is not one of two
        if self.constant and isinstance(filter.transition, GaussianTransition):
            moved, Q = filter.transition.mean_network()(mean, previous_action), self.prior[0]
        else:
            moved, P = filter.transition(mean, previous_action)
            P = Q = P.to(H.dtype)
        if cov is not None and self.propagated:
            F = filter.mean_jacobian
            if filter.jacobian == "row":
                F = jacobian_of(filter.transition, mean, previous_action)
            P = propagate(F, cov.masked_fill(first, 0.0)).to(H.dtype) + Q
        m = torch.where(is_init, filter.initial_mean, moved)
        wants_cov, filtered_cov = self.propagated or self.policy_input == "mean_cov", None
        # A product and a sum, not a matmul: Inductor fuses it with what surrounds it.
        cause = torch.cat([m, previous_action], -1).unsqueeze(-2)
        expected = (self.expectation * cause).sum(-1) + self.offset
        if P is not None:
            P = torch.where(first, self.prior[1], P)
            cross = H @ P
            S = cross @ H.mT + self.noise
        elif not self.information or filter.robust is not None:
            cross, S = _row(self.cross, first), _row(self.innovation_cov, first)
        residual, trust = zero_missing(x - expected, seen).to(H.dtype), seen.to(H.dtype)
        if filter.robust is not None:
            noise = self.noise.diagonal()
            trust = trust * innovation_weights(
                residual, S, noise, seen, filter.robust, filter.robust_threshold
            )
            S = S + torch.diag_embed(zero_missing(noise / trust - noise, seen))
        residual = residual.unsqueeze(-1)
        # cholesky_ex: its plain form looks at a value on the host to raise.
        if self.sequential:
            # Of the difference from the predicted mean, which is 0 before the first reading.
            P = _row(self.prior, first) if P is None else P
            change = Belief(torch.zeros_like(m, dtype=H.dtype), P)
            arrived, r = residual.squeeze(-1), self.noise.diagonal()
            step, filtered_cov = sequential_update(change, arrived, seen, H, r)
            step = step.unsqueeze(-1)
        elif self.information:
            weight = trust * self.weight
            precision = (weight @ self.outer).view(*weight.shape[:-1], *self.prior.shape[1:])
            factor, _ = torch.linalg.cholesky_ex(precision + _row(self.precision, first))
            step = torch.cholesky_solve(H.mT @ (weight.unsqueeze(-1) * residual), factor)
            filtered_cov = torch.cholesky_inverse(factor) if wants_cov else None
        else:
            factor, _ = torch.linalg.cholesky_ex(masked_cov(S, seen))
            step = cross.mT @ torch.cholesky_solve(residual, factor)
            if wants_cov:
                P = _row(self.prior, first) if P is None else P
                cross = zero_missing(cross, seen.unsqueeze(-1))
                filtered_cov = P - cross.mT @ torch.cholesky_solve(cross, factor)
        features = filtered = m + step.squeeze(-1).to(m.dtype)
        if filtered_cov is not None and self.policy_input == "mean_cov":
            features = torch.cat([filtered, tril_to_vector(filtered_cov).to(m.dtype)], -1)
        out = self.head(features)
        chosen = action = out[0] if isinstance(out, tuple) else out
        if self.action_low is not None and self.action_high is not None:
            action = torch.clamp(chosen, self.action_low, self.action_high)
        rejected = (observed ^ seen).sum(-1, keepdim=True)
        found = (action, filtered, torch.where(is_init, 0, age) + 1, chosen, rejected)
        if filtered_cov is None or not self.propagated:
            return found
        return *found, rounded_cov(filtered_cov, mean.dtype)


def _row(pair: Tensor, first: Tensor) -> Tensor:
    """Choose what serves at the first step of an episode, or within it, row by row."""
    return torch.where(first, pair[1], pair[0])
