"""Sensors that fail for a while: outages that last, one sensor or one group at a time."""

from typing import ClassVar, Literal, Unpack

import torch
from torch import Tensor

from torchrl_drbpn.functional.missingness import outage_rates, sample_working
from torchrl_drbpn.transforms._base import Step
from torchrl_drbpn.transforms._carried import CarriedKeys, CarriedStateTransform


class SensorOutages(CarriedStateTransform):
    r"""Let sensors fail and come back, each a two-state Markov chain over the steps of an episode.

    With mean outage length L and long-run missing ratio $\eta$,

    $P(\text{off} \to \text{on}) = 1/L, \qquad
    P(\text{on} \to \text{off}) = \frac{\eta}{1 - \eta} \frac{1}{L}$

    the Gilbert-Elliott model of packets that are dropped in bursts, in Gilbert's form: all are lost
    in the bad state, none in the good one (Bell System Technical Journal 1960 and 1963).
    $L = 1/(1 - \eta)$ is MCAR at $\eta$; a shorter L makes sensors alternate.

    With `initial="stationary"` every entry of every step, the first included, is missing with
    probability exactly $\eta$. With `initial="on"` every sensor works at a reset and t steps later
    is off with probability $\eta (1 - (1 - a - b)^t)$, a and b being the two probabilities above.
    Ratios of single episodes scatter more than under MCAR: report the realised one.

    Which sensors work travels in the tensordict under `state_keys`, as the counts of TorchRL's
    `StepCounter` do. A simulator that resets itself inside its step carries outages over to the
    next episode, whatever `initial` says.

    Args:
        eta: long-run missing ratio of the sensors that can fail, in [0, 1).
        mean_length: mean length of an outage in steps, at least 1 and at least eta / (1 - eta).

    Keyword Args:
        initial: "stationary" or "on"; the sensors at the start of an episode.
        groups: lists of indices of sensors that go together (negative ones count from the end),
            each index in one list at most; entries in none always arrive. None, the default: every
            entry by itself.
        state_keys: bool `(*batch, groups)`, True for a group that works; by default `sensor_on`
            beside the first observation.
        **keys: `seed`, `in_keys`, `mask_keys`, `complete_key` as in `ObservationMissingness`.

    Example:
        >>> from tensordict import TensorDict
        >>> outages = SensorOutages(0.5, mean_length=20, groups=[[0, 1], [2]])
        >>> data = outages._call(TensorDict({"observation": torch.ones(1000, 4)}, [1000]))
        >>> observed = data["observed"]
        >>> bool((observed[:, 0] == observed[:, 1]).all()), bool(observed[:, 3].all())
        (True, True)
    """

    stream: ClassVar[int] = 3
    state_names: ClassVar[tuple[str, ...]] = ("sensor_on",)

    def __init__(
        self,
        eta: float,
        mean_length: float,
        *,
        initial: Literal["stationary", "on"] = "stationary",
        **keys: Unpack[CarriedKeys],
    ) -> None:
        super().__init__(**keys)
        self.rates = outage_rates(eta, mean_length)
        self.eta, self.mean_length = float(eta), float(mean_length)
        if initial not in ("stationary", "on"):
            raise ValueError(f"`initial` must be one of 'stationary' and 'on', got {initial!r}.")
        self.initial = initial

    def _layout(self, obs_dim: int) -> list[tuple[tuple[int, ...], torch.dtype | None]]:
        return [((self._count(obs_dim),), torch.bool)]

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor]:
        x = step.observation
        like, before = self._group_like(x), self._carried(step)
        if before is None and self.initial == "on":
            working = torch.ones_like(like, dtype=torch.bool)
        else:
            previous = None if before is None else before[0]
            working = sample_working(previous, self.rates, like, self.generator(x.device))
        self._carry(step, working)
        return x, self._spread(working, x, True) & step.observed
