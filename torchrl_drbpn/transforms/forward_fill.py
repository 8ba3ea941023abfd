"""Fill missing entries with the last value that was observed."""

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite, Unbounded

from torchrl_drbpn.functional.gaussian import check_observed
from torchrl_drbpn.transforms._base import (
    EnvironmentTransform,
    Keys,
    as_key_list,
    enter_state,
    flagged_rows,
    pair_keys,
    read_vector,
)


class FillLastObserved(EnvironmentTransform):
    r"""Replace missing entries by the last observed value of the same episode.

    filled_t = x_t where observed, filled_{t-1} elsewhere, `fill_value` before the first observed
    value of an episode. The mask stays as it is. The last values travel in the tensordict. A
    transform after it that makes entries go missing is refused with a ValueError.

    Args:
        in_keys: observations, shape `(*batch, obs)`, floating point.
        mask_keys: one mask per observation, bool, same shape. Default `"observed"` beside each.
        out_keys: where to write. Default in place.

    Keyword Args:
        fill_value: what stands in for an entry never observed in this episode, in the units of the
            observation here; NaN marks it for `MaskedObservationNorm(missing="keep")`.
        state_keys: where the last values are kept. Default `last_<name>` beside each observation.

    Examples:
        >>> from tensordict import TensorDict
        >>> fill = FillLastObserved()
        >>> root = TensorDict(last_observation=torch.tensor([1.0, 2.0]))
        >>> seen = torch.tensor([True, False])
        >>> step = TensorDict(observation=torch.tensor([5.0, 0.0]), observed=seen)
        >>> fill._step(root, step)["observation"]
        tensor([5., 2.])
    """

    fills: ClassVar[bool] = True
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
        self.state_keys = pair_keys(inputs, state_keys, name="state_keys", default="last_{}")
        self.fill_value = float(fill_value)
        self._keys = list(zip(inputs, self.mask_keys, outputs, self.state_keys, strict=True))
        self._checked = False

    def _check(self, source: Composite | TensorDictBase) -> None:
        for key, mask_key, _, _ in self._keys:
            leaf = read_vector(source, key, self)
            if mask_key not in source.keys(True, True):
                raise KeyError(
                    f"`FillLastObserved` reads the mask {mask_key!r}, which the environment does "
                    "not write. Put ObservationMissingness, SensorReduction or ObservedFromNaN "
                    "before it, or pass mask_keys=... ."
                )
            check_observed(leaf, source[mask_key], mask_key)

    def _fill(self, last: TensorDictBase | None, tensordict: TensorDictBase) -> TensorDictBase:
        if not self._checked:
            self._check(tensordict)
            self._checked = True
        for key, mask_key, out_key, state_key in self._keys:
            value, observed = tensordict.get(key), tensordict.get(mask_key)
            previous = None if last is None else last.get(state_key, None)
            filled = torch.where(observed, value, self.fill_value if previous is None else previous)
            tensordict.set(out_key, filled)
            tensordict.set(state_key, filled)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._fill(tensordict, next_tensordict)

    def _reset(self, _: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        # every row: the environment keeps the old values of the rows that are not reset
        return self._fill(None, tensordict_reset)

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        # The first observation was filled as if its episode were the one before; the mask says
        # where. Exact unless a transform after this one has rescaled the observation.
        for _, mask_key, out_key, state_key in self._keys:
            rows = flagged_rows(tensordict, out_key, tensordict_reset.get(out_key))
            if rows is not None:
                stale = rows & ~tensordict_reset.get(mask_key)
                for key in (out_key, state_key):
                    value = tensordict_reset.get(key)
                    tensordict_reset.set(key, value.masked_fill(stale, self.fill_value))
        return tensordict_reset

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Enter the filled observations and the last values, unbounded."""
        self._check(observation_spec)
        for key, _, out_key, state_key in self._keys:
            leaf = observation_spec[key]
            for written in (out_key, state_key):
                observation_spec[written] = Unbounded(leaf.shape, leaf.device, leaf.dtype)
        return observation_spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Enter the last values as a state that a step reads."""
        observed = self.parent.full_observation_spec
        for key, _, _, state_key in self._keys:
            leaf = observed[key]
            last = Unbounded(leaf.shape, leaf.device, leaf.dtype)
            enter_state(state_spec, state_key, last, observed)
        return state_spec
