"""Seed an environment together with its transforms, in worker processes too."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torchrl.envs import Compose, EnvBase, ParallelEnv, SerialEnv, Transform, TransformedEnv

from torchrl_drbpn.transforms._corrupting import SeededTransform, check_seed

_EXTRA = "_extra_state"


def seed_env(env: EnvBase, seed: int) -> int | None:
    """Seed `env` and every transform that owns a generator, with a seed of its own for each.

    TorchRL's `env.set_seed` reaches the simulator alone. This reaches the transforms of
    `TransformedEnv`s too, nested ones included, and those inside the workers of `SerialEnv` and
    `ParallelEnv`, so that no two workers see the same noise and a seed reproduces everything. The
    `mechanism_seed` of a mechanism stays what it is.

    A batched environment inside the worker process of a `ParallelEnv` is not reached, nor are the
    environments of collectors that run in processes of their own: seed those in the function that
    builds them.

    Args:
        env: the environment; batched ones are started.
        seed: the seed, not negative.

    Returns:
        What `env.set_seed` returns: a seed for the next environment.

    Raises:
        TypeError: if `seed` is no integer.
        ValueError: if it is negative.

    Example:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_drbpn.transforms import ObservationNoise
        >>> env = TransformedEnv(GymEnv("InvertedPendulum-v5"), ObservationNoise(0.1))
        >>> def first():
        ...     seed_env(env, 3)
        ...     return env.reset()["observation"]
        >>> bool((first() == first()).all())
        True
    """
    seed = check_seed(seed)
    next_seed: int | None = env.set_seed(seed)
    source = torch.Generator().manual_seed(seed)
    for set_seed in _seed_setters(env):
        set_seed(int(torch.randint(2**62, (), generator=source)))
    return next_seed


def _seed_setters(env: EnvBase) -> Iterator[Callable[[int], Any]]:
    """Yield `set_seed` of every transform in `env` that has a generator, in a fixed order."""
    while isinstance(env, TransformedEnv):
        yield from _in_transform(env.transform)
        env = env.base_env
    if isinstance(env, ParallelEnv):
        states = env.state_dict()
        for index in range(env.num_workers):
            yield from _in_worker(env, index, states[f"worker{index}"])
    elif isinstance(env, SerialEnv):
        for worker in env._envs:
            yield from _seed_setters(worker)


def _in_transform(transform: Transform) -> Iterator[Callable[[int], Any]]:
    if isinstance(transform, Compose):
        for part in transform.transforms:
            yield from _in_transform(part)
    elif isinstance(transform, SeededTransform):
        yield transform.set_seed


def _in_worker(
    env: ParallelEnv, index: int, state: dict[str, Any]
) -> Iterator[Callable[[int], Any]]:
    """Yield setters that act inside a worker process.

    The state that a worker reports names the place of each generator, as in
    `transforms.1._extra_state`; a chain of attributes asked of a `ParallelEnv` is looked up in its
    workers, and one of its entries is a view on that worker alone.
    """
    for key, value in state.items():
        *path, last = key.split(".")
        if last == _EXTRA and isinstance(value, dict) and {"seed", "generator"} <= value.keys():
            yield partial(_call_in_worker, env, index, path)


def _call_in_worker(env: ParallelEnv, index: int, path: list[str], seed: int) -> None:
    target: Any = env[index].transform
    for name in [*path, "set_seed"]:
        target = getattr(target, name)
    target(seed)
