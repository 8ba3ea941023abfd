"""Readings that come late, in another order than they were taken, or only now and then."""

from collections.abc import Sequence
from typing import ClassVar, Literal, TypeAlias, Unpack

import torch
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import StepCounter

from torchrl_drbpn.functional.missingness import sample_delay
from torchrl_drbpn.transforms._base import Step, chain_of, check_count
from torchrl_drbpn.transforms._carried import CarriedKeys, CarriedStateTransform, read_steps

Steps: TypeAlias = int | Sequence[int] | Tensor


class ObservationDelay(CarriedStateTransform):
    r"""Let every reading arrive some steps after it was taken.

    A reading of step t arrives at step $t + d$, d = `delay`, or drawn for every reading uniformly
    from `delay` to `max_delay`. A step at which nothing new arrives, as the first d of an episode,
    is masked; of several that arrive at once the newest counts. With random delays a reading may
    arrive after one that was taken later: it is shown, as a network that does not sort would do, or
    dropped with `in_order=True`. A reading that a mask hides was never sent: the mask so far is
    delayed with its readings. A simulator that resets itself inside its step lets the last readings
    of an episode arrive in the next one.

    Args:
        delay: steps, 0 or more; a number for all, or one for each group (each component, where
            there are no groups).

    Keyword Args:
        max_delay: the most that a delay is drawn to, in the form of `delay`; None, the default:
            `delay` is fixed.
        in_order: drop readings that arrive after one that was taken later.
        **keys: `groups` as in `SensorOutages`, which travel in one packet, what is in none arrives
            at once; `state_keys` of the values on their way and of their mask, each `(*batch,
            max_delay, obs)`, by default `delayed_observation` and `delayed_observed` beside the
            first observation; `seed`, `in_keys`, `mask_keys`, `complete_key` as in
            `ObservationMissingness`.

    Raises:
        ValueError: for numbers out of range, and where a `StepCounter` of the environment ends
            episodes before the first reading of a sensor can arrive; other limits are not seen.

    Example:
        >>> from tensordict import TensorDict
        >>> late = ObservationDelay(1)
        >>> first = late._reset(None, TensorDict({"observation": torch.tensor([1.0, 2.0])}))
        >>> second = late._step(first, TensorDict({"observation": torch.tensor([3.0, 4.0])}))
        >>> first["observed"].any().item(), second["observation"].tolist()
        (False, [1.0, 2.0])
    """

    stream: ClassVar[int] = 5
    state_names: ClassVar[tuple[str, ...]] = ("delayed_observation", "delayed_observed")
    per_group: ClassVar[tuple[str, ...]] = ("delay", "max_delay")

    def __init__(
        self,
        delay: Steps,
        *,
        max_delay: Steps | None = None,
        in_order: bool = False,
        **keys: Unpack[CarriedKeys],
    ) -> None:
        super().__init__(**keys)
        self.delay = read_steps(delay, "delay", 0)
        self.max_delay = self.delay if max_delay is None else read_steps(max_delay, "max_delay", 0)
        if self.delay.ndim:
            check_count(self.max_delay, "max_delay", len(self.delay), "entry of `delay`")
        if bool((self.max_delay < self.delay).any()):
            raise ValueError(
                f"`max_delay` must not be under `delay`, got {max_delay!r} and {delay!r}."
            )
        self.in_order = in_order
        self._random = bool((self.max_delay > self.delay).any())
        # one place at least: a dimension of none is nothing that shared memory can hold
        self._places = max(1, int(self.max_delay.max()))

    def _layout(self, obs_dim: int) -> list[tuple[tuple[int, ...], torch.dtype | None]]:
        return [((self._places, obs_dim), None), ((self._places, obs_dim), torch.bool)]

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor]:
        x, carried = step.observation, self._carried(step)
        least, most = self.delay.to(x.device), self.max_delay.to(x.device)
        delay = least
        if self._random:
            delay = sample_delay(least, most, self._group_like(x), self.generator(x.device))
        delay = self._spread(delay, x, 0).unsqueeze(-2)
        # place j holds the newest reading that arrives in j steps
        if carried is None:
            waiting = x.new_zeros(*x.shape[:-1], self._places + 1, x.shape[-1])
            due = torch.zeros_like(waiting, dtype=torch.bool)
        else:
            waiting, due = (torch.cat([s, torch.zeros_like(s[..., :1, :])], -2) for s in carried)
        place = torch.arange(self._places + 1, device=x.device).unsqueeze(-1)
        sent = step.observed.unsqueeze(-2)
        sent_there = (place == delay) & sent
        waiting = torch.where(sent_there, x.unsqueeze(-2), waiting)
        due = due | sent_there
        if self.in_order:
            due = due & ~((place > delay) & sent)
        self._carry(step, waiting[..., 1:, :].contiguous(), due[..., 1:, :].contiguous())
        return waiting[..., 0, :], due[..., 0, :].clone()

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Enter the observation, its mask, the states and, on request, what was complete."""
        spec = super().transform_observation_spec(observation_spec)
        longest = int(self.delay.max())
        for part in chain_of(self):
            steps = part.max_steps if isinstance(part, StepCounter) else None
            if steps is not None and longest >= steps:
                raise ValueError(
                    f"`delay` must be shorter than an episode, got {longest} steps and "
                    f"StepCounter(max_steps={steps}): nothing would arrive before its end."
                )
        return spec


class ObservationMultiRate(CarriedStateTransform):
    r"""Let every sensor deliver at a rate of its own, as cameras, encoders and force sensors do.

    A reading arrives at the steps $t = \text{phase}, \text{phase} + \text{period}, \dots$ of an
    episode, t = 0 at the reset; between them the sensor is masked. Period 1 is every step.

    Args:
        period: steps from one reading to the next, 1 or more; a number for all, or one for each
            group (each component, where there are no groups).

    Keyword Args:
        phase: step of the first reading, under the period, in the form of `period`; or "random", a
            phase drawn for every group and episode.
        **keys: `groups` as in `SensorOutages`, what is in none arrives at every step; `state_keys`
            of the steps until the next reading, int64 `(*batch, groups)`, 0 where one arrives, by
            default `steps_to_reading` beside the first observation; `seed`, `in_keys`, `mask_keys`,
            `complete_key` as in `ObservationMissingness`.

    Example:
        >>> from tensordict import TensorDict
        >>> rates = ObservationMultiRate([1, 2], phase=[0, 1])
        >>> data = rates._reset(None, TensorDict({"observation": torch.ones(2)}))
        >>> data["observed"].tolist()
        [True, False]
        >>> rates._step(data, TensorDict({"observation": torch.ones(2)}))["observed"].tolist()
        [True, True]
    """

    stream: ClassVar[int] = 6
    state_names: ClassVar[tuple[str, ...]] = ("steps_to_reading",)
    per_group: ClassVar[tuple[str, ...]] = ("period", "phase")

    def __init__(
        self,
        period: Steps,
        *,
        phase: Steps | Literal["random"] = 0,
        **keys: Unpack[CarriedKeys],
    ) -> None:
        super().__init__(**keys)
        self.period = read_steps(period, "period", 1)
        random = isinstance(phase, str) and phase == "random"
        self.phase = None if random else read_steps(phase, "phase", 0)
        if self.phase is not None:
            if self.period.ndim:
                check_count(self.phase, "phase", len(self.period), "entry of `period`")
            if bool((self.phase >= self.period).any()):
                raise ValueError(
                    f"`phase` must be under the period, got {phase!r} and period {period!r}."
                )

    def _layout(self, obs_dim: int) -> list[tuple[tuple[int, ...], torch.dtype | None]]:
        return [((self._count(obs_dim),), torch.int64)]

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor]:
        x, carried = step.observation, self._carried(step)
        like, last = self._group_like(x), self.period.to(x.device) - 1
        if carried is not None:
            left = torch.where(carried[0] == 0, last, carried[0] - 1)
        elif self.phase is not None:
            left = self.phase.to(x.device).expand(like.shape).clone()
        else:
            left = sample_delay(torch.zeros_like(last), last, like, self.generator(x.device))
        self._carry(step, left)
        return x, (self._spread(left, x, 0) == 0) & step.observed
