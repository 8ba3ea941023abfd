"""The moments of incomplete data are those of the observed values alone.

Specified here: `masked_moments` against torch.var on the values that are left when the missing
ones are deleted; merging in any order and grouping; no loss of precision where the mean is large;
nothing observed changes nothing.
"""

import pytest
import torch

from torchrl_drbpn.functional.statistics import Moments, masked_moments, merge_moments, variance

TIGHT = {"rtol": 1e-11, "atol": 1e-11}


def draw(samples, obs, seed=0, missing=0.4, dtype=torch.float64):
    """Return values with NaN where they are missing, and the mask."""
    generator = torch.Generator().manual_seed(seed)
    value = torch.randn(samples, obs, generator=generator, dtype=dtype)
    value = value * torch.arange(1, obs + 1) + 10 * torch.arange(obs)
    observed = torch.rand(samples, obs, generator=generator) >= missing
    return torch.where(observed, value, torch.nan), observed


@pytest.mark.parametrize("seed", range(3))
def test_masked_moments_are_those_of_the_observed_values_alone(seed):
    value, observed = draw(50, 4, seed)
    moments = masked_moments(value, observed)
    for i in range(4):
        kept = value[observed[:, i], i]
        assert moments.n[i] == len(kept)
        torch.testing.assert_close(moments.mean[i], kept.mean(), **TIGHT)
        torch.testing.assert_close(variance(moments)[i], torch.var(kept, correction=0), **TIGHT)


@pytest.mark.parametrize("seed", range(3))
def test_merging_gives_the_same_in_any_order_and_grouping(seed):
    value, observed = draw(97, 3, seed)
    whole = masked_moments(value, observed)
    generator = torch.Generator().manual_seed(seed)
    batches = [
        masked_moments(*pair)
        for pair in zip(
            value.split([1, 40, 7, 2, 47]), observed.split([1, 40, 7, 2, 47]), strict=True
        )
    ]
    for _ in range(5):
        order = torch.randperm(5, generator=generator).tolist()
        merged = Moments(*torch.zeros(3, 3, dtype=torch.float64))
        for index in order:
            merged = merge_moments(merged, batches[index])
        right = merge_moments(batches[order[3]], batches[order[4]])
        tree = merge_moments(
            merge_moments(batches[order[0]], batches[order[1]]),
            merge_moments(batches[order[2]], right),
        )
        for other in (merged, tree):
            for a, b in zip(other, whole, strict=True):
                torch.testing.assert_close(a, b, **TIGHT)


def test_merging_with_nothing_observed_changes_nothing():
    value, observed = draw(20, 3)
    moments = masked_moments(value, observed)
    nothing = masked_moments(value, torch.zeros_like(observed))
    for merged in (merge_moments(moments, nothing), merge_moments(nothing, moments)):
        for a, b in zip(merged, moments, strict=True):
            assert torch.equal(a, b)


def test_no_mask_equals_a_mask_of_ones():
    value, _ = draw(20, 3, missing=0.0)
    for a, b in zip(
        masked_moments(value), masked_moments(value, torch.ones_like(value).bool()), strict=True
    ):
        torch.testing.assert_close(a, b, **TIGHT)


def test_a_mean_far_larger_than_the_spread_costs_no_precision():
    # the textbook formula E[x^2] - E[x]^2 would lose all 16 digits here: 1e8^2 = 1e16
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(1000, 2, generator=generator, dtype=torch.float64)
    merged = Moments(*torch.zeros(3, 2, dtype=torch.float64))
    for batch in (noise + 1e8).split(10):
        merged = merge_moments(merged, masked_moments(batch))
    torch.testing.assert_close(variance(merged), noise.var(0, correction=0), rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("seen", [0, 1])
def test_with_fewer_than_two_values_the_variance_is_one(seen):
    observed = torch.arange(5)[:, None] < seen
    value = torch.full((5, 1), 3.0, dtype=torch.float64)
    assert variance(masked_moments(value, observed)).item() == 1.0


@pytest.mark.parametrize(
    ("mask", "error"), [(torch.ones(4, 2), TypeError), (torch.ones(4).bool(), ValueError)]
)
def test_moments_refuse_a_mask_of_wrong_dtype_or_shape(mask, error):
    with pytest.raises(error, match="`observed` must"):
        masked_moments(torch.zeros(4, 2), mask)
