"""Count, mean and variance of incomplete data, batch by batch, without keeping the data.

Only entries that were observed count, so every component has a count of its own. Batches are merged
by the pairwise rule, which loses no precision where the mean is large beside the spread.
"""

from typing import NamedTuple

import torch
from torch import Tensor

# Its square is still a float64.
_LARGEST = 1e150
# Learned deviations from the learned mean; beyond them a reading is moved to the bound.
_WIDTH = 10.0
# Readings of a component from which its learned deviation is trusted.
_ENOUGH = 100
# The bound before that, in deviations from the median that all but one in a thousand stay within.
_FIRST_WIDTH = 5.0
_FIRST_SHARE = 1000


class RunningMoments(NamedTuple):
    """Hold how many values were seen, their mean and their population variance, each ``(*event)``.

    Where nothing was observed the mean is 0, of fewer than two values the variance.
    """

    n: Tensor
    mean: Tensor
    var: Tensor


def masked_moments(value: Tensor, observed: Tensor | None = None) -> RunningMoments:
    """Compute the moments of the observed entries of a batch, float64; of no entry they are 0.

    With `o` the mask: n = sum o,  mean = sum o x / n,  var = sum o (x - mean)^2 / n, each over the
    first dimension of a value ``(samples, *event)``. ``observed`` is bool of that shape; None: all.
    What lies under a False entry, NaN included, is never used.

    Example:
        >>> x = torch.tensor([[1.0], [3.0], [torch.nan]])
        >>> masked_moments(x, x.isfinite()).mean
        tensor([2.], dtype=torch.float64)
    """
    if observed is None:
        observed = torch.ones_like(value, dtype=torch.bool)
    weight = observed.double()
    count = weight.sum(0)
    share = weight / count.clamp_min(1.0)
    # Filled before any arithmetic, since 0 * NaN is NaN.
    value = value.double().masked_fill(~observed, 0.0)
    mean = (share * value).sum(0)
    return RunningMoments(count, mean, (share * (value - mean).square()).sum(0))


def merge_moments(first: RunningMoments, second: RunningMoments) -> RunningMoments:
    """Merge the moments of two batches into those of both together.

    With d = mean_b - mean_a and w = n_b / (n_a + n_b):
    mean = mean_a + w d,  var = (1 - w) var_a + w var_b + w (1 - w) d^2.
    Eq. (1.5) of [Chan, Golub, LeVeque 1979, Updating formulae and a pairwise algorithm for
    computing sample variances], divided by the count.

    Example:
        >>> x = torch.randn(9, 2, dtype=torch.float64)
        >>> split = merge_moments(masked_moments(x[:4]), masked_moments(x[4:]))
        >>> torch.allclose(split.var, masked_moments(x).var)
        True
    """
    count = first.n + second.n
    # The clamp only meets a count of 0, where the weight is 0 anyway.
    weight = second.n / count.clamp_min(1)
    shift = second.mean - first.mean
    between = weight * (1 - weight) * shift.square()
    return RunningMoments(
        count,
        first.mean + weight * shift,
        (1 - weight) * first.var + weight * second.var + between,
    )


def spread(moments: RunningMoments, eps: float) -> Tensor:
    """Return the deviation sqrt(var + eps), and 1 where fewer than two values were seen.

    Example:
        >>> x = torch.randn(9, 2, dtype=torch.float64)
        >>> torch.allclose(spread(masked_moments(x), 0.0), x.std(0, correction=0))
        True
    """
    return torch.where(moments.n < 2, 1.0, (moments.var + eps).sqrt())


def winsorize(
    value: Tensor, observed: Tensor, learned: RunningMoments, eps: float
) -> tuple[Tensor, Tensor]:
    """Clip outliers to a bound, so that one reading cannot dominate the statistics.

    A component with 100 learned readings and a variance above ``eps``, squared units, is clipped
    to its learned mean plus and minus 10 learned deviations: a scale that really grows can grow
    tenfold with each batch. Before that the batch sets the bound: its median plus and minus 5 times
    a deviation that only one in a thousand readings, and at least one, exceeds. Of fewer than three
    readings nothing is learned, as an outlier among them could not be recognised.

    Of readings ``(samples, *event)``, finite where the bool ``observed`` is True, and the moments
    learned so far it returns the readings, float64, and which of them to learn from.

    Example:
        >>> nothing = RunningMoments(*torch.zeros(3, 1, dtype=torch.float64))
        >>> x = torch.cat([torch.randn(999, 1), torch.tensor([[1e30]])])
        >>> bool(winsorize(x, torch.ones_like(x) > 0, nothing, 1e-8)[0].max() < 30)
        True
    """
    value = value.double().masked_fill(~observed, 0.0).clamp(-_LARGEST, _LARGEST)
    known = (learned.n >= _ENOUGH) & (learned.var > eps)
    centre, radius = learned.mean.double(), _WIDTH * learned.var.double().sqrt()
    if not bool(known.all()):
        count = observed.sum(0, keepdim=True)
        middle = _gather(value.masked_fill(~observed, torch.inf), (count - 1) // 2)
        distance = (middle - value).abs().neg().masked_fill(~observed, torch.inf)
        exceeded = 1 + count // _FIRST_SHARE
        reach = -_FIRST_WIDTH * _gather(distance, torch.minimum(exceeded, count - 1))
        observed = observed & (known | (count >= 3))
        centre = torch.where(known, centre, middle)
        radius = torch.where(known, radius, reach)
    return torch.minimum(torch.maximum(value, centre - radius), centre + radius), observed


def _gather(value: Tensor, rank: Tensor) -> Tensor:
    """Return the values of the given ranks along the first dimension, 0 the smallest."""
    return value.sort(0).values.gather(0, rank.clamp_min(0)).nan_to_num(posinf=0.0)
