"""ACKTR: natural-gradient steps for policy and value, each inside its trust region."""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale
from torch.distributions import kl_divergence
from torchrl.objectives import LossModule
from torchrl.objectives.value import GAE
from training.agent import Agent
from training.errors import UserError
from training.ppo import GradientSteps

from algorithms.kfac import KFAC

_STEP_FACTOR = 1.5  # of baselines, as are the limits
_STEP_LIMITS = (1e-8, 1.0)


class ACKTR:
    """Fit the value, then take one natural-gradient step of the policy, on a whole rollout.

    The policy descends ``-E[advantage log p(action)]`` in the metric of its own Fisher matrix; the
    value descends its squared error, in the metric of a Gaussian of unit standard deviation around
    it (Gauss-Newton). The step size of the policy follows ``desired_kl``, nats a rollout; ``loss``,
    ``steps`` and ``gae`` are PPO's.
    """

    def __init__(
        self,
        agent: Agent,
        *,
        loss: LossModule,
        steps: GradientSteps,
        gae: GAE,
        seed: int,
        desired_kl: float,
        policy: Mapping[str, Any],
        critic: Mapping[str, Any],
    ) -> None:
        del loss, steps, gae
        if any(True for _ in agent.belief.parameters()):
            # A recurrent layer is used many times in a sequence: its Fisher matrix has no such
            # factors.
            raise UserError(
                "`algo=acktr` must have a belief module without weights (belief=none or fill); "
                "train another one with algo=ppo."
            )
        self.agent, self.desired_kl = agent, desired_kl
        own = dict(critic)
        self.critic_steps = int(own.pop("steps"))
        if not desired_kl > 0 or self.critic_steps < 1:
            raise ValueError(
                f"`desired_kl` must be positive and `critic.steps` 1 or more, "
                f"got {desired_kl} and {self.critic_steps}."
            )
        scales = [m for m in agent.actor.modules() if isinstance(m, AddStateIndependentNormalScale)]
        # The scale is the exp of its parameter: 2 nats a component, whatever the state.
        fisher = {scale.state_independent_scale: 2.0 for scale in scales}
        self.policy = KFAC(agent.actor, constant_fisher=fisher, **policy)
        self.critic = KFAC(agent.critic, **own)
        self.generator = torch.Generator().manual_seed(seed)

    def update(self, data: TensorDictBase, remaining: float) -> dict[str, float]:
        """Learn from one rollout; return losses before their steps, ``kl``, and step size."""
        del remaining
        frames = data.reshape(-1)
        loss_critic = self._fit_critic(frames)
        row = self._step_policy(frames)
        return {**row, "loss_critic": loss_critic}

    def _fit_critic(self, frames: TensorDictBase) -> float:
        inputs, target = frames.select(*self.agent.critic.in_keys), frames.get("value_target")
        losses = []
        for _ in range(self.critic_steps):
            with self.critic.recording():
                value = self.agent.critic(inputs.copy()).get("state_value")
            noise = torch.randn(value.shape, generator=self.generator)
            self.critic.observe(value, noise.to(value.device))
            loss = (value - target).square().mean() / 2
            self.critic.zero_grad()
            torch.autograd.backward(loss)
            self.critic.step()
            losses.append(loss.item())
        return losses[0]

    def _step_policy(self, frames: TensorDictBase) -> dict[str, float]:
        actor = self.agent.actor
        inputs = frames.select("features")
        advantage = frames.get("advantage").squeeze(-1)
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        with self.policy.recording():
            dist = actor.get_dist(inputs.copy())
        noise = torch.randn(dist.mean.shape, generator=self.generator).to(dist.mean.device)
        self.policy.observe(dist.mean, noise / dist.stddev.detach())
        loss = -(advantage * dist.log_prob(frames.get("action"))).mean()
        self.policy.zero_grad()
        torch.autograd.backward(loss)
        norms = [p.grad.norm() for p in actor.parameters() if p.grad is not None]
        self.policy.step()
        with torch.no_grad():
            kl = kl_divergence(dist, actor.get_dist(inputs.copy())).mean().item()
        lr = self.policy.param_groups[0]["lr"]
        for group in self.policy.param_groups:
            group["lr"] = _adapted(lr, kl, self.desired_kl)
        return {
            "loss_objective": loss.item(),
            "kl": kl,
            "grad_norm": torch.stack(norms).norm().item(),
            "lr": lr,
        }

    def state_dict(self) -> dict[str, Any]:
        """Return curvatures, momenta, step sizes, and the generator's state."""
        return {
            "policy_optimizer": self.policy.state_dict(),
            "critic_optimizer": self.critic.state_dict(),
            "curvature_generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take up a saved state."""
        self.policy.load_state_dict(state["policy_optimizer"])
        self.critic.load_state_dict(state["critic_optimizer"])
        self.generator.set_state(state["curvature_generator"])


def _adapted(lr: float, kl: float, desired_kl: float) -> float:
    """Return the next step size: smaller above twice the desired divergence, larger below half."""
    low, high = _STEP_LIMITS
    if kl > 2 * desired_kl:
        return max(low, lr / _STEP_FACTOR)
    return min(high, lr * _STEP_FACTOR) if kl < desired_kl / 2 else lr
