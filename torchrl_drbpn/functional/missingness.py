"""Sample missing entries, outages, delays and noise of an observation.

Eq. (2) [DRBPN]: noise is added to the complete observation, then entries of the noisy observation
go missing, completely at random (MCAR), at random given what always arrives (MAR), or not at random
(NMAR): the terms of Rubin, "Inference and missing data", Biometrika 1976. Functions that draw take
`like`, a tensor `(*batch, obs)` or `(*batch, sensors)` of which only shape, device and the dtype of
noise are read, and a generator on its device; None is torch's global one.
"""

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import linear

MissingnessKind = Literal["mcar", "mar", "nmar"]


class MissingnessMechanism(NamedTuple):
    """The fixed parameters of a MAR or NMAR mechanism.

    Attributes:
        always_observed: bool, shape `(obs,)`; True where an entry never goes missing.
        bias: b0, shape `(obs,)`; minus infinity where `always_observed`.
        observation_weight: b2, shape `(obs, obs)`, row i for entry i, per observation unit; under
            MAR the columns outside `always_observed` are 0.
        action_weight: b1, shape `(obs, action)`, per action unit.
    """

    always_observed: Tensor
    bias: Tensor
    observation_weight: Tensor
    action_weight: Tensor


def draw_mechanism(
    kind: Literal["mar", "nmar"],
    obs_dim: int,
    action_dim: int,
    *,
    always_observed: float = 0.25,
    generator: torch.Generator | None,
) -> MissingnessMechanism:
    """Draw the always observed entries and b0, b1, b2 ~ N(0, 1) of a mechanism, float64 on the CPU.

    round(always_observed * obs_dim) entries always arrive, at least 1; a ValueError where that is
    all of them. MAR and NMAR draw the same numbers from the same CPU generator, and the action's
    weights come last, so that all else does not depend on `action_dim`, which may be 0.

    Example:
        >>> draw = lambda: draw_mechanism("mar", 8, 3, generator=torch.Generator().manual_seed(0))
        >>> int(draw().always_observed.sum()), torch.equal(draw().bias, draw().bias)
        (2, True)
    """
    if kind not in ("mar", "nmar"):
        raise ValueError(f'`kind` must be "mar" or "nmar", got {kind!r}; "mcar" has no parameters.')
    share = always_observed
    if not 0.0 <= share <= 1.0 or (count := max(1, round(share * obs_dim))) >= obs_dim:
        raise ValueError(
            "`always_observed` must be a share that leaves an entry that can go missing, got "
            f"{share} of {obs_dim} entries. Pass a smaller one, or MCAR where there is one entry."
        )
    always = torch.zeros(obs_dim, dtype=torch.bool)
    always[torch.randperm(obs_dim, generator=generator)[:count]] = True
    bias = torch.randn(obs_dim, generator=generator, dtype=torch.float64)
    observation_weight = torch.randn(obs_dim, obs_dim, generator=generator, dtype=torch.float64)
    action_weight = torch.randn(obs_dim, action_dim, generator=generator, dtype=torch.float64)
    if kind == "mar":
        observation_weight = observation_weight.masked_fill(~always, 0.0)
    return MissingnessMechanism(
        always, bias.masked_fill(always, -math.inf), observation_weight, action_weight
    )


def missing_probability(
    mechanism: MissingnessMechanism,
    observation: Tensor,
    previous_action: Tensor | None,
    eta: float,
) -> Tensor:
    r"""Return the probability that each entry goes missing, `(*batch, obs)`.

    $P(\text{missing}_i) = \min(\sigma(b_{1i}^\top a_{t-1} + b_{2i}^\top x + b_{0i}), \eta)$, and 0
    for the always observed entries (experiments of [DRBPN]). It realises clearly less than eta.

    Args:
        mechanism: parameters, on the device and in the dtype of `observation`.
        observation: complete, noise included, shape `(*batch, obs)`.
        previous_action: a_{t-1}, shape `(*batch, action)`; None counts as zero.
        eta: upper bound of the probability.

    Example:
        >>> m = draw_mechanism("nmar", 4, 2, generator=torch.Generator().manual_seed(0))
        >>> p = missing_probability(m, torch.randn(7, 4).double(), torch.zeros(7, 2).double(), 0.3)
        >>> bool((p[:, m.always_observed] == 0).all()), bool((p <= 0.3).all())
        (True, True)
    """
    logits = linear(observation, mechanism.observation_weight, mechanism.bias)
    if previous_action is not None:
        logits = logits + linear(previous_action, mechanism.action_weight)
    return logits.sigmoid().clamp(max=eta)


def sample_mask(
    probability: Tensor | float, like: Tensor, generator: torch.Generator | None
) -> Tensor:
    """Draw which entries arrive, bool; `probability` of missing is a number or `(*batch, obs)`.

    Example:
        >>> x = torch.zeros(3, 5)
        >>> bool(sample_mask(0.0, x, None).all()), bool(sample_mask(1.0, x, None).any())
        (True, False)
    """
    uniform = torch.rand(like.shape, generator=generator, device=like.device)
    # uniform < 1, so that probability 1 always misses; where the probability is NaN, from a NaN in
    # the observation, the entry arrives: a mask must not hide that the simulation broke down
    return (uniform < probability).logical_not_()


