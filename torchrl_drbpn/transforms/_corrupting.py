"""What the corrupting transforms share: a generator of their own, observations, masks and specs."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from numbers import Integral
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec

from torchrl_drbpn.transforms._common import (
    OrderedTransform,
    as_key_list,
    fetch,
    observation_leaf,
    pair_keys,
    read,
    set_mask_spec,
    store,
    unbounded_like,
)

_SEED_BITS = 63


# ------------------------------------------------------------------------------------ randomness
def check_seed(seed: int, name: str = "seed") -> int:
    """Return `seed` after checking that it is an integer that is not negative.

    Args:
        seed: the seed.
        name: the argument's name, for the error.

    Returns:
        The seed.

    Raises:
        TypeError: if it is no integer.
        ValueError: if it is negative or too large for a 64-bit integer.
    """
    if isinstance(seed, bool) or not isinstance(seed, Integral):
        raise TypeError(f"`{name}` must be an integer, got {seed!r} of type {type(seed).__name__}.")
    if not 0 <= seed < 1 << _SEED_BITS:
        raise ValueError(f"`{name}` must lie in [0, 2**{_SEED_BITS}), got {seed}.")
    return int(seed)


class SeededTransform(OrderedTransform):
    """A transform with a random generator of its own, made on the device of the data.

    The global generator is neither read nor advanced. The state of the generator is part of
    `state_dict`, so that a checkpoint continues the same random sequence.

    Args:
        seed: seed of the generator, not negative. Equal seeds give equal sequences; two classes
            with the same seed give unrelated ones.
        **keys: passed on to the next class.
    """

    # separates the random streams of the classes: noise and missingness with the same seed must not
    # be built from the same uniform numbers
    stream: ClassVar[int]

    def __init__(self, *, seed: int, **keys: Any) -> None:
        super().__init__(**keys)
        self.seed = check_seed(seed)
        self._generator: torch.Generator | None = None
        self._saved_state: Tensor | None = None

    def set_seed(self, seed: int) -> None:
        """Start the random sequence of `seed` from its beginning.

        Args:
            seed: the new seed, not negative.
        """
        self.seed = check_seed(seed)
        self._generator = None
        self._saved_state = None

    def generator(self, device: torch.device) -> torch.Generator:
        """Return the transform's generator on `device`, made at the first call.

        Args:
            device: where random numbers are needed.

        Returns:
            The generator; drawing from it advances the transform's sequence.
        """
        generator = self._generator
        if generator is None or generator.device != device:
            generator = torch.Generator(device=device)
            # golden-ratio steps spread neighbouring seeds, `stream` separates the classes
            mixed = self.seed * 0x9E3779B97F4A7C15 + self.stream * 0xD1B54A32D192ED03
            generator.manual_seed(mixed % (1 << _SEED_BITS))
            if self._saved_state is not None:
                self._restore(generator, self._saved_state)
                self._saved_state = None
            self._generator = generator
        return generator

    @staticmethod
    def _restore(generator: torch.Generator, state: Tensor) -> None:
        if state.numel() != generator.get_state().numel():
            warnings.warn(
                f"the saved generator state has {state.numel()} bytes, one on {generator.device} "
                f"has {generator.get_state().numel()}: it was saved on another kind of device and "
                "can't be continued here. The sequence starts again from its seed.",
                stacklevel=3,
            )
            return
        generator.set_state(state)

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return seed and generator state as tensors, for `state_dict`."""
        if self._generator is not None:
            state = self._generator.get_state()
        elif self._saved_state is not None:
            state = self._saved_state
        else:
            state = torch.empty(0, dtype=torch.uint8)
        return {"seed": torch.tensor(self.seed), "generator": state.clone()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Continue from what `get_extra_state` returned.

        Args:
            state: seed and generator state.
        """
        self.seed = int(state["seed"])
        saved = state["generator"].cpu()
        self._generator = None
        self._saved_state = saved.clone() if saved.numel() else None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Refuse to work outside an environment.

        Args:
            tensordict: data of a replay buffer or in front of a model.

        Raises:
            NotImplementedError: always.
        """
        del tensordict
        name = type(self).__name__
        raise NotImplementedError(
            f"`{name}` draws afresh at every call: on a replay buffer or in front of a model the "
            "same transition would be corrupted differently each time it is read, and root and "
            f"next would not match. Append it to the environment: TransformedEnv(env, {name}(...))."
        )

    def clone(self) -> Any:
        """Return a copy without a parent, whose generator runs on by itself from the same state."""
        copy = super().clone()
        if self._generator is not None:
            copy._generator = self._generator.clone_state()
        return copy


# ------------------------------------------------------------------------------------ corruption
class CorruptingTransform(OrderedTransform):
    """The frame of the transforms that change what arrives: keys, masks, specs, step and reset.

    Several observation keys count as one vector, in the order of `in_keys`, so that one law holds
    for the whole observation however it is cut into keys. A subclass writes `_corrupt`.

    Args:
        in_keys: observation keys; the corrupted observation is written under the same key.
        mask_keys: one mask per observation; by default `observed` beside it.
        complete_key: where the observation as it arrives is recorded; one key per observation, or
            None for not at all.
    """

    writes_mask: ClassVar[bool] = True

    def __init__(
        self,
        *,
        in_keys: NestedKey | Sequence[NestedKey] = ("observation",),
        mask_keys: NestedKey | Sequence[NestedKey] | None = None,
        complete_key: NestedKey | Sequence[NestedKey] | None = None,
    ) -> None:
        keys = as_key_list(in_keys)
        if not keys:
            raise ValueError("`in_keys` must name at least one observation, got none.")
        masks = pair_keys(keys, mask_keys, name="mask_keys", default="observed")
        complete = (
            []
            if complete_key is None
            else pair_keys(keys, complete_key, name="complete_key", default="")
        )
        out_keys = [*keys, *masks, *complete] if self.writes_mask else [*keys, *complete]
        super().__init__(in_keys=keys, out_keys=out_keys)
        self.mask_keys = masks
        self.complete_keys = complete

    def _corrupt(
        self,
        observation: Tensor,
        observed: Tensor | None,
        root: TensorDictBase | None,
        following: TensorDictBase,
    ) -> tuple[Tensor, Tensor | None]:
        """Return the corrupted observation and its mask.

        Args:
            observation: shape `(*batch, obs)`, all in_keys side by side.
            observed: the mask so far, same shape, or None.
            root: the data of the step before, with the action; None at a reset.
            following: the data of this step, observations not yet changed, where a subclass may
                write what it has drawn.
        """
        raise NotImplementedError

    def _check_obs_dim(self, obs_dim: int) -> None:
        """Raise a ValueError where the transform was made for another number of components."""

    def _run(self, tensordict: TensorDictBase, root: TensorDictBase | None) -> TensorDictBase:
        if len(self.in_keys) > 1:
            return self._run_many(tensordict, root)
        key, mask_key = self.in_keys[0], self.mask_keys[0]
        observation = fetch(tensordict, key)
        if observation is None:
            if self.missing_tolerance:
                return tensordict
            observation = read(tensordict, key, self)
        observed = fetch(tensordict, mask_key)
        if observed is not None:
            self._check_mask(observed, observation, mask_key)
        corrupted, observed = self._corrupt(observation, observed, root, tensordict)
        if self.complete_keys:
            store(tensordict, self.complete_keys[0], observation)
        store(tensordict, key, corrupted)
        if self.writes_mask and observed is not None:
            store(tensordict, mask_key, observed)
        return tensordict

    def _run_many(self, tensordict: TensorDictBase, root: TensorDictBase | None) -> TensorDictBase:
        if self.missing_tolerance and any(tensordict.get(k, None) is None for k in self.in_keys):
            return tensordict
        parts = [read(tensordict, key, self) for key in self.in_keys]
        masks = [tensordict.get(key, None) for key in self.mask_keys]
        for mask, part, key in zip(masks, parts, self.mask_keys, strict=True):
            if mask is not None:
                self._check_mask(mask, part, key)
        observed = None
        if any(mask is not None for mask in masks):
            observed = torch.cat(
                [
                    torch.ones_like(part, dtype=torch.bool) if mask is None else mask
                    for mask, part in zip(masks, parts, strict=True)
                ],
                -1,
            )
        sizes = [part.shape[-1] for part in parts]
        corrupted, observed = self._corrupt(torch.cat(parts, -1), observed, root, tensordict)
        for key, part in zip(self.complete_keys, parts, strict=bool(self.complete_keys)):
            tensordict.set(key, part)
        for key, part in zip(self.in_keys, torch.split(corrupted, sizes, -1), strict=True):
            tensordict.set(key, part)
        if self.writes_mask and observed is not None:
            for key, part in zip(self.mask_keys, torch.split(observed, sizes, -1), strict=True):
                tensordict.set(key, part)
        return tensordict

    @staticmethod
    def _check_mask(observed: Tensor, observation: Tensor, key: NestedKey) -> None:
        if observed.dtype is not torch.bool or observed.shape != observation.shape:
            raise ValueError(
                f"`{key}` must be bool of shape (*batch, obs) = {tuple(observation.shape)}, one "
                f"entry per component, got {observed.dtype} {tuple(observed.shape)}. Is it "
                "the mask of another observation? Pass mask_keys=... ."
            )

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._run(next_tensordict, None)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._run(next_tensordict, tensordict)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        del tensordict
        # the first observation of an episode arrives through the same sensors as every other
        return self._run(tensordict_reset, None)

    @dispatch(source="in_keys", dest="out_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Apply the transform to data outside an environment, as on a replay buffer.

        Args:
            tensordict: data with the observation keys, any batch shape.

        Returns:
            The same data, changed.
        """
        return self._call(tensordict)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Widen the observation, enter its mask and, on request, the complete observation.

        Args:
            observation_spec: the spec before the transform.

        Returns:
            The spec after it.

        Raises:
            KeyError: if an observation key is absent.
            ValueError: if an observation is no vector, or a key is taken by something else.
        """
        spec = observation_spec.clone()
        obs_dim = 0
        for index, key in enumerate(self.in_keys):
            leaf = observation_leaf(spec, key, self)
            obs_dim += leaf.shape[-1]
            if self.complete_keys:
                complete = self.complete_keys[index]
                if complete in spec.keys(True, True):
                    raise ValueError(
                        f"`{complete}` is among the observations of the environment already, so "
                        f"`{type(self).__name__}` can't write it: two transforms (one perhaps "
                        "inside the workers) or the environment itself do. Choose another key."
                    )
                spec[complete] = leaf.clone()
            if self.writes_mask:
                set_mask_spec(spec, self.mask_keys[index], leaf, self)
            spec[key] = unbounded_like(leaf)
        self._check_obs_dim(obs_dim)
        return spec
