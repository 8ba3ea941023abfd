"""One decision on plain tensors: what runs on the robot, for torch.export and AOTInductor."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from torchrl_drbpn.functional import tril_to_vector, zero_missing
from torchrl_drbpn.functional.robust import bounded
from torchrl_drbpn.modules.belief_filter_module import BeliefFilterModule
from torchrl_drbpn.modules.normalization import MaskedObservationNorm

__all__ = ["PolicyStep"]


class PolicyStep(nn.Module):
    r"""Decide once: update the belief with what arrived, act on it; tensors in, tensors out.

    .. math::
        m_t = m^-_t + K_t (x_t - H m^-_t - B a_{t-1} - d), \qquad a_t = \mu(m_t)

    The numbers of the policy's modules one step at a time, with the mean action, as a frozen copy:
    later training does not reach it. What the parameters alone determine is computed once, here,
    and kept in buffers. It has no TensorDict and no branch on
    values, so ``torch.export.export`` takes it, with a dynamic batch too, and
    ``torch._inductor.aoti_compile_and_package`` compiles it ahead of time.

    Args:
        belief: the belief module; its ``gate`` is kept.
        head: maps ``features`` ``(*batch, features)`` to the action ``(*batch, action)``, or to a
            tuple that begins with it, such as (loc, scale).

    Keyword Args:
        norm: standardises the observations first, where the belief reads standardised ones.
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
        >>> nothing, first = torch.zeros(3, 5, dtype=torch.bool), torch.ones(3, 1, dtype=torch.bool)
        >>> zeros = torch.zeros(3, 5), nothing, torch.zeros(3, 2)
        >>> action, mean, age, chosen, rejected = step(*zeros, first, mean, age)
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
        norm: MaskedObservationNorm | None = None,
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
        self.norm, self.filter, self.head = copy.deepcopy((norm, belief.filter, head))
        self.requires_grad_(False)
        for name, limit in (("action_low", action_low), ("action_high", action_high)):
            self.register_buffer(name, None if limit is None else limit.detach().clone())
        with torch.no_grad():
            model = self.filter.state_space()
        H, R, Q = model.emission_matrix.double(), model.emission_cov.double(), model.transition_cov
        # float64, as in the belief module: what is factorised loses most digits in float32 where R
        # is small. Of each pair the first serves within an episode, the second at its first step.
        covs = [P.double() for P in (Q, model.initial_cov) if isinstance(P, Tensor)]
        self.constant = len(covs) == 2
        self.information = self.constant and R.ndim == 1 and H.shape[0] > H.shape[1]
        P = torch.stack([P.diag() if P.ndim == 1 else P for P in (covs[0], covs[-1])])
        S = H @ P @ H.mT + (R.diag() if R.ndim == 1 else R)
        kept = {"matrix": H, "prior": P, "cross": H @ P, "innovation_cov": S}
        kept |= {"noise": R.diag() if R.ndim == 1 else R, "eye": torch.eye(len(H)).to(H)}
        if self.information:
            kept |= {"precision": torch.linalg.inv(P), "weight": 1 / R}
            kept["outer"] = (H.unsqueeze(-1) * H.unsqueeze(-2)).flatten(-2)
        for name, value in kept.items():
            self.register_buffer(name, value.detach().clone())
        self.eval()

    def initial_state(self, batch: int) -> tuple[Tensor, Tensor]:
        """Return mean and age before the first step, zeros, as the primer does.

        Args:
            batch: number of robots.

        Returns:
            mean ``(batch, state)`` and age int64 ``(batch, 1)``.
        """
        mean = self.filter.initial_mean.new_zeros(batch, self.filter.state_dim)
        return mean, torch.zeros(batch, 1, dtype=torch.int64, device=mean.device)

    def forward(
        self,
        observation: Tensor,
        observed: Tensor,
        previous_action: Tensor,
        is_init: Tensor,
        mean: Tensor,
        age: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return the action, and what the next step reads.

        Args:
            observation: shape ``(*batch, obs)``; missing entries may hold anything. A NaN or an
                infinity that is called observed counts as missing.
            observed: bool, shape ``(*batch, obs)``, True = arrived.
            previous_action: shape ``(*batch, action)``, zero at the first step.
            is_init: bool, shape ``(*batch, 1)``, True starts from the initial belief.
            mean: filtered mean of the step before, shape ``(*batch, state)``.
            age: updates since the reset, int64, shape ``(*batch, 1)``.

        Returns:
            the action within its limits ``(*batch, action)``; the next ``mean`` and ``age``; the
            action as it was chosen, which is the next ``previous_action``, since that is what the
            belief was trained on; how many readings were called observed and were no finite
            number, int64 ``(*batch, 1)``.

        Raises:
            ValueError: for another shape, or a mask or ``is_init`` that is not bool.
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
        seen = observed & observation.isfinite()
        x = zero_missing(observation, seen)
        x = (x if self.norm is None else self.norm.normalize(x, seen)).to(mean.dtype)
        moved, cov = filter.transition(mean, previous_action)
        m = torch.where(is_init, filter.initial_mean, moved)
        expected = filter.emission(m, previous_action)
        kept, wants_cov = self.get_buffer, self.policy_input == "mean_cov"
        H = kept("matrix")
        if not self.constant:
            P = torch.where(is_init.unsqueeze(-1), kept("prior")[1], cov.to(H.dtype))
            cross = H @ P
            S = cross @ H.mT + kept("noise")
        elif not self.information or self.gate is not None:
            cross, S = self._pair("cross", is_init), self._pair("innovation_cov", is_init)
        if self.gate is not None:
            deviation = S.diagonal(dim1=-2, dim2=-1).sqrt().to(x.dtype)
            x = bounded(x, seen, expected, deviation, self.gate)
        residual = zero_missing(x - expected, seen).to(H.dtype).unsqueeze(-1)
        # cholesky_ex: its plain form looks at a value on the host to raise.
        if self.information:
            weight = seen * kept("weight")
            precision = (weight @ kept("outer")).view(*weight.shape[:-1], *kept("prior").shape[1:])
            factor, _ = torch.linalg.cholesky_ex(precision + self._pair("precision", is_init))
            step = torch.cholesky_solve(H.mT @ (weight.unsqueeze(-1) * residual), factor)
            cov = torch.cholesky_inverse(factor) if wants_cov else cov
        else:
            both = seen.unsqueeze(-1) & seen.unsqueeze(-2)
            factor, _ = torch.linalg.cholesky_ex(torch.where(both, S, kept("eye")))
            step = cross.mT @ torch.cholesky_solve(residual, factor)
            if wants_cov:
                P = self._pair("prior", is_init) if self.constant else P
                cross = zero_missing(cross, seen.unsqueeze(-1))
                cov = P - cross.mT @ torch.cholesky_solve(cross, factor)
        features = filtered = m + step.squeeze(-1).to(m.dtype)
        if wants_cov:
            features = torch.cat([filtered, tril_to_vector(cov).to(m.dtype)], -1)
        out = self.head(features)
        chosen = action = out[0] if isinstance(out, tuple) else out
        if self.action_low is not None and self.action_high is not None:
            action = torch.clamp(chosen, self.action_low, self.action_high)
        rejected = (observed & ~seen).sum(-1, keepdim=True)
        return action, filtered, torch.where(is_init, 0, age) + 1, chosen, rejected

    def _pair(self, name: str, is_init: Tensor) -> Tensor:
        """Choose between what serves within an episode and at its first step, row by row."""
        within, first = self.get_buffer(name)
        return torch.where(is_init.unsqueeze(-1), first, within)
