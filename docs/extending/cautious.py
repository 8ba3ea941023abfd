"""A loss of one's own: PPO that also pays for the distance to the policy that acted."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.objectives import LossModule
from training.agent import Agent
from training.ppo import make_loss


class CautiousLoss(LossModule):
    """Add ``kl_coeff`` times the approximate KL divergence to a loss.

    Args:
        loss: of the recipe.
        kl_coeff: weight.
    """

    def __init__(self, loss: LossModule, kl_coeff: float) -> None:
        super().__init__()
        self.loss, self.kl_coeff = loss, kl_coeff
        self.in_keys = loss.in_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the terms; those that begin with ``loss`` are summed by the recipe."""
        data = tensordict.copy()
        out = self.loss(data)
        far = data["action_log_prob"] - self.loss.ppo_loss.actor_network.get_dist(
            self.loss.filter_network(data)
        ).log_prob(data["action"])
        return out.set("loss_kl", self.kl_coeff * far.square().mean() / 2)


def build(agent: Agent, *, kl_coeff: float, **settings: Any) -> CautiousLoss:
    """Build it around the recipe's loss, whose settings are in conf/loss/ppo.yaml."""
    return CautiousLoss(make_loss(agent, **settings), kl_coeff)
