"""Entries missing for a reason (NMAR): what the mask itself says of the readings it hides."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import LOG_2PI, Belief, as_matrix, zero_missing
from torchrl_drbpn.functional.kalman import update

__all__ = ["MaskModel", "update_by_mask"]

_SCALE = math.sqrt(math.pi / 8)  # makes the normal distribution function a logistic one
_LEAST_INFORMATION = 1e-12


class MaskModel(NamedTuple):
    r"""Say how likely a reading is to arrive, given what it would have been.

    .. math:: P(\text{observed}_i \mid x_i) = \Phi(\sqrt{\pi/8}\, (a_i + b_i x_i))

    which differs from the logistic :math:`1 / (1 + \exp(-a_i - b_i x_i))` by at most .02
    (§4.5.2 [Bishop 2006]) and has an average over a Gaussian in closed form.

    Args:
        intercept: a, shape ``(obs,)``.
        slope: b, shape ``(obs,)``, one over the units of an observation; 0 is ignorable.

    Example:
        >>> MaskModel._fields
        ('intercept', 'slope')
    """

    intercept: Tensor
    slope: Tensor


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

    Args:
        belief: filtered belief, mean ``(*batch, state)``, cov ``(*batch, state, state)``.
        observation: shape ``(*batch, obs)``; missing entries may hold anything.
        observed: bool, shape ``(*batch, obs)``.
        emission_matrix: H, shape ``(obs, state)``.
        emission_cov: R, shape ``(*batch, obs, obs)``, or ``(obs,)`` for its diagonal.
        offset: B a + d, shape ``(*batch, obs)``.
        mask_model: how likely readings are to arrive.

    Returns:
        The belief, and the log-probability of the mask, nats, shape ``(*batch,)``: entries that
        are missing together are counted as independent.

    Example:
        >>> import torch
        >>> belief, zero = Belief(torch.zeros(1), torch.eye(1)), torch.zeros(1)
        >>> nothing = torch.zeros(1, dtype=torch.bool)
        >>> rarely_high = MaskModel(torch.zeros(1), torch.tensor([-2.0]))
        >>> after, _ = update_by_mask(
        ...     belief, zero, nothing, torch.eye(1), torch.ones(1), zero, rarely_high)
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
    telling = ~observed & (variance * h > _LEAST_INFORMATION)
    h = torch.where(telling, h, 1.0 / (2.0 * variance))  # no division by 0 where nothing is told
    reading = mean + g / h
    extra = torch.diag_embed(1.0 / h - variance)
    told = update(belief, reading, telling, emission_matrix, noise + extra, offset)
    return told, log_mask.to(belief.mean.dtype)
