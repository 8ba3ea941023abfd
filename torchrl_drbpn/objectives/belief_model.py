"""The likelihood of the learned model as a TorchRL loss."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from tensordict import TensorDict, TensorDictBase, unravel_key
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives.common import AUTO_LOSS_MASK_KEYS, LossModule


class BeliefModelLoss(LossModule):
    r"""Minus the log-likelihood of every observation that arrived, each counted once.

    .. math::
        L = - \frac{\sum_t \log N(x_t^{obs}; \cdot)}{\max(1, \text{observed entries})}

    Eq. (12) [DRBPN]; differs from the paper: divided by observed entries, not by steps, so that
    its scale does not change with the missing rate (``normalize="step"`` is the paper's).

    It holds no network: a belief module has written ``("belief", "log_likelihood")`` before.
    Every step counts with its own observation, and those of :meth:`last_steps` with the next one
    too if ``("next", "belief", "log_likelihood")`` is there (:class:`DRBPNLoss` writes it). As in
    TorchRL's losses ``done`` and ``terminated`` are read inside "next".

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
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
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
        keys = self.tensor_keys
        nexts = (keys.log_likelihood, keys.observed, keys.done, keys.terminated)
        return [keys.log_likelihood, keys.observed, *map(in_next, nexts), keys.final, "index"]

    def _forward_value_estimator_keys(self, **kwargs: NestedKey) -> None:
        """Do nothing: this loss estimates no value."""

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return ``loss_model`` and, detached, ``log_likelihood`` per observed entry (nats)."""
        keys = self.tensor_keys
        ll, observed = self._read(tensordict, keys.log_likelihood, keys.observed)
        if observed.dtype is not torch.bool or observed.shape[:-1] != ll.shape:
            raise ValueError(
                f"`{keys.observed}` must be bool of shape (*batch, obs) with *batch = "
                f"{tuple(ll.shape)}, that of the log-likelihood, got {observed.dtype} "
                f"{tuple(observed.shape)}."
            )
        steps, entries = torch.ones_like(ll), observed.sum(-1).to(ll.dtype)
        next_ll = tensordict.get(in_next(keys.log_likelihood), None)
        if next_ll is not None:
            (next_observed,) = self._read(tensordict, in_next(keys.observed))
            last = self.last_steps(tensordict)
            ll = ll + torch.where(last, next_ll, 0.0)
            entries = entries + torch.where(last, next_observed.sum(-1), 0)
            steps = steps + last
        for valid in self._valid(tensordict, ll.shape):
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
        return TensorDict({"loss_model": value, "log_likelihood": per_entry.detach()})

    def last_steps(self, tensordict: TensorDictBase) -> Tensor:
        """Return which steps, bool ``(*batch, time)``, have a next observation of their own alone.

        Those that terminated, that are ``final`` (the rollout was cut there), or that are ``done``.
        In data of a replay buffer of single steps ``done`` alone does not count: TorchRL's
        SliceSampler writes it where it cuts a slice. Mark the ends of episodes and rollouts as
        ``final`` before such data are stored.
        """
        keys, shape = self.tensor_keys, tensordict.shape
        none = torch.zeros(shape, dtype=torch.bool, device=tensordict.get(keys.observed).device)
        flags = (in_next(keys.terminated), keys.final, in_next(keys.done))
        terminated, final, done = (tensordict.get(key, none).reshape(shape) for key in flags)
        index = tensordict.get("index", None)
        if index is not None and shape:
            # Where each step was stored. Of rows that were stored whole it is constant in time.
            index = index.reshape(*shape, -1)
            moves = index[..., 1:, :] != index[..., :-1, :]
            done = done & ~moves.any(-1).any(-1, keepdim=True)
        return terminated | final | done

    def _read(self, tensordict: TensorDictBase, *keys: NestedKey) -> list[Tensor]:
        found = [tensordict.get(key, None) for key in keys]
        for key, value in zip(keys, found, strict=True):
            if value is None:
                raise KeyError(
                    f"`{key}` is not in the tensordict: run the belief module on it first, under "
                    "set_recurrent_mode(True)."
                )
        return found

    def _valid(self, tensordict: TensorDictBase, shape: torch.Size) -> list[Tensor]:
        """Return the masks that TorchRL marks padded or cut steps with, as its own losses do."""
        key = self.loss_mask_key
        keys = () if key is None else AUTO_LOSS_MASK_KEYS if key == "auto" else (key,)
        masks = (tensordict.get(name, None) for name in keys)
        return [mask.reshape(shape) for mask in masks if mask is not None]


def in_next(key: NestedKey) -> NestedKey:
    """Return a key inside "next", where it may be already."""
    key = unravel_key(key)
    return key if isinstance(key, tuple) and key[0] == "next" else unravel_key(("next", key))
