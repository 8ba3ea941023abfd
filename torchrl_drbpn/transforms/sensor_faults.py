"""Readings that arrive and are wrong for a while: sensors that are stuck, sensors that drift."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import zero_missing
from torchrl_drbpn.functional.missingness import sample_noise
from torchrl_drbpn.transforms._base import Keys, Role, Step
from torchrl_drbpn.transforms._carried import CarriedStateTransform, Lifecycle, read_lifecycle
from torchrl_drbpn.transforms.noise import STD, PerComponent


class _FaultyReadings(CarriedStateTransform):
    """A transform of readings that are wrong while their sensor has a fault; masks stay."""

    role: ClassVar[Role] = "noise"
    writes_mask: ClassVar[bool] = False

    def __init__(self, *, lifecycle: Lifecycle, **keys: Any) -> None:
        super().__init__(**keys)
        self.lifecycle = lifecycle

    def _layout(self, obs_dim: int) -> list[tuple[tuple[int, ...], torch.dtype | None]]:
        return [((self._count(obs_dim),), torch.int64), ((obs_dim,), None)]

    def _faulty(self, step: Step) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return how long faults have lasted, which entries are wrong, and the other state."""
        x, carried = step.observation, self._carried(step)
        before, other = (None, None) if carried is None else carried
        steps = self.lifecycle.advance(before, self._group_like(x), self.generator(x.device))
        return steps, self._spread(self.lifecycle.active(steps), x, False), other


class StuckSensors(_FaultyReadings):
    r"""Let sensors get stuck at their last value: it arrives again and again, as if it were new.

    With `probability` a sensor that works gets stuck at a step with this probability and a stuck
    one is released with probability 1 / `mean_length`: a two-state Markov chain, all sensors
    working at the reset, t steps later stuck with probability $\eta (1 - (1 - p - 1/L)^t)$, $\eta =
    p / (p + 1/L)$. With `onset` all sensors of `groups` get stuck at this step of every episode.

    A stuck reading arrives: its mask stays True, and a model that trusts every reading is misled.
    A sensor is stuck at what it showed the step before, noise and other errors of transforms before
    this one included; at 0 where nothing of it has arrived yet.

    How long each sensor has been stuck, and at what, travels in the tensordict under `state_keys`,
    so that partial resets and workers hold, and evaluations can look; no policy should read it. A
    simulator that resets itself inside its step carries faults over to the next episode.

    Args:
        probability: that a working sensor gets stuck at a step, in [0, 1].
        mean_length: mean time that a sensor is stuck, steps, at least 1; None: for good.

    Keyword Args:
        onset: in the place of `probability`: the step of every episode at which sensors get stuck,
            0 or more; at the reset, 0, they show one reading and keep to it.
        duration: in the place of `mean_length`: for how many steps, 1 or more; None: for good.
        groups: lists of indices of sensors that get stuck together (negative ones count from the
            end), each index in one list at most; entries in none never do. None, the default: every
            entry by itself. Several observation keys count as one vector.
        seed, in_keys, mask_keys, complete_key: as in `ObservationMissingness`.
        state_keys: where the state is kept: the steps that a fault has lasted, int64 `(*batch,
            groups)`, 0 or less for a sensor that works, and what each shows, `(*batch, obs)`; by
            default `stuck_steps` and `stuck_observation` beside the first observation.

    Raises:
        ValueError: if neither or both of `probability` and `onset` are given, one is out of range,
            or an index of a group is out of range or in two.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> stuck = StuckSensors(onset=1, groups=[[0]])
        >>> first = stuck._reset(None, TensorDict({"observation": torch.tensor([1.0, 2.0])}))
        >>> stuck._step(first, TensorDict({"observation": torch.tensor([3.0, 4.0])}))["observation"]
        tensor([1., 4.])

    See also: `torchrl_drbpn.functional.sample_fault_steps`.
    """

    stream: ClassVar[int] = 7
    state_names: ClassVar[tuple[str, ...]] = ("stuck_steps", "stuck_observation")

    def __init__(
        self,
        probability: float | None = None,
        mean_length: float | None = None,
        *,
        onset: int | None = None,
        duration: int | None = None,
        groups: Sequence[Sequence[int]] | None = None,
        seed: int | None = None,
        in_keys: Keys = ("observation",),
        mask_keys: Keys | None = None,
        complete_key: Keys | None = None,
        state_keys: Keys | None = None,
    ) -> None:
        super().__init__(
            lifecycle=read_lifecycle(probability, mean_length, onset, duration),
            groups=groups,
            state_keys=state_keys,
            seed=seed,
            in_keys=in_keys,
            mask_keys=mask_keys,
            complete_key=complete_key,
        )

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor | None]:
        steps, faulty, last = self._faulty(step)
        shown = step.observation
        if last is None:
            # the state never holds what a mask hides
            last = shown if step.observed is None else zero_missing(shown, step.observed)
        else:
            shown = torch.where(faulty, last, shown)
            last = shown if step.observed is None else torch.where(step.observed, shown, last)
        self._carry(step, steps, last.clone())
        return shown.clone(), None


