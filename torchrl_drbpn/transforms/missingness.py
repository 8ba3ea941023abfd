"""Entries that do not arrive: at random, by design, or as NaN from real sensors."""

from collections.abc import Sequence
from functools import lru_cache
from numbers import Real
from typing import ClassVar, Literal, Unpack, get_args

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_drbpn.functional.gaussian import zero_missing
from torchrl_drbpn.functional.missingness import (
    MissingnessKind,
    MissingnessMechanism,
    draw_mechanism,
    missing_probability,
    sample_mask,
)
from torchrl_drbpn.transforms._base import (
    CorruptingTransform,
    CorruptionKeys,
    Step,
    as_key_list,
    read_leaf,
)
from torchrl_drbpn.transforms.seeding import SeededKeys, SeededTransform, check_seed


class ObservationMissingness(SeededTransform):
    r"""Let entries of the observation go missing, at every step and at every reset.

    Second half of Eq. (2) [DRBPN]. With a_{t-1} the action that led to the observation x (zero at
    the first step of an episode), an entry i goes missing with probability

    - "mcar": $\eta$, every component;
    - "mar": $\min(\sigma(b_{1i}^\top a_{t-1} + b_{2i}^\top x_{always} + b_{0i}), \eta)$, never for
      the always observed components x_always;
    - "nmar": the same with the whole x.

    x is the observation that reaches the transform, noise included. The always observed components
    (round(always_observed * obs), at least 1) and b0, b1, b2 ~ N(0, 1) are drawn together from
    `mechanism_seed`, untouched by `seed_env`. MAR and NMAR realise clearly less than $\eta$: report
    the realised ratio as well.

    Missing entries become 0, NaN and inf beneath included, and False in the mask, which is ANDed
    into one that is there already. Several observation keys count as one vector.

    Args:
        mechanism: "mcar", "mar" or "nmar".
        eta: missing rate (mcar) or its upper bound (mar, nmar), in [0, 1].

    Keyword Args:
        always_observed: share of the components that always arrive (mar, nmar), in [0, 1); one has
            to be left that can go missing.
        mechanism_seed: seed of the mechanism's parameters, not negative.
        action_key: the action (mar, nmar), shape `(*batch, action)`, of the environment itself.
        seed: None, to draw from torch's global generator, or the seed of a generator of its own,
            which gives the same draws to every worker and every transform that is built with it.
        in_keys: observation keys, each of shape `(*batch, obs)`.
        mask_keys: one mask per observation, bool `(*batch, obs)`; by default `observed` beside it.
        complete_key: key (or one key per observation) under which the observation is recorded
            before this transform; None, the default, records nothing.

    Example:
        >>> from tensordict import TensorDict
        >>> mask = ObservationMissingness("mcar", 0.5)
        >>> data = mask._call(TensorDict({"observation": torch.ones(1000, 17)}, [1000]))
        >>> bool((data["observation"] == data["observed"]).all())
        True

    Attributes:
        mechanism_parameters: of `torchrl_drbpn.functional.missing_probability`, in the dtype and on
            the device of the data; None under "mcar" and before the first step.
    """

    stream: ClassVar[int] = 2
    _eta: float

    def __init__(
        self,
        mechanism: MissingnessKind,
        eta: float,
        *,
        always_observed: float = 0.25,
        mechanism_seed: int = 0,
        action_key: NestedKey = "action",
        **keys: Unpack[SeededKeys],
    ) -> None:
        super().__init__(**keys)
        kinds = get_args(MissingnessKind)
        if mechanism not in kinds:
            raise ValueError(f"`mechanism` must be one of {kinds}, got {mechanism!r}.")
        if mechanism != "mcar" and not 0.0 <= always_observed < 1.0:
            raise ValueError(
                f"`always_observed` must be a share in [0, 1), got {always_observed}: with 1 "
                "nothing is ever missing. Pass eta=0.0 for complete data."
            )
        self.mechanism = mechanism
        self.eta = eta
        self.always_observed = always_observed
        self.mechanism_seed = check_seed(mechanism_seed, "mechanism_seed")
        (self.action_key,) = as_key_list([action_key])
        self.mechanism_parameters: MissingnessMechanism | None = None

    @property
    def eta(self) -> float:
        """Missing rate (mcar) or its upper bound (mar, nmar), in [0, 1]; may be set at any time."""
        return self._eta

    @eta.setter
    def eta(self, eta: float) -> None:
        if isinstance(eta, bool) or not isinstance(eta, Real) or not 0.0 <= eta <= 1.0:
            raise ValueError(f"`eta` must be a missing rate in [0, 1], got {eta!r}.")
        self._eta = float(eta)

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor]:
        x, generator = step.observation, self.generator(step.observation.device)
        if self.mechanism == "mcar":
            return x, sample_mask(self._eta, x, generator) & step.observed
        action = None if step.before is None else self._action(step.before, x)
        # what an earlier transform hides does not enter the probability
        seen = zero_missing(x, step.observed)
        sizes = x.shape[-1], 0 if action is None else action.shape[-1]
        draw = self.mechanism, sizes, self.always_observed, self.mechanism_seed
        mechanism = _drawn(*draw, x.dtype, x.device)
        if action is not None:
            self.mechanism_parameters = mechanism
        probability = missing_probability(mechanism, seen, action, self._eta)
        return x, sample_mask(probability, x, generator) & step.observed

    def _action(self, before: TensorDictBase, observation: Tensor) -> Tensor:
        action: Tensor = read_leaf(before, self.action_key, self)
        if action.shape[:-1] != observation.shape[:-1] or action.ndim == 0:
            raise ValueError(
                f"`{self.action_key}` must be a vector of shape (*batch, action) with batch "
                f"{tuple(observation.shape[:-1])}, got {tuple(action.shape)}. Mechanism "
                f'{self.mechanism!r} weighs its components; use one-hot actions or "mcar".'
            )
        return action.to(observation.dtype)


