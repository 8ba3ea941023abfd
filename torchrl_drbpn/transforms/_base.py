"""What the transforms share: keys, numbers, specs, order, and the frame of those that corrupt."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import takewhile
from typing import Any, ClassVar, NamedTuple, TypeAlias, TypedDict

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import dispatch
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform, TransformedEnv

from torchrl_drbpn.functional.gaussian import check_observed, zero_missing

Keys: TypeAlias = NestedKey | Sequence[NestedKey]


def as_key_list(keys: Keys) -> list[NestedKey]:
    """Return one key, or a list of keys, as a list; a tuple of strings is one nested key."""
    items: list[Any] = [keys] if isinstance(keys, str | tuple) else list(keys)
    for place, key in enumerate(items):
        # YAML has no tuples: inside a list, a list of strings is a nested key as well
        flat = [key] if isinstance(key, str) or not isinstance(key, Sequence) else list(key)
        if not flat or not all(isinstance(part, str) for part in flat):
            raise TypeError(
                "a key must be a string or a tuple of strings and several keys a list of those, "
                f"got {key!r} of type {type(key).__name__}."
            )
        items[place] = unravel_key(tuple(flat))
    return items


def sibling_key(key: NestedKey, name: str) -> NestedKey:
    """Return the key called `name` beside `key`; a `{}` in it stands for what `key` is called."""
    *folder, last = key if isinstance(key, tuple) else (key,)
    return unravel_key((*folder, name.format(last)))


def pair_keys(
    in_keys: Sequence[NestedKey], keys: Keys | None, *, name: str, default: str
) -> list[NestedKey]:
    """Return one key for each in_key: those given as `name`, or `default` beside each in_key."""
    pairs = [sibling_key(key, default) for key in in_keys] if keys is None else as_key_list(keys)
    if len(pairs) != len(in_keys) or len(set(pairs)) != len(pairs):
        raise ValueError(
            f"`{name}` must name one key of its own for each of the {len(in_keys)} in_keys "
            f"{list(in_keys)}, got {pairs}. Pass a list of {len(in_keys)} different keys."
        )
    return pairs


def read_numbers(
    value: object,
    name: str,
    meaning: str,
    least: float = 0.0,
    most: float = math.inf,
    *,
    whole: bool = False,
    several: bool = True,
) -> Tensor:
    """Return a number or, where `several`, a list of them as float64, or as int64 where `whole`."""
    try:
        read = torch.as_tensor(value, dtype=None if whole else torch.float64).cpu()
    except (TypeError, ValueError, RuntimeError):
        read = torch.tensor(math.nan)
    broken = whole and (read.is_floating_point() or read.dtype is torch.bool)
    inside = (read >= least) & (read <= most) & read.isfinite()
    if broken or read.ndim > several or not bool(inside.all()):
        raise ValueError(f"`{name}` must be {meaning}, got {value!r}.")
    return read


def check_count(numbers: Tensor | None, name: str, count: int, per: str) -> None:
    """Refuse numbers that are neither one nor `count`."""
    if numbers is not None and numbers.ndim and numbers.shape[0] != count:
        raise ValueError(
            f"`{name}` must have one entry per {per}, {count}, got {numbers.shape[0]}."
        )


def read_leaf(source: Any, key: NestedKey, owner: Transform) -> Any:
    """Return the tensor or spec under `key`, or raise a KeyError that names the transform."""
    leaf = source.get(key, None)
    if leaf is None:
        raise KeyError(
            f"`{type(owner).__name__}` reads {key!r}, which is not among "
            f"{sorted(map(str, source.keys(True, True)))}. Pass the key that the environment has."
        )
    return leaf


def read_vector(source: Any, key: NestedKey, owner: Transform) -> Any:
    """Return the observation, or its spec, under `key`: one vector of floats for each row."""
    leaf = read_leaf(source, key, owner)
    batch_dims = (source[key[:-1]] if isinstance(key, tuple) else source).ndim
    if leaf.ndim != batch_dims + 1 or not leaf.dtype.is_floating_point:
        raise ValueError(
            f"`{key}` must be a vector of floating point numbers of shape (*batch, obs) for "
            f"`{type(owner).__name__}`, got {leaf.dtype} of shape {tuple(leaf.shape)}. Flatten "
            "or cast it first, as with FlattenObservation, CatTensors or DTypeCastTransform."
        )
    return leaf


def enter_new(spec: Composite, key: NestedKey, leaf: TensorSpec, owner: Transform) -> None:
    """Enter a key into `spec` that nothing else may write."""
    if key in spec.keys(True, True):
        raise ValueError(
            f"`{key}` is among the observations of the environment already, so "
            f"`{type(owner).__name__}` can't write it: another transform (perhaps inside the "
            "workers) or the environment itself does. Pass another key."
        )
    spec[key] = leaf


def enter_state(spec: Composite, key: NestedKey, leaf: TensorSpec, like: Composite) -> None:
    """Enter a key into the state spec, in folders of the shapes that they have in ``like``."""
    for depth in range(1, len(key)) if isinstance(key, tuple) else ():
        folder = key[:depth]
        if folder not in spec.keys(True) and folder in like.keys(True):
            spec[folder] = Composite(shape=like[folder].shape, device=like.device)
    spec[key] = leaf


def environment_of(transform: Transform) -> EnvBase | None:
    """Return the environment that holds the transform, if any does."""
    try:
        return transform.container
    except ValueError:  # inside a Compose that belongs to no environment
        return None


def chain_of(transform: Transform) -> list[Transform]:
    """Return the transforms of its environment in their order; those in workers can't be seen."""
    env = environment_of(transform)
    chain: list[Transform] = []
    while isinstance(env, TransformedEnv):
        chain = [part for part in env.transform.modules() if isinstance(part, Transform)] + chain
        env = env.base_env
    return chain


