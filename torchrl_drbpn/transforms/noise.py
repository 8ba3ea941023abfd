"""What is wrong with readings that arrive: Gaussian noise, and gross errors now and then."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Composite

from torchrl_drbpn.functional.missingness import sample_noise, sample_spikes
from torchrl_drbpn.transforms._base import Keys, Role, Step, enter_new, mask_like, pair_keys
from torchrl_drbpn.transforms.seeding import SeededTransform

STD = "finite and not negative, in observation units"


class PerComponent:
    """A number, or one a component, from `least` to `most`, finite, in the dtype of the data."""

    def __init__(
        self, value: object, name: str, meaning: str, most: float = math.inf, least: float = 0.0
    ) -> None:
        try:
            read = torch.as_tensor(value, dtype=torch.float64).cpu()
        except (TypeError, ValueError, RuntimeError):
            read = torch.tensor(math.nan)
        inside = (read >= least) & (read <= most) & read.isfinite()
        if read.ndim > 1 or not bool(inside.all()):
            raise ValueError(
                f"`{name}` must be a number or one number per component, {meaning}, got {value!r}."
            )
        self.name = name
        self.value: float | Tensor = float(read) if read.ndim == 0 else read

    def check_obs_dim(self, obs_dim: int) -> None:
        """Refuse numbers that are neither one nor as many as there are components."""
        if isinstance(self.value, Tensor) and self.value.shape[0] != obs_dim:
            raise ValueError(
                f"`{self.name}` must have one entry per component, {obs_dim}, got "
                f"{self.value.shape[0]}."
            )

    def like(self, observation: Tensor) -> float | Tensor:
        """Return the numbers on the device and in the dtype of `observation`."""
        return self.value.to(observation) if isinstance(self.value, Tensor) else self.value


class ObservationNoise(SeededTransform):
    r"""Add independent Gaussian noise to every component, at every step and at every reset.

    $\tilde x = x + \epsilon, \quad \epsilon \sim N(0, \mathrm{diag}(\text{noise\_std}^2))$, the
    first half of Eq. (2) [DRBPN], where noise_std = 0.01 sigma.

    Entries that a mask declares missing stay 0. Spec bounds are lifted, since noise leaves them.
    Several observation keys count as one vector.

    Args:
        noise_std: standard deviation in observation units; a number for all components, or one per
            component, shape `(obs,)`.

    Keyword Args:
        seed, in_keys, mask_keys, complete_key: as in `ObservationMissingness`.

    Raises:
        ValueError: if a standard deviation is negative or not finite, or their number is not that
            of the components.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> noise = ObservationNoise(0.1, complete_key="complete_observation")
        >>> data = noise._call(TensorDict({"observation": torch.zeros(4, 3)}, [4]))
        >>> bool((data["observation"] != data["complete_observation"]).all())
        True
    """

    role: ClassVar[Role] = "noise"
    writes_mask: ClassVar[bool] = False
    stream: ClassVar[int] = 1

    def __init__(
        self,
        noise_std: float | Sequence[float] | Tensor,
        *,
        seed: int | None = None,
        in_keys: Keys = ("observation",),
        mask_keys: Keys | None = None,
        complete_key: Keys | None = None,
    ) -> None:
        super().__init__(seed=seed, in_keys=in_keys, mask_keys=mask_keys, complete_key=complete_key)
        self._std = PerComponent(noise_std, "noise_std", STD)

    @property
    def noise_std(self) -> float | Tensor:
        """Standard deviation in observation units, a number or shape `(obs,)`, float64."""
        return self._std.value

    def _check_obs_dim(self, obs_dim: int) -> None:
        self._std.check_obs_dim(obs_dim)

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor | None]:
        x = step.observation
        return x + sample_noise(self._std.like(x), x, self.generator(x.device)), None


class ObservationSpikes(SeededTransform):
    r"""Now and then add a large error to a reading, at every step and at every reset.

    $\tilde x_i = x_i + b_i e_i, \quad b_i \sim \mathrm{Bernoulli}(p_i), \quad
    e_i \sim N(0, \text{spike\_std}_i^2)$

    independently for every entry and step: with `ObservationNoise` before it the error is the
    contaminated normal $(1 - p) N(0, \sigma^2) + p N(0, \sigma^2 + \text{spike\_std}^2)$ of Tukey
    ("A survey of sampling from contaminated distributions", 1960). A spiked entry arrives: its mask
    stays True, and a model that trusts every reading is misled.

    Entries that a mask declares missing stay 0 and are not spiked. Spec bounds are lifted. Several
    observation keys count as one vector.

    Args:
        probability: that an entry is hit at a step, in [0, 1]; a number for all components, or one
            per component, shape `(obs,)`.
        spike_std: standard deviation of the error in observation units; a number, or one per
            component, shape `(obs,)`.

    Keyword Args:
        seed, in_keys, mask_keys, complete_key: as in `ObservationMissingness`.
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
        seed: int | None = None,
        in_keys: Keys = ("observation",),
        mask_keys: Keys | None = None,
        complete_key: Keys | None = None,
        spiked_key: Keys | None = None,
    ) -> None:
        super().__init__(seed=seed, in_keys=in_keys, mask_keys=mask_keys, complete_key=complete_key)
        self.spiked_keys: list[NestedKey] = []
        if spiked_key is not None:
            self.spiked_keys = pair_keys(self.in_keys, spiked_key, name="spiked_key", default="")
        taken = [*self.in_keys, *self.mask_keys, *self.complete_keys]
        if not set(self.spiked_keys).isdisjoint(taken):
            raise ValueError(
                f"`spiked_key` must name keys of its own, got {self.spiked_keys} beside {taken}."
            )
        self.out_keys = [*self.out_keys, *self.spiked_keys]
        self._probability = PerComponent(probability, "probability", "in [0, 1]", 1.0)
        self._std = PerComponent(spike_std, "spike_std", STD)

    @property
    def probability(self) -> float | Tensor:
        """Probability that an entry is hit, a number or shape `(obs,)`, float64."""
        return self._probability.value

    @property
    def spike_std(self) -> float | Tensor:
        """Standard deviation of the error, observation units, a number or `(obs,)`, float64."""
        return self._std.value

    def _check_obs_dim(self, obs_dim: int) -> None:
        self._probability.check_obs_dim(obs_dim)
        self._std.check_obs_dim(obs_dim)

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor | None]:
        x = step.observation
        probability, std = self._probability.like(x), self._std.like(x)
        error, hit = sample_spikes(probability, std, x, self.generator(x.device))
        if self.spiked_keys:
            arrived = hit if step.observed is None else hit & step.observed
            sizes = [step.data.get(key).shape[-1] for key in self.in_keys]
            for key, part in zip(self.spiked_keys, torch.split(arrived, sizes, -1), strict=True):
                step.data.set(key, part)
        return x + error, None

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Widen the observation and enter, on request, what was complete and what was hit."""
        spec = super().transform_observation_spec(observation_spec)
        for key, spiked in zip(self.in_keys, self.spiked_keys, strict=False):
            enter_new(spec, spiked, mask_like(spec[key]), self)
        return spec
