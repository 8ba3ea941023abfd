"""The terms of a ClipPPOLoss on plain tensors, for the heads that nearly every agent has."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torchrl.modules import IndependentNormal
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.utils import distance_loss

from torchrl_drbpn.functional.heads import clipped_heads
from torchrl_drbpn.objectives._filtered import hooked

_LOG_2PI = math.log(2 * math.pi)


class _ClippedGain(torch.autograd.Function):
    """Minus the mean of min(w A, clip(w) A), w the ratio of a Gaussian policy to the old one."""

    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, Tensor, Tensor]:
        """Return the objective, log w, and log w clipped; only the first has a gradient."""
        loc, scale, action, old_log_prob, advantage, low, high = args
        z = (action - loc) / scale
        square = z * z
        log_prob = -(0.5 * square + scale.log()).sum(-1) - 0.5 * _LOG_2PI * loc.shape[-1]
        log_ratio = log_prob - old_log_prob
        clipped = log_ratio.clamp(low, high)
        gain, clipped_gain = log_ratio.exp() * advantage, clipped.exp() * advantage
        # d(w A) / d log w = w A; the clipped gain is the smaller one where its own gradient is 0.
        by = torch.where(gain > clipped_gain, 0.0, gain).unsqueeze(-1) * (-1.0 / gain.numel())
        by = by / scale
        ctx.save_for_backward(by * z, by * (square - 1.0))
        ctx.mark_non_differentiable(log_ratio, clipped)
        ctx.set_materialize_grads(False)
        return -torch.minimum(gain, clipped_gain).mean(), log_ratio, clipped

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, *_: Any) -> tuple[Tensor | None, ...]:
        """Return the gradients by location and scale."""
        by_loc, by_scale = ctx.saved_tensors
        return grad * by_loc, grad * by_scale, None, None, None, None, None


def plain_terms(
    ppo: ClipPPOLoss,
    heads: tuple[TensorDictModule, TensorDictModule],
    data: TensorDictBase,
    written: Mapping[NestedKey, Tensor],
) -> dict[str, Tensor]:
    """Compute what ``ppo`` returns without a TensorDict or a distribution in between.

    A quarter of the time of ClipPPOLoss, whose own operations on a minibatch of some hundred frames
    are few; two tanh networks on the CPU take one call of C each way. Held to it by test, in values
    and gradients. Both terms are then one node of the graph: to differentiate them one by one,
    retain it, as the belief below them demands anyway.

    Args:
        ppo: the loss; nothing of it is changed.
        heads: of :func:`plain_heads`.
        data: what it would be called with.
        written: entries that are read in place of those of ``data``.

    Returns:
        Its outputs by name.
    """
    actor, critic = heads
    inputs = [
        [written[key] if key in written else data.get(key) for key in head.in_keys]
        for head in heads
    ]
    keys = ppo.tensor_keys
    advantage = ppo._maybe_normalize_advantage(
        data.get(keys.advantage), data, update_norm=False
    ).squeeze(-1)
    native = _native_terms(ppo, heads, data, inputs, advantage)
    if native is not None:
        return native
    loc, scale = actor.module(*inputs[0])
    objective, log_ratio, clipped = _ClippedGain.apply(  # type: ignore[no-untyped-call]
        loc, scale, data.get(keys.action), data.get(keys.sample_log_prob), advantage,
        *ppo._clip_bounds,
    )  # fmt: skip
    value = critic.module(*inputs[1])
    error = distance_loss(data.get(keys.value_target), value, loss_function=ppo.loss_critic_type)
    with torch.no_grad():
        ratio = log_ratio.exp()
        weight = (log_ratio - log_ratio.amax(0)).exp()
        metrics = {
            "clip_fraction": (clipped != log_ratio).to(ratio.dtype).mean(),
            "kl_approx": -log_ratio.mean(),
            "ESS": weight.sum(0).square() / (weight * weight).sum(0) / len(weight),
            "max_ratio": ratio.max(),
            "mean_ratio": ratio.mean(),
        }
    return {"loss_objective": objective, "loss_critic": ppo.critic_coeff * error.mean(), **metrics}


def _native_terms(
    ppo: ClipPPOLoss,
    heads: tuple[TensorDictModule, TensorDictModule],
    data: TensorDictBase,
    inputs: list[list[Tensor]],
    advantage: Tensor,
) -> dict[str, Tensor] | None:
    """Compute the same by one call of C for two tanh networks that read the same features."""
    networks, keys = _tanh_networks(heads), ppo.tensor_keys
    if networks is None or len(inputs[0]) != 1 or inputs[0][0] is not inputs[1][0]:
        return None
    actor, scale, critic = networks
    action, target = data.get(keys.action), data.get(keys.value_target).squeeze(-1)
    given = (
        inputs[0][0], action, data.get(keys.sample_log_prob), advantage, target,
        scale.state_independent_scale,
    )  # fmt: skip
    if (
        scale.state_independent_scale.shape != action.shape[-1:]
        or action.shape[:-1] != data.shape
        or target.shape != data.shape
        or target.requires_grad
        or advantage.requires_grad
    ):
        return None
    low, high = ppo._clip_bounds
    terms = clipped_heads(
        *given, actor, critic, low=float(low), high=float(high),
        scale_floor=float(scale.scale_lb), kind=ppo.loss_critic_type,
    )  # fmt: skip
    if terms is None:
        return None
    return {
        "loss_objective": terms.objective,
        "loss_critic": ppo.critic_coeff * terms.error,
        "clip_fraction": terms.clip_fraction,
        "kl_approx": terms.kl,
        "ESS": terms.sample_size,
        "max_ratio": terms.max_ratio,
        "mean_ratio": terms.mean_ratio,
    }


def _tanh_networks(
    heads: tuple[TensorDictModule, TensorDictModule],
) -> tuple[list[Tensor], AddStateIndependentNormalScale, list[Tensor]] | None:
    """Return the layers of both heads, and what makes the policy's scale."""
    policy, critic = (head.module for head in heads)
    if type(policy) is not nn.Sequential or len(policy) != 2 or hooked(policy):
        return None
    location, scale = policy
    if (
        type(scale) is not AddStateIndependentNormalScale
        or scale.scale_mapping != "exp"
        or hooked(scale)
    ):
        return None
    layers = [_tanh_layers(network) for network in (location, critic)]
    return None if layers[0] is None or layers[1] is None else (layers[0], scale, layers[1])