@lru_cache(maxsize=32)
def _drawn(
    kind: Literal["mar", "nmar"],
    sizes: tuple[int, int],
    always_observed: float,
    seed: int,
    dtype: torch.dtype,
    device: torch.device,
) -> MissingnessMechanism:
    """Return the mechanism of a seed; at a reset without the weights of an action."""
    generator = torch.Generator().manual_seed(seed)
    always, *parts = draw_mechanism(
        kind, *sizes, always_observed=always_observed, generator=generator
    )
    return MissingnessMechanism(always.to(device), *(part.to(device, dtype) for part in parts))


class SensorReduction(CorruptingTransform):
    """Take sensors away for good: the named components never arrive.

    Nothing is drawn, so that it works in an environment and on a replay buffer: with
    `in_keys=["observation", ("next", "observation")]` both lose the same sensors.

    Args:
        missing: the components without a sensor: indices (negative ones count from the end), bool
            of shape `(obs,)`, True where there is none, or bool of shape `(*batch, obs)`, where
            each row, such as each environment of a batch, lacks sensors of its own.
        **keys: `in_keys`, `mask_keys`, `complete_key` as in `ObservationMissingness`.

    Example:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": torch.ones(2, 3)}, [2])
        >>> SensorReduction([0, -1])(data.clone())["observation"].tolist()
        [[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]
        >>> rows = torch.tensor([[True, False, False], [False, True, False]])
        >>> SensorReduction(rows)(data)["observation"].tolist()
        [[0.0, 1.0, 1.0], [1.0, 0.0, 1.0]]
    """

    def __init__(
        self,
        missing: Sequence[int] | Sequence[bool] | Tensor,
        **keys: Unpack[CorruptionKeys],
    ) -> None:
        super().__init__(**keys)
        tensor = torch.as_tensor(missing).cpu()
        if tensor.numel() == 0 and tensor.dtype != torch.bool:
            tensor = tensor.to(torch.int64).reshape(-1)
        whole = not (tensor.is_floating_point() or tensor.is_complex())
        if not whole or tensor.ndim == 0 or (tensor.ndim > 1 and tensor.dtype != torch.bool):
            raise ValueError(
                "`missing` must be a list of indices, or bool of shape (obs,) or (*batch, obs), "
                f"True where there is no sensor, got {tensor.dtype} of shape {tuple(tensor.shape)}."
            )
        self.missing = tensor

    def _check_obs_dim(self, obs_dim: int) -> None:
        missing, where = self.missing, f"for in_keys {self.in_keys} with {obs_dim} components"
        if missing.dtype == torch.bool:
            if missing.shape[-1] != obs_dim:
                raise ValueError(
                    f"`missing` as bool must have one entry per component {where}, got "
                    f"{missing.shape[-1]}."
                )
            self._present = ~missing
            return
        if bool(((missing < -obs_dim) | (missing >= obs_dim)).any()):
            raise ValueError(
                f"`missing` must hold indices from {-obs_dim} to {obs_dim - 1} {where}, got "
                f"{missing.tolist()}."
            )
        self._present = torch.ones(obs_dim, dtype=torch.bool)
        self._present[missing] = False

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor]:
        observation = step.observation
        present = self._present.to(observation.device)
        if present.ndim > 1 and present.shape != observation.shape:
            # never broadcast: rows that were meant for other environments would go unnoticed
            raise ValueError(
                "`missing` with a row of its own for each row of the data must be bool of shape "
                f"(*batch, obs) = {tuple(observation.shape)}, got {tuple(present.shape)}. One "
                "choice for all rows has the shape (obs,)."
            )
        return observation, present & step.observed


class ObservedFromNaN(CorruptingTransform):
    """Read NaN as "did not arrive": NaN becomes 0 and False in the mask.

    The way in for real sensors that fail, in an environment or on a replay buffer. Infinite values
    are left: they are errors, not gaps.

    Args:
        **keys: `in_keys`, `mask_keys`, `complete_key` as in `ObservationMissingness`.

    Example:
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": torch.tensor([1.0, float("nan")])}, [])
        >>> data = ObservedFromNaN()(data)
        >>> data["observation"].tolist(), data["observed"].tolist()
        ([1.0, 0.0], [True, False])
    """

    keeps_readings: ClassVar[bool] = True

    def _corrupt(self, step: Step) -> tuple[Tensor, Tensor]:
        return step.observation, ~step.observation.isnan() & step.observed
