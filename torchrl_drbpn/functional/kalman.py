"""One time step of the masked Kalman filter in textbook form: predict, innovation, update.

The fast sequence filter (:mod:`.filtering`) is held to these functions. They take any mask and any
leading batch shape. The book's letters stand for: m, P the belief, H the emission matrix, R the
emission covariance, S the innovation covariance, K the gain. A covariance is a matrix or, of shape
``(n,)``, the variances of a diagonal one.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import (
    LOG_2PI,
    Belief,
    as_matrix,
    check_observed,
    factorise,
    masked_cov,
    masked_log_density,
    rounded_cov,
    zero_missing,
)

_SCALE = math.sqrt(math.pi / 8)  # makes the normal distribution function a logistic one
_LEAST_INFORMATION = 1e-12


class MaskModel(NamedTuple):
    r"""Say how likely a reading is to arrive, given what it would have been.

    .. math:: P(\text{observed}_i \mid x_i) = \Phi(\sqrt{\pi/8}\, (a_i + b_i x_i))

    which differs from the logistic :math:`1 / (1 + \exp(-a_i - b_i x_i))` by at most .02
    (§4.5.2 [Bishop 2006]) and has an average over a Gaussian in closed form. ``intercept`` a and
    ``slope`` b, one over the units of an observation, are ``(obs,)``; a slope of 0 is ignorable.
    """

    intercept: Tensor
    slope: Tensor


def predict(
    belief: Belief,
    transition: Callable[[Tensor, Tensor], Tensor],
    transition_cov: Tensor,
    previous_action: Tensor,
    *,
    jacobian: Tensor | None,
) -> Belief:
    r"""Carry a filtered belief over one transition.

    .. math:: m^- = f(m, a), \qquad P^- = Q \quad\text{or}\quad P^- = J P J' + Q

    Eq. (8) [DRBPN] takes the transition at the mean only, so that :math:`P^- = Q`. With
    ``jacobian`` the covariance is propagated, as in the extended Kalman filter (§5.2 [Särkkä
    2013]). A Q that was trained without it holds the past's share already.

    Args:
        belief: filtered belief of the step before, mean ``(*batch, state)``.
        transition: f, maps ``(*batch, state)`` and ``(*batch, action)`` to ``(*batch, state)``.
        transition_cov: Q, shape ``(*batch, state, state)``, or ``(state,)`` for its diagonal.
        previous_action: shape ``(*batch, action)``.
        jacobian: J, the derivative of f by the mean, shape ``(*batch, state, state)``; None for the
            constant covariance of the paper, which drops the past.

    Example:
        >>> belief, eye = Belief(torch.ones(5, 2), torch.eye(2).expand(5, 2, 2)), torch.eye(2)
        >>> predicted = predict(belief, lambda m, a: m + a, eye, torch.ones(5, 2), jacobian=None)
        >>> bool((predicted.mean == 2).all()), predicted.cov.shape
        (True, torch.Size([5, 2, 2]))
    """
    mean = transition(belief.mean, previous_action)
    Q = as_matrix("transition_cov", transition_cov, mean.shape[-1])
    if jacobian is None:
        return Belief(mean, Q.expand(*mean.shape, mean.shape[-1]))
    moved = jacobian @ as_matrix("belief.cov", belief.cov, mean.shape[-1]) @ jacobian.mT
    return Belief(mean, 0.5 * (moved + moved.mT) + Q)


def _covariances(
    belief: Belief,
    observation: Tensor,
    observed: Tensor,
    H: Tensor,
    R: Tensor,
    offset: Tensor | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Check the sizes of an update; return H, P and R as float64 matrices."""
    check_observed(observation, observed)
    obs, state = observation.shape[-1], belief.mean.shape[-1]
    if H.shape[-2:] != (obs, state):
        raise ValueError(
            f"`emission_matrix` must have shape (obs, state) = {(obs, state)}, got "
            f"{tuple(H.shape)}: `observation` and `belief.mean` say the sizes."
        )
    if offset is not None and offset.shape[-1:] != (obs,):
        raise ValueError(
            f"`offset` must have shape (*batch, obs) = {tuple(observation.shape)}, got "
            f"{tuple(offset.shape)}."
        )
    P, R = as_matrix("belief.cov", belief.cov, state), as_matrix("emission_cov", R, obs)
    return H.double(), P.double(), R.double()


