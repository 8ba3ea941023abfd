"""One pass of a BeliefFilterModule over sequences, and the model's term, on plain tensors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor, nn

from torchrl_drbpn.functional import Following
from torchrl_drbpn.modules import BeliefFilter, BeliefFilterModule
from torchrl_drbpn.objectives.belief_model import BeliefModelLoss

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["filtered_terms", "hooked"]

_OUT_KEYS: list[NestedKey] = ["features", ("belief", "mean"), ("belief", "log_likelihood")]


def hooked(module: nn.Module) -> bool:
    """Tell whether calling a module does more than its ``forward``."""
    return bool(
        module._forward_hooks
        or module._forward_pre_hooks
        or module._backward_hooks
        or module._backward_pre_hooks
        or "forward" in module.__dict__
    )


def filtered_terms(
    module: nn.Module, model_loss: BeliefModelLoss | None, data: TensorDictBase
) -> tuple[Mapping[NestedKey, Tensor], dict[str, Tensor]] | None:
    """Filter sequences and add up the model's likelihood, each observation counted once.

    The same calls of the filter as through the module, without copying the batch, writing into it
    and reading from it. The likelihood of the observations after the last steps is summed where it
    is computed; nothing is scattered back into the batch.

    Args:
        module: the belief module.
        model_loss: the model's loss, or None.
        data: sequences, batch size ``(*batch, time)``; nothing is written.

    Returns:
        What the belief module would have written, by key, and ``loss_model`` (not weighted) and
        ``log_likelihood``; None where anything is not as this function knows it: then call the
        modules.
    """
    if not _known(module, model_loss, data):
        return None
    assert isinstance(module, BeliefFilterModule)  # _known saw to it; for the type checker
    entries = [data.get(key, None) for key in module.in_keys]
    if any(entry is None for entry in entries):
        return None
    observation, observed, action, is_init, mean, age = entries
    action = action.to(mean.dtype)
    first = is_init.squeeze(-1)
    reset = first & (age.squeeze(-1) == 0)
    following = None
    if model_loss is not None:
        last = _last(data, model_loss.tensor_keys.done, model_loss.tensor_keys.final)
        next_observed = data.get(model_loss.tensor_keys.next_observed, None)
        if last is not None and next_observed is not None and len(last):
            nexts = [data.get(unravel_key(("next", key)), None) for key in module.in_keys[:3]]
            if any(entry is None for entry in nexts):
                return None  # the module says what is missing
            after_x, after_observed, after_action = (
                entry.flatten(0, -2).index_select(0, last) for entry in nexts
            )
            following = Following(last, after_action.to(mean.dtype), after_x, after_observed)
    out = module.filter(
        mean[..., 0, :], None, action, observation, observed, reset,
        restart=first & ~reset, restart_mean=mean, following=following,
    )  # fmt: skip
    results = (out.mean, out.mean, out.log_likelihood, out.mean, age + 1)
    written = dict(zip(module.out_keys, results, strict=True))
    if model_loss is None:
        return written, {}
    total, count, steps = out.log_likelihood.sum(), observed.sum(), reset.numel()
    if following is not None:
        total = total + out.following_log_likelihood.sum()
        count, steps = count + following.observed.sum(), steps + len(following.step)
    per_entry = total / count.clamp_min(1)
    loss = -per_entry if model_loss.normalize == "entry" else total / -float(max(1, steps))
    return written, {"loss_model": loss, "log_likelihood": per_entry.detach()}


def _known(module: nn.Module, model_loss: BeliefModelLoss | None, data: TensorDictBase) -> bool:
    """Tell whether :func:`filtered_terms` does what the modules do."""
    if (
        type(module) is not BeliefFilterModule
        or type(module.filter) is not BeliefFilter
        or hooked(module)
        or module.policy_input != "mean"
        or module.gate is not None  # the module says that it is for acting
        or len(module.out_keys) != len(_OUT_KEYS) + 2
        or module.out_keys[:3] != _OUT_KEYS
        or not data.ndim
        or not module.recurrent_mode
    ):
        return False
    if model_loss is None:
        return True
    if (
        type(model_loss) is not BeliefModelLoss
        or model_loss.reduction != "mean"
        or model_loss._forward_hooks
        or len(model_loss._forward_pre_hooks) > 1  # TorchRL gives every loss one
        or any(data.get(key, None) is not None for key in model_loss._loss_mask_keys())
    ):
        return False
    keys = model_loss.tensor_keys
    return (
        keys.log_likelihood == module.out_keys[2]
        and keys.observed == module.in_keys[1]
        and keys.next_observed == unravel_key(("next", module.in_keys[1]))
    )


def _last(data: TensorDictBase, *keys: NestedKey) -> Tensor | None:
    """Return the places of the steps whose next observation no other root step holds."""
    flags = [flag for flag in (data.get(key, None) for key in keys) if flag is not None]
    if not flags:
        return None
    last = flags[0] if len(flags) == 1 else torch.logical_or(*flags)
    return last.flatten().nonzero().squeeze(-1)
