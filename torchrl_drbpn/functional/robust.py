"""A robust update: readings too far from their forecast are moved to a bound around it."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import without_autocast, zero_missing
from torchrl_drbpn.functional.state_space import StateSpace, predict_step

__all__ = ["bounded", "check_gate", "reading_variance", "saturate_innovation"]

_NORMAL_MEDIAN = 0.6744897501960817  # of |z|, z standard normal: it turns a median into a deviation


def saturate_innovation(
    model: StateSpace,
    mean: Tensor,
    previous_action: Tensor,
    observation: Tensor,
    observed: Tensor,
    reset: Tensor,
    gate: float,
    cov: Tensor | None = None,
) -> Tensor:
    r"""Move every reading to within ``gate`` deviations of its forecast.

    .. math::
        \tilde x_i = \hat x_i + \max(-b_i, \min(b_i, x_i - \hat x_i)), \quad
        b_i = g\, c\, \sqrt{S_{ii}}, \quad
        c = \max(1, \mathrm{med}_{j\ \mathrm{arrived}} |z_j| / .6745)

    with :math:`z_i = (x_i - \hat x_i) / \sqrt{S_{ii}}`, :math:`\hat x = H m^- + B a + d` and
    S = H P H' + R; P is Q, or P_0 where an episode starts. A reading within the bound stays as it
    is, to the bit [Masreliez and Martin 1977].

    What is bounded is the marginal deviation of each reading, by the diagonal of S. A reading that
    contradicts others which it should agree with passes: among five sensors with S = 1 1' + .01 I
    one may lie 25 of its noise deviations off and only 2.5 marginal ones.

    c estimates from the readings of this step how many times too small S is. If most of them are
    far off, the belief has diverged, and c lets them pull it back; a fixed bound, or rejection, may
    never do so, as P does not grow meanwhile. So most of the readings that arrive must be right. A
    single reading is its own median: it is believed unless ``gate`` is under .67. The median of an
    even number is the lower one.

    Args:
        model: the state-space model.
        mean: filtered mean of the step before, shape ``(*batch, state)``.
        previous_action: shape ``(*batch, action)``.
        observation: shape ``(*batch, obs)``; missing entries may hold anything.
        observed: bool, shape ``(*batch, obs)``, True = arrived.
        reset: bool, shape ``(*batch,)``; True starts from the initial belief.
        gate: g, standard deviations of the forecast.
        cov: filtered covariance of the step before, ``(*batch, state, state)``; read where the
            model propagates it.

    Returns:
        Readings, shape ``(*batch, obs)``; NaN and inf that arrived stay what they are.

    Raises:
        ValueError: if ``gate`` is not positive and finite, or for a wrong shape or dtype.

    Example:
        >>> import torch
        >>> eye = torch.eye(3)
        >>> model = StateSpace(
        ...     lambda m, a: m, 3 * eye, eye, torch.ones(3), torch.zeros(3, 1), torch.zeros(3),
        ...     torch.zeros(3), eye)
        >>> arrived = torch.ones(3, dtype=torch.bool)
        >>> x = saturate_innovation(model, torch.zeros(3), torch.zeros(1),
        ...                         torch.tensor([100.0, 1.0, -1.0]), arrived,
        ...                         torch.tensor(False), 3.0)
        >>> x.tolist()  # 3 deviations of sqrt(3 + 1)
        [6.0, 1.0, -1.0]

    See also :meth:`torchrl_drbpn.BeliefFilter.step`, which takes a gate.
    """
    check_gate(gate)
    steps = tuple(reset.shape)
    model.check_inputs(steps, steps, mean, previous_action, observation, observed, reset, cov=cov)
    with without_autocast(mean):
        predicted = predict_step(model, mean, previous_action, reset, cov)
        H = model.emission_matrix
        expected = predicted.mean @ H.mT + model.offset(previous_action)
        deviation = reading_variance(H, predicted.cov, model.emission_cov).sqrt()
        return bounded(observation, observed, expected, deviation, gate)


def bounded(
    observation: Tensor, observed: Tensor, expected: Tensor, deviation: Tensor, gate: float
) -> Tensor:
    """Saturate innovations whose forecasts are known; all shapes ``(*batch, obs)``."""
    # Before any arithmetic: a NaN under a False mask would spoil gradients.
    observation = zero_missing(observation, observed)
    score = ((observation - expected) / deviation).abs()
    typical = score.masked_fill(~observed, torch.nan).nanmedian(-1, keepdim=True).values
    # Without any reading the median is NaN, and there is nothing to bound.
    excess = (typical / _NORMAL_MEDIAN).nan_to_num(1.0).clamp_min(1.0)
    bound = gate * excess * deviation
    near = torch.clamp(observation, expected - bound, expected + bound)
    # The filter refuses an infinite reading that is called observed; a clamp would hide it.
    return torch.where(observation.isinf(), observation, near)


def reading_variance(emission: Tensor, cov: Tensor, noise: Tensor) -> Tensor:
    """Return the diagonal of H P H' + R; R a matrix, or its diagonal."""
    own = noise if noise.ndim == 1 else noise.diagonal()
    return ((emission @ cov) * emission).sum(-1) + own


def check_gate(gate: float) -> None:
    """Raise unless a gate is a positive, finite number."""
    number = isinstance(gate, (int, float)) and not isinstance(gate, bool)
    if not number or not 0 < gate < math.inf:
        raise ValueError(
            "`gate` must be a positive, finite number of standard deviations of the innovation, "
            f"got {gate!r}; 3 is usual, None is no gate."
        )
