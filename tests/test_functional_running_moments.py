"""The moments of incomplete data are those of the observed values alone."""

import functools

import pytest
import torch

from torchrl_drbpn.functional.running_moments import (
    RunningMoments,
    masked_moments,
    merge_moments,
    spread,
    winsorize,
)

TIGHT = {"rtol": 1e-11, "atol": 1e-11}
EPS = 1e-8


def nothing(obs=3):
    return RunningMoments(*torch.zeros(3, obs, dtype=torch.float64))


def draw(samples, obs, seed=0, missing=0.4, dtype=torch.float64):
    """Return values with NaN where they are missing, and the mask."""
    generator = torch.Generator().manual_seed(seed)
    value = torch.randn(samples, obs, generator=generator, dtype=dtype)
    value = value * torch.arange(1, obs + 1) + 10 * torch.arange(obs)
    observed = torch.rand(samples, obs, generator=generator) >= missing
    return torch.where(observed, value, torch.nan), observed


@pytest.mark.parametrize("seed", range(3))
def test_merging_gives_the_same_in_any_order_and_grouping(seed):
    value, observed = draw(97, 3, seed)
    whole = masked_moments(value, observed)
    parts = (x.split([1, 40, 7, 2, 47]) for x in (value, observed))
    batches = [masked_moments(*pair) for pair in zip(*parts, strict=True)]
    a, b, c, d, e = (batches[i] for i in torch.randperm(5).tolist())
    unseen = masked_moments(value, torch.zeros_like(observed))
    left = functools.reduce(merge_moments, (nothing(), a, b, unseen, c, d, e))
    tree = merge_moments(merge_moments(merge_moments(a, b), c), merge_moments(d, e))
    for one, other, expected in zip(left, tree, whole, strict=True):
        torch.testing.assert_close(one, expected, **TIGHT)
        torch.testing.assert_close(other, expected, **TIGHT)


def test_a_mean_far_larger_than_the_spread_costs_no_precision():
    # the textbook formula E[x^2] - E[x]^2 would lose all 16 digits here: 1e8^2 = 1e16
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(1000, 2, generator=generator, dtype=torch.float64)
    merged = nothing(2)
    for batch in (noise + 1e8).split(10):
        merged = merge_moments(merged, masked_moments(batch))
    torch.testing.assert_close(merged.var, noise.var(0, correction=0), rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("seen", [0, 1])
def test_with_fewer_than_two_values_the_spread_is_one(seen):
    observed = torch.arange(5)[:, None] < seen
    value = torch.full((5, 1), 3.0, dtype=torch.float64)
    assert spread(masked_moments(value, observed), EPS).item() == 1.0


def test_a_sensor_that_rarely_speaks_is_learned():
    value = torch.zeros(2000, 1, dtype=torch.float64)
    value[::100] = 1.0  # one reading in a hundred
    bounded, counted = winsorize(value, torch.ones_like(value).bool(), nothing(1), EPS)
    assert counted.all()
    assert torch.equal(bounded, value)


def test_a_scale_that_grows_is_followed():
    # by a factor of 1000, as of a robot that learns to run
    generator = torch.Generator().manual_seed(0)
    moments = masked_moments(torch.randn(2000, 1, generator=generator))
    for _ in range(12):
        value = 1000 * torch.randn(2000, 1, generator=generator)
        batch = winsorize(value, torch.ones_like(value).bool(), moments, EPS)
        moments = merge_moments(moments, masked_moments(*batch))
    assert spread(moments, EPS).item() > 700


def test_of_fewer_than_three_readings_nothing_is_learned():
    value = torch.tensor([[1.0], [1e160], [0.0]])
    observed = torch.tensor([[True], [True], [False]])
    assert not winsorize(value, observed, nothing(1), EPS)[1].any()
