"""Gaussian noise on what the sensors deliver."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_drbpn.functional.corruption import sample_noise
from torchrl_drbpn.functional.gaussian import zero_missing
from torchrl_drbpn.transforms._common import Role
from torchrl_drbpn.transforms._corrupting import (
    CorruptingTransform,
    SeededTransform,
)


class ObservationNoise(SeededTransform, CorruptingTransform):
    r"""Add independent Gaussian noise to every component, at every step and at every reset.

    $\tilde x = x + \epsilon, \quad \epsilon \sim N(0, \mathrm{diag}(\text{noise\_std}^2))$, the
    first half of Eq. (2) [DRBPN], where noise_std = 0.01 sigma.

    Entries that a mask declares missing stay 0. Spec bounds are lifted, since noise leaves them.
    Several observation keys count as one vector. The workers of a batched environment that are
    built by one function share a seed and so their noise, until `seed_env` gives each its own. Two
    `ObservationNoise` on different keys of one environment need different seeds.

    Args:
        noise_std: standard deviation in observation units; a number for all components, or one per
            component, shape `(obs,)`.

    Keyword Args:
        seed: seed of the noise, not negative.
        in_keys: observation keys, each of shape `(*batch, obs)`.
        mask_keys: one mask per observation, read where it exists; by default `observed` beside it.
        complete_key: key (or one key per observation) under which the observation is recorded
            before the noise; None, the default, records nothing.

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
        seed: int = 0,
        in_keys: NestedKey | Sequence[NestedKey] = ("observation",),
        mask_keys: NestedKey | Sequence[NestedKey] | None = None,
        complete_key: NestedKey | Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__(seed=seed, in_keys=in_keys, mask_keys=mask_keys, complete_key=complete_key)
        self.noise_std: float | Tensor
        try:
            std = torch.as_tensor(noise_std, dtype=torch.float64)
        except (TypeError, ValueError):
            std = torch.tensor(math.nan)
        if std.ndim > 1 or not bool(((std >= 0) & (std < math.inf)).all()):
            raise ValueError(
                "`noise_std` must be a number or one number per component, finite and not "
                f"negative, in observation units, got {noise_std!r}."
            )
        self.noise_std = float(std) if std.ndim == 0 else std
        self._cast_std = self.noise_std

    def _check_obs_dim(self, obs_dim: int) -> None:
        if isinstance(self.noise_std, Tensor) and self.noise_std.shape[0] != obs_dim:
            raise ValueError(
                f"`noise_std` must have one entry per component, {obs_dim}, for in_keys "
                f"{self.in_keys}, got {self.noise_std.shape[0]}."
            )

    def _corrupt(
        self,
        observation: Tensor,
        observed: Tensor | None,
        root: TensorDictBase | None,
        following: TensorDictBase,
    ) -> tuple[Tensor, Tensor | None]:
        del root, following
        std = self._cast_std
        if isinstance(std, Tensor) and (
            std.dtype is not observation.dtype or std.device != observation.device
        ):
            std = self._cast_std = self.noise_std.to(observation)  # type: ignore[union-attr]
        if isinstance(std, Tensor):
            self._check_obs_dim(observation.shape[-1])
        noise = sample_noise(std, observation, self.generator(observation.device))
        noisy = noise.add_(observation)
        return (noisy if observed is None else zero_missing(noisy, observed)), observed
