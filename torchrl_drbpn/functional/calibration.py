r"""Is a Gaussian belief as sure as it should be: normalised squared errors.

[Bar-Shalom 2001] is Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and
Navigation*.
"""

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import as_matrix, check_observed, masked_cov, zero_missing


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
