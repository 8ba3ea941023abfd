"""Put the action of the last step beside the observation that it led to."""

from typing import ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Binary, Categorical, Composite, Unbounded

from torchrl_drbpn.transforms._base import (
    EnvironmentTransform,
    Keys,
    as_key_list,
    flagged_rows,
    pair_keys,
    read_leaf,
    sibling_key,
)


class PreviousAction(EnvironmentTransform):
    r"""Write the action of step t beside the observation of step t + 1, zeros after a reset.

    `("next", "previous_action")` at t is `action` at t, and `previous_action` is zero in the first
    step of an episode: a_{t-1} of Eq. (8) [DRBPN]. It is the action as the agent chose it, before
    the environment clips it and before any action transform that stands earlier in the chain
    rescales it; action transforms later in the chain have been at it already.

    Discrete actions keep dtype and shape. The zeros of the first step are then no valid one-hot
    code, or the index of action 0: `one_hot=True` tells them apart.

    Args:
        in_keys: actions, shape `(*batch, action)`. Default `"action"`.
        out_keys: where to write. Default `"previous_action"` beside each action.

    Keyword Args:
        one_hot: write an index action (`Categorical`, n actions) as a one-hot vector of floats,
            shape `(*batch, n)`.

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
        self._chosen = [sibling_key(key, "_chosen_{}") for key in inputs]

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
                action = read_leaf(tensordict, key, self)
            if self.one_hot:
                shape, _, dtype = self._layout(key)
                codes = torch.arange(shape[-1], device=action.device)
                action = (action.unsqueeze(-1) == codes).to(dtype)
            next_tensordict.set(out_key, action)
        return next_tensordict

    def _reset(self, _: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        # every row: the environment keeps the old values of the rows that are not reset
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            shape, device, dtype = self._layout(key)
            tensordict_reset.set(out_key, torch.zeros(shape, device=device, dtype=dtype))
        return tensordict_reset

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        for key in self.out_keys:
            value = tensordict_reset.get(key)
            rows = flagged_rows(tensordict, key, value)
            if rows is not None:
                tensordict_reset.set(key, value.masked_fill(rows, 0))
        return tensordict_reset

    def _layout(self, key: NestedKey) -> tuple[tuple[int, ...], torch.device, torch.dtype]:
        """Return shape, device and dtype of the previous action."""
        leaf = read_leaf(self.parent.full_action_spec, key, self)
        if not self.one_hot:
            return leaf.shape, leaf.device, leaf.dtype
        if type(leaf) is not Categorical:
            raise ValueError(
                f"`one_hot` needs an index action (Categorical), got {type(leaf).__name__} "
                f"under {key!r}, which needs no coding. Leave one_hot=False."
            )
        return (*leaf.shape, leaf.n), leaf.device, torch.get_default_dtype()

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Enter the previous action, unbounded: after a reset it is zero, no action's own."""
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            shape, device, dtype = self._layout(key)
            observation_spec[out_key] = (
                Binary(shape=shape, device=device, dtype=dtype)
                if dtype is torch.bool
                else Unbounded(shape, device, dtype)
            )
        return observation_spec
