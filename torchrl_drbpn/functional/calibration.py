r"""Is a Gaussian belief as sure as it should be: consistency tests, coverage, proper scores.

Two questions are kept apart. *Calibration*: does what was said to have probability p happen with
frequency p (NIS, NEES, coverage, reliability curve)? *Accuracy and calibration together*: how good
was the whole distribution (CRPS, log score; both are proper, so that nobody gains by claiming
another variance than he believes in)? Missing entries count nowhere, as if they were not there.

[Bar-Shalom 2001] is Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and
Navigation*; [Gneiting 2007] is Gneiting, Raftery, *Strictly Proper Scoring Rules, Prediction, and
Estimation*, JASA 102.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import (
    LOG_2PI,
    check_observed,
    masked_cov,
    masked_log_density,
    zero_missing,
)

__all__ = [
    "Consistency",
    "central_coverage",
    "chi_square_quantile",
    "consistency",
    "gaussian_crps",
    "gaussian_log_score",
    "gaussian_pit",
    "log_score",
    "normalised_squared",
    "reliability_curve",
]

_BISECTIONS = 100  # halve an interval until float64 has no number between its ends


# ------------------------------------------------------------------------------ NIS, NEES, chi2
def normalised_squared(error: Tensor, cov: Tensor, observed: Tensor | None = None) -> Tensor:
    r"""Weigh a squared error by the covariance that was claimed for it: NIS and NEES.

    .. math:: \epsilon = (M e)' (M C M')^{-1} (M e)

    §5.4 [Bar-Shalom 2001]. With the innovation v and its covariance S this is the normalised
    innovation squared (NIS), with the error of the state and P the normalised estimation error
    squared (NEES). If the belief is right it is chi-square distributed, and its mean is the number
    of entries: those that were observed at that step for the NIS, the dimension of the state for
    the NEES. Larger: too sure. Smaller: not sure enough.

    Args:
        error: e, shape ``(*batch, dim)``; what stands at missing entries is ignored.
        cov: C, shape ``(*batch, dim, dim)`` or ``(dim, dim)``, over all entries.
        observed: bool M, shape ``(*batch, dim)``, True = counts; None: all of them.

    Returns:
        Shape ``(*batch,)``, no unit, float64; exactly 0 where nothing was observed. It is computed
        in float64: an innovation covariance is as ill-conditioned as signal over noise.

    Raises:
        ValueError: if the mask is not bool or not of the shape of ``error``.

    Example:
        >>> import torch
        >>> error, cov = torch.tensor([3.0, float("nan")]), torch.diag(torch.tensor([9.0, 1.0]))
        >>> normalised_squared(error, cov, torch.tensor([True, False])).item()
        1.0
    """
    if observed is not None:
        check_observed(error, observed)
        error, cov = zero_missing(error, observed), masked_cov(cov, observed)
    factor = torch.linalg.cholesky(cov.double())
    white = torch.linalg.solve_triangular(factor, error.double().unsqueeze(-1), upper=False)
    return white.square().sum((-2, -1))


def chi_square_quantile(probability: Tensor | float, dof: Tensor | float) -> Tensor:
    r"""Return the value that a chi-square variable stays under with a given probability.

    .. math:: x: \; \gamma(k/2, x/2) / \Gamma(k/2) = p

    By bisection of ``torch.special.gammainc``, to the last bits of float64.

    Args:
        probability: p in [0, 1), broadcasts with ``dof``.
        dof: k > 0, degrees of freedom.

    Returns:
        Quantiles, the broadcast shape, float64.

    Raises:
        ValueError: if a probability lies outside [0, 1) or a number of degrees is not positive.

    Example:
        >>> round(chi_square_quantile(0.95, 2).item(), 6)  # -2 log(1 - p)
        5.991465
    """
    p = torch.as_tensor(probability, dtype=torch.float64)
    k = torch.as_tensor(dof, dtype=torch.float64)
    shape = (p + k).shape
    p, k = p.expand(shape), k.expand(shape)
    if not bool(((p >= 0) & (p < 1)).all()):
        raise ValueError(f"`probability` must lie in [0, 1), got {probability}.")
    if not bool((k > 0).all()):
        raise ValueError(f"`dof` must be positive, got {dof}. Did nothing arrive at all?")
    low = torch.zeros_like(p)
    # P(X > k + 2 sqrt(k y) + 2 y) <= exp(-y), Laurent and Massart 2000: under 2^-60 here.
    high = k + 2 * torch.sqrt(42 * k) + 84
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        under = torch.special.gammainc(0.5 * k, 0.5 * middle) < p
        low, high = torch.where(under, middle, low), torch.where(under, high, middle)
    return 0.5 * (low + high)


class Consistency(NamedTuple):
    """Hold the outcome of a consistency test.

    Args:
        ratio: sum of the normalised squares over the sum of their degrees of freedom; 1 expected.
        lower: of the band in which it lies with the probability asked for, if the belief is right.
        upper: of that band.

    Example:
        >>> Consistency._fields
        ('ratio', 'lower', 'upper')
    """

    ratio: Tensor
    lower: Tensor
    upper: Tensor


def consistency(
    squared: Tensor, dof: Tensor, probability: float = 0.95, dim: int | None = None
) -> Consistency:
    r"""Test normalised squares against the chi-square distribution: is the filter consistent?

    .. math::
        \frac{\sum_t \epsilon_t}{\sum_t n_t}, \qquad
        \left[ \frac{\chi^2_{N}(\alpha / 2)}{N}, \frac{\chi^2_{N}(1 - \alpha / 2)}{N} \right],
        \quad N = \sum_t n_t

    The time-average test of §5.4.2 [Bar-Shalom 2001], each step with as many degrees of freedom
    as entries were observed in it. The band holds for independent terms: the innovations of a
    right filter are, the NEES of successive steps is not (average it over runs at one step).

    Args:
        squared: NIS or NEES of every step, see :func:`normalised_squared`.
        dof: entries of every step, the same shape; steps with none count nowhere.
        probability: of the two-sided band, 1 - alpha.
        dim: dimension that is summed over; None: all of them.

    Returns:
        Ratio and band, float64, without that dimension; ratio and band are NaN where no entry was
        observed.

    Raises:
        ValueError: if the shapes differ or the probability does not lie in (0, 1).

    Example:
        >>> import torch
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
    counted = squared.double() * (dof > 0)
    total = counted.sum() if dim is None else counted.sum(dim)
    count = (dof.sum() if dim is None else dof.sum(dim)).double()
    tail = 0.5 * (1 - probability)
    nothing = count == 0
    dense = torch.where(nothing, torch.ones_like(count), count)
    values = (
        total / dense,
        chi_square_quantile(tail, dense) / dense,
        chi_square_quantile(1 - tail, dense) / dense,
    )
    return Consistency(*(value.masked_fill(nothing, math.nan) for value in values))