def flagged_rows(tensordict: TensorDictBase, key: NestedKey, value: Tensor) -> Tensor | None:
    """Return the rows that `"_reset"`, beside `key` or above it, marks, spread over `value`."""
    folders = key[:-1] if isinstance(key, tuple) else ()
    for depth in range(len(folders), -1, -1):
        flag = tensordict.get((*folders[:depth], "_reset"), None)
        if flag is not None:
            rows = flag.flatten(tensordict.ndim).any(-1) if flag.ndim > tensordict.ndim else flag
            return expand_as_right(rows, value)
    return None


class EnvironmentTransform(Transform):
    """A transform that works in an environment alone; `why_online` is the reason it gives."""

    why_online: ClassVar[str]

    def _refuse(self) -> NotImplementedError:
        name = type(self).__name__
        return NotImplementedError(
            f"`{name}` {self.why_online}, so that it can't work on a replay buffer or in front of "
            f"a model. Append it to the environment: TransformedEnv(env, {name}(...))."
        )

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # a replay buffer calls `inv` on what comes in and `forward` on what goes out
        if environment_of(self) is None:
            raise self._refuse()
        return tensordict

    def forward(self, _: TensorDictBase) -> TensorDictBase:
        """Raise a NotImplementedError: stored data can't be transformed."""
        raise self._refuse()


class Step(NamedTuple):
    """What a corrupting transform works on.

    Attributes:
        observation: shape `(*batch, obs)`, the keys of one vector side by side.
        observed: the mask so far, bool, same shape.
        before: the data of the step before, with the action; None at a reset.
        data: the data of this step, where what was drawn may be written.
    """

    observation: Tensor
    observed: Tensor
    before: TensorDictBase | None
    data: TensorDictBase


class CorruptionKeys(TypedDict, total=False):
    """Keyword arguments of every transform that corrupts, see `ObservationMissingness`."""

    in_keys: Keys
    mask_keys: Keys | None
    complete_key: Keys | None


