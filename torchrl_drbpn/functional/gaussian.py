"""Gaussian beliefs: the pair (mean, cov), the masked log-density, covariance parametrisations."""

import math
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import softplus

LOG_2PI = math.log(2.0 * math.pi)


class Belief(NamedTuple):
    """Hold a Gaussian belief N(mean, cov), ``(*batch, dim)`` and ``(*batch, dim, dim)``."""

    mean: Tensor
    cov: Tensor


class NotPositiveDefiniteError(ValueError):
    """Report a covariance that has no Cholesky factor."""


def check_observed(observation: Any, observed: Any, name: Any = "observed") -> None:
    """Refuse a mask, or its spec, that would broadcast or be read as numbers."""
    if observed.dtype is not torch.bool or observed.shape != observation.shape:
        raise ValueError(
            f"`{name}` must be bool of the observation's shape {tuple(observation.shape)}, got "
            f"{observed.dtype} {tuple(observed.shape)}. One entry a component: True = arrived."
        )


def as_matrix(name: str, cov: Tensor, dim: int) -> Tensor:
    """Return a covariance ``(..., dim, dim)``; of variances ``(dim,)`` the diagonal matrix."""
    if cov.shape[-2:] == (dim, dim):
        return cov
    if cov.shape == (dim,):
        return cov.diag()
    raise ValueError(
        f"`{name}` must be a covariance of shape (..., {dim}, {dim}) or the variances ({dim},) of "
        f"a diagonal one, got {tuple(cov.shape)}."
    )


def factorise(name: str, cov: Tensor) -> Tensor:
    """Return the lower Cholesky factor of covariances, or say that one has none."""
    try:
        return torch.linalg.cholesky(cov)
    except RuntimeError as error:  # LinAlgError, which torch.linalg does not export by name
        raise NotPositiveDefiniteError(
            f"{name} is not positive definite: a covariance is singular or holds NaN. Two sensors "
            "that read the same quantity without noise (R = 0) are such a case: give R a positive "
            "variance."
        ) from error


def zero_missing(values: Tensor, observed: Tensor) -> Tensor:
    """Put 0 where nothing arrived, whatever stood there (NaN and inf included).

    Both of shape ``(*batch, obs)``. Multiplying by the mask would keep a NaN (0 * NaN = NaN).

    Example:
        >>> zero_missing(torch.tensor([1.0, float("nan")]), torch.tensor([True, False])).tolist()
        [1.0, 0.0]
    """
    return torch.where(observed, values, torch.zeros((), dtype=values.dtype, device=values.device))


def masked_cov(cov: Tensor, observed: Tensor) -> Tensor:
    r"""Replace the rows and columns of missing entries by those of the identity.

    .. math:: A = (m m') \circ S + \mathrm{diag}(1 - m)

    Determinant of A and inverse on the observed block are those of ``M S M'`` (eq. 10 and 12
    [DRBPN]), with a static shape: S is ``(*batch, obs, obs)`` or, its diagonal, ``(obs,)``,
    ``observed`` ``(*batch, obs)``, A ``(*batch, obs, obs)``.

    Example:
        >>> cov = torch.tensor([[2.0, 1.0], [1.0, 2.0]])
        >>> masked_cov(cov, torch.tensor([True, False])).tolist()
        [[2.0, 0.0], [0.0, 1.0]]
    """
    cov = as_matrix("cov", cov, observed.shape[-1])
    both = observed.unsqueeze(-1) & observed.unsqueeze(-2)
    eye = torch.eye(cov.shape[-1], dtype=cov.dtype, device=cov.device)
    return torch.where(both, cov, eye)


def masked_log_density(residual: Tensor, cov: Tensor, observed: Tensor) -> Tensor:
    r"""Evaluate log N(M residual; 0, M cov M') with M selecting the observed entries.

    .. math:: \log p = -\tfrac12 \left( r' A^{-1} r + \log|A| + n \log 2\pi \right)

    Eq. (12) [DRBPN]. A is :func:`masked_cov`, n the number of observed entries, ``residual``
    ``(*batch, obs)``. Nats, ``(*batch,)``; with nothing observed exactly 0.

    Example:
        >>> nothing = torch.zeros(2, dtype=torch.bool)
        >>> masked_log_density(torch.ones(2), torch.eye(2), nothing).item() == 0
        True
    """
    check_observed(residual, observed)
    residual = zero_missing(residual, observed)
    factor = factorise("`cov`", masked_cov(cov, observed))
    white = torch.linalg.solve_triangular(factor, residual.unsqueeze(-1), upper=False).squeeze(-1)
    log_det = 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    count = observed.sum(-1).to(residual.dtype)
    return -0.5 * (white.square().sum(-1) + log_det + count * LOG_2PI)


def inverse_softplus(value: Tensor) -> Tensor:
    """Return x with softplus(x) = value, for value > 0.

    Example:
        >>> round(softplus(inverse_softplus(torch.tensor(0.3))).item(), 6)
        0.3
    """
    return value + torch.log(-torch.expm1(-value))


def positive_std(raw: Tensor, min_std: float) -> Tensor:
    """Return standard deviations min_std + softplus(raw), which never fall under a floor.

    Example:
        >>> bool((positive_std(torch.tensor([-1e3, 0.0]), 0.1) >= 0.1).all())
        True
    """
    return softplus(raw) + min_std


def full_cov(raw: Tensor, min_std: float) -> Tensor:
    """Map a free square matrix ``(*batch, dim, dim)`` to a covariance L L' + min_std**2 I.

    L is the lower triangle of ``raw`` with a softplus diagonal; the rest of it is not read. No
    standard deviation, in whatever direction, is under ``min_std``.

    Example:
        >>> cov = full_cov(torch.randn(4, 4, dtype=torch.float64), 0.1)
        >>> bool(torch.linalg.eigvalsh(cov).min() >= 0.01 - 1e-12)
        True
    """
    tril = raw.tril(-1) + torch.diag_embed(softplus(raw.diagonal(dim1=-2, dim2=-1)))
    eye = torch.eye(raw.shape[-1], dtype=raw.dtype, device=raw.device)
    cov = tril @ tril.mT
    # A matrix product may round the two triangles differently.
    return 0.5 * (cov + cov.mT) + (min_std * min_std) * eye


def rounded_cov(cov: Tensor, dtype: torch.dtype) -> Tensor:
    """Return float64 covariances in another dtype, symmetric and positive definite there too."""
    cov = (0.5 * (cov + cov.mT)).to(dtype)
    unit = 0.5 * cov.shape[-1] * torch.finfo(dtype).eps
    return cov + torch.diag_embed(unit * cov.diagonal(dim1=-2, dim2=-1).detach())


def tril_to_vector(cov: Tensor) -> Tensor:
    """Flatten the lower triangle of ``(*batch, dim, dim)``, row by row.

    Example:
        >>> tril_to_vector(torch.tensor([[1.0, 2.0], [2.0, 3.0]])).tolist()
        [1.0, 2.0, 3.0]
    """
    row, column = torch.tril_indices(cov.shape[-1], cov.shape[-1], device=cov.device)
    return cov[..., row, column]


def without_autocast(like: Tensor) -> AbstractContextManager[None]:
    """Keep dtypes inside torch.autocast on the device of ``like``: half precision loses digits."""
    kind = like.device.type
    if kind == "meta" or not torch.is_autocast_enabled(kind):
        return nullcontext()
    return torch.autocast(kind, enabled=False)
