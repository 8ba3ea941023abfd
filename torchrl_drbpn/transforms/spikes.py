"""Gross errors: readings that arrive but are wrong."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec

from torchrl_drbpn.functional.corruption import sample_spikes
from torchrl_drbpn.functional.gaussian import zero_missing
from torchrl_drbpn.transforms._common import Role, pair_keys, set_mask_spec
from torchrl_drbpn.transforms._corrupting import CorruptingTransform, SeededTransform


class ObservationSpikes(SeededTransform, CorruptingTransform):
    r"""Now and then add a large error to a reading, at every step and at every reset.

    $\tilde x_i = x_i + b_i e_i, \quad b_i \sim \mathrm{Bernoulli}(p_i), \quad
    e_i \sim N(0, \text{spike\_std}_i^2)$

    independently for every entry and step: with `ObservationNoise` before it the error is the
    contaminated normal $(1 - p) N(0, \sigma^2) + p N(0, \sigma^2 + \text{spike\_std}^2)$ of Tukey
    ("A survey of sampling from contaminated distributions", 1960). The error is added rather than
    put in place of the reading, so that one law serves sensors of any range. A spiked entry
    arrives: its mask stays True, and a model that trusts every reading is misled.

    Entries that a mask declares missing stay 0 and are not spiked. Spec bounds are lifted. Several
    observation keys count as one vector. The workers of a batched environment that are built by one
    function share a seed, until `seed_env` gives each its own. Two `ObservationSpikes` on different
    keys of one environment need different seeds.

    Args:
        probability: that an entry is hit at a step, in [0, 1]; a number for all components, or one
            per component, shape `(obs,)`.
        spike_std: standard deviation of the error in observation units; a number, or one per
            component, shape `(obs,)`.

    Keyword Args:
        seed: seed of the spikes, not negative.
        in_keys: observation keys, each of shape `(*batch, obs)`.
        mask_keys: one mask per observation, read where it exists; by default `observed` beside it.
        complete_key: key (or one key per observation) under which the observation is recorded
            before the spikes; None, the default, records nothing.
        spiked_key: key (or one key per observation) under which the entries that were hit are
            recorded, bool `(*batch, obs)`; None, the default, records nothing. For evaluation: no
            policy should read it.

    Raises:
        ValueError: if a probability lies outside [0, 1], a standard deviation is negative or not
            finite, or their number is not that of the components.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> spikes = ObservationSpikes(0.05, 10.0, spiked_key="spiked")
        >>> data = spikes._call(TensorDict({"observation": torch.zeros(1000, 3)}, [1000]))
        >>> bool(((data["observation"] != 0) == data["spiked"]).all())
        True
        >>> bool((data["spiked"].float().mean() - 0.05).abs() < 0.02)
        True

    See also: `torchrl_drbpn.functional.sample_spikes`.
    """

    role: ClassVar[Role] = "noise"
    writes_mask: ClassVar[bool] = False
    stream: ClassVar[int] = 4

    def __init__(
        self,
        probability: float | Sequence[float] | Tensor,
        spike_std: float | Sequence[float] | Tensor,
        *,
        seed: int = 0,
        in_keys: NestedKey | Sequence[NestedKey] = ("observation",),
        mask_keys: NestedKey | Sequence[NestedKey] | None = None,
        complete_key: NestedKey | Sequence[NestedKey] | None = None,
        spiked_key: NestedKey | Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__(seed=seed, in_keys=in_keys, mask_keys=mask_keys, complete_key=complete_key)
        self.spiked_keys: list[NestedKey] = (
            []
            if spiked_key is None
            else pair_keys(self.in_keys, spiked_key, name="spiked_key", default="")
        )
        taken = [*self.in_keys, *self.mask_keys, *self.complete_keys]
        if not set(self.spiked_keys).isdisjoint(taken):
            raise ValueError(
                f"`spiked_key` must name keys of its own, got {self.spiked_keys} beside {taken}."
            )
        self.out_keys = [*self.in_keys, *self.complete_keys, *self.spiked_keys]
        self.probability = _per_component(
            probability, 1.0, "`probability` must be a number or one per component, in [0, 1]"
        )
        self.spike_std = _per_component(
            spike_std,
            math.inf,
            "`spike_std` must be a number or one number per component, finite and not negative, "
            "in observation units",
        )
        self._cast = self.probability, self.spike_std

    def _check_obs_dim(self, obs_dim: int) -> None:
        for name, value in (("probability", self.probability), ("spike_std", self.spike_std)):
            if isinstance(value, Tensor) and value.shape[0] != obs_dim:
                raise ValueError(
                    f"`{name}` must have one entry per component, {obs_dim}, for in_keys "
                    f"{self.in_keys}, got {value.shape[0]}."
                )

    def _corrupt(
        self,
        observation: Tensor,
        observed: Tensor | None,
        root: TensorDictBase | None,
        following: TensorDictBase,
    ) -> tuple[Tensor, Tensor | None]:
        del root
        self._check_obs_dim(observation.shape[-1])
        if any(
            isinstance(part, Tensor)
            and (part.dtype is not observation.dtype or part.device != observation.device)
            for part in self._cast
        ):
            self._cast = _like(self.probability, observation), _like(self.spike_std, observation)
        generator = self.generator(observation.device)
        error, hit = sample_spikes(*self._cast, observation, generator)
        spiked = error.add_(observation)
        if observed is not None:
            spiked, hit = zero_missing(spiked, observed), hit & observed
        if self.spiked_keys:
            sizes = [following.get(key).shape[-1] for key in self.in_keys]
            for key, part in zip(self.spiked_keys, torch.split(hit, sizes, -1), strict=True):
                following.set(key, part)
        return spiked, observed

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Widen the observation and enter, on request, what was complete and what was hit.

        Args:
            observation_spec: the spec before the transform.

        Returns:
            The spec after it.

        Raises:
            KeyError: if an observation key is absent.
            ValueError: if an observation is no vector, or a key is taken by something else.
        """
        spec = super().transform_observation_spec(observation_spec)
        for key, spiked in zip(self.in_keys, self.spiked_keys, strict=bool(self.spiked_keys)):
            if spiked in spec.keys(True, True):
                raise ValueError(
                    f"`{spiked}` is among the observations of the environment already, so "
                    f"`{type(self).__name__}` can't write it. Pass another spiked_key."
                )
            set_mask_spec(spec, spiked, spec[key], self)
        return spec


def _per_component(value: object, most: float, expected: str) -> float | Tensor:
    """Read a number, or one number per component, from 0 to `most`; infinity is never meant."""
    try:
        read = torch.as_tensor(value, dtype=torch.float64)
    except (TypeError, ValueError):
        read = torch.tensor(math.nan)
    if read.ndim > 1 or not bool(((read >= 0) & (read <= most) & (read < math.inf)).all()):
        raise ValueError(f"{expected}, got {value!r}.")
    return float(read) if read.ndim == 0 else read


def _like(value: float | Tensor, observation: Tensor) -> float | Tensor:
    return value.to(observation) if isinstance(value, Tensor) else value