def innovation(
    belief: Belief,
    observation: Tensor,
    observed: Tensor,
    emission_matrix: Tensor,
    emission_cov: Tensor,
    offset: Tensor | None = None,
) -> Belief:
    r"""Compare an observation with what the predicted belief expects.

    .. math:: v = M'M (x - H m - o), \qquad S = H P H' + R

    Args:
        belief: predicted belief, mean ``(*batch, state)``, cov ``(*batch, state, state)``.
        observation: x, shape ``(*batch, obs)``; missing entries may hold anything.
        observed: bool, shape ``(*batch, obs)``, True = arrived.
        emission_matrix: H, shape ``(obs, state)``.
        emission_cov: R, shape ``(*batch, obs, obs)``, or ``(obs,)`` for its diagonal.
        offset: o = B a + d, shape ``(*batch, obs)``; None is 0.

    Returns:
        ``Belief(v, S)``, float64: with R at its floor S has a condition number of 1e6 and more.
        v is 0 at missing entries; S is over all components, observed or not.

    Example:
        >>> belief, seen = Belief(torch.zeros(2), torch.eye(2)), torch.tensor([True, False])
        >>> v, S = innovation(belief, torch.ones(2), seen, torch.eye(2), torch.eye(2))
        >>> v.tolist(), S.diagonal().tolist()
        ([1.0, 0.0], [2.0, 2.0])
    """
    H, P, R = _covariances(belief, observation, observed, emission_matrix, emission_cov, offset)
    return _innovation(belief.mean, observation, observed, H, P, R, offset)


def _innovation(
    mean: Tensor,
    observation: Tensor,
    observed: Tensor,
    H: Tensor,
    P: Tensor,
    R: Tensor,
    offset: Tensor | None,
) -> Belief:
    """Return v and S of what :func:`_covariances` has checked."""
    expected = (H @ mean.double().unsqueeze(-1)).squeeze(-1)
    expected = expected if offset is None else expected + offset
    # Zero first, subtract after: a NaN under a False mask must reach neither value nor gradient.
    residual = zero_missing(zero_missing(observation, observed) - expected, observed)
    return Belief(residual, H @ P @ H.mT + R)


def update(
    belief: Belief,
    observation: Tensor,
    observed: Tensor,
    emission_matrix: Tensor,
    emission_cov: Tensor,
    offset: Tensor | None = None,
) -> Belief:
    r"""Condition a predicted belief on the entries that arrived.

    .. math::
        K = P H' M' (M S M')^{-1} M, \qquad m^+ = m + K v, \qquad
        P^+ = (I - K H) P (I - K H)' + K R K'

    Eq. (10) [DRBPN]; differs from the paper: the covariance is in Joseph's form (§4.3 [Särkkä
    2013] with exercise 4.5), equal to :math:`P - K H P` in exact arithmetic and positive definite
    in float32 too. Nothing observed leaves the belief as it is.

    Arguments are those of :func:`innovation`; it returns the filtered belief.

    Example:
        >>> belief, seen = Belief(torch.zeros(2), torch.eye(2)), torch.tensor([True, False])
        >>> mean, cov = update(belief, torch.ones(2), seen, torch.eye(2), 3 * torch.eye(2))
        >>> mean.tolist(), torch.allclose(cov, torch.diag(torch.tensor([0.75, 1.0])))
        ([0.25, 0.0], True)
    """
    dtype = belief.mean.dtype
    H, P, R = _covariances(belief, observation, observed, emission_matrix, emission_cov, offset)
    v, S = _innovation(belief.mean, observation, observed, H, P, R, offset)
    factor = factorise("the innovation covariance H P H' + R", masked_cov(S, observed))
    # K' = A^-1 (M'M) H P: the rows of missing entries are zero, so K ignores them.
    cross = zero_missing(H @ P, observed.unsqueeze(-1))
    K = torch.cholesky_solve(cross, factor).mT
    mean = belief.mean + (K @ v.unsqueeze(-1)).squeeze(-1).to(dtype)
    kept = torch.eye(mean.shape[-1], dtype=P.dtype, device=P.device) - K @ H
    cov = kept @ P @ kept.mT + K @ R @ K.mT
    cov = rounded_cov(cov, dtype)
    anything = observed.any(-1)[..., None, None]
    return Belief(mean, torch.where(anything, cov, P.to(dtype)))


def sequential_update(
    belief: Belief,
    observation: Tensor,
    observed: Tensor,
    emission_matrix: Tensor,
    emission_cov: Tensor,
    offset: Tensor | None = None,
) -> Belief:
    r"""Condition a belief on the entries that arrived, one after the other.

    .. math::
        s_i = h_i' P h_i + r_i, \quad k_i = P h_i / s_i, \quad
        m \leftarrow m + k_i (x_i - h_i' m), \quad P \leftarrow P - k_i h_i' P

    Arguments and result are those of :func:`update` but for rounding, R by its diagonal ``(obs,)``
    alone [Anderson and Moore 1979]; a ValueError for a matrix. Nothing is factorised: what has no
    Cholesky decomposition, such as ONNX, can run it.

    Example:
        >>> belief, H = Belief(torch.zeros(2), torch.eye(2)), torch.tensor([[1.0, 0.0], [1.0, 1.0]])
        >>> step = belief, torch.ones(2), torch.ones(2, dtype=torch.bool), H, torch.ones(2)
        >>> all(torch.allclose(a, b) for a, b in zip(sequential_update(*step), update(*step)))
        True
    """
    if emission_cov.ndim != 1:
        raise ValueError(
            "`emission_cov` must be the variances (obs,) of a diagonal R, got "
            f"{tuple(emission_cov.shape)}: readings that depend on each other need `update`."
        )
    H, P, _ = _covariances(belief, observation, observed, emission_matrix, emission_cov, offset)
    dtype, m = belief.mean.dtype, belief.mean.double()
    x = zero_missing(observation if offset is None else observation - offset, observed).double()
    for i, (h, r) in enumerate(zip(H, emission_cov.double(), strict=True)):
        along = P @ h
        gain = along / ((along * h).sum(-1, keepdim=True) + r)
        gain = zero_missing(gain, observed[..., i : i + 1])
        m = m + gain * (x[..., i : i + 1] - (m * h).sum(-1, keepdim=True))
        P = P - gain.unsqueeze(-1) * along.unsqueeze(-2)
    return Belief(m.to(dtype), rounded_cov(P, dtype))


