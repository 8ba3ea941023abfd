"""What is wrong with readings that arrive: Gaussian noise, and gross errors now and then."""

from collections.abc import Sequence
from typing import ClassVar, TypeAlias, Unpack

from torch import Tensor

from torchrl_drbpn.functional.missingness import sample_noise, sample_spikes
from torchrl_drbpn.transforms._base import Step, read_numbers
from torchrl_drbpn.transforms.seeding import SeededKeys, SeededTransform

Numbers: TypeAlias = float | Sequence[float] | Tensor
NUMBERS = "a number or one number per component"
STD = f"{NUMBERS}, finite and not negative, in observation units"


class ObservationNoise(SeededTransform):
    r"""Add independent Gaussian noise to every component, at every step and at every reset.

    $\tilde x = x + \epsilon, \quad \epsilon \sim N(0, \mathrm{diag}(\text{noise\_std}^2))$, the
    first half of Eq. (2) [DRBPN], where noise_std = 0.01 sigma. Entries that a mask declares
    missing stay 0. Spec bounds are lifted, since noise leaves them.

    Args:
        noise_std: standard deviation in observation units, finite and not negative; a number for
            all components, or one per component, shape `(obs,)`.
        **keys: `seed`, `in_keys`, `mask_keys`, `complete_key` as in `ObservationMissingness`.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> noise = ObservationNoise(0.1, complete_key="complete_observation")
        >>> data = noise._call(TensorDict({"observation": torch.zeros(4, 3)}, [4]))
        >>> bool((data["observation"] != data["complete_observation"]).all())
        True
    """

    writes_mask: ClassVar[bool] = False
    per_component: ClassVar[tuple[str, ...]] = ("noise_std",)
    stream: ClassVar[int] = 1

    def __init__(self, noise_std: Numbers, **keys: Unpack[SeededKeys]) -> None:
        super().__init__(**keys)
        self.noise_std = read_numbers(noise_std, "noise_std", STD)

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor]:
        x = step.observation
        noise = sample_noise(self.noise_std.to(x), x, self.generator(x.device))
        return x + noise, step.observed


class ObservationSpikes(SeededTransform):
    r"""Now and then add a large error to a reading, at every step and at every reset.

    $\tilde x_i = x_i + b_i e_i, \quad b_i \sim \mathrm{Bernoulli}(p_i), \quad
    e_i \sim N(0, \text{spike\_std}_i^2)$

    independently for every entry and step: with `ObservationNoise` before it the error is the
    contaminated normal $(1 - p) N(0, \sigma^2) + p N(0, \sigma^2 + \text{spike\_std}^2)$ of Tukey
    ("A survey of sampling from contaminated distributions", 1960). A spiked entry arrives: its mask
    stays True. Entries that a mask declares missing stay 0 and are not spiked.

    Args:
        probability: that an entry is hit at a step, in [0, 1]; a number for all components, or one
            per component, shape `(obs,)`.
        spike_std: standard deviation of the error in observation units, finite, likewise.

        **keys: `seed`, `in_keys`, `mask_keys`, `complete_key` as in `ObservationMissingness`.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> spikes = ObservationSpikes(0.05, 10.0)
        >>> data = spikes._call(TensorDict({"observation": torch.zeros(1000, 3)}, [1000]))
        >>> 0 < int((data["observation"] != 0).sum()) < 3000
        True
    """

    writes_mask: ClassVar[bool] = False
    per_component: ClassVar[tuple[str, ...]] = ("probability", "spike_std")
    stream: ClassVar[int] = 4

    def __init__(
        self,
        probability: Numbers,
        spike_std: Numbers,
        **keys: Unpack[SeededKeys],
    ) -> None:
        super().__init__(**keys)
        share = f"{NUMBERS}, in [0, 1]"
        self.probability = read_numbers(probability, "probability", share, most=1.0)
        self.spike_std = read_numbers(spike_std, "spike_std", STD)

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor]:
        x = step.observation
        probability, std = self.probability.to(x), self.spike_std.to(x)
        error, _ = sample_spikes(probability, std, x, self.generator(x.device))
        return x + error, step.observed
