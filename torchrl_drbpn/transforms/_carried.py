"""What transforms with a memory share: a state in the tensordict, and sensors that go together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any, ClassVar, NamedTuple

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded

from torchrl_drbpn.functional.missingness import OutageRates, sample_fault_steps
from torchrl_drbpn.transforms._base import (
    Keys,
    Step,
    as_key_list,
    enter_new,
    read_vector,
    sibling_key,
)
from torchrl_drbpn.transforms.seeding import SeededTransform


class CarriedStateTransform(SeededTransform):
    """A corrupting transform that remembers something from step to step.

    What it remembers travels in the tensordict, as the counts of TorchRL's `StepCounter` do, so
    that partial resets and workers hold and a stored step says what the next starts from. A
    subclass names its states and says of what shape they are.

    Args:
        groups: lists of indices of sensors that go together, or None for each by itself.
        state_keys: where the states are kept; None: under `state_names` beside the first
            observation.
        **keys: passed on to `SeededTransform`.
    """

    state_names: ClassVar[tuple[str, ...]]
    # what errors call the argument that names the states
    state_argument: ClassVar[str] = "state_keys"

    def __init__(
        self, *, groups: Sequence[Sequence[int]] | None, state_keys: Keys | None, **keys: Any
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
                f"`{self.state_argument}` must be {number} of its own, got {self.state_keys} "
                f"beside {self.out_keys}, which this transform writes something else to."
            )
        self.out_keys = [*self.out_keys, *self.state_keys]
        self._columns: Tensor | None = None

    # ------------------------------------------------------------------------------------ groups
    def _count(self, obs_dim: int) -> int:
        """Return how many groups there are; without groups every component is one."""
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
        columns = self._columns_for(observation)
        return torch.cat([of_group, outside], -1).index_select(-1, columns)

    def _columns_for(self, observation: Tensor) -> Tensor:
        """Return the group of every component; the number of groups where it is in none."""
        columns = self._columns
        if columns is None or columns.device != observation.device:
            groups = self.groups or []
            columns = torch.full(observation.shape[-1:], len(groups))
            for index, group in enumerate(groups):
                columns[group] = index
            columns = self._columns = columns.to(observation.device)
        return columns

    def _check_obs_dim(self, obs_dim: int) -> None:
        indices = [index for group in self.groups or [] for index in group]
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

    # ------------------------------------------------------------------------------------- state
    def _layout(self, obs_dim: int) -> list[tuple[tuple[int, ...], torch.dtype | None]]:
        """Return shape behind the batch and dtype of each state; None: that of the observation."""
        raise NotImplementedError

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
                    f"it the state of another transform? Pass {self.state_argument}=... ."
                )
            states.append(state)
        return states

    def _carry(self, step: Step, *states: Tensor) -> None:
        """Write the states after this step."""
        for key, state in zip(self.state_keys, states, strict=True):
            step.data.set(key, state)

    def _state_specs(self, spec: Composite) -> list[TensorSpec]:
        leaves = [read_vector(spec, key, self) for key in self.in_keys]
        made: list[TensorSpec] = []
        for event, dtype in self._layout(sum(leaf.shape[-1] for leaf in leaves)):
            shape, device = (*leaves[0].shape[:-1], *event), leaves[0].device
            kind = Binary if dtype is torch.bool else Unbounded
            made.append(kind(shape=shape, device=device, dtype=dtype or leaves[0].dtype))
        return made

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Enter the observation, its mask, the states and, on request, what was complete."""
        spec = super().transform_observation_spec(observation_spec)
        for key, leaf in zip(self.state_keys, self._state_specs(spec), strict=True):
            enter_new(spec, key, leaf, self)
        return spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Enter the states as what a step reads."""
        specs = self._state_specs(self.parent.full_observation_spec)
        for key, leaf in zip(self.state_keys, specs, strict=True):
            state_spec[key] = leaf
        return state_spec


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")


def _read_groups(groups: Sequence[Sequence[int]]) -> list[list[int]]:
    lists = [[] if isinstance(group, str | Integral) else list(group) for group in groups]
    whole = all(isinstance(i, Integral) and not isinstance(i, bool) for g in lists for i in g)
    if not lists or not all(lists) or not whole:
        raise ValueError(
            f"`groups` must be lists of indices, none empty, such as [[0, 1], [2]], got {groups!r}."
        )
    return [[int(index) for index in group] for group in lists]


# -------------------------------------------------------------------------------- when faults occur
class Lifecycle(NamedTuple):
    """When faults begin and end: drawn at every step, or at a fixed step of every episode.

    The state is an int64 count for each group: how many steps its fault has lasted, this one
    included; 0 or less while it works. Every group works before an episode begins.

    Attributes:
        rates: probabilities of a fault's begin and end, or None where `onset` fixes it.
        onset: the step at which faults begin, 0 for the reset.
        duration: how many steps they last.
    """

    rates: OutageRates | None
    onset: int
    duration: float

    def advance(
        self, steps: Tensor | None, like: Tensor, generator: torch.Generator | None
    ) -> Tensor:
        """Return the counts at this step from those of the step before, None at a reset."""
        if self.rates is not None:
            return sample_fault_steps(steps, self.rates, like, generator)
        if steps is None:
            return torch.full(like.shape, 1 - self.onset, dtype=torch.int64, device=like.device)
        return steps + 1

    def active(self, steps: Tensor) -> Tensor:
        """Return which groups have a fault now, bool."""
        return (steps > 0) & (steps <= self.duration)


def read_lifecycle(
    probability: float | None, mean_length: float | None, onset: int | None, duration: int | None
) -> Lifecycle:
    """Check the four arguments that say when faults begin and end; None: not given."""
    if (probability is None) == (onset is None):
        raise ValueError(
            "`probability` (with `mean_length`) draws when a fault begins, `onset` (with "
            f"`duration`) fixes it: give one of them, got probability={probability!r} and "
            f"onset={onset!r}."
        )
    if probability is None:
        if mean_length is not None:
            raise ValueError("`mean_length` goes with `probability`; with `onset` give `duration`.")
        first = read_whole(onset, "onset", 0, several=False)
        last = math.inf
        if duration is not None:
            last = float(read_whole(duration, "duration", 1, several=False))
        return Lifecycle(None, int(first), last)
    if duration is not None:
        raise ValueError("`duration` goes with `onset`; with `probability` give `mean_length`.")
    if not isinstance(probability, Real) or not 0 <= probability <= 1:
        raise ValueError(
            "`probability` must be that of a fault to begin at a step, in [0, 1], got "
            f"{probability!r}."
        )
    mean_length = math.inf if mean_length is None else mean_length
    if not isinstance(mean_length, Real) or not mean_length >= 1:
        raise ValueError(
            "`mean_length` must be the mean length of a fault in steps, at least 1 and infinite "
            f"for one that never ends, got {mean_length!r}."
        )
    return Lifecycle(OutageRates(float(probability), 1.0 / mean_length), 0, math.inf)


# ----------------------------------------------------------------------------------- whole numbers
def read_whole(value: object, name: str, least: int, *, several: bool = True) -> Tensor:
    """Return a whole number, or one for each group, as int64 of shape `()` or `(groups,)`."""
    given = value.tolist() if isinstance(value, Tensor) else value
    listed = several and isinstance(given, Sequence) and not isinstance(given, str)
    items: list[Any] = list(given) if listed else [given]  # type: ignore[call-overload]
    whole = all(isinstance(item, Integral) and not isinstance(item, bool) for item in items)
    if not items or not whole or min(items) < least:
        more = ", or one for each group of sensors" if several else ""
        raise ValueError(
            f"`{name}` must be a whole number of steps, at least {least}{more}, got {value!r}."
        )
    return torch.tensor(items if len(items) > 1 else int(items[0]))


def check_count(numbers: Tensor, name: str, groups: int) -> None:
    """Refuse numbers that are neither one nor as many as there are groups."""
    if numbers.ndim and numbers.shape[0] != groups:
        raise ValueError(
            f"`{name}` must have one entry for each of the {groups} groups (components, where "
            f"there are no groups), got {numbers.shape[0]}."
        )