def log_likelihood(
    belief: Belief,
    observation: Tensor,
    observed: Tensor,
    emission_matrix: Tensor,
    emission_cov: Tensor,
    offset: Tensor | None = None,
) -> Tensor:
    r"""Evaluate the log-likelihood of what arrived under the predicted belief.

    .. math:: \log N\left(M x;\; M (H m + o),\; M (H P H' + R) M'\right)

    Eq. (12) [DRBPN]. Nothing observed: exactly 0.

    Arguments are those of :func:`innovation`; it returns nats, shape ``(*batch,)``.

    Example:
        >>> belief, one = Belief(torch.zeros(1), torch.zeros(1, 1)), torch.ones(1)
        >>> value = log_likelihood(belief, one, one > 0, torch.eye(1), torch.eye(1))
        >>> torch.allclose(value, torch.distributions.Normal(0.0, 1.0).log_prob(one))
        True
    """
    v, S = innovation(belief, observation, observed, emission_matrix, emission_cov, offset)
    return masked_log_density(v, S, observed).to(belief.mean.dtype)


def update_by_mask(
    belief: Belief,
    observation: Tensor,
    observed: Tensor,
    emission_matrix: Tensor,
    emission_cov: Tensor,
    offset: Tensor,
    mask_model: MaskModel,
) -> tuple[Belief, Tensor]:
    r"""Condition a belief, filtered by what arrived, on what did not.

    With :math:`x_i \sim N(\mu, v)` by the belief the absence of entry i has the probability
    :math:`Z = \Phi(t), \; t = -c (a + b \mu) / \sqrt{1 + c^2 b^2 v}, \; c^2 = \pi / 8`. One
    Gaussian approximation step by moment matching (assumed density filtering, §3.6 [Rasmussen
    2006]): with :math:`g = \partial_\mu \log Z, \; h = -\partial^2_\mu \log Z` the absence is
    taken for a reading :math:`\mu + g / h` of variance :math:`1 / h - v` on top of R. For one
    missing entry mean and covariance are exact; several are matched from the same belief, once.

    Arguments are those of :func:`innovation` with the filtered belief, and the ``mask_model``. It
    returns the belief, and the log-probability of the mask, nats, shape ``(*batch,)``: entries that
    are missing together are counted as independent.

    Example:
        >>> belief, zero = Belief(torch.zeros(1), torch.eye(1)), torch.zeros(1)
        >>> rarely_high = MaskModel(zero, torch.tensor([-2.0]))
        >>> after, _ = update_by_mask(
        ...     belief, zero, zero > 0, torch.eye(1), torch.ones(1), zero, rarely_high)
        >>> bool(after.mean > 0), bool(after.cov < 1)  # it is missing: it was probably high
        (True, True)
    """
    H, P = emission_matrix.double(), belief.cov.double()
    noise = as_matrix("emission_cov", emission_cov, len(H)).double()
    mean = (H @ belief.mean.double().unsqueeze(-1)).squeeze(-1) + offset
    variance = ((H @ P) * H).sum(-1) + noise.diagonal(dim1=-2, dim2=-1)
    a, b = (_SCALE * x.double() for x in mask_model)
    spread = (1.0 + b.square() * variance).sqrt()
    t = -(a + b * mean) / spread
    log_absent = torch.special.log_ndtr(t)
    log_present = torch.special.log_ndtr(a + b * zero_missing(observation, observed).double())
    log_mask = torch.where(observed, log_present, log_absent).sum(-1)
    ratio = torch.exp(-0.5 * (t.square() + LOG_2PI) - log_absent)
    g = -b / spread * ratio
    h = (b / spread).square() * ratio * (ratio + t)
    informative = ~observed & (variance * h > _LEAST_INFORMATION)
    # No division by 0 where the absence says nothing.
    h = torch.where(informative, h, 1.0 / (2.0 * variance))
    reading = mean + g / h
    extra = torch.diag_embed(1.0 / h - variance)
    after = update(belief, reading, informative, emission_matrix, noise + extra, offset)
    return after, log_mask.to(belief.mean.dtype)
