"""What transforms with a memory share: a state in the tensordict, and sensors that go together."""

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from numbers import Integral
from typing import Any, ClassVar, Unpack

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded

from torchrl_drbpn.transforms._base import (
    Keys,
    Step,
    as_key_list,
    check_count,
    enter_new,
    enter_state,
    read_numbers,
    sibling_key,
)
from torchrl_drbpn.transforms.seeding import SeededKeys, SeededTransform

Groups = Sequence[Sequence[int]]


class CarriedKeys(SeededKeys, total=False):
    """And the sensors that go together, and where the state is kept."""

    groups: Groups | None
    state_keys: Keys | None


class CarriedStateTransform(SeededTransform):
    """A corrupting transform that remembers something from step to step.

    What it remembers travels in the tensordict, so that partial resets and workers hold and a
    stored step says what the next starts from.
    """

    state_names: ClassVar[tuple[str, ...]]
    # attributes that hold one number for all groups, or one for each
    per_group: ClassVar[tuple[str, ...]] = ()

    def __init__(
        self,
        *,
        groups: Groups | None = None,
        state_keys: Keys | None = None,
        **keys: Unpack[SeededKeys],
    ) -> None:
        super().__init__(**keys)
        self.groups = None if groups is None else _read_groups(groups)
        if state_keys is None:
            state_keys = [sibling_key(self.in_keys[0], name) for name in self.state_names]
        self.state_keys: list[NestedKey] = as_key_list(state_keys)
        wanted, taken = len(self.state_names), set(self.state_keys)
        if not len(self.state_keys) == len(taken) == wanted or not taken.isdisjoint(self.out_keys):
            number = "a key" if wanted == 1 else f"{wanted} keys"
            raise ValueError(
                f"`state_keys` must be {number} of its own, got {self.state_keys} "
                f"beside {self.out_keys}, which this transform writes something else to."
            )
        self.out_keys = [*self.out_keys, *self.state_keys]

    def _count(self, obs_dim: int) -> int:
        """Return how many groups there are; without `groups` every component is one."""
        return obs_dim if self.groups is None else len(self.groups)

    def _group_like(self, observation: Tensor) -> Tensor:
        """Return a tensor of shape `(*batch, groups)` to take shape and device from."""
        # there are never more groups than components
        return observation[..., : self._count(observation.shape[-1])]

    def _spread(self, of_group: Tensor, observation: Tensor, rest: int) -> Tensor:
        """Give every component what its group has, shape `(*batch, obs)`, and others `rest`."""
        if self.groups is None:
            return of_group.expand(observation.shape)
        of_group = of_group.expand(*observation.shape[:-1], len(self.groups))
        outside = torch.full_like(of_group[..., :1], rest)
        return torch.cat([of_group, outside], -1)[..., self._column.to(observation.device)]

    def _check_obs_dim(self, obs_dim: int) -> None:
        super()._check_obs_dim(obs_dim)
        groups = self.groups or []
        indices = [index for group in groups for index in group]
        if any(not -obs_dim <= index < obs_dim for index in indices):
            raise ValueError(
                f"`groups` must hold indices from {-obs_dim} to {obs_dim - 1} for in_keys "
                f"{self.in_keys} with {obs_dim} components, got {self.groups}."
            )
        if len({index % obs_dim for index in indices}) != len(indices):
            raise ValueError(
                f"`groups` must name every component once at most, got {self.groups} for {obs_dim} "
                f"components. Use two {type(self).__name__} where a sensor can fail in two ways."
            )
        # the group of every component; the number of groups where it is in none
        self._column = torch.full((obs_dim,), len(groups))
        for place, group in enumerate(groups):
            self._column[group] = place
        for name in self.per_group:
            check_count(
                getattr(self, name), name, self._count(obs_dim), "group (component, without groups)"
            )

    @abstractmethod
    def _layout(self, obs_dim: int) -> list[tuple[tuple[int, ...], torch.dtype | None]]:
        """Return shape behind the batch and dtype of each state; None: that of the observation."""

    def _carried(self, step: Step) -> list[Tensor] | None:
        """Return the states after the step before, None at a reset."""
        x, states = step.observation, []
        if step.before is None:
            return None
        layout = self._layout(x.shape[-1])
        for key, (event, dtype) in zip(self.state_keys, layout, strict=True):
            state: Tensor | None = step.before.get(key, None)
            if state is None:
                raise KeyError(
                    f"`{type(self).__name__}` reads its state after the step before under "
                    f"{key!r}, which is not there. Start from `env.reset()` and keep the key from "
                    "step to step, as `env.step_mdp` and TorchRL's collectors do."
                )
            shape, dtype = (*x.shape[:-1], *event), dtype or x.dtype
            if state.dtype is not dtype or state.shape != shape:
                raise ValueError(
                    f"`{key}` must be {_name(dtype)} of shape {tuple(shape)}, the state of "
                    f"`{type(self).__name__}`, got {_name(state.dtype)} {tuple(state.shape)}. Is "
                    f"it the state of another transform? Pass state_keys=... ."
                )
            states.append(state)
        return states

    def _carry(self, step: Step, *states: Tensor) -> None:
        """Write the states after this step."""
        for key, state in zip(self.state_keys, states, strict=True):
            step.data.set(key, state)

    def _state_specs(self, spec: Composite) -> Iterator[tuple[NestedKey, TensorSpec]]:
        leaves = [spec[key] for key in self.in_keys]
        layout = self._layout(sum(leaf.shape[-1] for leaf in leaves))
        for key, (event, dtype) in zip(self.state_keys, layout, strict=True):
            shape, device = (*leaves[0].shape[:-1], *event), leaves[0].device
            kind = Binary if dtype is torch.bool else Unbounded
            yield key, kind(shape=shape, device=device, dtype=dtype or leaves[0].dtype)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Enter the observation, its mask, the states and, on request, what was complete."""
        spec = super().transform_observation_spec(observation_spec)
        for key, leaf in self._state_specs(spec):
            enter_new(spec, key, leaf, self)
        return spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Enter the states as what a step reads."""
        observed = self.parent.full_observation_spec
        for key, leaf in self._state_specs(observed):
            enter_state(state_spec, key, leaf, observed)
        return state_spec


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _read_groups(groups: Groups) -> list[list[int]]:
    lists = [[] if isinstance(group, str | Integral) else list(group) for group in groups]
    whole = all(isinstance(i, Integral) and not isinstance(i, bool) for g in lists for i in g)
    if not lists or not all(lists) or not whole:
        raise ValueError(
            f"`groups` must be lists of indices, none empty, such as [[0, 1], [2]], got {groups!r}."
        )
    return [[int(index) for index in group] for group in lists]


def read_steps(value: Any, name: str, least: int, *, several: bool = True) -> Tensor:
    """Return a whole number of steps, or one for each group, as int64 `()` or `(groups,)`."""
    more = ", or one for each group of sensors" if several else ""
    meaning = f"a whole number of steps, at least {least}{more}"
    read = read_numbers(value, name, meaning, least, whole=True, several=several)
    return read.squeeze() if read.numel() == 1 else read
