"""State that travels in the tensordict from step to step, and the rows that a reset clears."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase, Transform

from torchrl_drbpn.transforms._common import OrderedTransform, fetch, read

__all__ = ["CarriedTransform", "clear_rows", "flagged_rows", "spread_rows"]


def flagged_rows(tensordict: TensorDictBase, name: str, key: NestedKey) -> Tensor | None:
    """Return the rows that a flag such as `"_reset"` marks for the entry `key`.

    Args:
        tensordict: where the flag is looked for, beside `key` first, then in the folders above it.
        name: `"_reset"` or `"_step"`.
        key: the entry that is about to be written.

    Returns:
        A bool tensor of the batch shape, or None where there is no flag: every row is meant.
    """
    folders = key[:-1] if isinstance(key, tuple) else ()
    for depth in range(len(folders), -1, -1):
        flag_key = (*folders[:depth], name) if depth else name
        flag = fetch(tensordict, flag_key)
        if flag is not None:
            batch_dims = tensordict.ndim
            if flag.ndim == batch_dims + 1 and flag.shape[-1] == 1:
                return flag.squeeze(-1)
            return flag.flatten(batch_dims).any(-1) if flag.ndim > batch_dims else flag
    return None


def spread_rows(rows: Tensor, value: Tensor) -> Tensor:
    """Expand row flags of shape `(*batch,)` over a value of shape `(*batch, *event)`."""
    return rows.reshape(*rows.shape, *(1,) * (value.ndim - rows.ndim)).expand_as(value)


def clear_rows(
    tensordict: TensorDictBase, tensordict_reset: TensorDictBase, key: NestedKey
) -> None:
    """Set the entry `key` to zero in the rows that `"_reset"` marks.

    Args:
        tensordict: where the flag is.
        tensordict_reset: where the entry is; it is replaced there.
        key: the entry, shape `(*batch, *event)`; nothing happens where it is absent.
    """
    rows = flagged_rows(tensordict, "_reset", key)
    value = tensordict_reset.get(key, None)
    if rows is not None and value is not None:
        tensordict_reset.set(key, value.masked_fill(spread_rows(rows, value), 0))


class CarriedTransform(OrderedTransform):
    """A transform whose entries are zero at the start of an episode.

    Specs are slow to ask and short episodes reset often, so that only the first reset asks.
    """

    _layouts: dict[NestedKey, tuple[torch.Size, torch.dtype, Any]] | None = None

    def _carried_leaf(self, key: NestedKey) -> TensorSpec:
        """Return the spec of the entry that belongs to the in_key `key`."""
        raise NotImplementedError

    def _zero(self, key: NestedKey, tensordict_reset: TensorDictBase) -> Tensor:
        """Return the zeros that belong to the in_key `key`, shape `(*batch, *event)`."""
        if self._layouts is None:
            self._layouts = {}
        layout = self._layouts.get(key)
        if layout is None:
            if self.parent is None:
                return torch.zeros_like(read(tensordict_reset, key, self))
            leaf = self._carried_leaf(key)
            event_shape = leaf.shape[len(self.parent.batch_size) :]
            layout = self._layouts[key] = (event_shape, leaf.dtype, leaf.device)
        event_shape, dtype, device = layout
        shape = (*tensordict_reset.batch_size, *event_shape)
        return torch.zeros(shape, dtype=dtype, device=device)

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attach the transform after checking the order rules.

        Args:
            container: the environment or the `Compose` that takes the transform.
        """
        super().set_container(container)
        self._layouts = None

    def empty_cache(self) -> None:
        """Forget what was read from the specs."""
        super().empty_cache()
        self._layouts = None
