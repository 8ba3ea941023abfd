"""The keys of a belief module: what a user may call them, and who writes one that is absent."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tensordict import TensorDictBase, unravel_key
from tensordict.utils import NestedKey
from torch import Tensor

_SOURCES = (
    "does the environment use another name? Pass in_keys",
    "ObservationMissingness or ObservedFromNaN writes it (all True: nothing missing)",
    "the PreviousAction transform writes it",
    "TorchRL's InitTracker transform writes it",
)


def read_entry(tensordict: TensorDictBase, in_keys: Sequence[NestedKey], index: int) -> Tensor:
    """Return one of the four inputs (index 0 to 3), or say who writes it."""
    value = tensordict.get(in_keys[index], None)
    if value is None:
        raise KeyError(f"`{in_keys[index]}` is not in the tensordict: {_SOURCES[index]}.")
    return value


def as_keys(given: Sequence[NestedKey], name: str) -> list[NestedKey]:
    """Return a list of keys; a key may be any sequence of strings, as configurations give them."""
    if isinstance(given, str) or not isinstance(given, Sequence):
        raise TypeError(
            f"`{name}` must be a list of keys or a dict, got {given!r} of type "
            f"{type(given).__name__}."
        )
    return [unravel_key(key if isinstance(key, str) else tuple(key)) for key in given]


def check_distinct(keys: Sequence[NestedKey], name: str) -> None:
    twice = sorted({str(key) for key in keys if list(keys).count(key) > 1})
    if twice:
        raise ValueError(
            f"`{name}` must give every entry a key of its own, got {', '.join(twice)} twice."
        )


def read_in_keys(
    given: Sequence[NestedKey] | Mapping[NestedKey, NestedKey] | None,
    names: Sequence[NestedKey],
    owner: str,
) -> list[NestedKey]:
    """Return the user's keys in the order of ``names``: four inputs, then the recurrent state."""
    if given is None:
        return list(names)
    if isinstance(given, Mapping):
        pairs = {unravel_key(name): unravel_key(key) for name, key in given.items()}
        unknown = [name for name in pairs if name not in names]
        if unknown:
            raise ValueError(f"`in_keys` names {unknown}; {owner} reads {list(names)}.")
        keys = [pairs.get(name, name) for name in names]
    else:
        keys = as_keys(given, "in_keys")
        if len(keys) not in (4, len(names)):
            raise ValueError(
                f"`in_keys` must have 4 or {len(names)} entries, in the order {list(names)}, got "
                f"{keys}. To rename one of them pass a dict such as "
                "{'observation': 'pixels_encoded'}."
            )
        keys = [*keys, *names[len(keys) :]]
    check_distinct(keys, "in_keys")
    return keys


def read_out_keys(
    given: Sequence[NestedKey] | Mapping[NestedKey, NestedKey] | None,
    default: Sequence[NestedKey],
    optional: Sequence[NestedKey],
    recurrent: Sequence[NestedKey],
    owner: str,
) -> dict[NestedKey, NestedKey]:
    """Map the canonical names to the user's keys; recurrent entries in a list are implied."""
    names = (*default, *optional)
    if given is None:
        return {name: name for name in default}
    if isinstance(given, Mapping):
        pairs = {unravel_key(name): unravel_key(key) for name, key in given.items()}
    else:
        pairs = {key: key for key in as_keys(given, "out_keys") if key not in recurrent}
    unknown = [name for name in pairs if name not in names]
    if unknown:
        raise ValueError(
            f"`out_keys` names {unknown}; {owner} can write {list(names)}, and writes "
            f"{list(recurrent)} in any case. To write one under another key pass a dict such as "
            "{'features': 'embed'}; to rename the recurrent state pass in_keys."
        )
    check_distinct([*pairs.values(), *recurrent], "out_keys")
    return pairs
