"""The agent: belief module, policy head, value head, and the loss that trains them."""

from __future__ import annotations

import itertools

import torch
from beliefs import Belief
from tensordict import TensorDictBase
from tensordict.nn import (
    AddStateIndependentNormalScale,
    TensorDictModule,
    TensorDictSequential,
)
from torch import nn
from torchrl.envs import TransformedEnv
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.modules.utils import get_primers_from_module
from torchrl.objectives import ClipPPOLoss, LossModule

from torchrl_drbpn import DRBPNLoss
from training.config import HeadSettings, LossSettings

# Written by the environment on request, read by a critic on request, by a policy never.
COMPLETE = "complete_observation"


class Agent(nn.Module):
    """Hold a belief module and the two heads that read its features.

    A critic may see more than the policy, as it is left behind after training (asymmetric
    actor-critic, [Pinto et al. 2018]). It reads the complete observation beside the features, not
    in their place: the value of a policy that acts on a belief depends on that belief, and a
    critic without it is biased [Baisero and Amato 2022].

    Args:
        belief: the belief module and what belongs to it.
        obs_dim: components of an observation.
        action_dim: components of an action.
        heads: sizes and initialisation of the heads.

    Attributes:
        belief: the belief module.
        actor: the policy head, a distribution over actions given ``features``.
        critic: the value head, ``state_value`` given ``features`` and, with
            ``heads.critic_input=complete``, the complete observation.
        policy: belief module, then policy head.
        model_loss: the loss of the belief's own model, or None.
    """

    def __init__(self, belief: Belief, obs_dim: int, action_dim: int, heads: HeadSettings) -> None:
        super().__init__()
        self.belief = belief.module
        self.model_loss = belief.model_loss
        sizes = [belief.feature_dim, *heads.hidden]
        location = _mlp([*sizes, action_dim], heads.hidden_gain, heads.policy_gain)
        scale = AddStateIndependentNormalScale(action_dim)
        nn.init.constant_(scale.state_independent_scale, heads.log_std)
        self.actor = ProbabilisticActor(
            TensorDictModule(
                nn.Sequential(location, scale), in_keys=["features"], out_keys=["loc", "scale"]
            ),
            in_keys=["loc", "scale"],
            distribution_class=IndependentNormal,
            return_log_prob=True,
        )
        complete = heads.critic_input == "complete"
        width = belief.feature_dim + (obs_dim if complete else 0)
        value = _mlp([width, *heads.hidden, 1], heads.hidden_gain, heads.value_gain)
        self.critic = ValueOperator(
            _SideBySide(*value) if complete else value,
            in_keys=["features", COMPLETE] if complete else ["features"],
        )
        # Not registered a second time: its parts are above.
        self.__dict__["policy"] = TensorDictSequential(self.belief, self.actor)

    policy: TensorDictSequential

    def make_loss(self, settings: LossSettings) -> LossModule:
        """Build the loss: PPO and, where the belief has a model, its likelihood.

        Args:
            settings: its coefficients.

        Returns:
            A loss whose outputs named ``loss*`` are to be summed.
        """
        ppo = ClipPPOLoss(
            self.actor,
            self.critic,
            clip_epsilon=settings.clip_epsilon,
            entropy_bonus=settings.entropy_coeff > 0,
            entropy_coeff=settings.entropy_coeff,
            critic_coeff=settings.critic_coeff,
            loss_critic_type=settings.loss_critic_type,
            normalize_advantage=settings.normalize_advantage,
            # The recipe reports it once a rollout; here it is a fifth of the PPO loss.
            log_explained_variance=False,
            # The parameters are those of the modules: swapping them in costs a tenth of an update.
            functional=False,
        )
        return DRBPNLoss(
            self.belief,
            ppo,
            self.model_loss,
            model_coeff=settings.model_coeff,
            detach_belief=settings.detach_belief,
        )

    def value(self, tensordict: TensorDictBase) -> torch.Tensor:
        """Return V of the beliefs that are stored in a rollout.

        Args:
            tensordict: with what the critic reads, any shape.

        Returns:
            Values, shape ``(*, 1)``.
        """
        return self.critic.module(*(tensordict.get(key) for key in self.critic.in_keys))

    @torch.no_grad()
    def one_step_value(
        self, tensordict: TensorDictBase, where: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Return V of the beliefs that one step of the belief module makes of what is stored.

        A stored step holds what arrived, the action before it and the belief before it, so one
        batched step gives every belief at once: no second pass over time. Of ``data["next"]`` it
        gives the beliefs that follow, truncated and terminal steps included.

        Args:
            tensordict: a rollout or its ``"next"``, any shape.
            where: bool of that shape; the steps to value. None: all.

        Returns:
            Values, shape ``(*, 1)``; with ``where`` shape ``(count, 1)``.
        """
        keys = (*self.belief.in_keys, *self.critic.in_keys)
        read = tensordict.select(*keys, strict=False)
        single = read.reshape(-1) if where is None else read[where]
        value = self.value(self.belief(single))
        return value if where is not None else value.reshape(*tensordict.shape, 1)


class _SideBySide(nn.Sequential):
    """A network of several inputs, joined in their last dimension."""

    def forward(self, *inputs: torch.Tensor) -> torch.Tensor:
        joined = torch.cat(inputs, -1)
        return super().forward(joined)  # type: ignore[no-untyped-call]


def _mlp(sizes: list[int], hidden_gain: float, last_gain: float) -> nn.Sequential:
    """Build a tanh network with orthogonal weights and zero biases."""
    layers: list[nn.Module] = []
    for i, (inputs, outputs) in enumerate(itertools.pairwise(sizes)):
        last = i == len(sizes) - 2
        linear = nn.Linear(inputs, outputs)
        nn.init.orthogonal_(linear.weight, last_gain if last else hidden_gain)
        nn.init.zeros_(linear.bias)
        layers += [linear] if last else [linear, nn.Tanh()]
    return nn.Sequential(*layers)


def add_primers(env: TransformedEnv, agent: Agent) -> None:
    """Append the entries of the belief module's recurrent state to an environment.

    Args:
        env: the environment; changed in place.
        agent: whose belief module may be recurrent.
    """
    primers = get_primers_from_module(agent.belief, warn=False)
    if primers is not None:
        env.append_transform(primers)