# --------------------------------------------------------------------------- coverage, reliability
def gaussian_pit(value: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    r"""Return the probability that was given to values under the one that came.

    .. math:: u = \Phi\left( (x - \mu) / \sigma \right)

    The probability integral transform: uniform on [0, 1] if the distributions are right.

    Args:
        value: x, shape ``(*batch,)``.
        mean: broadcasts with ``value``.
        std: broadcasts with ``value``, positive.

    Returns:
        The broadcast shape, in [0, 1].

    Example:
        >>> import torch
        >>> gaussian_pit(torch.tensor(2.0), torch.tensor(2.0), torch.tensor(0.1)).item()
        0.5
    """
    return torch.special.ndtr((value - mean) / std)


def central_coverage(
    pit: Tensor, levels: Tensor, observed: Tensor | None = None, dim: int | None = None
) -> Tensor:
    r"""Return the share of values inside their central intervals.

    .. math:: \frac1n \sum_i \left[ |2 u_i - 1| \le p \right]

    A central interval of probability p is [quantile (1-p)/2, quantile (1+p)/2]; for a Gaussian
    mean -+ z std. If the distributions are right the share is p.

    Args:
        pit: u, see :func:`gaussian_pit`.
        levels: p, shape ``(levels,)``, such as .5, .9, .95.
        observed: bool, the shape of ``pit``, True = counts; None: all of them.
        dim: dimension that is counted over; None: all of them.

    Returns:
        Shares, shape ``(*rest, levels)``; NaN where nothing counts.

    Raises:
        ValueError: if the mask is not bool or not of the shape of ``pit``.

    Example:
        >>> import torch
        >>> pit = torch.linspace(0, 1, 1001, dtype=torch.float64)
        >>> central_coverage(pit, torch.tensor([0.5, 0.9])).mul(100).round().tolist()
        [50.0, 90.0]
    """
    inside = (2 * pit - 1).abs().unsqueeze(-1) <= levels
    return _share(inside, pit, observed, dim)


def reliability_curve(
    pit: Tensor, levels: Tensor, observed: Tensor | None = None, dim: int | None = None
) -> Tensor:
    r"""Return how often values came under their quantiles: the distribution function of the PIT.

    .. math:: \frac1n \sum_i [ u_i \le p ]

    The diagonal if the distributions are right. Steep at both ends: too sure. Steep in the middle:
    not sure enough. On one side of the diagonal: biased.

    Args:
        pit: u, see :func:`gaussian_pit`.
        levels: p, shape ``(levels,)``.
        observed: bool, the shape of ``pit``, True = counts; None: all of them.
        dim: dimension that is counted over; None: all of them.

    Returns:
        Shares, shape ``(*rest, levels)``; NaN where nothing counts.

    Raises:
        ValueError: if the mask is not bool or not of the shape of ``pit``.

    Example:
        >>> import torch
        >>> reliability_curve(torch.tensor([0.1, 0.3, 0.6, 0.8]), torch.tensor([0.5])).tolist()
        [0.5]
    """
    return _share(pit.unsqueeze(-1) <= levels, pit, observed, dim)


def _share(inside: Tensor, pit: Tensor, observed: Tensor | None, dim: int | None) -> Tensor:
    """Average a (*pit, levels) bool over `dim` of pit, over what counts."""
    if observed is None:
        observed = torch.ones_like(pit, dtype=torch.bool)
    check_observed(pit, observed)
    # A NaN under a False mask compares False: it is inside nothing and counted by nobody.
    hits, weight = (inside & observed.unsqueeze(-1)).double(), observed.unsqueeze(-1).double()
    if dim is None:
        hits, weight, dim = hits.reshape(-1, hits.shape[-1]), weight.reshape(-1, 1), 0
    axis = dim if dim >= 0 else dim - 1  # the levels stand behind the dimensions of pit
    return (hits.sum(axis) / weight.sum(axis)).to(pit.dtype)


# ------------------------------------------------------------------------------------ proper scores
def gaussian_crps(value: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    r"""Score Gaussian forecasts by the continuous ranked probability score, entry by entry.

    .. math::
        \int (F(y) - [x \le y])^2 dy
        = \sigma \left( z (2 \Phi(z) - 1) + 2 \varphi(z) - \pi^{-1/2} \right),
        \quad z = (x - \mu) / \sigma

    Eq. (21) [Gneiting 2007], with the sign turned: smaller is better, 0 is perfect. In the units
    of the value; for std 0 it is the absolute error, so that a forecast without a spread can be
    set beside one with it.

    Args:
        value: x, shape ``(*batch,)``.
        mean: broadcasts with ``value``.
        std: broadcasts with ``value``, 0 or more.

    Returns:
        The broadcast shape, units of ``value``.

    Example:
        >>> import torch
        >>> x, mean = torch.tensor([3.0]), torch.tensor([1.0])
        >>> gaussian_crps(x, mean, torch.zeros(1)).item()
        2.0
    """
    error = value - mean
    z = error / std.clamp_min(torch.finfo(std.dtype).tiny)
    density = torch.exp(-0.5 * (z.square() + LOG_2PI))
    # error * (2 Phi - 1) rather than std * z * (...): std 0 leaves |error|.
    spread = error * (2 * torch.special.ndtr(z) - 1)
    return spread + std * (2 * density - 1 / math.sqrt(math.pi))


def gaussian_log_score(value: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    r"""Score Gaussian forecasts by minus the log-density of what came, entry by entry.

    .. math:: \tfrac12 \left( z^2 + \log \sigma^2 + \log 2\pi \right)

    Args:
        value: x, shape ``(*batch,)``.
        mean: broadcasts with ``value``.
        std: broadcasts with ``value``, positive.

    Returns:
        The broadcast shape, nats; smaller is better.

    Example:
        >>> import torch
        >>> score = gaussian_log_score(torch.ones(1), torch.zeros(1), torch.ones(1))
        >>> torch.allclose(score, -torch.distributions.Normal(0.0, 1.0).log_prob(torch.ones(1)))
        True
    """
    return 0.5 * (((value - mean) / std).square() + LOG_2PI) + std.log()


def log_score(error: Tensor, cov: Tensor, observed: Tensor, dim: int | None = None) -> Tensor:
    r"""Return the average negative log score of an observed entry, under the joint density.

    .. math:: -\frac{\sum_t \log N(M_t e_t; 0, M_t C_t M_t')}{\sum_t n_t}

    Args:
        error: e, shape ``(*batch, dim)``; what stands at missing entries is ignored.
        cov: C, shape ``(*batch, dim, dim)`` or ``(dim, dim)``.
        observed: bool, shape ``(*batch, dim)``.
        dim: dimension of ``batch`` that is averaged over; None: all of them.

    Returns:
        Nats per observed entry, float64; smaller is better. NaN where nothing was observed.

    Raises:
        ValueError: if the mask is not bool or not of the shape of ``error``.

    Example:
        >>> import torch
        >>> seen = torch.tensor([[True, False], [True, True]])
        >>> score = log_score(torch.zeros(2, 2), torch.eye(2), seen)
        >>> torch.allclose(score, torch.tensor(2 * torch.pi).double().log() / 2)
        True
    """
    check_observed(error, observed)
    density, count = masked_log_density(error.double(), cov.double(), observed), observed.sum(-1)
    if dim is None:
        return -density.sum() / count.sum()
    return -density.sum(dim) / count.sum(dim)
