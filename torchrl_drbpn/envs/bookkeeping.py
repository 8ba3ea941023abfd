"""TorchRL's bookkeeping transforms at the end of a chain, on plain dictionaries.

``RewardSum``, ``StepCounter``, ``InitTracker`` and ``TensorDictPrimer`` do three additions and a
few zeros; finding their keys, flags and specs anew costs them a third of a millisecond at every
step. In their ordinary configuration :func:`shorten` does the same from keys found once. The
transforms stay in the chain, with their specs, and do the work themselves everywhere else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDict
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import InitTracker, RewardSum, StepCounter, TensorDictPrimer, Transform

__all__ = ["Short", "holds", "shorten"]

_Entries = dict[str, Tensor | TensorDict]
_Step = Callable[[_Entries, _Entries], bool]


class Short(NamedTuple):
    """Hold the short form of one transform.

    Attributes:
        step: from the entries of a root and of its next step, write what the transform writes;
            False, and nothing written, where it has to do the work itself.
        zeroed: the entries that its reset sets to zero.
        flagged: the entries that its reset sets to the reset flag itself.
    """

    step: _Step
    zeroed: Sequence[NestedKey] = ()
    flagged: Sequence[str] = ()


def shorten(part: Transform) -> Short | None:
    """Return the short form of a transform.

    Args:
        part: an attached transform.

    Returns:
        The short form, or None where the transform is of another class or configured otherwise.
    """
    # Exactly these classes: a subclass may do more.
    form = _FORMS.get(type(part))
    return None if form is None else form(part)


def _all_strings(keys: Sequence[NestedKey]) -> bool:
    return all(isinstance(key, str) for key in keys)


def _reward_sum(part: RewardSum) -> Short | None:
    pairs = list(zip(part.in_keys, part.out_keys, strict=True))
    if not _all_strings([*part.in_keys, *part.out_keys]):
        return None

    def step(root: _Entries, following: _Entries) -> bool:
        for reward, total in pairs:
            if reward not in following or total not in root:
                return False
        for reward, total in pairs:
            following[total] = root[total] + following[reward]
        return True

    return Short(step, zeroed=list(part.out_keys))


def _step_counter(part: StepCounter) -> Short | None:
    keys = list(part.step_count_keys)
    if part.max_steps is not None or not _all_strings(keys):
        return None

    def step(root: _Entries, following: _Entries) -> bool:
        for key in keys:
            following[key] = root[key] + 1
        return True

    return Short(step, zeroed=keys)


def _init_tracker(part: InitTracker) -> Short | None:
    keys = list(part.init_keys)
    if not _all_strings(keys):
        return None

    def step(root: _Entries, following: _Entries) -> bool:
        del root
        for key in keys:
            if key not in following:
                following[key] = torch.zeros_like(following["done"])
        return True

    return Short(step, flagged=keys)


def _primer(part: TensorDictPrimer) -> Short | None:
    keys = list(part.primers.keys(True, True))
    values = part.default_value
    ordinary = (
        not part.random
        and not part.call_before_env_reset
        and not part.single_default_value
        and all(isinstance(values[key], int | float) and values[key] == 0 for key in keys)
    )
    if not ordinary:
        return None

    def step(root: _Entries, following: _Entries) -> bool:
        # The policy has written the next recurrent state; where none has, the old one is carried.
        absent = [key for key in keys if not holds(following, key)]
        if not all(holds(root, key) for key in absent):
            return False
        return all(_carry(root, following, key) for key in absent)

    return Short(step, zeroed=keys)


def _carry(root: _Entries, following: _Entries, key: NestedKey) -> bool:
    """Enter a root's entry into its next step; False where TensorDict itself has to do it."""
    path = (key,) if isinstance(key, str) else key
    for name in path[:-1]:
        inner: Any = root[name]
        if name not in following:
            following[name] = TensorDict._new_unsafe(
                {}, batch_size=inner.batch_size, device=inner.device
            )
        beside: Any = following[name]
        if type(beside) is not TensorDict:
            return False
        root, following = inner._tensordict, beside._tensordict
    following[path[-1]] = root[path[-1]]
    return True


def holds(entries: _Entries, key: NestedKey) -> bool:
    """Tell whether plain nested TensorDicts have an entry.

    Args:
        entries: of the outermost one.
        key: the entry's.

    Returns:
        False where it is absent, or inside another kind of TensorDict.
    """
    path = (key,) if isinstance(key, str) else key
    for name in path[:-1]:
        inner: Any = entries.get(name)
        if type(inner) is not TensorDict:
            return False
        entries = inner._tensordict
    return path[-1] in entries


_FORMS: dict[type[Transform], Callable[..., Short | None]] = {
    RewardSum: _reward_sum,
    StepCounter: _step_counter,
    InitTracker: _init_tracker,
    TensorDictPrimer: _primer,
}
