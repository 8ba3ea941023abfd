"""Cases for one step of the filter: systems, beliefs, masks."""

from __future__ import annotations

import oracles
import pytest
import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import Belief

# state smaller than, equal to and larger than obs
SIZES = [
    pytest.param(3, 5, id="state<obs"),
    pytest.param(4, 4, id="state=obs"),
    pytest.param(6, 4, id="state>obs"),
]
SEEDS = [0, 1, 2]
# what arrives: one entry, all, some, none
PATTERNS = ["one", "all", "some", "none"]


def pattern(kind: str, obs: int, generator: torch.Generator) -> Tensor:
    if kind == "all":
        return torch.ones(obs, dtype=torch.bool)
    mask = torch.zeros(obs, dtype=torch.bool)
    if kind == "one":
        mask[int(torch.randint(obs, (), generator=generator))] = True
    if kind == "some":
        mask[torch.randperm(obs, generator=generator)[: obs // 2 + 1]] = True
    return mask


def case(state: int, obs: int, *, seed: int = 0, batch: int = 5, full_noise: bool = True):
    """A system, a batch of predicted beliefs, complete observations and offsets."""
    system = oracles.random_system(state, obs, seed=seed, full_noise=full_noise)
    g = torch.Generator().manual_seed(seed + 77)
    mean = torch.randn(batch, state, generator=g, dtype=torch.float64)
    cov = torch.stack([oracles.spd(state, g) for _ in range(batch)])
    x = 2 * torch.randn(batch, obs, generator=g, dtype=torch.float64)
    offset = torch.randn(batch, obs, generator=g, dtype=torch.float64)
    return system, Belief(mean, cov), x, offset, g


def some_masks(batch: int, obs: int, generator: torch.Generator) -> Tensor:
    kinds = [PATTERNS[i % len(PATTERNS)] for i in range(batch)]
    return torch.stack([pattern(kind, obs, generator) for kind in kinds])


def given(state: int, obs: int, **kwargs):
    """The arguments of one step, whose rows observe one entry, all, some and none; a generator."""
    system, belief, x, offset, g = case(state, obs, **kwargs)
    return (belief, x, some_masks(len(x), obs, g), system.matrix, system.noise, offset), g