def sample_noise(std: Tensor | float, like: Tensor, generator: torch.Generator | None) -> Tensor:
    """Draw N(0, std^2) noise in the dtype of `like`; `std` is a number or `(obs,)`, its units.

    Example:
        >>> float(sample_noise(0.0, torch.ones(2, 3), None).abs().sum())
        0.0
    """
    noise = torch.randn(like.shape, generator=generator, device=like.device, dtype=like.dtype)
    return noise.mul_(std)


class OutageRates(NamedTuple):
    """What a sensor does next: failure = P(on -> off), repair = P(off -> on), a step."""

    failure: float
    repair: float

    @property
    def missing_rate(self) -> float:
        """Stationary probability of being off, failure / (failure + repair)."""
        return self.failure / (self.failure + self.repair)


def outage_rates(eta: float, mean_length: float) -> OutageRates:
    r"""Return the Markov chain with a given share of time off and a given mean outage.

    With $P(off \to on) = 1/L$ an outage lasts a geometric number of steps with mean L, and
    $P(on \to off) = \frac{\eta}{1 - \eta} \frac{1}{L}$ makes eta the stationary probability of
    being off (Gilbert, "Capacity of a burst-noise channel", Bell System Technical Journal 1960).
    L = 1 / (1 - eta) has no memory and is MCAR at eta; a shorter one makes a sensor alternate.

    ``eta`` is in [0, 1), ``mean_length`` L, steps, at least 1 and at least eta / (1 - eta), where
    P(on -> off) is 1; a ValueError where one of them is out of range.

    Example:
        >>> outage_rates(0.5, 20).repair, outage_rates(0.5, 20).missing_rate
        (0.05, 0.5)
    """
    if not 0.0 <= eta < 1.0:
        raise ValueError(
            f"`eta` must be a share of time in [0, 1), got {eta!r}. SensorReduction takes sensors "
            "away for good."
        )
    if not 1.0 <= mean_length < math.inf:
        raise ValueError(
            f"`mean_length` must be the mean length of an outage in steps, at least 1, got "
            f"{mean_length!r}."
        )
    odds = eta / (1.0 - eta)
    failure = odds / mean_length
    # 0.8 / (1 - 0.8) is 4.000000000000001 in floating point, and a mean length of 4 is meant
    if failure > 1.0 + 1e-9:
        raise ValueError(
            f"`mean_length` must be at least eta / (1 - eta) = {odds:.4g} steps for eta {eta}, got "
            f"{mean_length}: a sensor that is off so much of the time can't come back so soon."
        )
    return OutageRates(min(failure, 1.0), 1.0 / mean_length)


def sample_working(
    working: Tensor | None, rates: OutageRates, like: Tensor, generator: torch.Generator | None
) -> Tensor:
    """Draw which sensors work, bool, from which worked at the step before; None: stationary.

    Example:
        >>> before = torch.tensor([True, False, True])
        >>> after = sample_working(before, outage_rates(0.5, 1e9), before, None)
        >>> torch.equal(before, after)  # outages of a billion steps
        True
    """
    uniform = torch.rand(like.shape, generator=generator, device=like.device)
    if working is None:
        return uniform >= rates.missing_rate
    return torch.where(working, uniform >= rates.failure, uniform < rates.repair)


def sample_delay(
    least: Tensor, most: Tensor, like: Tensor, generator: torch.Generator | None
) -> Tensor:
    """Draw how many steps each reading is late, uniform on `least` to `most`, int64 `(sensors,)`.

    Example:
        >>> delay = sample_delay(torch.tensor(1), torch.tensor(3), torch.zeros(1000, 2), None)
        >>> delay.unique().tolist()
        [1, 2, 3]
    """
    uniform = torch.rand(like.shape, generator=generator, device=like.device)
    # uniform < 1, but its product with a large span may round up to the span
    return torch.minimum(least + (uniform * (most - least + 1)).long(), most)


def sample_spikes(
    probability: Tensor | float,
    std: Tensor | float,
    like: Tensor,
    generator: torch.Generator | None,
) -> tuple[Tensor, Tensor]:
    """Draw gross errors: with a small probability, an error of standard deviation `std`.

    Both are numbers or `(obs,)`. Returns the error, 0 where there is none, and where a reading is
    hit, bool.

    Example:
        >>> error, hit = sample_spikes(0.1, 50.0, torch.zeros(200, 9), None)
        >>> bool(((error != 0) == hit).all())
        True
    """
    hit = torch.rand(like.shape, generator=generator, device=like.device) < probability
    return sample_noise(std, like, generator).masked_fill_(~hit, 0.0), hit
