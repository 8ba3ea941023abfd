"""Means and variances of incomplete data, batch by batch, without keeping the data.

Only entries that were observed count, so every component has a count of its own. Batches are
merged by the pairwise rule of Chan, Golub and LeVeque, which loses no precision where the mean is
large beside the spread and gives the same result in whatever order the batches arrive.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

__all__ = ["Moments", "masked_moments", "merge_moments", "variance"]


class Moments(NamedTuple):
    """Hold how many values were seen, their mean, and their squared deviations.

    Attributes:
        n: number of observed values of every component, shape `(*event)`, float64.
        mean: their mean, 0 where nothing was observed, shape `(*event)`, units of the values.
        m2: sum of squared deviations from that mean, shape `(*event)`, squared units.

    Examples:
        >>> import torch
        >>> empty = Moments(*torch.zeros(3, 2, dtype=torch.float64))
        >>> batch = masked_moments(torch.randn(5, 2), torch.ones(5, 2, dtype=torch.bool))
        >>> all(torch.equal(a, b) for a, b in zip(merge_moments(empty, batch), batch))
        True
    """

    n: Tensor
    mean: Tensor
    m2: Tensor


def masked_moments(value: Tensor, observed: Tensor | None = None) -> Moments:
    r"""Compute the moments of the observed entries of a batch.

    With `o` the mask: n = sum o,  mean = sum o x / n,  m2 = sum o (x - mean)^2, each over the
    first dimension. What lies under a False entry is never used, NaN and infinity included.

    Args:
        value: the samples, shape `(samples, *event)`, floating point.
        observed: True where an entry was observed, shape `(samples, *event)`, bool. All of them
            where it is None.

    Returns:
        The moments, in float64; n, mean and m2 are 0 where nothing was observed.

    Raises:
        TypeError: `observed` is not bool.
        ValueError: `observed` has another shape than `value`.

    Examples:
        >>> import torch
        >>> x = torch.tensor([[1.0], [3.0], [torch.nan]])
        >>> masked_moments(x, x.isfinite()).mean
        tensor([2.], dtype=torch.float64)
    """
    value = value.double()
    if observed is None:
        var, mean = torch.var_mean(value, 0, correction=0)
        return Moments(torch.full_like(mean, value.shape[0]), mean, var.mul_(value.shape[0]))
    if observed.dtype is not torch.bool:
        raise TypeError(
            f"`observed` must be bool, got {observed.dtype}. "
            "Compare with what marks a missing entry, or call .bool()."
        )
    if observed.shape != value.shape:
        raise ValueError(
            f"`observed` must have the shape of `value` {tuple(value.shape)}, one entry for every "
            f"component, got {tuple(observed.shape)}."
        )
    weight = observed.double()
    n = weight.sum(0)
    # Filled before any arithmetic, since 0 * NaN is NaN; finite from here on, so weights will do.
    value = value.masked_fill(~observed, 0.0)
    mean = value.sum(0).div_(n.clamp_min(1.0))
    deviation = (value - mean).mul_(weight)
    return Moments(n, mean, torch.linalg.vecdot(deviation, deviation, dim=0))


def merge_moments(first: Moments, second: Moments) -> Moments:
    r"""Merge the moments of two batches into those of both together.

    With d = mean_b - mean_a and n = n_a + n_b:
    mean = mean_a + d n_b / n,  m2 = m2_a + m2_b + d^2 n_a n_b / n.
    Eq. (1.5) of [Chan, Golub, LeVeque 1979, Updating formulae and a pairwise algorithm for
    computing sample variances].

    Args:
        first: moments of shape `(*event)`.
        second: moments of shape `(*event)`.

    Returns:
        The moments of the union; neither argument is changed.

    Examples:
        >>> import torch
        >>> x = torch.randn(9, 2, dtype=torch.float64)
        >>> split = merge_moments(masked_moments(x[:4]), masked_moments(x[4:]))
        >>> torch.allclose(split.m2, masked_moments(x).m2)
        True
    """
    n = first.n + second.n
    # One product serves both formulas. The clamp only meets n = 0, where the weight is 0 anyway.
    delta = second.mean - first.mean
    shift = delta * (second.n / n.clamp_min(1.0))
    return Moments(
        n,
        first.mean + shift,
        (first.m2 + second.m2).addcmul_(delta * first.n, shift),
    )


def variance(moments: Moments) -> Tensor:
    r"""Return the population variance m2 / n, and 1 where n < 2.

    One value says nothing about a spread; 1 leaves such a component on its own scale instead of
    blowing it up.

    Args:
        moments: moments of shape `(*event)`.

    Returns:
        The variance, shape `(*event)`, squared units, float64.

    Examples:
        >>> import torch
        >>> x = torch.randn(9, 2, dtype=torch.float64)
        >>> torch.allclose(variance(masked_moments(x)), x.var(0, correction=0))
        True
    """
    return (moments.m2 / moments.n).masked_fill_(moments.n < 2.0, 1.0)