class CorruptingTransform(Transform, ABC):
    """The frame of the transforms that change what arrives: keys, masks, specs, step and reset.

    Several observation keys count as one vector, in the order of `in_keys`, so that one law holds
    for the whole observation however it is cut into keys; keys under `"next"` are a vector of
    their own. Shapes and dtypes are checked in the specs, in the first data (a reset comes before
    the specs), and in data from outside an environment. A subclass writes `_corrupt`.
    """

    writes_mask: ClassVar[bool] = True
    # what it reads is still complete for a transform after it
    keeps_readings: ClassVar[bool] = False
    # attributes that hold one number for all components, or one for each
    per_component: ClassVar[tuple[str, ...]] = ()
    out_keys: list[NestedKey]

    def __init__(
        self,
        *,
        in_keys: Keys = ("observation",),
        mask_keys: Keys | None = None,
        complete_key: Keys | None = None,
    ) -> None:
        keys = as_key_list(in_keys)
        if not keys:
            raise ValueError("`in_keys` must name at least one observation, got none.")
        masks = pair_keys(keys, mask_keys, name="mask_keys", default="observed")
        complete: list[NestedKey] = []
        if complete_key is not None:
            complete = pair_keys(keys, complete_key, name="complete_key", default="")
        out_keys = [*keys, *(masks if self.writes_mask else []), *complete]
        super().__init__(in_keys=keys, out_keys=out_keys)
        self.mask_keys, self.complete_keys = masks, complete
        self._checked = False
        rows = list(zip(keys, masks, complete or [None] * len(keys), strict=True))
        here = [row for row in rows if row[0][:1] != ("next",)]
        self._vectors = [vector for vector in (here, [r for r in rows if r not in here]) if vector]

    @abstractmethod
    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor]:
        """Return the observation as it arrives, and the mask; the frame sets what it hides to 0."""

    def _check_obs_dim(self, obs_dim: int) -> None:
        """Raise a ValueError where the transform was made for another number of components."""
        for name in self.per_component:
            check_count(getattr(self, name), name, obs_dim, "component")

    def _check(self, source: Composite | TensorDictBase) -> None:
        """Check the specs or the data of the observations."""
        for vector in self._vectors:
            leaves = [read_vector(source, key, self) for key, _, _ in vector]
            for (_, mask_key, _), leaf in zip(vector, leaves, strict=True):
                if mask_key in source.keys(True, True):
                    check_observed(leaf, source[mask_key], mask_key)
            if any(leaf.shape[:-1] != leaves[0].shape[:-1] for leaf in leaves):
                raise ValueError(
                    f"`in_keys` {self.in_keys} must share their batch to count as one vector, got "
                    f"shapes {[tuple(leaf.shape) for leaf in leaves]}. Give each batch a transform "
                    "of its own."
                )
            self._check_obs_dim(sum(leaf.shape[-1] for leaf in leaves))

    def _run(self, tensordict: TensorDictBase, before: TensorDictBase | None) -> TensorDictBase:
        if not self._checked:
            self._check(tensordict)
            self._checked = True
        for vector in self._vectors:
            parts: list[Tensor] = [tensordict.get(key) for key, _, _ in vector]
            masks = [tensordict.get(key, None) for _, key, _ in vector]
            masks = [
                torch.ones_like(part, dtype=torch.bool) if mask is None else mask
                for part, mask in zip(parts, masks, strict=True)
            ]
            step = Step(_join(parts), _join(masks), before, tensordict)
            corrupted, observed = self._corrupt(step)
            arrived = _split_like(zero_missing(corrupted, observed), parts)
            written = zip(vector, parts, arrived, _split_like(observed, parts), strict=True)
            for (key, mask_key, complete_key), part, value, mask in written:
                tensordict.set(key, value)
                if self.writes_mask:
                    tensordict.set(mask_key, mask)
                if complete_key is not None:
                    tensordict.set(complete_key, part)
        return tensordict

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._run(next_tensordict, None)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._run(next_tensordict, tensordict)

    def _reset(self, _: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        # the first observation of an episode arrives through the same sensors as every other
        return self._run(tensordict_reset, None)

    @dispatch(source="in_keys", dest="out_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Apply the transform to data outside an environment, as on a replay buffer."""
        self._checked = False
        return self._call(tensordict)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Widen the observation, enter its mask and, on request, the complete observation."""
        self._check_order()
        spec = observation_spec.clone()
        self._check(spec)
        for key, mask_key, complete_key in (row for vector in self._vectors for row in vector):
            leaf = spec[key]
            if complete_key is not None:
                enter_new(spec, complete_key, leaf.clone(), self)
            if self.writes_mask:
                spec[mask_key] = Binary(shape=leaf.shape, device=leaf.device, dtype=torch.bool)
            spec[key] = Unbounded(leaf.shape, leaf.device, leaf.dtype)
        return spec

    def _check_order(self) -> None:
        name, keys = type(self).__name__, set(self.in_keys)
        for earlier in takewhile(lambda part: part is not self, chain_of(self)):
            other = type(earlier).__name__
            if keys.isdisjoint([*earlier.in_keys, *earlier.out_keys]):
                continue
            if getattr(earlier, "fills", False):
                raise ValueError(
                    f"`{other}` stands before `{name}`, which leaves 0 where nothing arrived: what "
                    f"was filled is lost. Put `{other}` after `{name}`."
                )
            corrupts = isinstance(earlier, CorruptingTransform) and not earlier.keeps_readings
            if self.complete_keys and corrupts:
                raise ValueError(
                    f"`{name}` is asked for {self.complete_keys} but `{other}` has corrupted the "
                    f"observation before it. Pass complete_key to `{other}` instead."
                )


def _join(parts: list[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(parts, -1)


def _split_like(joined: Tensor, parts: Sequence[Tensor]) -> Sequence[Tensor]:
    """Cut one vector into pieces as wide as `parts`."""
    sizes = [part.shape[-1] for part in parts]
    return [joined] if len(parts) == 1 else torch.split(joined, sizes, -1)
