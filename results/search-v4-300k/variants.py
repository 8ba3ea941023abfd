"""Variants of heads and updates that were tried and not kept, each behind a ``_target_``.

With PYTHONPATH=results/search-v4-300k: heads._target_=variants.make_heads and +heads.skip=true,
+heads.layer_norm=true or +heads.detach_value=true; algo._target_=variants.PPO and
+algo.belief_lr=0.3, +algo.groups=true or +algo.max_kl=0.02.
"""

from collections.abc import Iterator
from math import inf
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from training import ppo


def make_heads(
    *,
    feature_dim: int,
    obs_dim: int,
    action_dim: int,
    log_std: float,
    layer_norm: bool = False,
    skip: bool = False,
    detach_value: bool = False,
    **_: Any,
) -> tuple[ProbabilisticActor, ValueOperator]:
    """Build the recipe's heads otherwise.

    ``layer_norm``: before them; ``skip``: they read observation and mask beside the features;
    ``detach_value``: the value's gradient does not reach the belief.
    """
    keys = ["features", *["normalized_observation", "observed"] * skip]
    width = feature_dim + 2 * obs_dim * skip
    scale = AddStateIndependentNormalScale(action_dim)
    nn.init.constant_(scale.state_independent_scale, log_std)
    location = _Joined(width, action_dim, 0.01, layer_norm, False, scale)
    actor = ProbabilisticActor(
        TensorDictModule(location, in_keys=keys, out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    value = _Joined(width, 1, 1.0, layer_norm, detach_value, nn.Identity())
    return actor, ValueOperator(value, in_keys=keys)


class _Joined(nn.Module):
    """A tanh network of 2 x 64 units of several inputs, joined in their last dimension."""

    def __init__(
        self, width: int, out: int, gain: float, layer_norm: bool, detach: bool, last: nn.Module
    ) -> None:
        super().__init__()
        layers: list[nn.Module] = [nn.LayerNorm(width)] if layer_norm else []
        for inputs, outputs, size in ((width, 64, 2**0.5), (64, 64, 2**0.5), (64, out, gain)):
            linear = nn.Linear(inputs, outputs)
            nn.init.orthogonal_(linear.weight, size)
            nn.init.zeros_(linear.bias)
            layers += [linear, nn.Tanh()]
        self.network = nn.Sequential(*layers[:-1])
        self.last, self.detach = last, detach

    def forward(self, *inputs: torch.Tensor) -> Any:
        joined = torch.cat([x.to(inputs[0].dtype) for x in inputs], -1)
        return self.last(self.network(joined.detach() if self.detach else joined))


class PPO(ppo.PPO):
    """The recipe's update, otherwise.

    ``belief_lr``: the belief's learning rate, as a share of the heads'; ``groups``: gradient norms
    of belief and heads are clipped apart; ``max_kl``: an epoch whose mean approximate KL is above
    it is the last one of its rollout.
    """

    def __init__(
        self,
        agent: Any,
        *,
        belief_lr: float = 1.0,
        groups: bool = False,
        max_kl: float = inf,
        **rest: Any,
    ) -> None:
        super().__init__(agent, **rest)
        belief = list(agent.belief.parameters())
        heads = [*agent.actor.parameters(), *agent.critic.parameters()]
        self.groups = [belief, heads] if groups else [self.steps.parameters]
        self.belief_lr, self.max_kl = belief_lr, max_kl
        parts = [{"params": belief}, {"params": heads}]
        self.steps.optimizer = torch.optim.Adam(parts, lr=self.steps.lr, eps=1e-5, fused=True)

    def cut(self, data: TensorDictBase) -> Iterator[TensorDictBase]:
        """Yield the sequences of each epoch, until one has gone too far."""
        for sequences in super().cut(data):
            self.kl: list[torch.Tensor] = []
            yield sequences
            if torch.stack(self.kl).mean() > self.max_kl:
                return

    def step(self, minibatch: TensorDictBase) -> dict[str, torch.Tensor]:
        """Take one gradient step."""
        terms = dict(self.loss(minibatch).items())
        self.kl.append(terms["kl_approx"].detach())
        losses = [value for key, value in terms.items() if key.startswith("loss")]
        self.steps.optimizer.zero_grad()
        torch.autograd.backward(torch.stack(losses).sum())
        clip = torch.nn.utils.clip_grad_norm_
        norms = [clip(group, self.steps.max_grad_norm) for group in self.groups]
        belief, heads = self.steps.optimizer.param_groups
        belief["lr"] = heads["lr"] * self.belief_lr
        self.steps.optimizer.step()
        return {**terms, "grad_norm": torch.stack(norms).sum()}
