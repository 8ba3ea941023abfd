"""The belief filter with TensorDict keys and the manners of TorchRL's GRUModule."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer
from torchrl.modules.tensordict_module.rnn import recurrent_mode

from torchrl_drbpn.functional import StateSpace, tril_to_vector
from torchrl_drbpn.functional.precision import outside_autocast
from torchrl_drbpn.functional.saturation import check_gate
from torchrl_drbpn.modules._keys import read_entry, read_in_keys, read_out_keys
from torchrl_drbpn.modules.belief_filter import BeliefFilter

__all__ = ["BeliefFilterModule"]

IN_KEYS: tuple[NestedKey, ...] = (
    "observation",
    "observed",
    "previous_action",
    "is_init",
    ("recurrent", "mean"),
    ("recurrent", "age"),
)
DEFAULT_OUT_KEYS: tuple[NestedKey, ...] = (
    "features",
    ("belief", "mean"),
    ("belief", "log_likelihood"),
)
OPTIONAL_OUT_KEYS: tuple[NestedKey, ...] = (
    ("belief", "cov"),
    ("belief", "observation"),
    ("belief", "predicted_observation"),
    ("belief", "innovation_cov"),
)


class BeliefFilterModule(TensorDictModuleBase):
    r"""Read what arrived, write the belief: a :class:`BeliefFilter` with keys.

    It stands where a ``GRUModule`` stands in a TorchRL pipeline: one step at a time by default,
    whole trajectories (last batch dimension = time) under ``set_recurrent_mode(True)``, its
    primer found by ``get_primers_from_module``.

    The recurrent state is ``("recurrent", "mean")``, the filtered mean of the step before, and
    ``("recurrent", "age")``, the updates since the reset. The learned initial belief is used
    where ``is_init & (age == 0)``; where ``is_init`` comes with an older age (the "next" stream
    of ``GAE(shifted=False)``, slices of a replay buffer) the stored state is taken. Without
    recurrent entries every row starts from the initial belief; one step at a time so does every
    step, with one warning.

    Args:
        filter: the filter.

    Keyword Args:
        in_keys: the six entries read, in the order ``observation, observed, previous_action,
            is_init, ("recurrent", "mean"), ("recurrent", "age")``: a list of the first four or
            of all six, or a dict from these names to yours.
        out_keys: the entries written, a list chosen from ``features``, ``("belief", "mean")``,
            ``("belief", "log_likelihood")`` (the default) and, computed only where asked for,
            ``("belief", "cov")``, ``("belief", "observation")`` (H m + B a + d of the filtered
            mean: every sensor's estimate), ``("belief", "predicted_observation")``,
            ``("belief", "innovation_cov")``; or a dict from these names to yours. The recurrent
            state is always written, under ``("next", ...)``.
        policy_input: what ``features`` holds, for policy and value to read (eq. 11 [DRBPN]):
            "mean", or "mean_cov" (lower triangle of the filtered covariance behind the mean).
        default_recurrent_mode: the mode outside any ``set_recurrent_mode`` context.
        gate: for an agent that is trained and acts among readings that arrive and are wrong:
            those further than about this many standard deviations from their forecast count as if
            they lay at that distance (:func:`torchrl_drbpn.functional.saturate_innovation`), and
            ``("belief", "log_likelihood")`` is that of what was counted. None, the default: every
            reading is believed. One step at a time only; the attribute ``gate`` may be set later.

    Raises:
        TypeError: if keys are neither a list nor a dict.
        ValueError: for a key list of another length, an unknown name, a key given twice, an
            unknown choice, or a gate that is not positive and finite.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import set_recurrent_mode
        >>> module = BeliefFilterModule(BeliefFilter(obs_dim=5, action_dim=2))
        >>> data = TensorDict(
        ...     observation=torch.randn(3, 10, 5),
        ...     observed=torch.rand(3, 10, 5) < 0.7,
        ...     previous_action=torch.zeros(3, 10, 2),
        ...     is_init=torch.zeros(3, 10, 1, dtype=torch.bool),
        ...     batch_size=[3, 10])
        >>> with set_recurrent_mode(True):
        ...     out = module(data)
        >>> out["features"].shape, out["belief", "log_likelihood"].shape
        (torch.Size([3, 10, 5]), torch.Size([3, 10]))
    """

    def __init__(
        self,
        filter: BeliefFilter,
        *,
        in_keys: Sequence[NestedKey] | Mapping[NestedKey, NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | Mapping[NestedKey, NestedKey] | None = None,
        policy_input: Literal["mean", "mean_cov"] = "mean",
        default_recurrent_mode: bool | None = None,
        gate: float | None = None,
    ) -> None:
        super().__init__()
        if policy_input not in ("mean", "mean_cov"):
            raise ValueError(f"`policy_input` must be 'mean' or 'mean_cov', got {policy_input!r}.")
        self.filter = filter
        self.policy_input = policy_input
        self._default_recurrent_mode = default_recurrent_mode
        self._warned = False
        self.gate = gate
        self.in_keys = read_in_keys(in_keys, IN_KEYS, "the filter")
        self._next_mean = unravel_key(("next", self.in_keys[4]))
        self._next_age = unravel_key(("next", self.in_keys[5]))
        self._out = read_out_keys(
            out_keys,
            DEFAULT_OUT_KEYS,
            OPTIONAL_OUT_KEYS,
            [self._next_mean, self._next_age],
            "the filter",
        )
        self.out_keys = [*self._out.values(), self._next_mean, self._next_age]

    # ------------------------------------------------------------------ forward
    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the belief; see the class for keys and modes."""
        return self._write(tensordict, self.recurrent_mode, None)

    def step(self, tensordict: TensorDictBase, model: StateSpace | None = None) -> TensorDictBase:
        """Write the belief of one step, whatever the mode.

        Args:
            tensordict: the entries read by :meth:`forward`.
            model: what ``filter.state_space()`` returned: a rollout, whose parameters stay what
                they are, builds it once instead of at every step.

        Returns:
            The tensordict.

        Example:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> module = BeliefFilterModule(BeliefFilter(obs_dim=5, action_dim=2))
            >>> data = TensorDict(
            ...     observation=torch.randn(3, 5), observed=torch.rand(3, 5) < 0.7,
            ...     previous_action=torch.zeros(3, 2), is_init=torch.ones(3, 1, dtype=torch.bool),
            ...     recurrent=dict(mean=torch.zeros(3, 5), age=torch.zeros(3, 1).long()),
            ...     batch_size=[3])
            >>> once = module.step(data.copy(), module.filter.state_space())
            >>> bool((once == module(data)).all())
            True
        """
        return self._write(tensordict, False, model)

    @outside_autocast
    def _write(
        self, tensordict: TensorDictBase, sequence: bool, model: StateSpace | None
    ) -> TensorDictBase:
        observation, observed, action, is_init = (
            read_entry(tensordict, self.in_keys, i) for i in range(4)
        )
        # Simulators take float32 actions beside float64 observations; a cast loses nothing there.
        action = action.to(self.filter.initial_mean.dtype)
        mean = tensordict.get(self.in_keys[4], None)
        age = tensordict.get(self.in_keys[5], None)
        first = is_init.squeeze(-1)
        if sequence and self.gate is not None:
            raise ValueError(
                f"`gate` is {self.gate:g}, and the mode is recurrent: a gate is for an agent that "
                "is trained and works one step at a time. Train without one (gate = None) and set "
                "it afterwards."
            )
        if sequence and first.ndim == 0:
            raise ValueError(
                "under set_recurrent_mode(True) the last batch dimension is time, but the input "
                "has no batch dimension at all."
            )
        fresh = mean is None or age is None
        if fresh:
            mean, age, first = self._fresh_state(observation, first, sequence)
        reset = first & (age.squeeze(-1) == 0)

        want_cov = ("belief", "cov") in self._out or self.policy_input == "mean_cov"
        if sequence:
            # At an is_init with an older age the row is stitched: take the stored state there.
            restart = first & ~reset
            out = self.filter(
                mean[..., 0, :], None, action, observation, observed, reset,
                restart=restart, restart_mean=mean, return_cov=want_cov,
            )  # fmt: skip
            if fresh:
                age = _steps_since(reset)
        else:
            out = self.filter.step(
                mean, None, action, observation, observed, reset,
                return_cov=want_cov, model=model, gate=self.gate,
            )  # fmt: skip

        tensordict.set(self._next_mean, out.mean)
        tensordict.set(self._next_age, age + 1)
        features = out.mean
        if self.policy_input == "mean_cov" and out.cov is not None:
            features = torch.cat([out.mean, tril_to_vector(out.cov)], -1)
        results: dict[NestedKey, Tensor | None] = {
            "features": features,
            ("belief", "mean"): out.mean,
            ("belief", "log_likelihood"): out.log_likelihood,
            ("belief", "cov"): out.cov,
        }
        if any(name not in results for name in self._out):
            previous = mean
            if sequence:
                shifted = torch.cat([mean[..., :1, :], out.mean[..., :-1, :]], -2)
                previous = torch.where(restart.unsqueeze(-1), mean, shifted)
            results.update(self._observations(previous, action, reset, out.mean))
        for name, key in self._out.items():
            tensordict.set(key, results[name])
        return tensordict

    def _fresh_state(
        self, observation: Tensor, first: Tensor, sequence: bool
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Make the state of rows that bring none: they start from the initial belief."""
        mean = observation.new_zeros(*first.shape, self.filter.state_dim)
        age = torch.zeros(*first.shape, 1, dtype=torch.int64, device=first.device)
        if sequence:
            return mean, age, torch.cat([torch.ones_like(first[..., :1]), first[..., 1:]], -1)
        if not self._warned and not torch.compiler.is_compiling():
            self._warned = True
            warnings.warn(
                f"`{self.in_keys[4]}` is not in the tensordict, so every step starts from the "
                "initial belief and nothing is remembered. Append make_tensordict_primer() to the "
                "environment, or collect with auto_register_policy_transforms=True.",
                stacklevel=2,
            )
        return mean, age, torch.ones_like(first)

    def _observations(
        self, previous: Tensor, action: Tensor, reset: Tensor, mean: Tensor
    ) -> dict[NestedKey, Tensor | None]:
        """Compute what only reports read: estimates of the sensors, and S."""
        emission = self.filter.emission
        predicted = self.filter.predict(previous, action, reset)
        cov = None
        if ("belief", "innovation_cov") in self._out:
            H = emission.matrix
            cov = H @ predicted.cov @ H.mT + emission.cov()
        return {
            ("belief", "observation"): emission(mean, action),
            ("belief", "predicted_observation"): emission(predicted.mean, action),
            ("belief", "innovation_cov"): cov,
        }

    @property
    def gate(self) -> float | None:
        """Standard deviations beyond which an innovation is saturated; None: nowhere."""
        return self._gate

    @gate.setter
    def gate(self, gate: float | None) -> None:
        if gate is not None:
            check_gate(gate)
        self._gate = gate

    @property
    def feature_dim(self) -> int:
        """Width of ``features``, for building the heads that read it."""
        state = self.filter.state_dim
        return state if self.policy_input == "mean" else state + state * (state + 1) // 2

    # ------------------------------------------------------------------ modes and primer
    @property
    def recurrent_mode(self) -> bool:
        """Whether the last batch dimension is read as time."""
        mode = recurrent_mode()
        return bool(self._default_recurrent_mode) if mode is None else mode

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Make the transform that puts the recurrent state into the environment.

        Returns:
            A primer of zeros for mean ``(state,)`` and age ``(1,)``; the zero age is what makes
            the filter start from its learned initial belief.

        Example:
            >>> module = BeliefFilterModule(BeliefFilter(obs_dim=5, action_dim=2))
            >>> primer = module.make_tensordict_primer()
            >>> ("recurrent", "mean") in primer.primers.keys(True)
            True
        """
        # No device, as in TorchRL's own: an environment that has one moves the primer to it, one
        # without (device=None) resets on the CPU, whatever the policy runs on.
        dtype = self.filter.initial_mean.dtype
        return TensorDictPrimer(
            {
                self.in_keys[4]: Unbounded((self.filter.state_dim,), dtype=dtype),
                self.in_keys[5]: Unbounded((1,), dtype=torch.int64),
            },
            expand_specs=True,
        )


def _steps_since(reset: Tensor) -> Tensor:
    """Count the steps since the last reset in each row, shape (*batch, time, 1)."""
    index = torch.arange(reset.shape[-1], device=reset.device).expand(reset.shape)
    last = torch.where(reset, index, 0).cummax(-1).values
    return (index - last).unsqueeze(-1)