def _tanh_layers(network: nn.Module) -> list[Tensor] | None:
    """Return weight and bias of every layer of linear, tanh, ..., linear."""
    if type(network) is not nn.Sequential or not len(network) % 2 or hooked(network):
        return None
    out: list[Tensor] = []
    for place, module in enumerate(network):
        if type(module) is not (nn.Tanh if place % 2 else nn.Linear) or hooked(module):
            return None
        if isinstance(module, nn.Linear):
            if module.bias is None:
                return None
            out += [module.weight, module.bias]
    return out


def plain_heads(
    ppo: ClipPPOLoss, data: TensorDictBase
) -> tuple[TensorDictModule, TensorDictModule] | None:
    """Return the heads of a loss that has nothing beyond the clipped gain and the value error.

    Args:
        ppo: the loss.
        data: what it would be called with.

    Returns:
        The networks of policy and value, or None where the loss is configured for more than
        :func:`plain_terms` does: then call the loss itself.
    """
    actor, critic, keys = ppo.actor_network, ppo.critic_network, ppo.tensor_keys
    if (
        type(ppo) is not ClipPPOLoss
        or ppo.functional
        or ppo.entropy_bonus
        or ppo.clip_value
        or ppo.separate_losses
        or ppo.delay_actor
        or ppo.max_importance_ratio is not None
        or ppo.advantage_norm is not None
        or ppo.log_explained_variance
        or ppo.reduction != "mean"
        or not isinstance(critic, TensorDictModule)
        or critic.out_keys != [keys.value]
        or len(getattr(actor, "module", ())) != 2
    ):
        return None
    head, last = actor.module
    needed = (keys.action, keys.sample_log_prob, keys.advantage, keys.value_target)
    if any(data.get(key, None) is None for key in needed):
        return None  # the loss says what is missing
    if (
        not isinstance(head, TensorDictModule)
        or any(hooked(module) for module in (actor, head, last, critic))
        or last.distribution_class is not IndependentNormal
        or last.distribution_kwargs
        or list(last.in_keys) != ["loc", "scale"]
        or head.out_keys != ["loc", "scale"]
        or data.get(keys.action).requires_grad
        or data.get(keys.sample_log_prob).requires_grad
        or data.get(keys.advantage).shape != (*data.shape, 1)
        or any(data.get(key, None) is not None for key in ppo._loss_mask_keys())
    ):
        return None
    return head, critic
