"""A step of a batch and the reset of its finished rows, with less Python around them.

TorchRL's ``step_and_maybe_reset`` looks up specs and keys, copies and compares nested entries and
calls every transform's inverse, whatever the environment is. For many simulators behind one
TensorDict these look-ups cost as much as a third of the simulators. Here they are made once and
kept in a :class:`Plan`; what a step does is TorchRL's, in its order, with the same results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, Transform

from torchrl_drbpn.envs.bookkeeping import Short, holds, shorten

__all__ = ["Plan"]

_Tree = Mapping[str, Any]


class Plan:
    """What the steps of one environment have in common: which calls, which keys.

    Args:
        env: the environment that is stepped.
        base: the batch of simulators inside it, or the same. Its ``_step`` and ``_reset`` return
            plain TensorDicts with all flags, of the shapes that the specs say.
        parts: the transforms between them, first applied first.

    Attributes:
        usable: False where the environment is out of the ordinary; nothing else may be called then.
    """

    def __init__(self, env: EnvBase, base: EnvBase, parts: Sequence[Transform] = ()) -> None:
        self.env, self.base, self.parts = env, base, list(parts)
        hooked = any(_overrides(part, "_post_step_mdp_hooks") for part in parts)
        flat = all(isinstance(key, str) for key in (*env.reward_keys, *env.done_keys))
        self.usable = flat and not hooked and not env.run_type_checks
        if not self.usable:
            return
        self.device, self.batch_size = env.device, env.batch_size
        self.done_keys = list(env.done_keys)
        self.drop: _Tree = env._step_mdp.exclude_from_root
        self.take: _Tree = env._step_mdp.keys_from_next
        rewards = env.output_spec["full_reward_spec"]
        self.rewards = [(key, rewards[key].shape) for key in env.reward_keys]
        # Short forms only at the end of the chain: no other transform then misses an entry that
        # a short reset leaves to the merge.
        self.short: list[Short] = []
        rest = list(parts)
        while rest and (short := shorten(rest[-1])) is not None:
            self.short.insert(0, short)
            rest.pop()
        self.steps = [part._step for part in rest]
        self.resets = [part._reset for part in rest]
        self.shortened = self.parts[len(rest) :]
        self.zeroed = [key for short in self.short for key in short.zeroed]
        self.flagged = [key for short in self.short for key in short.flagged]
        # The inverse runs from the last transform to the first; most do nothing.
        self.inverses = [
            part._inv_call
            for part in reversed(parts)
            if part.in_keys_inv or _overrides(part, "_inv_call")
        ]
        self.before_reset = [
            part._reset_env_preprocess
            for part in reversed(parts)
            if part.enable_inv_on_reset or _overrides(part, "_reset_env_preprocess")
        ]

    def __call__(self, root: TensorDict) -> tuple[TensorDictBase, TensorDictBase]:
        """Step the environment and reset its finished rows.

        Args:
            root: with the action; :meth:`takes` is true of it. The step goes into its ``"next"``.

        Returns:
            The root, and the root of the next step.
        """
        self._step(root)
        following = self._move_on(root)
        finished = int(following.get("done").sum())
        if finished:
            following = self._reset_finished(following, finished)
        return root, following

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        """Leave nothing in a copy or a pickle: a copied environment makes a plan of its own."""
        return type(None), ()

    def takes(self, tensordict: TensorDictBase) -> TypeGuard[TensorDict]:
        """Tell whether a root is of the ordinary kind.

        Args:
            tensordict: what ``step_and_maybe_reset`` was given.

        Returns:
            False where TorchRL's own way has to be gone.
        """
        return (
            type(tensordict) is TensorDict
            and not tensordict.is_locked
            and tensordict.device == self.device
            and tensordict.batch_size == self.batch_size
            and "_step" not in tensordict._tensordict
            and _is_plain(tensordict)
        )

    # ------------------------------------------------------------------ the three parts of a step
    def _step(self, root: TensorDict) -> None:
        """Step simulators and transforms; write ``"next"`` into the root."""
        preset = root._tensordict.get("next")
        # The root's own entries stay as they are, whatever the transforms write into theirs.
        working: TensorDictBase = _shallow(root)
        for inverse in self.inverses:
            working = inverse(working)
        following: TensorDictBase = self.base._step(working)
        if preset is not None:
            _fill(following, preset)
        for step in self.steps:
            following = step(working, following)
        if type(working) is TensorDict and type(following) is TensorDict:
            entries, results = working._tensordict, following._tensordict
            for part, short in zip(self.shortened, self.short, strict=True):
                if not short.step(entries, results):
                    part._step(working, following)
        else:
            for part in self.shortened:
                following = part._step(working, following)
        for key, shape in self.rewards:
            reward = following.get(key)
            if reward.shape != shape:
                following.set(key, reward.view(shape))
        if preset is not None:
            _fill(following, preset)
        root._set_str("next", following, validated=True, inplace=False, non_blocking=False)

    def _move_on(self, root: TensorDict) -> TensorDictBase:
        """Make the next root from a step, as TorchRL's ``step_mdp`` does."""
        following = root._tensordict["next"]
        if type(following) is not TensorDict or not _is_plain(following):
            out: TensorDictBase = self.env._step_mdp(root)
            return out
        return _advance(root, following, self.drop, self.take)

    def _reset_finished(self, root: TensorDictBase, finished: int) -> TensorDictBase:
        """Reset the rows that are done and put their first observations into the root."""
        if type(root) is not TensorDict or not _is_plain(root):
            return self.env.maybe_reset(root)
        entries = root._tensordict
        flag = entries["done"].clone()
        wanted: TensorDictBase = _new({"_reset": flag}, root)
        for prepare in self.before_reset:
            wanted = prepare(wanted)
        fresh: TensorDictBase = self.base._reset(wanted)
        flags = [fresh.get(key) for key in self.done_keys]
        for reset in self.resets:
            fresh = reset(wanted, fresh)
        partial = finished < flag.numel() and type(fresh) is TensorDict and _is_plain(fresh)
        if partial and all(holds(entries, key) for key in self.zeroed):
            # The merge puts zeros into the finished rows of what the fresh entries lack.
            for key in self.flagged:
                fresh._tensordict[key] = flag
        else:
            partial = False
            for part in self.shortened:
                fresh = part._reset(wanted, fresh)
        # What the simulators write is False everywhere; a transform may have written its own.
        untouched = all(fresh.get(k) is f for k, f in zip(self.done_keys, flags, strict=True))
        if partial and untouched:
            _merge(root, fresh, ~flag.reshape(self.batch_size))
            return root
        root.set("_reset", flag)
        merged: TensorDictBase = self.env._reset_proc_data(root, fresh)
        return merged


