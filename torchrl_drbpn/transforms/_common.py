"""What the transforms share: keys, specs and the rules of order.

A chain of transforms has an order that matters: noise falls on the complete observation, then
entries go missing, then what is left is filled or normalised. `check_order` holds a chain to it
whenever one of this package's transforms is attached, alone, inside a `Compose`, or appended to a
living environment.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import ClassVar, Literal

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv

Role = Literal["previous_action", "noise", "missingness", "from_nan", "fill", "normalise", "reward"]

# "from_nan" reads what real sensors failed to deliver: it belongs before fillers and normalisers as
# the others do, but it destroys nothing, so a complete observation may still be recorded after it.
CORRUPTING: frozenset[str] = frozenset({"noise", "missingness", "from_nan"})
MISSINGNESS: frozenset[str] = frozenset({"missingness", "from_nan"})


# ------------------------------------------------------------------------------------------- keys
def as_key_list(keys: NestedKey | Sequence[NestedKey]) -> list[NestedKey]:
    """Return `keys` as a list of unravelled nested keys; one key gives a list of one.

    A tuple of strings is one nested key, as everywhere in TorchRL; several keys come in a list.

    Args:
        keys: a string, a tuple of strings (one nested key), or a list of such keys.

    Returns:
        The list of keys.

    Raises:
        TypeError: if something in `keys` is no nested key.
    """
    items = [keys] if isinstance(keys, str | tuple) else list(keys)
    # Configurations know no tuples: inside a list, a sequence of strings is a nested key as well.
    items = [
        tuple(key) if isinstance(key, Sequence) and not isinstance(key, str) else key
        for key in items
    ]
    for key in items:
        flat = key if isinstance(key, tuple) else (key,)
        if not flat or not all(isinstance(part, str) for part in flat):
            raise TypeError(
                "a key must be a string or a tuple of strings and several keys a list of those, "
                f"got {key!r} of type {type(key).__name__}."
            )
    return [unravel_key(key) for key in items]


def sibling_key(key: NestedKey, name: str) -> NestedKey:
    """Return the key called `name` that lies beside `key`.

    >>> sibling_key("observation", "observed")
    'observed'
    >>> sibling_key(("agents", "observation"), "observed")
    ('agents', 'observed')
    """
    return (*key[:-1], name) if isinstance(key, tuple) else name


def pair_keys(
    in_keys: Sequence[NestedKey],
    keys: NestedKey | Sequence[NestedKey] | None,
    *,
    name: str,
    default: str,
) -> list[NestedKey]:
    """Return one key per observation key: those given, or `default` beside each observation.

    Args:
        in_keys: the observation keys.
        keys: what the user passed as `name`, or None for the default.
        name: the argument's name, for the error.
        default: the last part of the default key.

    Returns:
        As many keys as there are `in_keys`, all different.

    Raises:
        ValueError: if the numbers differ or two observations would share a key.

    Example:
        >>> pair_keys(["observation"], None, name="mask_keys", default="observed")
        ['observed']
    """
    pairs = [sibling_key(key, default) for key in in_keys] if keys is None else as_key_list(keys)
    if len(pairs) != len(in_keys) or len(set(pairs)) != len(pairs):
        raise ValueError(
            f"`{name}` must name one key of its own for each of the {len(in_keys)} in_keys "
            f"{list(in_keys)}, got {pairs}. Pass a list of {len(in_keys)} different keys."
        )
    return pairs


def fetch(tensordict: TensorDictBase, key: NestedKey) -> Tensor | None:
    """Return the entry under `key`, or None.

    What `tensordict.get(key, None)` does, without its handling of keys, a microsecond a call.
    """
    value: Tensor | None = (
        tensordict._get_str(key, None) if isinstance(key, str) else tensordict.get(key, None)
    )
    return value


def store(tensordict: TensorDictBase, key: NestedKey, value: Tensor) -> None:
    """Write an entry whose batch shape and device are those of the tensordict.

    What `tensordict.set(key, value)` does, without checking what was made from its other entries.
    """
    if isinstance(key, str):
        tensordict._set_str(key, value, validated=True, inplace=False, non_blocking=False)
    else:
        tensordict.set(key, value)


def read(tensordict: TensorDictBase, key: NestedKey, owner: Transform) -> Tensor:
    """Return the entry under `key`, or raise a KeyError that names the transform and the key."""
    value = fetch(tensordict, key)
    if value is None:
        raise KeyError(
            f"`{type(owner).__name__}` reads {key!r}, which is not among the keys "
            f"{sorted(map(str, tensordict.keys(True, True)))}. Pass in_keys=... with the key that "
            "your environment writes."
        )
    return value


# ------------------------------------------------------------------------------------------ specs
def observation_leaf(spec: Composite, key: NestedKey, owner: Transform) -> TensorSpec:
    """Return the spec under `key` after checking that it is a vector of floating point numbers.

    Args:
        spec: the observation spec of the environment.
        key: the observation's key.
        owner: the transform on whose behalf the check is made.

    Returns:
        The leaf, shape `(*batch, obs)`.

    Raises:
        KeyError: if there is no such key.
        ValueError: if the observation is no vector or not floating point.
    """
    name = type(owner).__name__
    if key not in spec.keys(True, True):
        raise KeyError(
            f"`{name}` reads {key!r}, which is not among the observations "
            f"{sorted(map(str, spec.keys(True, True)))} of the environment. Pass in_keys=... ."
        )
    leaf = spec[key]
    parent = spec[key[:-1]] if isinstance(key, tuple) else spec
    if len(leaf.shape) - len(parent.shape) != 1 or not leaf.dtype.is_floating_point:
        raise ValueError(
            f"`{key}` must be a vector of floating point numbers for `{name}`, of shape "
            f"(*batch, obs) with batch {tuple(parent.shape)}, got {leaf.dtype} of shape "
            f"{tuple(leaf.shape)}. Flatten or cast it first, as with FlattenObservation, "
            "CatTensors or DTypeCastTransform."
        )
    return leaf


def unbounded_like(leaf: TensorSpec) -> Unbounded:
    """Return an unbounded continuous spec with the shape, device and dtype of `leaf`."""
    return Unbounded(shape=leaf.shape, device=leaf.device, dtype=leaf.dtype)


def mask_like(leaf: TensorSpec) -> Binary:
    """Return the spec of a boolean mask with the shape and device of `leaf`."""
    return Binary(shape=leaf.shape, device=leaf.device, dtype=torch.bool)


def set_mask_spec(spec: Composite, key: NestedKey, leaf: TensorSpec, owner: Transform) -> None:
    """Enter the mask `key` into `spec`, or check the mask that is there already.

    Args:
        spec: the observation spec, changed in place.
        key: the mask's key.
        leaf: the spec of the observation that the mask belongs to.
        owner: the transform on whose behalf this is done.

    Raises:
        ValueError: if an entry of another shape or dtype has that key already.
    """
    if key in spec.keys(True, True):
        present = spec[key]
        if present.shape != leaf.shape or present.dtype != torch.bool:
            raise ValueError(
                f"`{key}` must be bool of shape {tuple(leaf.shape)}, one entry per component, for "
                f"`{type(owner).__name__}`, got {present.dtype} of shape {tuple(present.shape)}. "
                "Is it the mask of another observation? Pass mask_keys=... ."
            )
    spec[key] = mask_like(leaf)


# ------------------------------------------------------------------------------------------ order
def _container_of(transform: Transform) -> Transform | EnvBase | None:
    reference = transform.__dict__.get("_container")
    return None if reference is None else reference()


def _leaves(transform: Transform) -> Iterator[Transform]:
    if isinstance(transform, Compose):
        for part in transform.transforms:
            yield from _leaves(part)
    else:
        yield transform


def transform_chain(transform: Transform) -> list[Transform]:
    """Return every transform that works on the same data as `transform`, first applied first.

    It goes up through nested `Compose`s to the environment and down through environments that are
    wrapped several times. Transforms inside the workers of a batched environment can't be seen.

    Args:
        transform: a transform, attached or not.

    Returns:
        The chain, `transform` included.
    """
    top, container = transform, _container_of(transform)
    while isinstance(container, Compose):
        top, container = container, _container_of(container)
    chain = list(_leaves(top))
    while isinstance(container, TransformedEnv):
        container = container.base_env
        if isinstance(container, TransformedEnv):
            chain = [*_leaves(container.transform), *chain]
    return chain


def check_order(chain: Sequence[Transform]) -> None:
    """Hold a chain of transforms to the order in which corruption and repair make sense.

    Args:
        chain: transforms, first applied first. Those without a `role` are passed over.

    Raises:
        ValueError: if a normaliser stands before a corrupting transform, a filler before
            missingness, two transforms write the same complete observation, or one is to be
            recorded from observations that are corrupted already.
    """
    seen: list[Transform] = []
    writers: dict[NestedKey, str] = {}
    for transform in chain:
        role = getattr(transform, "role", None)
        if role is None:
            continue
        name = type(transform).__name__
        if role in CORRUPTING:
            keys = set(transform.in_keys)
            complete = getattr(transform, "complete_keys", [])
            for earlier in seen:
                if keys.isdisjoint([*earlier.in_keys, *earlier.out_keys]):
                    continue
                other = type(earlier).__name__
                if earlier.role == "normalise":
                    raise ValueError(
                        f"`{other}` stands before `{name}`: its statistics would come from "
                        "observations that the agent never sees, and noise would be counted in "
                        f"normalised units. Put `{other}` after `{name}`."
                    )
                if earlier.role == "fill" and role in MISSINGNESS:
                    raise ValueError(
                        f"`{other}` stands before `{name}`: what goes missing afterwards is never "
                        f"filled. Put `{other}` after `{name}`."
                    )
            for key in complete:
                if key in writers:
                    raise ValueError(
                        f"`{key}` is written by two transforms, `{writers[key]}` and `{name}`. "
                        "Pass complete_key to the first corrupting transform only."
                    )
                writers[key] = name
            if complete:
                for earlier in seen:
                    if earlier.role in {"noise", "missingness"} and not keys.isdisjoint(
                        earlier.in_keys
                    ):
                        raise ValueError(
                            f"`{name}` is asked for {complete} but `{type(earlier).__name__}` has "
                            "corrupted the observation before it. Pass complete_key to "
                            f"`{type(earlier).__name__}`, the first corrupting transform."
                        )
        seen.append(transform)


class OrderedTransform(Transform):
    """A transform with a role in the chain, checked against its neighbours when it is attached.

    Subclasses set `role`. Those that write the complete observation also set `complete_keys`.
    """

    role: ClassVar[Role]

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attach the transform and check the order of the chain that it has joined.

        Args:
            container: the environment or the `Compose` that takes the transform.

        Raises:
            ValueError: if the order is wrong; a living environment is left as it was.
        """
        super().set_container(container)
        try:
            check_order(transform_chain(self))
        except ValueError:
            self._leave(container)
            raise

    def _leave(self, container: Transform | EnvBase) -> None:
        # append and insert put a transform into the list before they attach it: without this, a
        # caller who catches the error would go on with the wrong order
        if not isinstance(container, Compose):
            return
        top = container
        while isinstance(above := _container_of(top), Compose):
            top = above
        if isinstance(above, TransformedEnv) and above.transform is top:
            for index, part in enumerate(container.transforms):
                if part is self:
                    container.transforms.pop(index)
                    break
            above.empty_cache()
            self.reset_parent()
