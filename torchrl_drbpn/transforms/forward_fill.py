"""Fill missing entries with the last value that was observed."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Composite

from torchrl_drbpn.transforms._base import (
    EnvironmentTransform,
    Keys,
    Role,
    as_key_list,
    check_mask,
    check_vector,
    flagged_rows,
    observation_leaf,
    pair_keys,
    read,
    sibling_key,
    unbounded_like,
)


class FillLastObserved(EnvironmentTransform):
    r"""Replace missing entries by the last observed value of the same episode.

    filled_t = x_t where observed, filled_{t-1} elsewhere, `fill_value` before the first observed
    value of an episode. The mask stays as it is. The last values travel in the tensordict, as the
    counts of TorchRL's `StepCounter` do, so partial resets and batched environments hold.

    Args:
        in_keys: observations, shape `(*batch, obs)`, floating point. Default `"observation"`.
        mask_keys: one mask per observation, bool, shape `(*batch, obs)`, True where observed.
            Default `"observed"` beside each observation.
        out_keys: where to write. Default in place.

    Keyword Args:
        fill_value: what stands in for an entry never observed in this episode, in the units that
            the observation has at this place of the chain; NaN marks it for
            `MaskedObservationNorm(missing="keep")`.
        state_keys: where the last values are kept, in the observation spec and the state spec.
            Default `last_<name>` beside each observation.

    Raises:
        ValueError: numbers of keys that do not match, or, when the
            environment is asked for its specs, missingness stands after the transform.

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
    why_online: ClassVar[str] = "needs the steps before"

    def __init__(
        self,
        in_keys: Keys = "observation",
        mask_keys: Keys | None = None,
        out_keys: Keys | None = None,
        *,
        fill_value: float = 0.0,
        state_keys: Keys | None = None,
    ) -> None:
        inputs = as_key_list(in_keys)
        outputs = pair_keys(inputs, out_keys or inputs, name="out_keys", default="")
        super().__init__(in_keys=inputs, out_keys=outputs)
        self.mask_keys = pair_keys(inputs, mask_keys, name="mask_keys", default="observed")
        if state_keys is None:
            names = [key[-1] if isinstance(key, tuple) else key for key in inputs]
            state_keys = [
                sibling_key(key, f"last_{name}") for key, name in zip(inputs, names, strict=True)
            ]
        self.state_keys = pair_keys(inputs, state_keys, name="state_keys", default="")
        self.fill_value = float(fill_value)
        self._keys = list(
            zip(self.in_keys, self.mask_keys, self.out_keys, self.state_keys, strict=True)
        )

    def _fill(self, last: TensorDictBase | None, tensordict: TensorDictBase) -> TensorDictBase:
        for key, mask_key, out_key, state_key in self._keys:
            value, observed = read(tensordict, key, self), tensordict.get(mask_key, None)
            if observed is None:
                raise _no_mask(mask_key)
            check_vector(value, key, self)
            check_mask(observed, value, mask_key)
            previous = None if last is None else last.get(state_key, None)
            filled = torch.where(observed, value, self.fill_value if previous is None else previous)
            tensordict.set(out_key, filled)
            tensordict.set(state_key, filled)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._fill(tensordict, next_tensordict)

    def _reset(
        self,
        tensordict: TensorDictBase,  # noqa: ARG002
        tensordict_reset: TensorDictBase,
    ) -> TensorDictBase:
        # every row: the environment keeps the old values of the rows that are not reset
        return self._fill(None, tensordict_reset)

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # The first observation was filled as if its episode were the one before; the mask tells
        # where. Exact unless a transform after this one has rescaled the observation.
        for _, mask_key, out_key, state_key in self._keys:
            value = tensordict_reset.get(out_key, None)
            rows = None if value is None else flagged_rows(tensordict, out_key, value)
            if rows is not None:
                stale = rows & ~read(tensordict_reset, mask_key, self)
                last = read(tensordict_reset, state_key, self)
                tensordict_reset.set(out_key, value.masked_fill(stale, self.fill_value))
                tensordict_reset.set(state_key, last.masked_fill(stale, self.fill_value))
        return tensordict_reset

    # ------------------------------------------------------------------------------------- specs
    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Enter the filled observations and the last values, unbounded."""
        for key, mask_key, out_key, state_key in self._keys:
            leaf = observation_leaf(observation_spec, key, self)
            if mask_key not in observation_spec.keys(True, True):
                raise _no_mask(mask_key)
            observation_spec[out_key] = unbounded_like(leaf)
            observation_spec[state_key] = unbounded_like(leaf)
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Enter the last values as a state that a step reads."""
        observation_spec = self.parent.full_observation_spec
        for key, _, _, state_key in self._keys:
            state_spec[state_key] = unbounded_like(observation_leaf(observation_spec, key, self))
        return state_spec


def _no_mask(mask_key: NestedKey) -> KeyError:
    return KeyError(
        f"`FillLastObserved` reads the mask {mask_key!r}, which the environment does not write. "
        "Put ObservationMissingness, SensorReduction or ObservedFromNaN before it, or pass "
        "mask_keys=... ."
    )
