"""Put the action of the last step beside the observation that it led to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torchrl.data import Binary, Composite, TensorSpec, Unbounded

from torchrl_drbpn.transforms._carried import CarriedTransform, clear_rows
from torchrl_drbpn.transforms._common import Role, as_key_list, fetch, pair_keys, read, store

__all__ = ["PreviousAction"]


class PreviousAction(CarriedTransform):
    r"""Write the action of step t beside the observation of step t + 1, zeros after a reset.

    `("next", "previous_action")` at t is `action` at t, and `previous_action` is zero in the first
    step of an episode: a_{t-1} of Eq. (8) [DRBPN]. It is the action as the agent chose it, before
    the environment clips it and before any action transform that stands earlier in the chain
    rescales it; action transforms later in the chain have been at it already.

    Discrete actions keep the dtype and shape of the environment (one-hot or index). The zeros of
    the first step are then no valid one-hot code, or equal to action 0: `is_init` tells them apart.

    Args:
        in_keys: actions, shape `(*batch, action)`. Default `"action"`.
        out_keys: where to write. Default `"previous_action"` beside each action.

    Raises:
        ValueError: as many out_keys as in_keys are needed.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), PreviousAction())
        >>> data = env.rollout(3)
        >>> bool((data["next", "previous_action"] == data["action"]).all())
        True
        >>> float(data["previous_action"][0])
        0.0
    """

    role: ClassVar[Role] = "previous_action"

    def __init__(
        self,
        in_keys: NestedKey | Sequence[NestedKey] = "action",
        out_keys: NestedKey | Sequence[NestedKey] | None = None,
    ) -> None:
        inputs = as_key_list(in_keys)
        outputs = pair_keys(inputs, out_keys, name="out_keys", default="previous_action")
        super().__init__(in_keys=inputs, out_keys=outputs)
        # What travels from the way in to the way out, where earlier action transforms have
        # overwritten the action: one private entry per action, never seen outside a step.
        self._chosen = [
            (*key[:-1], f"_chosen_{key[-1]}") if isinstance(key, tuple) else f"_chosen_{key}"
            for key in inputs
        ]

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        for key, chosen in zip(self.in_keys, self._chosen, strict=True):
            action = fetch(tensordict, key)
            if action is not None:
                store(tensordict, chosen, action)
        return tensordict

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for key, out_key, chosen in zip(self.in_keys, self.out_keys, self._chosen, strict=True):
            action = fetch(tensordict, chosen)
            if action is None:
                action = read(tensordict, key, self)
            store(next_tensordict, out_key, action)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        del tensordict
        # Every row: the environment keeps the old values of the rows that are not reset.
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            store(tensordict_reset, out_key, self._zero(key, tensordict_reset))
        return tensordict_reset

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        for out_key in self.out_keys:
            clear_rows(tensordict, tensordict_reset, out_key)
        return tensordict_reset

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refuse: a sampled transition does not know the action before it.

        Args:
            tensordict: a sample.

        Raises:
            NotImplementedError: always.
        """
        raise NotImplementedError(
            "PreviousAction needs the step before, which a sample from a replay buffer does not "
            "hold. Append it to the environment, and store `previous_action` with the data."
        )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Enter the previous action, unbounded, with shape and dtype of the action.

        Args:
            observation_spec: the spec before the transform.

        Returns:
            The spec after it.
        """
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            observation_spec[out_key] = self._carried_leaf(key)
        return observation_spec

    def _carried_leaf(self, key: NestedKey) -> TensorSpec:
        spec = self.parent.full_action_spec
        if key not in spec.keys(True, True):
            raise KeyError(
                f"`PreviousAction` reads {key!r}, which is not among the actions "
                f"{sorted(map(str, spec.keys(True, True)))} of the environment. Pass in_keys=... ."
            )
        leaf = spec[key]
        # Zeros need not be a valid action, hence not the action's own spec.
        if leaf.dtype is torch.bool:
            return Binary(shape=leaf.shape, device=leaf.device, dtype=leaf.dtype)
        return Unbounded(shape=leaf.shape, device=leaf.device, dtype=leaf.dtype)
