"""Clipped PPO, and the likelihood of the belief's own model, by Adam over minibatches."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.modules.utils import get_primers_from_module
from training.agent import Agent
from training.config import Settings
from training.rollout import (
    copy_advantages,
    make_gae,
    minibatches,
    recompute_advantages,
    to_sequences,
)

_NAMES = {"kl_approx": "kl", "ESS": "ess"}


class PPO:
    """Take epochs of minibatch steps on one loss over belief, policy and value.

    Args:
        agent: whose parameters are changed.
        settings: of the run; ``loss`` and ``optim`` are this algorithm's, ``seed`` orders the
            minibatches.

    Attributes:
        loss: its outputs named ``loss*`` are summed.
        gae: estimator of advantages, where they are recomputed.
        sequence_length: time steps of a sequence; 1 where the belief has no memory.
        optimizer: Adam over all parameters of the agent.
        generator: of the order of minibatches.
    """

    def __init__(self, agent: Agent, settings: Settings) -> None:
        self.agent, self.optim = agent, settings.optim
        self.loss = agent.make_loss(settings.loss)
        self.gae = make_gae(settings.loss)
        # Without memory no gradient flows through time: steps drawn one by one depend less on each
        # other than sequences do, and train better for nothing (docs/reproduction.md).
        recurrent = get_primers_from_module(agent.belief, warn=False) is not None
        self.sequence_length = settings.optim.sequence_length if recurrent else 1
        self.optimizer = torch.optim.Adam(
            agent.parameters(), lr=settings.optim.lr, eps=settings.optim.eps, fused=True
        )
        self.generator = torch.Generator().manual_seed(settings.seed)

    def update(self, data: TensorDictBase, remaining: float) -> dict[str, float]:
        """Take the gradient steps of one rollout.

        Args:
            data: rollout of batch size ``(environments, time)`` with advantages.
            remaining: share of the run still to come; the learning rate falls with it.

        Returns:
            The means of what the loss reports, and the learning rate.
        """
        lr = self.optim.lr * remaining
        return {**_update(self, data, lr), "lr": lr}

    def epochs(self, data: TensorDictBase) -> Iterator[TensorDict]:
        """Yield what the minibatches of each epoch are cut from.

        Args:
            data: rollout of batch size ``(environments, time)`` with advantages; they are
                changed in place where they are recomputed.

        Yields:
            Sequences, batch size ``(environments * time / length, length)``; the same object with
            other advantages where they are recomputed.
        """
        sequences = to_sequences(data, self.loss, self.sequence_length)
        for epoch in range(self.optim.epochs):
            if epoch and self.optim.recompute_advantages:
                recompute_advantages(data, self.agent, self.gae)
                copy_advantages(data, sequences)
            yield sequences

    def state_dict(self) -> dict[str, Any]:
        """Return the optimiser's state and the generator's.

        Returns:
            Entries of the checkpoint, by name.
        """
        return {
            "optimizer": self.optimizer.state_dict(),
            "minibatch_generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take up a saved state.

        Args:
            state: a checkpoint.
        """
        self.optimizer.load_state_dict(state["optimizer"])
        self.generator.set_state(state["minibatch_generator"])


def _update(ppo: PPO, data: TensorDictBase, lr: float) -> dict[str, float]:
    """Take the gradient steps of one rollout; return the means of what the loss reports."""
    optimizer, loss, optim = ppo.optimizer, ppo.loss, ppo.optim
    parameters = list(ppo.agent.parameters())
    for group in optimizer.param_groups:
        group["lr"] = lr
    seen: dict[str, list[torch.Tensor]] = {}
    for sequences in ppo.epochs(data):
        for minibatch in minibatches(sequences, optim.minibatches, ppo.generator):
            out = loss(minibatch)
            terms = {key: value for key, value in out.items() if isinstance(value, torch.Tensor)}
            total = sum(value for key, value in terms.items() if key.startswith("loss"))
            assert isinstance(total, torch.Tensor)
            optimizer.zero_grad()
            torch.autograd.backward(total)
            terms["grad_norm"] = torch.nn.utils.clip_grad_norm_(parameters, optim.max_grad_norm)
            optimizer.step()
            for key, value in terms.items():
                seen.setdefault(key, []).append(value.detach())
    means = {key: torch.stack(values).mean() for key, values in seen.items()}
    return {_NAMES.get(key, key): mean.item() for key, mean in means.items()}


def build(settings: Settings, agent: Agent) -> PPO:
    """Build PPO.

    Args:
        settings: of the run.
        agent: whose parameters it changes.

    Returns:
        The algorithm.
    """
    return PPO(agent, settings)
