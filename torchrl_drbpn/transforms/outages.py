"""Sensors that fail for a while: outages that last, one sensor or one group at a time."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Integral
from typing import ClassVar, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Binary, Composite, TensorSpec

from torchrl_drbpn.functional.corruption import outage_rates, sample_working
from torchrl_drbpn.functional.gaussian import zero_missing
from torchrl_drbpn.transforms._common import Role, as_key_list, observation_leaf, sibling_key
from torchrl_drbpn.transforms._corrupting import CorruptingTransform, SeededTransform

_INITIAL = ("stationary", "on")


class SensorOutages(SeededTransform, CorruptingTransform):
    r"""Let sensors fail and come back, each a two-state Markov chain over the steps of an episode.

    With mean outage length L and long-run missing ratio $\eta$,

    $P(\text{off} \to \text{on}) = 1/L, \qquad
    P(\text{on} \to \text{off}) = \frac{\eta}{1 - \eta} \frac{1}{L},$

    so that an outage lasts a geometric number of steps with mean L and $\eta$ is the stationary
    probability of being off (a Gilbert channel, Bell System Technical Journal 1960). $L = 1/(1 -
    \eta)$ is MCAR at $\eta$; a shorter L makes sensors alternate, L = 1 at $\eta = .5$ strictly.

    The realised ratio: with `initial="stationary"` every entry of every step, the first included,
    is missing with probability exactly $\eta$. With `initial="on"` every sensor works at a reset
    and t steps later is off with probability $\eta (1 - (1 - a - b)^t)$, a and b being the two
    probabilities above: less than $\eta$, the more so the shorter the episodes. Steps are not
    independent, so that ratios of single episodes scatter more than under MCAR: report the realised
    one.

    Which sensors work travels in the tensordict under `state_key`, as the counts of TorchRL's
    `StepCounter` do, so that partial resets and workers hold and a stored step says what the next
    starts from. A simulator that resets itself inside its step carries outages over to the next
    episode, whatever `initial` says. Missing entries become 0 and False in the mask, which is ANDed
    into one that is there already. One draw a step serves all sensors of all environments. The
    workers of a batched environment that are built by one function share a seed, until `seed_env`
    gives each its own.

    Args:
        eta: long-run missing ratio of the sensors that can fail, in [0, 1).
        mean_length: mean length of an outage in steps, at least 1 and at least eta / (1 - eta).

    Keyword Args:
        groups: lists of indices that fail together (negative ones count from the end), each index
            in one list at most; entries in none always arrive. None, the default: every entry by
            itself. Several observation keys count as one vector.
        initial: "stationary" or "on"; the sensors at the start of an episode.
        seed: seed of the outages, not negative.
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
        >>> bool((observed[:, :3].float().mean() - 0.5).abs() < 0.05)
        True

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
        seed: int = 0,
        in_keys: NestedKey | Sequence[NestedKey] = ("observation",),
        mask_keys: NestedKey | Sequence[NestedKey] | None = None,
        complete_key: NestedKey | Sequence[NestedKey] | None = None,
        state_key: NestedKey | None = None,
    ) -> None:
        super().__init__(seed=seed, in_keys=in_keys, mask_keys=mask_keys, complete_key=complete_key)
        self.rates = outage_rates(eta, mean_length)
        self.eta, self.mean_length = float(eta), float(mean_length)
        if initial not in _INITIAL:
            raise ValueError(f"`initial` must be one of {_INITIAL}, got {initial!r}.")
        self.initial = initial
        self.groups = None if groups is None else _read_groups(groups)
        if state_key is None:
            state_key = sibling_key(self.in_keys[0], "sensor_on")
        (self.state_key,) = as_key_list(state_key)
        written = [*self.in_keys, *self.mask_keys, *self.complete_keys]
        if self.state_key in written:
            raise ValueError(
                f"`state_key` must be a key of its own, got {self.state_key!r}, which this "
                "transform writes something else to."
            )
        self.out_keys = [*written, self.state_key]
        self._columns: tuple[Tensor, Tensor] | None = None

    # ------------------------------------------------------------------------------- on tensors
    def _corrupt(
        self,
        observation: Tensor,
        observed: Tensor | None,
        root: TensorDictBase | None,
        following: TensorDictBase,
    ) -> tuple[Tensor, Tensor | None]:
        # there are never more groups than entries; only shape and device of `like` are read
        like = observation if self.groups is None else observation[..., : len(self.groups)]
        if root is None and self.initial == "on":
            working = torch.ones_like(like, dtype=torch.bool)
        else:
            before = None if root is None else self._before(root, like)
            generator = self.generator(observation.device)
            working = sample_working(before, self.rates, like, generator)
        following.set(self.state_key, working)
        arrived = self._spread(working, observation)
        if observed is not None:
            arrived = arrived & observed
        return zero_missing(observation, arrived), arrived

    def _before(self, root: TensorDictBase, like: Tensor) -> Tensor:
        before = root.get(self.state_key, None)
        if before is None:
            raise KeyError(
                f"`{type(self).__name__}` reads which sensors worked at the step before under "
                f"{self.state_key!r}, which is not there. Start from `env.reset()` and keep the "
                "key from step to step, as `env.step_mdp` and TorchRL's collectors do."
            )
        if before.dtype is not torch.bool or before.shape != like.shape:
            raise ValueError(
                f"`{self.state_key}` must be bool of shape {tuple(like.shape)}, one entry a group "
                f"of sensors, got {before.dtype} {tuple(before.shape)}. Is it the state of another "
                "transform? Pass state_key=... ."
            )
        state: Tensor = before
        return state

    def _spread(self, working: Tensor, observation: Tensor) -> Tensor:
        """Turn the state of the groups into a mask of its own over the entries."""
        if self.groups is None:
            # the mask may be changed by who gets it, the state is for the next step
            return working.clone()
        columns = self._columns
        if (
            columns is None
            or columns[0].shape[0] != observation.shape[-1]
            or columns[0].device != observation.device
        ):
            self._check_obs_dim(observation.shape[-1])
            column = torch.zeros(observation.shape[-1], dtype=torch.int64)
            never = torch.ones(observation.shape[-1], dtype=torch.bool)
            for index, group in enumerate(self.groups):
                column[group], never[group] = index, False
            columns = column.to(observation.device), never.to(observation.device)
            self._columns = columns
        return working.index_select(-1, columns[0]) | columns[1]

    def _check_obs_dim(self, obs_dim: int) -> None:
        if self.groups is None:
            return
        indices = [index for group in self.groups for index in group]
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
        sizes = sum(leaf.shape[-1] for leaf in leaves)
        count = sizes if self.groups is None else len(self.groups)
        leaf = leaves[0]
        return Binary(shape=(*leaf.shape[:-1], count), device=leaf.device, dtype=torch.bool)

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Widen the observation and enter its mask, the state and, on request, what was complete.

        Args:
            observation_spec: the spec before the transform.

        Returns:
            The spec after it.

        Raises:
            KeyError: if an observation key is absent.
            ValueError: if an observation is no vector, or a key is taken by something else.
        """
        spec = super().transform_observation_spec(observation_spec)
        if self.state_key in spec.keys(True, True):
            raise ValueError(
                f"`{self.state_key}` is among the observations of the environment already, so "
                f"`{type(self).__name__}` can't keep its state there. Pass state_key=... ."
            )
        spec[self.state_key] = self._state_spec(spec)
        return spec

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Enter which sensors work as a state that a step reads.

        Args:
            state_spec: the spec before the transform.

        Returns:
            The spec after it.
        """
        state_spec[self.state_key] = self._state_spec(self.parent.full_observation_spec)
        return state_spec


def _read_groups(groups: Sequence[Sequence[int]]) -> list[list[int]]:
    read: list[list[int]] = []
    for group in groups:
        items = [] if isinstance(group, str | Integral) else list(group)
        whole = all(isinstance(i, Integral) and not isinstance(i, bool) for i in items)
        if not items or not whole:
            raise ValueError(
                "`groups` must be lists of indices, none empty, such as [[0, 1], [2]], got "
                f"{groups!r}."
            )
        read.append([int(index) for index in items])
    if not read:
        raise ValueError("`groups` must hold at least one list of indices, got none.")
    return read
