"""From a collected rollout to minibatches: values, advantages, sequences."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torchrl.objectives import LossModule
from torchrl.objectives.value import GAE

from training.agent import Agent
from training.config import LossSettings

_ESTIMATES = ("advantage", "value_target", "state_value")


def make_gae(settings: LossSettings) -> GAE:
    """Build TorchRL's estimator of advantages from values that are there already.

    Args:
        settings: discount and lambda.

    Returns:
        The estimator; it reads the scaled reward.
    """
    gae = GAE(gamma=settings.gamma, lmbda=settings.lmbda, value_network=None)
    gae.set_keys(reward="scaled_reward")
    return gae


@torch.no_grad()
def recompute_advantages(data: TensorDictBase, agent: Agent, gae: GAE) -> None:
    """Write values and advantages by the current parameters into a rollout.

    Every belief is taken one step on from the stored one before it, by the current parameters, in
    one batched step: exact for a belief without memory. With memory, what lies before that step is
    as old as the beliefs that the sequences of the update start from.

    Args:
        data: rollout of batch size ``(environments, time)``; changed in place.
        agent: the agent as it is now.
        gae: see :func:`make_gae`.
    """
    data.set("state_value", agent.one_step_value(data))
    _estimate(data, agent, gae)


@torch.no_grad()
def add_advantages(data: TensorDictBase, agent: Agent, gae: GAE) -> None:
    """Write values and advantages into a rollout.

    Args:
        data: rollout of batch size ``(environments, time)`` with stored features; changed in place.
        agent: whose critic values the beliefs; its parameters are those that collected the rollout.
        gae: see :func:`make_gae`.
    """
    data.set("state_value", agent.value(data))
    _estimate(data, agent, gae)


def _estimate(data: TensorDictBase, agent: Agent, gae: GAE) -> None:
    """Write next values and advantages beside the values.

    Where an episode goes on, the belief that follows a step is the one stored at the next step, and
    so is its value: only where one ends, or the rollout is cut, is there another one to value.
    """
    value, following = data.get("state_value"), data.get("next")
    ends = following.get("done").squeeze(-1).clone()
    ends[:, -1] = True
    next_value = torch.cat([value[:, 1:], value[:, :1]], 1)
    next_value[ends] = agent.one_step_value(following, ends)
    following.set("state_value", next_value)
    gae(data)


def copy_advantages(data: TensorDictBase, sequences: TensorDict) -> None:
    """Bring values and advantages of a rollout into the sequences that were cut from it.

    Args:
        data: rollout of batch size ``(environments, time)``.
        sequences: from :func:`to_sequences`; changed in place.
    """
    for key in _ESTIMATES:
        sequences.get(key).copy_(data.get(key).reshape(*sequences.shape, 1))


def to_sequences(data: TensorDictBase, loss: LossModule, length: int) -> TensorDict:
    """Cut a rollout into sequences and keep what the loss reads.

    The last step of each environment is marked ``final``: the rollout ends there, so that the
    observation after it is nobody's root step and its likelihood is counted here. Where sequences
    are cut from each other nothing is marked.

    Args:
        data: rollout of batch size ``(environments, time)`` with advantages.
        loss: the loss that reads the sequences.
        length: time steps of a sequence; divides the rollout.

    Returns:
        Contiguous tensors, batch size ``(environments * time / length, length)``.
    """
    final = torch.zeros(*data.shape, 1, dtype=torch.bool)
    final[:, -1] = True
    tensors: dict[NestedKey, torch.Tensor] = {"final": final}
    for key in (*loss.in_keys, *_ESTIMATES):
        value = data.get(key, None)
        if value is not None:
            tensors[key] = value
    rows = data.shape[0] * data.shape[1] // length
    out = TensorDict({}, batch_size=[rows, length])
    for key, value in tensors.items():
        out.set(key, value.reshape(rows, length, *value.shape[2:]).contiguous())
    return out


def minibatches(
    sequences: TensorDict, count: int, generator: torch.Generator
) -> Iterator[TensorDictBase]:
    """Yield the sequences in random order, each once.

    Args:
        sequences: batch size ``(sequences, time)``.
        count: minibatches; divides the number of sequences.
        generator: of the order.

    Yields:
        Minibatches of batch size ``(sequences / count, time)``.
    """
    order = torch.randperm(sequences.shape[0], generator=generator)
    # One gather an epoch; the minibatches are views of it.
    yield from sequences[order].split(sequences.shape[0] // count)


def realised_missing_ratio(data: TensorDictBase) -> float:
    """Return the share of entries that did not arrive, over all components.

    Args:
        data: rollout with ``observed``.

    Returns:
        The ratio, in [0, 1].
    """
    return 1.0 - data.get("observed").to(torch.float64).mean().item()


def log_likelihood_per_entry(data: TensorDictBase) -> float | None:
    """Return the mean log-likelihood of an entry that arrived, as the belief saw it coming.

    Args:
        data: rollout with ``observed`` and, where the belief has a model,
            ``("belief", "log_likelihood")``.

    Returns:
        Nats per observed entry of normalised observation; None where there is no model.
    """
    value = data.get(("belief", "log_likelihood"), None)
    if value is None:
        return None
    return (value.sum() / data.get("observed").sum().clamp_min(1)).item()


def explained_variance(data: TensorDictBase) -> float:
    """Return the share of the returns' variance that the values explain.

    Args:
        data: rollout with ``state_value`` and ``value_target``.

    Returns:
        ``1 - var(target - value) / var(target)``; 0 where the targets do not vary.
    """
    target, value = data.get("value_target"), data.get("state_value")
    spread = target.var()
    return (1 - (target - value).var() / spread).item() if spread > 0 else 0.0
