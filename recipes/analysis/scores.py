r"""A proper score of Gaussian predictions, entry by entry: claiming another variance never pays."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def gaussian_crps(value: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    r"""Score by the continuous ranked probability score, the integral of (F(y) - [x <= y])^2.

    .. math:: \sigma \left( z (2 \Phi(z) - 1) + 2 \varphi(z) - \pi^{-1/2} \right)

    Eq. (21) of Gneiting and Raftery, *Strictly Proper Scoring Rules, Prediction, and Estimation*,
    JASA 102, 2007, with the sign turned: smaller is better, 0 is perfect. In units of ``value``; a
    ``std`` of 0 leaves the absolute error.
    """
    error = value - mean
    z = error / std.clamp_min(torch.finfo(std.dtype).tiny)
    density = torch.exp(-0.5 * z.square()) / math.sqrt(2 * math.pi)
    # error * (2 Phi - 1) rather than std * z * (...): std 0 leaves |error|.
    spread = error * (2 * torch.special.ndtr(z) - 1)
    return spread + std * (2 * density - 1 / math.sqrt(math.pi))
