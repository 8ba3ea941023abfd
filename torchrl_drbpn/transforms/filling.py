"""Fill missing entries with the last value that was observed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite

from torchrl_drbpn.transforms._carried import flagged_rows, spread_rows
from torchrl_drbpn.transforms._common import (
    OrderedTransform,
    Role,
    as_key_list,
    observation_leaf,
    pair_keys,
    read,
    unbounded_like,
)

__all__ = ["FillLastObserved"]


class FillLastObserved(OrderedTransform):
    r"""Replace missing entries by the last observed value of the same episode.

    filled_t = x_t where observed, filled_{t-1} elsewhere, `fill_value` before the first observed
    value of an episode. The mask stays as it is. The last values travel in the tensordict, as the
    counts of TorchRL's `StepCounter` do, so partial resets and batched environments hold.

    State keys: `last_observation` beside each observation (`last_<name>` in general), in the
    observation spec and the state spec.

    Args:
        in_keys: observations, shape `(*batch, obs)`, floating point. Default `"observation"`.
        mask_keys: one mask per observation, bool, shape `(*batch, obs)`, True where observed.
            Default `"observed"` beside each observation.
        out_keys: where to write. Default in place.

    Keyword Args:
        fill_value: what stands in for an entry never observed in this episode, in the units that
            the observation has at this place of the chain.
        state_keys: where the last values are kept. Default `last_<name>` beside each observation.

    Raises:
        ValueError: numbers of keys that do not match, or the transform stands before missingness.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> fill = FillLastObserved()
        >>> root = TensorDict(last_observation=torch.tensor([1.0, 2.0]))
        >>> seen = torch.tensor([True, False])
        >>> step = TensorDict(observation=torch.tensor([5.0, 0.0]), observed=seen)
        >>> fill._step(root, step)["observation"]
        tensor([5., 2.])
    """

    role: ClassVar[Role] = "fill"

    def __init__(
        self,
        in_keys: NestedKey | Sequence[NestedKey] = "observation",
        mask_keys: NestedKey | Sequence[NestedKey] | None = None,
        out_keys: NestedKey | Sequence[NestedKey] | None = None,
        *,
        fill_value: float = 0.0,
        state_keys: NestedKey | Sequence[NestedKey] | None = None,
    ) -> None:
        inputs = as_key_list(in_keys)
        outputs = list(inputs) if out_keys is None else as_key_list(out_keys)
        if len(outputs) != len(inputs):
            raise ValueError(
                f"`out_keys` must name one key for each of the {len(inputs)} in_keys, got "
                f"{outputs}."
            )
        super().__init__(in_keys=inputs, out_keys=outputs)
        self.mask_keys = pair_keys(inputs, mask_keys, name="mask_keys", default="observed")
        if state_keys is None:
            state_keys = [
                (*key[:-1], f"last_{key[-1]}") if isinstance(key, tuple) else f"last_{key}"
                for key in inputs
            ]
        self.state_keys = pair_keys(inputs, state_keys, name="state_keys", default="")
        self.fill_value = float(fill_value)

    def _fill(self, last: TensorDictBase | None, tensordict: TensorDictBase) -> TensorDictBase:
        for key, mask_key, out_key, state_key in zip(
            self.in_keys, self.mask_keys, self.out_keys, self.state_keys, strict=True
        ):
            value = read(tensordict, key, self)
            observed = tensordict.get(mask_key, None)
            if observed is None:
                raise _no_mask(mask_key)
            if observed.dtype is not torch.bool or observed.shape != value.shape:
                raise ValueError(
                    f"`{mask_key}` must be bool of shape {tuple(value.shape)}, one entry for every "
                    f"component of {key!r}, got {observed.dtype} of shape {tuple(observed.shape)}. "
                    "Is it the mask of another observation?"
                )
            previous: Tensor | float | None = None if last is None else last.get(state_key, None)
            filled = torch.where(observed, value, self.fill_value if previous is None else previous)
            tensordict.set(out_key, filled)
            tensordict.set(state_key, filled)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._fill(tensordict, next_tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        del tensordict
        # Every row starts afresh: the environment keeps the old values of rows that are not reset.
        return self._fill(None, tensordict_reset)

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # The first observation was filled as if its episode were the one before; the mask tells
        # where. Exact unless a transform after this one has rescaled the observation.
        for mask_key, out_key, state_key in zip(
            self.mask_keys, self.out_keys, self.state_keys, strict=True
        ):
            rows = flagged_rows(tensordict, "_reset", out_key)
            value = tensordict_reset.get(out_key, None)
            if rows is not None and value is not None:
                observed = read(tensordict_reset, mask_key, self)
                stale = spread_rows(rows, value) & ~observed
                last = read(tensordict_reset, state_key, self)
                tensordict_reset.set(out_key, value.masked_fill(stale, self.fill_value))
                tensordict_reset.set(state_key, last.masked_fill(stale, self.fill_value))
        return tensordict_reset

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refuse: a sampled transition does not know what was observed before it.

        Args:
            tensordict: a sample.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(
            "FillLastObserved needs the steps before, which a sample from a replay buffer does not "
            "hold. Append it to the environment, so that the filled observations are stored."
        )

    # ------------------------------------------------------------------------------------- specs
    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Enter the filled observations and the last values, unbounded.

        Args:
            observation_spec: the spec before the transform.

        Returns:
            The spec after it.

        Raises:
            KeyError: there is no mask to fill by.
        """
        for key, mask_key, out_key, state_key in zip(
            self.in_keys, self.mask_keys, self.out_keys, self.state_keys, strict=True
        ):
            leaf = observation_leaf(observation_spec, key, self)
            if mask_key not in observation_spec.keys(True, True):
                raise _no_mask(mask_key)
            observation_spec[out_key] = unbounded_like(leaf)
            observation_spec[state_key] = unbounded_like(leaf)
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Enter the last values as a state that a step reads.

        Args:
            state_spec: the spec before the transform.

        Returns:
            The spec after it.
        """
        observation_spec = self.parent.full_observation_spec
        for key, state_key in zip(self.in_keys, self.state_keys, strict=True):
            leaf = observation_leaf(observation_spec, key, self)
            state_spec[state_key] = unbounded_like(leaf)
        return state_spec


def _no_mask(mask_key: NestedKey) -> KeyError:
    return KeyError(
        f"`FillLastObserved` reads the mask {mask_key!r}, which the environment does not write. "
        "Put ObservationMissingness, SensorReduction or ObservedFromNaN before it, or pass "
        "mask_keys=... ."
    )
