"""Entries that do not arrive: at random, by design, or as NaN from real sensors."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import TransformedEnv

from torchrl_drbpn.functional.arrivals import sample_arrivals
from torchrl_drbpn.functional.corruption import (
    MissingnessKind,
    MissingnessMechanism,
    draw_mechanism,
)
from torchrl_drbpn.functional.gaussian import zero_missing
from torchrl_drbpn.transforms._common import Role, as_key_list, fetch
from torchrl_drbpn.transforms._corrupting import (
    CorruptingTransform,
    SeededTransform,
    check_seed,
)

_KINDS = ("mcar", "mar", "nmar")


class ObservationMissingness(SeededTransform, CorruptingTransform):
    r"""Let entries of the observation go missing, at every step and at every reset.

    Second half of Eq. (2) [DRBPN]. With a_{t-1} the action that led to the observation x (zero at
    the first step of an episode), an entry i goes missing with probability

    - "mcar": $\eta$, every component;
    - "mar": $\min(\sigma(b_{1i}^\top a_{t-1} + b_{2i}^\top x_{always} + b_{0i}), \eta)$, never for
      the always observed components x_always;
    - "nmar": the same with the whole x.

    x is the observation that reaches the transform, noise included. The always observed components
    (round(always_observed * obs), at least 1) and b0, b1, b2 ~ N(0, 1) are drawn together from
    `mechanism_seed`: the same for every method, training seed and evaluation, untouched by
    `seed_env`. MAR and NMAR realise clearly less than $\eta$: report the realised ratio as well.

    Missing entries become 0, NaN and inf beneath included, and False in the mask, which is ANDed
    into one that is there already. One seed gives one sequence of masks. The workers of a batched
    environment that are built by one function share a seed and so their masks, until `seed_env`
    gives each its own. Several observation keys count as one vector. Two of them in one environment
    need different seeds, or they lose the same entries.

    Args:
        mechanism: "mcar", "mar" or "nmar".
        eta: missing rate (mcar) or its upper bound (mar, nmar), in [0, 1].

    Keyword Args:
        always_observed: share of the components that always arrive (mar, nmar), in [0, 1].
        mechanism_seed: seed of the mechanism's parameters, not negative.
        seed: seed of the masks, not negative.
        in_keys: observation keys, each of shape `(*batch, obs)`.
        mask_keys: one mask per observation, bool `(*batch, obs)`; by default `observed` beside it.
        complete_key: key (or one key per observation) under which the observation is recorded
            before this transform; None, the default, records nothing.
        action_key: the action (mar, nmar), shape `(*batch, action)`, of the environment itself.

    Raises:
        ValueError: if an argument lies outside its range.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> mask = ObservationMissingness("mcar", 0.5)
        >>> data = mask._call(TensorDict({"observation": torch.ones(1000, 17)}, [1000]))
        >>> bool((data["observation"] == data["observed"]).all())
        True
        >>> bool((data["observed"].float().mean() - 0.5).abs() < 0.02)
        True

    See also: `torchrl_drbpn.functional.missing_probability`, `sample_observed`.
    """

    role: ClassVar[Role] = "missingness"
    stream: ClassVar[int] = 2
    _eta: float

    def __init__(
        self,
        mechanism: MissingnessKind,
        eta: float,
        *,
        always_observed: float = 0.25,
        mechanism_seed: int = 0,
        seed: int = 0,
        in_keys: NestedKey | Sequence[NestedKey] = ("observation",),
        mask_keys: NestedKey | Sequence[NestedKey] | None = None,
        complete_key: NestedKey | Sequence[NestedKey] | None = None,
        action_key: NestedKey = "action",
    ) -> None:
        super().__init__(seed=seed, in_keys=in_keys, mask_keys=mask_keys, complete_key=complete_key)
        if mechanism not in _KINDS:
            raise ValueError(f"`mechanism` must be one of {_KINDS}, got {mechanism!r}.")
        if not 0.0 <= always_observed <= 1.0:
            raise ValueError(f"`always_observed` must be a share in [0, 1], got {always_observed}.")
        self.mechanism = mechanism
        self.eta = eta
        self.always_observed = always_observed
        self.mechanism_seed = check_seed(mechanism_seed, "mechanism_seed")
        (self.action_key,) = as_key_list(action_key)
        self._parameters_drawn: MissingnessMechanism | None = None
        self._parameters_cast: MissingnessMechanism | None = None

    @property
    def eta(self) -> float:
        """Missing rate (mcar) or its upper bound (mar, nmar), in [0, 1]; may be set at any time."""
        return self._eta

    @eta.setter
    def eta(self, eta: float) -> None:
        if not isinstance(eta, Real) or not 0.0 <= eta <= 1.0:
            raise ValueError(f"`eta` must be a missing rate in [0, 1], got {eta!r}.")
        self._eta = float(eta)

    @property
    def mechanism_parameters(self) -> MissingnessMechanism | None:
        """Always observed components and b0, b1, b2; None under "mcar" or before the first use."""
        return self._parameters_drawn

    # ------------------------------------------------------------------------------- on tensors
    def _corrupt(
        self,
        observation: Tensor,
        observed: Tensor | None,
        root: TensorDictBase | None,
        following: TensorDictBase,
    ) -> tuple[Tensor, Tensor | None]:
        del following
        action = parameters = None
        if self.mechanism != "mcar":
            action = None if root is None else self._action(root, observation)
            parameters = self._parameters_for(observation, action)
        return sample_arrivals(
            parameters,
            observation,
            observed,
            action,
            self._eta,
            self.generator(observation.device),
        )

    def _action(self, root: TensorDictBase, observation: Tensor) -> Tensor:
        action = fetch(root, self.action_key)
        if action is None:
            raise KeyError(
                f"`{type(self).__name__}` with mechanism {self.mechanism!r} reads the action under "
                f"{self.action_key!r}, which is not there. Pass action_key=... ."
            )
        if action.shape[:-1] != observation.shape[:-1] or action.ndim == 0:
            raise ValueError(
                f"`{self.action_key}` must be a vector of shape (*batch, action) with batch "
                f"{tuple(observation.shape[:-1])}, got {tuple(action.shape)}. Mechanism "
                f'{self.mechanism!r} weighs its components; use "mcar" for other actions.'
            )
        same = action.dtype is observation.dtype
        cast: Tensor = action if same else action.to(observation.dtype)
        return cast

    # ------------------------------------------------------------------ the mechanism's parameters
    def _parameters_for(self, observation: Tensor, action: Tensor | None) -> MissingnessMechanism:
        cast = self._parameters_cast
        if (
            cast is not None
            and cast.bias.dtype is observation.dtype
            and cast.bias.device == observation.device
        ):
            self._check_dimensions(cast, observation, action)
            return cast
        drawn = self._parameters_drawn
        if drawn is None:
            action_dim = self._action_dim() if action is None else action.shape[-1]
            drawn = draw_mechanism(
                "mar" if self.mechanism == "mar" else "nmar",
                observation.shape[-1],
                0 if action_dim is None else action_dim,
                always_observed=self.always_observed,
                generator=torch.Generator().manual_seed(self.mechanism_seed),
            )
            if action_dim is not None:
                self._parameters_drawn = drawn
        self._check_dimensions(drawn, observation, action)
        cast = MissingnessMechanism(
            drawn.always_observed.to(observation.device),
            *(part.to(observation) for part in drawn[1:]),
        )
        if self._parameters_drawn is not None:
            self._parameters_cast = cast
        return cast

    def _check_dimensions(
        self, parameters: MissingnessMechanism, observation: Tensor, action: Tensor | None
    ) -> None:
        obs_dim, action_dim = parameters.action_weight.shape
        if observation.shape[-1] != obs_dim or (
            action is not None and action.shape[-1] != action_dim
        ):
            received = None if action is None else action.shape[-1]
            raise ValueError(
                f"`{self.in_keys}` must have {obs_dim} components and `{self.action_key}` "
                f"{action_dim}, for which the mechanism was drawn or loaded, got "
                f"{observation.shape[-1]} and {received}. Is the state of another environment?"
            )

    def _action_dim(self) -> int | None:
        # the action that reaches the innermost environment is the one found at the root in `_step`:
        # the inverse transforms have all been applied by then
        env = self.container
        if env is None:
            return None
        while isinstance(env, TransformedEnv):
            env = env.base_env
        spec = env.full_action_spec
        if self.action_key not in spec.keys(True, True):
            raise KeyError(
                f"`{type(self).__name__}` with mechanism {self.mechanism!r} reads the action under "
                f"{self.action_key!r}, which is not among the actions "
                f"{sorted(map(str, spec.keys(True, True)))}. Pass action_key=... ."
            )
        leaf, key = spec[self.action_key], self.action_key
        parent = spec[key[:-1]] if isinstance(key, tuple) else spec
        if len(leaf.shape) - len(parent.shape) != 1:
            raise ValueError(
                f"`{key}` must be a vector of shape (*batch, action) for mechanism "
                f"{self.mechanism!r}, got shape {tuple(leaf.shape)} with batch "
                f'{tuple(parent.shape)}. Use one-hot actions or "mcar".'
            )
        return int(leaf.shape[-1])

    # -------------------------------------------------------------------------------------- state
    def get_extra_state(self) -> dict[str, Tensor]:
        """Return seed, generator state and the mechanism's parameters as tensors."""
        state = super().get_extra_state()
        if self._parameters_drawn is not None:
            state |= {f"mechanism.{k}": v for k, v in self._parameters_drawn._asdict().items()}
            state["mechanism.kind"] = torch.tensor(_KINDS.index(self.mechanism))
            state["mechanism.seed"] = torch.tensor(self.mechanism_seed)
        return state

    def set_extra_state(self, state: dict[str, Tensor]) -> None:
        """Continue from what `get_extra_state` returned.

        Parameters of another mechanism are passed over, so that an agent trained under "mar" can be
        evaluated under "mcar" with the rest of its state.

        Args:
            state: seed, generator state, parameters.

        Raises:
            ValueError: the state is that of the same mechanism with another `mechanism_seed`.
        """
        kind = state.get("mechanism.kind")
        same = kind is not None and _KINDS[int(kind)] == self.mechanism
        drawn_by = state.get("mechanism.seed")
        if same and drawn_by is not None and int(drawn_by) != self.mechanism_seed:
            raise ValueError(
                f"the state is that of mechanism_seed {int(drawn_by)}, this transform has "
                f"mechanism_seed {self.mechanism_seed}: they lose other sensors. Build it with "
                "that seed, or load the state of the normaliser alone."
            )
        super().set_extra_state(state)
        if same:
            self._parameters_drawn = MissingnessMechanism(
                *(state[f"mechanism.{name}"].cpu() for name in MissingnessMechanism._fields)
            )
            self._parameters_cast = None


