"""Sensors that fail for a while: outages that last, one sensor or one group at a time."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import ClassVar, Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec

from torchrl_drbpn.functional.missingness import outage_rates, sample_working
from torchrl_drbpn.transforms._base import (
    Keys,
    Role,
    Step,
    as_key_list,
    enter_new,
    observation_leaf,
    sibling_key,
)
from torchrl_drbpn.transforms.seeding import SeededTransform

_INITIAL = ("stationary", "on")


class SensorOutages(SeededTransform):
    r"""Let sensors fail and come back, each a two-state Markov chain over the steps of an episode.

    With mean outage length L and long-run missing ratio $\eta$,

    $P(\text{off} \to \text{on}) = 1/L, \qquad
    P(\text{on} \to \text{off}) = \frac{\eta}{1 - \eta} \frac{1}{L}$

    (a Gilbert channel, Bell System Technical Journal 1960). $L = 1/(1 - \eta)$ is MCAR at $\eta$; a
    shorter L makes sensors alternate, L = 1 at $\eta = .5$ strictly.

    The realised ratio: with `initial="stationary"` every entry of every step, the first included,
    is missing with probability exactly $\eta$. With `initial="on"` every sensor works at a reset
    and t steps later is off with probability $\eta (1 - (1 - a - b)^t)$, a and b being the two
    probabilities above. Steps are not independent, so that ratios of single episodes scatter more
    than under MCAR: report the realised one.

    Which sensors work travels in the tensordict under `state_key`, as the counts of TorchRL's
    `StepCounter` do, so that partial resets and workers hold and a stored step says what the next
    starts from. A simulator that resets itself inside its step carries outages over to the next
    episode, whatever `initial` says. Missing entries become 0 and False in the mask, which is ANDed
    into one that is there already.

    Args:
        eta: long-run missing ratio of the sensors that can fail, in [0, 1).
        mean_length: mean length of an outage in steps, at least 1 and at least eta / (1 - eta).

    Keyword Args:
        groups: lists of indices that fail together (negative ones count from the end), each index
            in one list at most; entries in none always arrive. None, the default: every entry by
            itself. Several observation keys count as one vector.
        initial: "stationary" or "on"; the sensors at the start of an episode.
        seed: None, to draw from torch's global generator, or the seed of a generator of its own,
            which gives the same outages to every worker and every transform built with it.
        in_keys: observation keys, each of shape `(*batch, obs)`.
        mask_keys: one mask per observation, bool `(*batch, obs)`; by default `observed` beside it.
        complete_key: key (or one key per observation) under which the observation is recorded
            before this transform; None, the default, records nothing.
        state_key: where the state is kept, bool `(*batch, groups)`, True for a group that works; by
            default `sensor_on` beside the first observation. Two `SensorOutages` in one environment
            need two.

    Raises:
        ValueError: if an argument is out of range, `mean_length` is under eta / (1 - eta), or an
            index is out of range or in two groups.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> outages = SensorOutages(0.5, mean_length=20, groups=[[0, 1], [2]])
        >>> data = outages._call(TensorDict({"observation": torch.ones(1000, 4)}, [1000]))
        >>> observed = data["observed"]
        >>> bool((observed[:, 0] == observed[:, 1]).all()), bool(observed[:, 3].all())
        (True, True)

    See also: `torchrl_drbpn.functional.outage_rates`, `sample_working`.
    """

    role: ClassVar[Role] = "missingness"
    stream: ClassVar[int] = 3

    def __init__(
        self,
        eta: float,
        mean_length: float,
        *,
        groups: Sequence[Sequence[int]] | None = None,
        initial: Literal["stationary", "on"] = "stationary",
        seed: int | None = None,
        in_keys: Keys = ("observation",),
        mask_keys: Keys | None = None,
        complete_key: Keys | None = None,
        state_key: NestedKey | None = None,
    ) -> None:
        super().__init__(seed=seed, in_keys=in_keys, mask_keys=mask_keys, complete_key=complete_key)
        self.rates = outage_rates(eta, mean_length)
        self.eta, self.mean_length = float(eta), float(mean_length)
        if initial not in _INITIAL:
            raise ValueError(f"`initial` must be one of {_INITIAL}, got {initial!r}.")
        self.initial = initial
        self.groups = None if groups is None else _read_groups(groups)
        default = sibling_key(self.in_keys[0], "sensor_on")
        (self.state_key,) = as_key_list(default if state_key is None else state_key)
        if self.state_key in self.out_keys:
            raise ValueError(
                f"`state_key` must be a key of its own, got {self.state_key!r}, which this "
                "transform writes something else to."
            )
        self.out_keys = [*self.out_keys, self.state_key]
        self._columns: Tensor | None = None

    # ------------------------------------------------------------------------------- on tensors
    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor | None]:
        # there are never more groups than entries; only shape and device of `like` are read
        x = step.observation
        like = x if self.groups is None else x[..., : len(self.groups)]
        if step.before is None and self.initial == "on":
            working = torch.ones_like(like, dtype=torch.bool)
        else:
            before = None if step.before is None else self._state(step.before, like)
            working = sample_working(before, self.rates, like, self.generator(x.device))
        step.data.set(self.state_key, working)
        if self.groups is None:
            # the mask may be changed by who gets it, the state is for the next step
            return x, working.clone()
        always = torch.ones_like(working[..., :1])
        return x, torch.cat([working, always], -1).index_select(-1, self._columns_for(x))

    def _state(self, before: TensorDictBase, like: Tensor) -> Tensor:
        state: Tensor | None = before.get(self.state_key, None)
        if state is None:
            raise KeyError(
                f"`{type(self).__name__}` reads which sensors worked at the step before under "
                f"{self.state_key!r}, which is not there. Start from `env.reset()` and keep the "
                "key from step to step, as `env.step_mdp` and TorchRL's collectors do."
            )
        if state.dtype is not torch.bool or state.shape != like.shape:
            raise ValueError(
                f"`{self.state_key}` must be bool of shape {tuple(like.shape)}, one entry a group "
                f"of sensors, got {state.dtype} {tuple(state.shape)}. Is it the state of another "
                "transform? Pass state_key=... ."
            )
        return state

    def _columns_for(self, observation: Tensor) -> Tensor:
        """Return the group of every entry; the number of groups where it is in none."""
        columns, obs_dim = self._columns, observation.shape[-1]
        if columns is None or columns.shape[0] != obs_dim or columns.device != observation.device:
            self._check_obs_dim(obs_dim)
            groups = self.groups or []
            columns = torch.full((obs_dim,), len(groups))
            for index, group in enumerate(groups):
                columns[group] = index
            columns = self._columns = columns.to(observation.device)
        return columns

    def _check_obs_dim(self, obs_dim: int) -> None:
        indices = [index for group in self.groups or [] for index in group]
        if any(not -obs_dim <= index < obs_dim for index in indices):
            raise ValueError(
                f"`groups` must hold indices from {-obs_dim} to {obs_dim - 1} for in_keys "
                f"{self.in_keys} with {obs_dim} components, got {self.groups}."
            )
        if len({index % obs_dim for index in indices}) != len(indices):
            raise ValueError(
                f"`groups` must name every component once at most, got {self.groups} for {obs_dim} "
                "components. Use two SensorOutages where a sensor can fail in two ways."
            )

    # ------------------------------------------------------------------------------------- specs
    def _state_spec(self, spec: Composite) -> TensorSpec:
        leaves = [observation_leaf(spec, key, self) for key in self.in_keys]
        sensors = sum(leaf.shape[-1] for leaf in leaves)
        count = sensors if self.groups is None else len(self.groups)
        shape = (*leaves[0].shape[:-1], count)
        return Binary(shape=shape, device=leaves[0].device, dtype=torch.bool)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Enter the observation, its mask, the state and, on request, what was complete."""
        spec = super().transform_observation_spec(observation_spec)
        enter_new(spec, self.state_key, self._state_spec(spec), self)
        return spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Enter which sensors work as a state that a step reads."""
        state_spec[self.state_key] = self._state_spec(self.parent.full_observation_spec)
        return state_spec


def _read_groups(groups: Sequence[Sequence[int]]) -> list[list[int]]:
    lists = [[] if isinstance(group, str | Integral) else list(group) for group in groups]
    whole = all(isinstance(i, Integral) and not isinstance(i, bool) for g in lists for i in g)
    if not lists or not all(lists) or not whole:
        raise ValueError(
            f"`groups` must be lists of indices, none empty, such as [[0, 1], [2]], got {groups!r}."
        )
    return [[int(index) for index in group] for group in lists]
