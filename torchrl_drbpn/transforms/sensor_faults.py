"""Readings that arrive and are wrong for a while: sensors that are stuck, sensors that drift."""

import math
from numbers import Real
from typing import ClassVar, Unpack

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import zero_missing
from torchrl_drbpn.functional.missingness import OutageRates, sample_noise, sample_working
from torchrl_drbpn.transforms._base import Step, read_numbers
from torchrl_drbpn.transforms._carried import CarriedKeys, CarriedStateTransform, read_steps
from torchrl_drbpn.transforms.noise import NUMBERS, STD, Numbers


class FaultyReadings(CarriedStateTransform):
    """A transform of readings that are wrong while their sensor has a fault; masks stay."""

    writes_mask: ClassVar[bool] = False

    def __init__(
        self,
        probability: float | None = None,
        mean_length: float | None = None,
        *,
        onset: int | None = None,
        duration: int | None = None,
        **keys: Unpack[CarriedKeys],
    ) -> None:
        super().__init__(**keys)
        if (probability is None) == (onset is None):
            raise ValueError(
                "`probability` (with `mean_length`) draws when a fault begins, `onset` (with "
                f"`duration`) fixes it: give one of them, got probability={probability!r} and "
                f"onset={onset!r}."
            )
        self._rates: OutageRates | None = None
        self._onset, self._last = 0, math.inf
        if probability is None:
            if mean_length is not None:
                raise ValueError(
                    "`mean_length` goes with `probability`; with `onset` give `duration`."
                )
            self._onset = int(read_steps(onset, "onset", 0, several=False))
            if duration is not None:
                self._last = float(read_steps(duration, "duration", 1, several=False))
            return
        if duration is not None:
            raise ValueError("`duration` goes with `onset`; with `probability` give `mean_length`.")
        meaning = "that of a fault to begin at a step, in [0, 1]"
        begin = read_numbers(probability, "probability", meaning, most=1.0, several=False)
        length = math.inf if mean_length is None else mean_length
        if not isinstance(length, Real) or not length >= 1:
            raise ValueError(
                "`mean_length` must be the mean length of a fault in steps, at least 1 and "
                f"infinite for one that never ends, got {mean_length!r}."
            )
        self._rates = OutageRates(float(begin), 1.0 / length)

    def _layout(self, obs_dim: int) -> list[tuple[tuple[int, ...], torch.dtype | None]]:
        return [((self._count(obs_dim),), torch.int64), ((obs_dim,), None)]

    def _faulty(self, step: Step) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return how long faults have lasted, which entries are wrong, and the other state."""
        x, carried = step.observation, self._carried(step)
        before, other = (None, None) if carried is None else carried
        like = self._group_like(x)
        if before is None:
            first = 0 if self._rates is not None else 1 - self._onset
            steps = torch.full_like(like, first, dtype=torch.int64)
        else:
            steps = before + 1
            if self._rates is not None:  # 0 for a sensor that works
                generator = self.generator(x.device)
                working = sample_working(before == 0, self._rates, like, generator)
                steps = steps.masked_fill(working, 0)
        return steps, self._spread((steps > 0) & (steps <= self._last), x, False), other


class StuckSensors(FaultyReadings):
    r"""Let sensors get stuck at their last value: it arrives again and again, as if it were new.

    With `probability` a sensor that works gets stuck at a step with this probability and a stuck
    one is released with probability 1 / `mean_length`: a two-state Markov chain, all sensors
    working at the reset, t steps later stuck with probability $\eta (1 - (1 - p - 1/L)^t)$, $\eta =
    p / (p + 1/L)$. With `onset` all sensors of `groups` get stuck at this step of every episode.

    A stuck reading arrives: its mask stays True. It is what the sensor showed a step before, noise
    and other errors of transforms before this one included; 0 where nothing has arrived yet.

    Args:
        probability: that a working sensor gets stuck at a step, in [0, 1]; this or `onset`.
        mean_length: mean time that a sensor is stuck, steps, at least 1; None: for good.

    Keyword Args:
        onset: in the place of `probability`: the step of every episode at which sensors get stuck,
            0 or more; at the reset, 0, they show one reading and keep to it.
        duration: in the place of `mean_length`: for how many steps, 1 or more; None: for good.
        state_keys: the steps that a fault has lasted, this one included, int64 `(*batch, groups)`,
            0 or less for a sensor that works, and what each shows, `(*batch, obs)`; by default
            `stuck_steps` and `stuck_observation` beside the first observation.
        **keys: `groups` as in `SensorOutages`; what is in none never gets stuck. `seed`, `in_keys`,
            `mask_keys`, `complete_key` as in `ObservationMissingness`.

    Example:
        >>> from tensordict import TensorDict
        >>> stuck = StuckSensors(onset=1, groups=[[0]])
        >>> first = stuck._reset(None, TensorDict({"observation": torch.tensor([1.0, 2.0])}))
        >>> stuck._step(first, TensorDict({"observation": torch.tensor([3.0, 4.0])}))["observation"]
        tensor([1., 4.])
    """

    stream: ClassVar[int] = 7
    state_names: ClassVar[tuple[str, ...]] = ("stuck_steps", "stuck_observation")

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor]:
        steps, faulty, last = self._faulty(step)
        shown = step.observation
        if last is None:
            # the state never holds what a mask hides
            last = zero_missing(shown, step.observed)
        else:
            shown = torch.where(faulty, last, shown)
            last = torch.where(step.observed, shown, last)
        self._carry(step, steps, last)
        return shown, step.observed


class SensorDrift(FaultyReadings):
    r"""Add a bias to readings that grows from step to step: a ramp, a random walk, or both.

    $\tilde x_t = x_t + b_t, \quad b_t = b_{t-1} + \text{rate} + \text{walk\_std}\, \epsilon_t,
    \quad \epsilon_t \sim N(0, 1)$

    for every entry of a sensor that drifts, and $b_t = 0$ for one that does not: after n steps of
    drift the bias has mean n rate and standard deviation sqrt(n) walk_std. By default every sensor
    drifts from the reset on, which counts as the first step; with `onset` from that step on; with
    `probability` drifts begin and end at random as the faults of `StuckSensors` do.

    A drifting reading arrives: its mask stays True. Under a mask the bias goes on growing.

    Args:
        walk_std: standard deviation of a step of the walk, observation units, finite and not
            negative; a number, or one per component, shape `(obs,)`.
        rate: growth of the ramp a step, observation units, of either sign, likewise.

    Keyword Args:
        probability: that a sensor begins to drift at a step, in [0, 1]; None, the default: `onset`.
        onset: the step of every episode at which sensors begin to drift; None, the default, is 0,
            the reset, where there is no `probability`.
        mean_length: with `probability`, and `duration` with `onset`, as in `StuckSensors`.
        **keys: `groups` as in `SensorOutages`, each component with a bias of its own, what is in
            none never drifts; `state_keys` of the steps of drift, as in `StuckSensors`, and of the
            bias, `(*batch, obs)`, by default `drift_steps` and `drift_bias`; `seed`, `in_keys`,
            `mask_keys`, `complete_key` as in `ObservationMissingness`.

    Example:
        >>> from tensordict import TensorDict
        >>> drift = SensorDrift(rate=0.5, groups=[[1]])
        >>> first = drift._reset(None, TensorDict({"observation": torch.zeros(2)}))
        >>> drift._step(first, TensorDict({"observation": torch.zeros(2)}))["observation"]
        tensor([0., 1.])
    """

    per_component: ClassVar[tuple[str, ...]] = ("walk_std", "rate")
    stream: ClassVar[int] = 8
    state_names: ClassVar[tuple[str, ...]] = ("drift_steps", "drift_bias")

    def __init__(
        self,
        walk_std: Numbers = 0.0,
        rate: Numbers = 0.0,
        *,
        probability: float | None = None,
        mean_length: float | None = None,
        onset: int | None = None,
        duration: int | None = None,
        **keys: Unpack[CarriedKeys],
    ) -> None:
        if probability is None and onset is None:
            onset = 0
        super().__init__(probability, mean_length, onset=onset, duration=duration, **keys)
        self.walk_std = read_numbers(walk_std, "walk_std", STD)
        meaning = f"{NUMBERS}, finite, in observation units"
        self.rate = read_numbers(rate, "rate", meaning, least=-math.inf)

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor]:
        x = step.observation
        steps, faulty, bias = self._faulty(step)
        growth = sample_noise(self.walk_std.to(x), x, self.generator(x.device)) + self.rate.to(x)
        grown = growth if bias is None else bias + growth
        bias = grown.masked_fill(~faulty, 0.0)
        self._carry(step, steps, bias)
        return x + bias, step.observed