class SensorDrift(_FaultyReadings):
    r"""Add a bias to readings that grows from step to step: a ramp, a random walk, or both.

    $\tilde x_t = x_t + b_t, \quad b_t = b_{t-1} + \text{rate} + \text{walk\_std}\, \epsilon_t,
    \quad \epsilon_t \sim N(0, 1)$

    for every entry of a sensor that drifts, and $b_t = 0$ for one that does not: at the reset it
    starts anew, and a sensor that recovers is calibrated again. After n steps of drift the bias has
    mean n rate and standard deviation sqrt(n) walk_std. By default every sensor drifts from the
    reset on, which counts as the first step; with `onset` from that step on; with `probability`
    drifts begin and end at random as the faults of `StuckSensors` do.

    A drifting reading arrives: its mask stays True. Entries that a mask hides stay 0 while the bias
    goes on growing. The state travels in the tensordict under `state_keys`, so that partial resets
    and workers hold, and evaluations can look; no policy should read it. A simulator that resets
    itself inside its step carries the bias over to the next episode.

    Args:
        walk_std: standard deviation of a step of the walk, observation units; a number, or one per
            component, shape `(obs,)`.
        rate: growth of the ramp a step, observation units, of either sign; a number, or one per
            component, shape `(obs,)`.

    Keyword Args:
        probability: that a sensor begins to drift at a step, in [0, 1]; None, the default: `onset`.
        mean_length: mean time that it drifts, steps, at least 1; None: to the end of the episode.
        onset: the step of every episode at which sensors begin to drift, 0 or more; None, the
            default, is 0, the reset, where there is no `probability`.
        duration: with `onset`: for how many steps, 1 or more; None: to the end of the episode.
        groups: lists of indices of sensors that begin and cease to drift together (negative ones
            count from the end), each with a bias of its own, each index in one list at most;
            entries in none never do. None, the default: every entry by itself. Several observation
            keys count as one vector.
        seed, in_keys, mask_keys, complete_key: as in `ObservationMissingness`.
        state_keys: where the state is kept: the steps that a sensor has drifted, int64 `(*batch,
            groups)`, 0 or less for one that does not, and the bias, `(*batch, obs)`; by default
            `drift_steps` and `drift_bias` beside the first observation.

    Raises:
        ValueError: if `walk_std` is negative or not finite, `rate` is not finite, their number is
            not that of the components, both `probability` and `onset` are given, one is out of
            range, or an index of a group is out of range or in two.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> drift = SensorDrift(rate=0.5, groups=[[1]])
        >>> first = drift._reset(None, TensorDict({"observation": torch.zeros(2)}))
        >>> drift._step(first, TensorDict({"observation": torch.zeros(2)}))["observation"]
        tensor([0., 1.])
    """

    stream: ClassVar[int] = 8
    state_names: ClassVar[tuple[str, ...]] = ("drift_steps", "drift_bias")

    def __init__(
        self,
        walk_std: float | Sequence[float] | Tensor = 0.0,
        rate: float | Sequence[float] | Tensor = 0.0,
        *,
        probability: float | None = None,
        mean_length: float | None = None,
        onset: int | None = None,
        duration: int | None = None,
        groups: Sequence[Sequence[int]] | None = None,
        seed: int | None = None,
        in_keys: Keys = ("observation",),
        mask_keys: Keys | None = None,
        complete_key: Keys | None = None,
        state_keys: Keys | None = None,
    ) -> None:
        if probability is None and onset is None:
            onset = 0
        super().__init__(
            lifecycle=read_lifecycle(probability, mean_length, onset, duration),
            groups=groups,
            state_keys=state_keys,
            seed=seed,
            in_keys=in_keys,
            mask_keys=mask_keys,
            complete_key=complete_key,
        )
        self._walk_std = PerComponent(walk_std, "walk_std", STD)
        self._rate = PerComponent(rate, "rate", "finite, observation units", least=-math.inf)

    def _check_obs_dim(self, obs_dim: int) -> None:
        super()._check_obs_dim(obs_dim)
        self._walk_std.check_obs_dim(obs_dim)
        self._rate.check_obs_dim(obs_dim)

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor | None]:
        x = step.observation
        steps, faulty, bias = self._faulty(step)
        growth = sample_noise(self._walk_std.like(x), x, self.generator(x.device))
        growth = growth + self._rate.like(x)
        grown = growth if bias is None else bias + growth
        bias = grown.masked_fill(~faulty, 0.0)
        self._carry(step, steps, bias)
        return x + bias, None
