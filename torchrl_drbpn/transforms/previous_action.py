"""Put the action of the last step beside the observation that it led to."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, TensorSpec, Unbounded

from torchrl_drbpn.transforms._base import (
    EnvironmentTransform,
    Keys,
    as_key_list,
    flagged_rows,
    pair_keys,
    read,
    sibling_key,
)


class PreviousAction(EnvironmentTransform):
    r"""Write the action of step t beside the observation of step t + 1, zeros after a reset.

    `("next", "previous_action")` at t is `action` at t, and `previous_action` is zero in the first
    step of an episode: a_{t-1} of Eq. (8) [DRBPN]. It is the action as the agent chose it, before
    the environment clips it and before any action transform that stands earlier in the chain
    rescales it; action transforms later in the chain have been at it already.

    Discrete actions keep the dtype and shape of the environment. The zeros of the first step are
    then no valid one-hot code, or the index of action 0: `one_hot=True` tells them apart.

    Args:
        in_keys: actions, shape `(*batch, action)`. Default `"action"`.
        out_keys: where to write. Default `"previous_action"` beside each action.

    Keyword Args:
        one_hot: write an index action (`Categorical`, n actions) as a one-hot vector of floats,
            shape `(*batch, n)`.

    Raises:
        ValueError: as many out_keys as in_keys are needed, and `one_hot` needs index actions.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = GymEnv("CartPole-v1", categorical_action_encoding=True)
        >>> data = TransformedEnv(env, PreviousAction(one_hot=True)).rollout(3)
        >>> bool((data["next", "previous_action"].argmax(-1) == data["action"]).all())
        True
        >>> data["previous_action"][0].tolist()
        [0.0, 0.0]
    """

    why_online: ClassVar[str] = "needs the step before"

    def __init__(
        self, in_keys: Keys = "action", out_keys: Keys | None = None, *, one_hot: bool = False
    ) -> None:
        inputs = as_key_list(in_keys)
        outputs = pair_keys(inputs, out_keys, name="out_keys", default="previous_action")
        super().__init__(in_keys=inputs, out_keys=outputs)
        self.one_hot = one_hot
        # What travels from the way in to the way out, where earlier action transforms have
        # overwritten the action: one entry per action, never seen outside a step.
        self._chosen = [
            sibling_key(key, f"_chosen_{key[-1] if isinstance(key, tuple) else key}")
            for key in inputs
        ]
        self._layouts: dict[NestedKey, tuple[torch.Size, TensorSpec]] = {}

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = super()._inv_call(tensordict)
        for key, chosen in zip(self.in_keys, self._chosen, strict=True):
            action = tensordict.get(key, None)
            if action is not None:
                tensordict.set(chosen, action)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key, out_key, chosen in zip(self.in_keys, self.out_keys, self._chosen, strict=True):
            action = tensordict.get(chosen, None)
            if action is None:
                action = read(tensordict, key, self)
            if self.one_hot:
                event_shape, leaf = self._layout(key)
                codes = torch.arange(event_shape[-1], device=action.device)
                action = (action.unsqueeze(-1) == codes).to(leaf.dtype)
            next_tensordict.set(out_key, action)
        return next_tensordict

    def _reset(
        self,
        tensordict: TensorDictBase,  # noqa: ARG002
        tensordict_reset: TensorDictBase,
    ) -> TensorDictBase:
        # every row: the environment keeps the old values of the rows that are not reset
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            tensordict_reset.set(out_key, self._zero(key, tensordict_reset))
        return tensordict_reset

    def _zero(self, key: NestedKey, tensordict_reset: TensorDictBase) -> Tensor:
        if self.parent is None:
            return torch.zeros_like(read(tensordict_reset, key, self))
        event_shape, leaf = self._layout(key)
        shape = (*tensordict_reset.batch_size, *event_shape)
        return torch.zeros(shape, dtype=leaf.dtype, device=leaf.device)

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        for key in self.out_keys:
            value = tensordict_reset.get(key, None)
            rows = None if value is None else flagged_rows(tensordict, key, value)
            if rows is not None:
                tensordict_reset.set(key, value.masked_fill(rows, 0))
        return tensordict_reset

    # ------------------------------------------------------------------------------------- specs
    def _layout(self, key: NestedKey) -> tuple[torch.Size, TensorSpec]:
        # specs are slow to ask and short episodes reset often
        if key not in self._layouts:
            leaf = self._leaf(key)
            self._layouts[key] = leaf.shape[len(self.parent.batch_size) :], leaf
        return self._layouts[key]

    def _leaf(self, key: NestedKey) -> TensorSpec:
        spec = self.parent.full_action_spec
        if key not in spec.keys(True, True):
            raise KeyError(
                f"`PreviousAction` reads {key!r}, which is not among the actions "
                f"{sorted(map(str, spec.keys(True, True)))} of the environment. Pass in_keys=... ."
            )
        leaf = spec[key]
        if self.one_hot:
            if type(leaf) is not Categorical:
                raise ValueError(
                    f"`one_hot` needs an index action (Categorical), got {type(leaf).__name__} "
                    f"under {key!r}, which needs no coding. Leave one_hot=False."
                )
            return Unbounded(shape=(*leaf.shape, leaf.n), device=leaf.device)
        # zeros need not be a valid action, hence not the action's own spec
        if leaf.dtype is torch.bool:
            return Binary(shape=leaf.shape, device=leaf.device, dtype=leaf.dtype)
        return Unbounded(shape=leaf.shape, device=leaf.device, dtype=leaf.dtype)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Enter the previous action, unbounded."""
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            observation_spec[out_key] = self._leaf(key)
        return observation_spec

    def empty_cache(self) -> None:
        """Forget what was read from the specs."""
        super().empty_cache()
        self._layouts = {}