# --------------------------------------------------------------------- TensorDicts as dictionaries
# TensorDict's public operations check and copy at every call, which costs more than the arithmetic
# of sixteen robots. TorchRL's own step uses the same internals: _set_str, _new_unsafe.
def _new(source: dict[str, Any], like: TensorDictBase) -> TensorDict:
    return TensorDict._new_unsafe(source, batch_size=like.batch_size, device=like.device)


def _is_plain(tensordict: TensorDict) -> bool:
    """Tell whether all entries are tensors, or plain TensorDicts of tensors."""
    for value in tensordict._tensordict.values():
        if not isinstance(value, Tensor) and not (type(value) is TensorDict and _is_plain(value)):
            return False
    return not tensordict._has_names()


def _shallow(tensordict: TensorDict) -> TensorDict:
    """Copy the dictionaries, not the tensors."""
    return _new(
        {
            key: value if isinstance(value, Tensor) else _shallow(value)
            for key, value in tensordict._tensordict.items()
        },
        tensordict,
    )


def _fill(following: TensorDictBase, preset: TensorDict) -> None:
    """Enter what the policy wrote under ``"next"`` where the environment did not write it."""
    for key, value in preset._tensordict.items():
        present = following._get_str(key, None)
        if present is None:
            copy = value if isinstance(value, Tensor) else _shallow(value)
            following._set_str(key, copy, validated=True, inplace=False, non_blocking=False)
        elif type(present) is TensorDict and type(value) is TensorDict:
            _fill(present, value)


def _advance(root: TensorDict, following: TensorDict, drop: _Tree, take: _Tree) -> TensorDict:
    """Keep the root's entries but those to drop, and take those of the step that follows."""
    out: dict[str, Any] = {}
    for key, value in root._tensordict.items():
        if key not in drop:
            out[key] = value if isinstance(value, Tensor) else _shallow(value)
        elif drop[key] is not None:
            out[key] = _advance(value, value, drop[key], {})
    for key, inner in take.items():
        value = following._tensordict.get(key)
        if value is None:
            continue
        if inner is None or isinstance(value, Tensor):
            out[key] = value if isinstance(value, Tensor) else _shallow(value)
            continue
        kept = out.get(key)
        kept = _new({}, value) if kept is None else kept
        out[key] = _advance(kept, value, {}, inner)
    return _new(out, root)


def _merge(root: TensorDict, fresh: TensorDict | None, keep: Tensor) -> None:
    """Put the rows of `fresh` that are not kept into the root; 0 where one of them has no entry.

    The root's tensors are those of the last step, which collectors keep: they are replaced.
    """
    entries, others = root._tensordict, {} if fresh is None else fresh._tensordict
    column = keep.unsqueeze(-1)
    for key, old in entries.items():
        new = others.get(key)
        if not isinstance(old, Tensor):
            _merge(old, new, keep)
            continue
        rows = _over(keep, column, old)
        entries[key] = torch.where(rows, old, 0 if new is None else new)
    for key, new in others.items():
        if key not in entries:
            if isinstance(new, Tensor):
                entries[key] = torch.where(_over(keep, column, new), 0, new)
            else:
                entries[key] = _new({}, new)
                _merge(entries[key], new, keep)


def _over(keep: Tensor, column: Tensor, value: Tensor) -> Tensor:
    """Give row flags the dimensions of a value."""
    extra = value.ndim - keep.ndim
    if extra == 1:
        return column
    return keep.reshape(*keep.shape, *(1,) * extra) if extra else keep


def _overrides(part: Transform, name: str) -> bool:
    return getattr(type(part), name) is not getattr(Transform, name)
