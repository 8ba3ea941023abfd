"""Scale rewards by the running spread of the discounted return."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, TensorSpec

from torchrl_drbpn.transforms._carried import (
    CarriedTransform,
    clear_rows,
    flagged_rows,
    spread_rows,
)
from torchrl_drbpn.transforms._common import (
    Role,
    as_key_list,
    fetch,
    pair_keys,
    read,
    store,
    unbounded_like,
)
from torchrl_drbpn.transforms._running import RunningMoments, RunningScaleTransform

__all__ = ["RunningReturnScale"]


class RunningReturnScale(CarriedTransform, RunningScaleTransform):
    r"""Divide the reward by the running standard deviation of the discounted return.

    With R_t = gamma R_{t-1} + r_t, R = 0 at the start of an episode, and var the population
    variance of every R seen so far over all environments, this step's included:

        scaled = clip(r_t / sqrt(var + eps), -clip, clip).

    The mean is not subtracted: that would change which policy is best. Reward scaling of
    [Engstrom et al. 2020, Implementation matters in deep policy gradients]. With fewer than two
    returns seen the reward keeps its scale.

    With `out_keys` other than `in_keys` the raw reward stays beside the scaled one, for `RewardSum`
    to sum, and the scaled one is entered in the reward spec, as by TorchRL's reward transforms.
    Such an environment has two rewards: name the one you mean, `RewardSum(in_keys=["reward"])`,
    `GAE.set_keys(reward="scaled_reward")`.

    State keys: `discounted_return` beside each reward, in reward units, in the observation spec and
    the state spec; it travels in the tensordict, so partial resets and batched environments hold.
    The statistics are in `state_dict()`, tensors only.

    Args:
        gamma: discount of the return, in [0, 1]; the agent's own.
        in_keys: rewards, shape `(*batch, 1)`, floating point. Default `"reward"`.
        out_keys: where to write. Default in place.

    Keyword Args:
        clip: largest magnitude of a scaled reward; None for no limit.
        eps: added to the variance, squared reward units.
        state_keys: where the discounted returns are kept. Default `"discounted_return"` beside each
            reward.

    Raises:
        ValueError: `gamma` outside [0, 1], `clip` or `eps` not positive, numbers of keys that do
            not match.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> scale = RunningReturnScale(0.9, out_keys="scaled_reward")
        >>> r = torch.randn(256, 1, dtype=torch.float64)
        >>> root = TensorDict(discounted_return=torch.zeros_like(r), batch_size=256)
        >>> step = scale._step(root, TensorDict(reward=r, batch_size=256))
        >>> torch.allclose(step["scaled_reward"], r / r.std(correction=0))
        True
    """

    role: ClassVar[Role] = "reward"

    def __init__(
        self,
        gamma: float,
        in_keys: NestedKey | Sequence[NestedKey] = "reward",
        out_keys: NestedKey | Sequence[NestedKey] | None = None,
        *,
        clip: float | None = 10.0,
        eps: float = 1e-8,
        state_keys: NestedKey | Sequence[NestedKey] | None = None,
    ) -> None:
        if not 0.0 <= gamma <= 1.0:
            raise ValueError(f"`gamma` must be in [0, 1], got {gamma}.")
        inputs = as_key_list(in_keys)
        outputs = list(inputs) if out_keys is None else as_key_list(out_keys)
        super().__init__(inputs, outputs, clip=clip, eps=eps)
        self.state_keys = pair_keys(
            inputs, state_keys, name="state_keys", default="discounted_return"
        )
        self.gamma = float(gamma)

    @property
    def scale(self) -> Tensor:
        """Running sqrt(var + eps) of the first in_key, shape `(1,)`, reward units, float64."""
        return self._running[0].inverse_scale.reciprocal()

    # ---------------------------------------------------------------------------- action on data
    def _write(
        self, tensordict: TensorDictBase, index: int, reward: Tensor, moments: RunningMoments
    ) -> None:
        scaled = moments.scale(reward, None, clip=self.clip, centred=False)
        store(tensordict, self.out_keys[index], scaled)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        for index, key in enumerate(self.in_keys):
            reward = read(next_tensordict, key, self)
            moments = self._moments_for(index, reward, next_tensordict.ndim)
            state_key = self.state_keys[index]
            previous = fetch(tensordict, state_key)
            discounted = reward if previous is None else previous * self.gamma + reward
            if not self._frozen:
                rows = flagged_rows(tensordict, "_step", key)
                counted = None if rows is None else spread_rows(rows, reward)
                if not moments.learn(discounted, counted):
                    raise ValueError(
                        f"`{key}` holds NaN or an infinity. RunningReturnScale would scale every "
                        "later reward by it; look at the environment's reward."
                    )
            self._write(next_tensordict, index, reward, moments)
            store(next_tensordict, state_key, discounted)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        del tensordict
        self._check_collector()
        # Every row: the environment keeps the old values of the rows that are not reset.
        for key, state_key in zip(self.in_keys, self.state_keys, strict=True):
            store(tensordict_reset, state_key, self._zero(key, tensordict_reset))
        return tensordict_reset

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        for state_key in self.state_keys:
            clear_rows(tensordict, tensordict_reset, state_key)
        return tensordict_reset

    def _scale(self, tensordict: TensorDictBase) -> None:
        for index, key in enumerate(self.in_keys):
            reward = tensordict.get(key, None)
            # The root of a stored step has no reward, its "next" has.
            if reward is not None:
                moments = self._moments_for(index, reward, tensordict.ndim)
                self._write(tensordict, index, reward, moments)

    # ------------------------------------------------------------------------------------- specs
    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Enter the scaled rewards, unbounded, beside or in place of the raw ones.

        Args:
            reward_spec: the spec before the transform.

        Returns:
            The spec after it.

        Raises:
            KeyError: an in_key is no reward of the environment.
            ValueError: a reward is not floating point.
        """
        for key, out_key in zip(self.in_keys, self.out_keys, strict=True):
            reward_spec[out_key] = unbounded_like(self._reward_leaf(reward_spec, key))
        return reward_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Enter the discounted returns.

        Args:
            observation_spec: the spec before the transform.

        Returns:
            The spec after it.
        """
        return self._with_state(observation_spec)

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Enter the discounted returns as a state that a step reads.

        Args:
            state_spec: the spec before the transform.

        Returns:
            The spec after it.
        """
        return self._with_state(state_spec)

    def _with_state(self, spec: Composite) -> Composite:
        for key, state_key in zip(self.in_keys, self.state_keys, strict=True):
            spec[state_key] = self._carried_leaf(key)
        return spec

    def _carried_leaf(self, key: NestedKey) -> TensorSpec:
        return unbounded_like(self._reward_leaf(self.parent.full_reward_spec, key))

    def _reward_leaf(self, reward_spec: Composite, key: NestedKey) -> TensorSpec:
        if key not in reward_spec.keys(True, True):
            raise KeyError(
                f"`RunningReturnScale` reads {key!r}, which is not among the rewards "
                f"{sorted(map(str, reward_spec.keys(True, True)))} of the environment. Pass "
                "in_keys=... ."
            )
        leaf = reward_spec[key]
        if not leaf.dtype.is_floating_point:
            raise ValueError(
                f"`{key}` must be floating point for RunningReturnScale, got {leaf.dtype}. Cast it "
                "with DTypeCastTransform first."
            )
        return leaf