class SensorReduction(CorruptingTransform):
    """Take sensors away for good: the named components never arrive.

    Nothing is drawn, so that it may stand in an environment as well as on a replay buffer, for
    which in_keys should then name the next observations too.

    Args:
        missing: the components without a sensor; indices (negative ones count from the end), or
            bool of shape `(obs,)`, True where there is none, or of shape `(*batch, obs)`, with the
            batch of the data: each row, such as each environment of a batch, lacks sensors of its
            own. Several observation keys count as one vector.

    Keyword Args:
        in_keys: observation keys, each of shape `(*batch, obs)`.
        mask_keys: one mask per observation, bool `(*batch, obs)`; by default `observed` beside it.
        complete_key: key (or one key per observation) under which the observation is recorded
            before this transform; None, the default, records nothing.

    Raises:
        ValueError: if an index is out of range or the bool tensor is of another shape.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": torch.ones(2, 3)}, [2])
        >>> SensorReduction([0, -1])(data.clone())["observation"].tolist()
        [[0.0, 1.0, 0.0], [0.0, 1.0, 0.0]]
        >>> rows = torch.tensor([[True, False, False], [False, True, False]])
        >>> SensorReduction(rows)(data)["observation"].tolist()
        [[0.0, 1.0, 1.0], [1.0, 0.0, 1.0]]
    """

    role: ClassVar[Role] = "missingness"

    def __init__(
        self,
        missing: Sequence[int] | Sequence[bool] | Tensor,
        *,
        in_keys: NestedKey | Sequence[NestedKey] = ("observation",),
        mask_keys: NestedKey | Sequence[NestedKey] | None = None,
        complete_key: NestedKey | Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__(in_keys=in_keys, mask_keys=mask_keys, complete_key=complete_key)
        tensor = torch.as_tensor(missing)
        if tensor.numel() == 0 and tensor.dtype != torch.bool:
            tensor = tensor.to(torch.int64).reshape(-1)
        is_bool = tensor.dtype == torch.bool
        if (
            tensor.ndim == 0
            or (tensor.ndim > 1 and not is_bool)
            or tensor.is_floating_point()
            or tensor.is_complex()
        ):
            raise ValueError(
                "`missing` must be a list of indices, or bool of shape (obs,) or (*batch, obs), "
                f"True where there is no sensor, got {missing!r}."
            )
        self.missing = tensor.cpu()
        self._present: Tensor | None = None

    def _check_obs_dim(self, obs_dim: int) -> None:
        missing = self.missing
        if missing.dtype == torch.bool:
            if missing.shape[-1] != obs_dim:
                raise ValueError(
                    f"`missing` as bool must have one entry per component, {obs_dim}, for in_keys "
                    f"{self.in_keys}, got {missing.shape[-1]}."
                )
        elif bool(((missing < -obs_dim) | (missing >= obs_dim)).any()):
            raise ValueError(
                f"`missing` must hold indices from {-obs_dim} to {obs_dim - 1} for in_keys "
                f"{self.in_keys} with {obs_dim} components, got {missing.tolist()}."
            )

    def _corrupt(
        self,
        observation: Tensor,
        observed: Tensor | None,
        root: TensorDictBase | None,
        following: TensorDictBase,
    ) -> tuple[Tensor, Tensor | None]:
        del root, following
        present = self._present
        if (
            present is None
            or present.shape[-1] != observation.shape[-1]
            or present.device != observation.device
        ):
            self._check_obs_dim(observation.shape[-1])
            if self.missing.dtype == torch.bool:
                present = ~self.missing
            else:
                present = torch.ones(observation.shape[-1], dtype=torch.bool)
                present[self.missing] = False
            present = self._present = present.to(observation.device)
        if present.ndim > 1 and present.shape != observation.shape:
            # never broadcast: rows that were meant for other environments would go unnoticed
            raise ValueError(
                "`missing` with a row of its own for each row of the data must be bool of shape "
                f"(*batch, obs) = {tuple(observation.shape)}, got {tuple(present.shape)}. One "
                "choice for all rows has the shape (obs,)."
            )
        arrived = present.expand(observation.shape)
        # a copy of its own in both cases: what is expanded shares memory between rows
        arrived = arrived.clone() if observed is None else arrived & observed
        return zero_missing(observation, arrived), arrived


class ObservedFromNaN(CorruptingTransform):
    """Read NaN as "did not arrive": NaN becomes 0 and False in the mask.

    The way in for real sensors that fail. Where the environment writes a mask of its own under the
    mask key, an entry counts as observed if that mask is True and the value is not NaN. Infinite
    values are left: they are errors, not gaps.

    Keyword Args:
        in_keys: observation keys, each of shape `(*batch, obs)`.
        mask_keys: one mask per observation, bool `(*batch, obs)`; by default `observed` beside it.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> data = TensorDict({"observation": torch.tensor([1.0, float("nan")])}, [])
        >>> data = ObservedFromNaN()(data)
        >>> data["observation"].tolist(), data["observed"].tolist()
        ([1.0, 0.0], [True, False])
    """

    role: ClassVar[Role] = "from_nan"

    def __init__(
        self,
        *,
        in_keys: NestedKey | Sequence[NestedKey] = ("observation",),
        mask_keys: NestedKey | Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__(in_keys=in_keys, mask_keys=mask_keys)

    def _corrupt(
        self,
        observation: Tensor,
        observed: Tensor | None,
        root: TensorDictBase | None,
        following: TensorDictBase,
    ) -> tuple[Tensor, Tensor | None]:
        del root, following
        arrived = observation == observation  # NaN alone differs from itself
        if observed is not None:
            arrived = arrived & observed
        return zero_missing(observation, arrived), arrived
