"""The likelihood of the learned model as a TorchRL loss."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.common import LossModule

__all__ = ["BeliefModelLoss"]


class BeliefModelLoss(LossModule):
    r"""Minus the log-likelihood of every observation that arrived, each counted once.

    .. math::
        L = - \frac{\sum_t \log N(x_t^{obs}; \cdot)}{\max(1, \text{observed entries})}

    Eq. (12) [DRBPN]; differs from the paper: divided by observed entries, not by steps, so that
    its scale does not change with the missing rate (``normalize="step"`` is the paper's).

    It holds no network: a belief module has written ``("belief", "log_likelihood")`` before.
    Steps count with their own observation. Where an episode ends, or where the bool entry
    ``final`` says that the rollout was cut, the next observation counts too if
    ``("next", "belief", "log_likelihood")`` is there (:class:`DRBPNLoss` writes it): nobody
    else's root step holds it.

    Keyword Args:
        normalize: "entry" divides by the number of observed entries, "step" by steps.
        reduction: "mean" (the normalised value), "sum" (minus the sum, nats), "none" (minus the
            log-likelihood of each step, nats, shape ``(*batch,)``).

    Raises:
        ValueError: for an unknown choice.
        KeyError: if the log-likelihood or the mask is not in the tensordict.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> data = TensorDict(
        ...     {("belief", "log_likelihood"): torch.full((3, 4), -2.0),
        ...      "observed": torch.ones(3, 4, 5, dtype=torch.bool)}, batch_size=[3, 4])
        >>> round(BeliefModelLoss()(data)["loss_model"].item(), 6)  # 2 nats over 5 entries
        0.4
    """

    @dataclass
    class _AcceptedKeys:
        """Name the entries read; each can be renamed by ``set_keys``."""

        log_likelihood: NestedKey = ("belief", "log_likelihood")
        observed: NestedKey = "observed"
        next_log_likelihood: NestedKey = ("next", "belief", "log_likelihood")
        next_observed: NestedKey = ("next", "observed")
        done: NestedKey = ("next", "done")
        final: NestedKey = "final"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys: ClassVar[list[NestedKey]] = ["loss_model", "log_likelihood"]

    def __init__(
        self,
        *,
        normalize: Literal["entry", "step"] = "entry",
        reduction: Literal["none", "mean", "sum"] = "mean",
    ) -> None:
        super().__init__()
        if normalize not in ("entry", "step"):
            raise ValueError(f"`normalize` must be 'entry' or 'step', got {normalize!r}.")
        if reduction not in ("none", "mean", "sum"):
            raise ValueError(f"`reduction` must be 'none', 'mean' or 'sum', got {reduction!r}.")
        self.normalize = normalize
        self.reduction = reduction

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries read; the loss cannot do without the first two."""
        return [getattr(self.tensor_keys, field.name) for field in fields(self._AcceptedKeys)]

    @in_keys.setter
    def in_keys(self, value: list[NestedKey]) -> None:
        names = [field.name for field in fields(self._AcceptedKeys)]
        self.set_keys(**dict(zip(names, value, strict=False)))

    def set_keys(self, **kwargs: Any) -> None:
        """Rename entries.

        Args:
            kwargs: names of ``_AcceptedKeys`` and their new keys; None restores the default. See
                :func:`following_keys` for what renaming one means for its next one.
        """
        super().set_keys(**following_keys(kwargs))

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """Do nothing: this loss estimates no value."""

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``loss_model`` and, detached, ``log_likelihood`` per observed entry (nats)."""
        keys = self.tensor_keys
        ll, observed = (
            tensordict.get(keys.log_likelihood, None),
            tensordict.get(keys.observed, None),
        )
        if ll is None or observed is None:
            absent = keys.log_likelihood if ll is None else keys.observed
            raise KeyError(
                f"`{absent}` is not in the tensordict: run the belief module on it first, under "
                "set_recurrent_mode(True)."
            )
        if observed.dtype is not torch.bool or observed.shape[:-1] != ll.shape:
            raise ValueError(
                f"`{keys.observed}` must be bool of shape (*batch, obs) with *batch = "
                f"{tuple(ll.shape)}, that of the log-likelihood, got {observed.dtype} "
                f"{tuple(observed.shape)}."
            )
        steps = torch.ones_like(ll)
        entries = observed.sum(-1).to(ll.dtype)
        next_ll = tensordict.get(keys.next_log_likelihood, None)
        if next_ll is not None:
            last = last_steps(tensordict, done=keys.done, final=keys.final, like=ll)
            ll = ll + torch.where(last, next_ll, 0.0)
            next_observed = tensordict.get(keys.next_observed, None)
            if next_observed is None:
                raise KeyError(
                    f"`{keys.next_observed}` is not in the tensordict although "
                    f"`{keys.next_log_likelihood}` is: the mask says how many entries it counts."
                )
            next_entries = next_observed.sum(-1)
            entries = entries + torch.where(last, next_entries, 0)
            steps = steps + last
        valid = self._valid(tensordict, ll)
        if valid is not None:
            ll, entries, steps = (torch.where(valid, v, 0.0) for v in (ll, entries, steps))

        per_entry = ll.sum() / entries.sum().clamp_min(1.0)
        if self.reduction == "none":
            value = -ll
        elif self.reduction == "sum":
            value = -ll.sum()
        elif self.normalize == "entry":
            value = -per_entry
        else:
            value = -ll.sum() / steps.sum().clamp_min(1.0)
        return TensorDict(
            {"loss_model": value, "log_likelihood": per_entry.detach()},
            batch_size=ll.shape if self.reduction == "none" and per_entry.ndim else [],
        )

    def _valid(self, tensordict: TensorDictBase, like: Tensor) -> Tensor | None:
        """Read the masks that TorchRL marks padded or cut steps with, as its own losses do."""
        valid = None
        for key in self._loss_mask_keys():
            mask = tensordict.get(key, None)
            if mask is not None:
                mask = mask.reshape(like.shape)
                valid = mask if valid is None else valid & mask
        return valid


def following_keys(names: dict[str, Any]) -> dict[str, Any]:
    """Complete what the keys of an observation are called by what those of the next one are.

    A flag ``done`` lies inside "next", where TorchRL's losses look for it: the root's tells what
    happened before. The next mask and the next likelihood are called what the root's are.

    Args:
        names: accepted names and keys; None restores a default.

    Returns:
        The same, completed.
    """
    out = dict(names)
    done = unravel_key(out["done"]) if out.get("done") is not None else None
    if done is not None and not (isinstance(done, tuple) and done[0] == "next"):
        out["done"] = unravel_key(("next", done))
    for name in ("observed", "log_likelihood"):
        if name in out and f"next_{name}" not in out:
            key = out[name]
            out[f"next_{name}"] = None if key is None else unravel_key(("next", key))
    return out


def last_steps(
    tensordict: TensorDictBase, *, done: NestedKey, final: NestedKey, like: Tensor
) -> Tensor:
    """Tell the steps whose next observation no other root step holds.

    Args:
        tensordict: rollout data.

    Keyword Args:
        done: key of the bool entry that ends an episode, shape ``(*batch, 1)``.
        final: key of the bool entry that marks where the rollout was cut; may be absent.
        like: a tensor of the shape wanted, ``(*batch,)``.

    Returns:
        Bool, shape ``(*batch,)``.
    """
    last = torch.zeros_like(like, dtype=torch.bool)
    for key in (done, final):
        flag = tensordict.get(key, None)
        if flag is not None:
            last = last | flag.reshape(like.shape)
    return last
