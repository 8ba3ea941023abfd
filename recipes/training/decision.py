"""The decisions of a rollout: belief, policy head, sample and log-probability in one call."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, TensorDictModuleBase
from tensordict.nn.probabilistic import interaction_type
from torch import Tensor, nn

from torchrl_drbpn import BeliefFilterModule
from torchrl_drbpn.functional import StateSpace
from torchrl_drbpn.functional.heads import PreparedPolicy, policy_refusal
from training.agent import Agent

_LOG_SQRT_2PI = math.log(math.sqrt(2 * math.pi))


class _Spread(NamedTuple):
    """Hold the scale of the policy's Gaussian and what its density needs of it."""

    scale: Tensor
    twice_variance: Tensor
    log_scale: Tensor


class RolloutPolicy(TensorDictModuleBase):
    r"""Write what ``agent.policy`` writes, without the objects around it.

    With loc and scale of the head and eps ~ N(0, 1) from the global generator:

    .. math::
        a = loc + eps \cdot scale, \qquad
        \log \pi(a) = \sum_i -\frac{(a_i - loc_i)^2}{2 scale_i^2} - \log scale_i - \log\sqrt{2\pi}

    On the CPU the head is one call of C, equal to rounding; elsewhere the operations are those of
    ``agent.policy`` run, to the last bit. Both draw the same random numbers.

    A ``ProbabilisticActor`` builds a distribution, checks its parameters and looks up keys at
    every step, which costs several times what the networks do for sixteen robots. It still decides
    where actions are not sampled (``set_exploration_type``) and where gradients are wanted.

    Args:
        agent: whose modules decide.
    """

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        belief = agent.belief
        self.belief, self.actor = belief, agent.actor
        self.in_keys, self.out_keys = list(agent.policy.in_keys), list(agent.policy.out_keys)
        # In a plain dictionary: nn.Module's attributes cost a microsecond each.
        self.__dict__["_layers"] = list(agent.location)
        self.__dict__["_widen"] = agent.scale
        self.__dict__["_filter"] = belief if isinstance(belief, BeliefFilterModule) else None
        self.refresh()

    _filter: BeliefFilterModule | None
    _model: StateSpace | None
    _layers: list[nn.Module]
    _widen: nn.Module
    _spread: _Spread | None
    _prepared: PreparedPolicy | None

    def refresh(self) -> None:
        """Forget what was computed from the parameters: to be called before every rollout."""
        self.__dict__["_spread"] = self.__dict__["_model"] = self.__dict__["_prepared"] = None

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what was computed: a copy computes its own."""
        nothing = dict.fromkeys(("_spread", "_model", "_prepared"))
        return {**super().__getstate__(), **nothing}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the belief, the action, its distribution and its log-probability.

        Args:
            tensordict: root entries of the environment.

        Returns:
            The same tensordict.
        """
        if torch.is_grad_enabled() or interaction_type() is not InteractionType.RANDOM:
            decided: TensorDictBase = self.actor(self.belief(tensordict))
            return decided
        if self._filter is None:
            tensordict = self.belief(tensordict)
        else:
            if self._model is None:
                self.__dict__["_model"] = self._filter.filter.state_space()
            tensordict = self._filter.step(tensordict, self._model)
        features: Tensor = tensordict._get_str("features", None)
        loc, scale, action, log_prob = self._decide(features)
        for key, value in (
            ("loc", loc),
            ("scale", scale),
            ("action", action),
            ("action_log_prob", log_prob),
        ):
            tensordict._set_str(key, value, validated=True, inplace=False, non_blocking=False)
        return tensordict

    def _decide(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return location, scale, action and log-probability."""
        spread = self._spread
        if spread is None or spread.scale.shape[:-1] != features.shape[:-1]:
            loc = self._locate(features)
            _, scale = self._widen(loc)
            spread = self.__dict__["_spread"] = _Spread(scale, 2 * scale**2, scale.log())
            self.__dict__["_prepared"] = self._prepare(features, scale)
        noise = torch.empty_like(spread.scale).normal_()
        prepared = self._prepared
        if prepared is not None and prepared.takes(features):
            loc, action, log_prob = prepared(features, noise)
            return loc, spread.scale, action, log_prob
        loc = self._locate(features)
        # The order of operations is that of torch.distributions.Normal: rsample, then log_prob.
        action = noise.mul_(spread.scale).add_(loc)
        log_prob = (action - loc).square_().neg_().div_(spread.twice_variance)
        log_prob = log_prob.sub_(spread.log_scale).sub_(_LOG_SQRT_2PI).sum(-1)
        return loc, spread.scale, action, log_prob

    def _locate(self, features: Tensor) -> Tensor:
        loc = features
        for layer in self._layers:
            if isinstance(layer, nn.Linear):
                loc = nn.functional.linear(loc, layer.weight, layer.bias)
            else:
                loc = layer(loc)
        return loc

    def _prepare(self, features: Tensor, scale: Tensor) -> PreparedPolicy | None:
        """Lay the head out for C, where that runs."""
        layers = [
            part
            for layer in self._layers
            if isinstance(layer, nn.Linear)
            for part in (layer.weight, layer.bias)
        ]
        spread = scale.reshape(-1, scale.shape[-1])[0].contiguous()
        if policy_refusal(layers, features, spread) is not None:
            return None
        return PreparedPolicy(layers, spread, len(features))
