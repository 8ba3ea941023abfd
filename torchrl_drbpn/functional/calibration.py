r"""Is a Gaussian belief as sure as it should be: normalised squared errors and their test.

[Bar-Shalom 2001] is Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and
Navigation*.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import as_matrix, check_observed, masked_cov, zero_missing

_BISECTIONS = 100  # halve an interval until float64 has no number between its ends


def nis(innovation: Tensor, innovation_cov: Tensor, observed: Tensor) -> Tensor:
    r"""Normalise a squared innovation by the covariance that was claimed for it.

    .. math:: \epsilon = (M v)' (M S M')^{-1} (M v)

    §5.4 [Bar-Shalom 2001]. If the belief is right it is chi-square distributed with as many
    degrees of freedom as entries were observed, which is then its mean. Larger: too sure.
    Smaller: not sure enough. No unit, ``(*batch,)``, float64; exactly 0 where nothing was observed.

    Args:
        innovation: v of :func:`innovation`, shape ``(*batch, obs)``.
        innovation_cov: S over all entries, shape ``(*batch, obs, obs)``, or ``(obs,)`` for its
            diagonal.
        observed: bool M, shape ``(*batch, obs)``, True = counts; a ValueError for another.

    Example:
        >>> v, S = torch.tensor([3.0, float("nan")]), torch.diag(torch.tensor([9.0, 1.0]))
        >>> nis(v, S, torch.tensor([True, False])).item()
        1.0
    """
    check_observed(innovation, observed)
    S = as_matrix("innovation_cov", innovation_cov, innovation.shape[-1])
    return nees(zero_missing(innovation, observed), masked_cov(S, observed))


def nees(error: Tensor, cov: Tensor) -> Tensor:
    r"""Normalise a squared estimation error by the covariance that was claimed for it.

    .. math:: \epsilon = e' P^{-1} e

    §5.4 [Bar-Shalom 2001]. If the belief is right it is chi-square distributed with the dimension
    of the state as degrees of freedom. Of e, truth minus estimate, ``(*batch, state)``, and P,
    ``(*batch, state, state)`` or, its diagonal, ``(state,)``; ``(*batch,)``, no unit, float64.

    Example:
        >>> nees(torch.tensor([3.0, 2.0]), torch.diag(torch.tensor([9.0, 4.0]))).item()
        2.0
    """
    factor = torch.linalg.cholesky(as_matrix("cov", cov, error.shape[-1]).double())
    white = torch.linalg.solve_triangular(factor, error.double().unsqueeze(-1), upper=False)
    return white.square().sum((-2, -1))


def chi_square_quantile(probability: Tensor | float, dof: Tensor | float) -> Tensor:
    r"""Return the value that a chi-square variable stays under with a given probability.

    .. math:: x: \; \gamma(k/2, x/2) / \Gamma(k/2) = p

    To the last bits of float64. ``probability`` p in [0, 1) and ``dof`` k > 0 broadcast; a
    ValueError for others.

    Example:
        >>> round(chi_square_quantile(0.95, 2).item(), 6)  # -2 log(1 - p)
        5.991465
    """
    p = torch.as_tensor(probability, dtype=torch.float64)
    k = torch.as_tensor(dof, dtype=torch.float64)
    if not bool(((p >= 0) & (p < 1)).all()):
        raise ValueError(f"`probability` must lie in [0, 1), got {probability}.")
    if not bool((k > 0).all()):
        raise ValueError(f"`dof` must be positive, got {dof}. Did nothing arrive at all?")
    low = torch.zeros_like(p + k)
    # P(X > k + 2 sqrt(k y) + 2 y) <= exp(-y), Laurent and Massart 2000: under 2^-60 here.
    high = (k + 2 * torch.sqrt(42 * k) + 84).expand_as(low)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        under = torch.special.gammainc(0.5 * k, 0.5 * middle) < p
        low, high = torch.where(under, middle, low), torch.where(under, high, middle)
    return 0.5 * (low + high)


class Consistency(NamedTuple):
    """Hold a ratio, 1 expected, and the band in which it lies with the probability asked for."""

    ratio: Tensor
    lower: Tensor
    upper: Tensor


def consistency(
    squared: Tensor, dof: Tensor, probability: float = 0.95, dim: int | None = None
) -> Consistency:
    r"""Test normalised squares against the chi-square distribution: is the filter consistent?

    .. math::
        \frac{\sum_t \epsilon_t}{N}, \qquad
        \left[ \frac{\chi^2_{N}(\alpha / 2)}{N}, \frac{\chi^2_{N}(1 - \alpha / 2)}{N} \right],
        \quad N = \sum_t n_t

    The time-average test of §5.4.2 [Bar-Shalom 2001]. The band holds for independent terms: the
    innovations of a right filter are, the NEES of successive steps is not (average it over runs at
    one step). Ratio and band are float64, NaN where no entry was observed.

    Args:
        squared: :func:`nis` or :func:`nees` of every step.
        dof: n, the entries of every step, the same shape; steps with none do not count.
        probability: of the two-sided band, 1 - alpha, in (0, 1).
        dim: dimension that is summed over; None: all of them.

    Example:
        >>> squared = torch.distributions.Chi2(3.0).sample((4000,))
        >>> ratio, lower, upper = consistency(squared, torch.full((4000,), 3))
        >>> bool(lower < 1 < upper), bool((ratio - 1).abs() < 0.1)
        (True, True)
    """
    if squared.shape != dof.shape:
        raise ValueError(
            f"`dof` must have the shape of `squared` {tuple(squared.shape)}, one number a step, "
            f"got {tuple(dof.shape)}. observed.sum(-1) is it."
        )
    if not 0 < probability < 1:
        raise ValueError(f"`probability` must lie in (0, 1), got {probability}.")
    counted = torch.where(dof > 0, squared.double(), 0.0)
    total = counted.sum() if dim is None else counted.sum(dim)
    count = (dof.sum() if dim is None else dof.sum(dim)).double()
    dense = count.where(count > 0, 1.0)
    tail = 0.5 * (1 - probability)
    values = (total, chi_square_quantile(tail, dense), chi_square_quantile(1 - tail, dense))
    return Consistency(*((value / dense).where(count > 0, math.nan) for value in values))
