"""Where the random transforms take their numbers from, and how a whole environment is seeded."""

import multiprocessing
import os
import warnings
import zlib
from functools import reduce
from numbers import Integral
from typing import Any, ClassVar, Unpack

import torch
from torch import Tensor
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, TransformedEnv

from torchrl_drbpn.transforms._base import (
    CorruptingTransform,
    CorruptionKeys,
    EnvironmentTransform,
)

_SEED_BITS = 63
_NO_STATE = torch.empty(0, dtype=torch.uint8)


def check_seed(seed: int, name: str = "seed") -> int:
    """Return `seed` after checking that it is an integer in [0, 2**63)."""
    if isinstance(seed, bool) or not isinstance(seed, Integral):
        raise TypeError(f"`{name}` must be an integer, got {seed!r} of type {type(seed).__name__}.")
    if not 0 <= seed < 1 << _SEED_BITS:
        raise ValueError(f"`{name}` must lie in [0, 2**{_SEED_BITS}), got {seed}.")
    return int(seed)


# The seed of torch's global generator as this process inherited it; None where it has its own. A
# forked process starts with a copy of its parent's generator, so that siblings draw the same
# numbers; a child that imports this module late is treated as forked.
_inherited: int | None = torch.initial_seed() if multiprocessing.parent_process() else None


def _note_fork() -> None:
    global _inherited
    _inherited = torch.initial_seed()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_note_fork)


def _separate_worker() -> None:
    """Advance a global generator copied from the parent by the name of the process, once."""
    global _inherited
    # `torch.manual_seed` in the process, as by `ParallelEnv.set_seed`, overrides it at any time
    if _inherited is not None and torch.initial_seed() == _inherited:
        name = zlib.crc32(multiprocessing.current_process().name.encode())
        moved = torch.Generator().manual_seed(int(torch.randint(1 << 62, ())) ^ name)
        torch.set_rng_state(moved.get_state())
    _inherited = None


class SeededKeys(CorruptionKeys, total=False):
    """And the seed of those that draw."""

    seed: int | None


class SeededTransform(EnvironmentTransform, CorruptingTransform):
    """A corrupting transform that draws: with a seed from its own generator, else from torch's.

    Its generator lies on the device of the data, and its state is part of `state_dict`.
    """

    why_online = "draws afresh at every call"
    # one number a class, so that noise and missingness with the same seed are not correlated
    stream: ClassVar[int]

    def __init__(self, *, seed: int | None = None, **keys: Unpack[CorruptionKeys]) -> None:
        super().__init__(**keys)
        self.set_seed(seed)
        if seed is None:
            _separate_worker()

    def set_seed(self, seed: int | None) -> None:
        """Start the sequence of `seed`; None draws from torch's global generator."""
        self.seed = None if seed is None else check_seed(seed)
        self._generator: torch.Generator | None = None
        self._saved_state = _NO_STATE

    def generator(self, device: torch.device) -> torch.Generator | None:
        """Return what to draw from on `device`; None is torch's global generator."""
        if self.seed is None or device.type == "meta":
            _separate_worker()
            return None
        generator = self._generator
        if generator is None or generator.device != device:
            generator = self._generator = torch.Generator(device=device)
            # golden-ratio steps spread neighbouring seeds, `stream` separates the classes
            mixed = self.seed * 0x9E3779B97F4A7C15 + self.stream * 0xD1B54A32D192ED03
            generator.manual_seed(mixed % (1 << _SEED_BITS))
            saved, self._saved_state = self._saved_state, _NO_STATE
            size = generator.get_state().numel()
            if saved.numel() == size:
                generator.set_state(saved)
            elif saved.numel():
                warnings.warn(
                    f"the saved generator state has {saved.numel()} bytes, one on {device} has "
                    f"{size}: it was saved on another kind of device and can't be continued here. "
                    "The sequence starts again from its seed.",
                    stacklevel=2,
                )
        return generator

    def get_extra_state(self) -> dict[str, Tensor]:
        """Return seed (-1 for None) and generator state as tensors, for `state_dict`."""
        state = self._saved_state if self._generator is None else self._generator.get_state()
        seed = torch.tensor(-1 if self.seed is None else self.seed)
        return {"seed": seed, "generator": state.clone()}

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Continue from what `get_extra_state` returned."""
        seed = int(state["seed"])
        self.set_seed(None if seed < 0 else seed)
        self._saved_state = state["generator"].cpu().clone()

    def clone(self) -> Any:
        """Return a copy without a parent, whose generator runs on by itself from the same state."""
        copy = super().clone()
        if self._generator is not None:
            copy._generator = self._generator.clone_state()
        return copy


def seed_env(env: EnvBase, seed: int) -> int | None:
    """Seed `env` and every transform that draws, with a seed of its own for each.

    Beside `env.set_seed` this gives every transform that draws a generator of its own, in nested
    `TransformedEnv`s and in the workers of `SerialEnv` and `ParallelEnv`, so that workers see
    different noise and a seed reproduces everything, whatever else draws.

    Not reached: environments wrapped twice or batched inside a worker, and those of collectors that
    run in processes of their own: seed those in the function that builds them.

    Args:
        env: the environment; batched ones are started.
        seed: an integer in [0, 2**63).

    Returns:
        What `env.set_seed` returns: a seed for the next environment.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_drbpn.transforms import ObservationNoise
        >>> env = TransformedEnv(GymEnv("InvertedPendulum-v5"), ObservationNoise(0.1))
        >>> first = [(seed_env(env, 3), env.reset()["observation"])[1] for _ in range(2)]
        >>> bool((first[0] == first[1]).all())
        True
    """
    seed = check_seed(seed)
    next_seed: int | None = env.set_seed(seed)
    source = torch.Generator().manual_seed(seed)

    def draw() -> int:
        return int(torch.randint(2**62, (), generator=source))

    while isinstance(env, TransformedEnv):
        for transform in env.transform.modules():
            if isinstance(transform, SeededTransform):
                transform.set_seed(draw())
        env = env.base_env
    if isinstance(env, SerialEnv | ParallelEnv):
        # what a worker reports of its state names the generators in it
        states = env.state_dict()
        for index in range(env.num_workers):
            state = states[f"worker{index}"]
            for key, value in state.items():
                if not isinstance(value, dict) or "generator" not in value:
                    continue
                if isinstance(env, ParallelEnv):
                    # It looks up a chain of attributes in its workers. Its load_state_dict would
                    # leave a signal behind that the next step takes for its own.
                    path = key.split(".")[:-1]
                    reduce(getattr, [*path, "set_seed"], env[index].transform)(draw())
                else:
                    value |= {"seed": torch.tensor(draw()), "generator": value["generator"][:0]}
        if isinstance(env, SerialEnv):
            env.load_state_dict(states)
    return next_seed
