"""What every batch of simulators shares: specs, clipping, time limit, partial resets, errors.

A backend says how its simulators are made, stepped and reset on NumPy arrays; this class turns
that into a TorchRL environment, so that two backends can not differ in keys, specs or the manners
of an episode's end.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

__all__ = ["NO_SEED", "BatchedSimulators"]

NO_SEED = -1


class BatchedSimulators(EnvBase):
    """Step many simulators of one task as one TorchRL environment with batch size ``[num_envs]``.

    A subclass sets ``_obs_dim``, ``_action_low`` and ``_action_high`` in :meth:`_build` and
    implements :meth:`_find_limit`, :meth:`_advance`, :meth:`_restart` and
    :meth:`_close_simulators`.

    Args:
        env_id: id of the task.
        num_envs: number of environments, at least 1.

    Keyword Args:
        seed: seed as in ``set_seed``; None: seeds from the operating system.
        device: device of the tensors that come out.
        dtype: ``torch.float32`` or ``torch.float64``, of observations and rewards.
        max_episode_steps: steps after which an episode is truncated; None: as registered; -1: no
            limit.
        num_threads: threads that step the simulators.

    Raises:
        ValueError: where a number is out of range.
        TypeError: where ``dtype`` is not ``torch.float32`` or ``torch.float64``.
    """

    # A frame skip belongs to the simulator: TorchRL must not add its own.
    _has_frame_skip = True
    _obs_dim: int
    _action_low: NDArray[Any]
    _action_high: NDArray[Any]

    def __init__(
        self,
        env_id: str,
        num_envs: int,
        *,
        seed: int | None,
        device: torch.device | str | None,
        dtype: torch.dtype,
        max_episode_steps: int | None,
        num_threads: int,
    ) -> None:
        _check_count("num_envs", num_envs)
        _check_count("num_threads", num_threads)
        if max_episode_steps is not None and max_episode_steps != -1:
            _check_count("max_episode_steps", max_episode_steps)
        if dtype not in (torch.float32, torch.float64):
            raise TypeError(f"`dtype` must be torch.float32 or torch.float64, got {dtype}.")
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.env_id = env_id
        self.num_envs = num_envs
        self.dtype = dtype
        self.num_threads = min(num_threads, num_envs)
        registered = self._find_limit()
        self.max_episode_steps = registered if max_episode_steps is None else max_episode_steps
        if self.max_episode_steps == -1:
            self.max_episode_steps = None
        self._build()
        self.is_closed = False
        self._observation = np.zeros((num_envs, self._obs_dim))
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._seeds = np.full(num_envs, NO_SEED, dtype=np.int64)
        self._forget_episodes()
        self._make_specs()
        if seed is not None:
            self.set_seed(seed)

    # What a backend says ---------------------------------------------------------------------

    @abstractmethod
    def _find_limit(self) -> int | None:
        """Return the registered time limit of ``env_id``; ValueError where the id is unknown."""

    @abstractmethod
    def _build(self) -> None:
        """Make the simulators; set ``_obs_dim``, ``_action_low`` and ``_action_high``."""

    @abstractmethod
    def _advance(
        self,
        rows: NDArray[np.int64] | None,
        action: NDArray[Any],
        observation: NDArray[np.float64],
        reward: NDArray[np.float64],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
    ) -> None:
        """Step ``rows`` (None: all) and write what they return into their rows of the arrays.

        ``action`` is clipped. ``reward``, ``terminated`` and ``truncated`` have shape
        ``(num_envs, 1)``. The time limit is not the backend's: the caller adds it.
        """

    @abstractmethod
    def _restart(self, rows: NDArray[np.int64], observation: NDArray[np.float64]) -> None:
        """Reset ``rows``, with their pending ``_seeds``, and write their first observations."""

    @abstractmethod
    def _close_simulators(self) -> None:
        """Free the simulators and their threads."""

    def _forget_episodes(self) -> None:
        """Require a reset of every row before the next step."""
        self._started = np.zeros(self.num_envs, dtype=bool)
        self._all_started = False

    # Specs ----------------------------------------------------------------------------------

    def _make_specs(self) -> None:
        n = self.num_envs
        low, high = (torch.as_tensor(x) for x in (self._action_low, self._action_high))
        self.observation_spec = Composite(
            observation=Unbounded((n, self._obs_dim), dtype=self.dtype, device=self.device),
            shape=(n,),
            device=self.device,
        )
        self.action_spec = Bounded(
            low=low.repeat(n, 1), high=high.repeat(n, 1), dtype=low.dtype, device=self.device
        )
        self.reward_spec = Unbounded((n, 1), dtype=self.dtype, device=self.device)
        flag = Binary(1, shape=(n, 1), dtype=torch.bool, device=self.device)
        self.done_spec = Composite(
            done=flag,
            terminated=flag.clone(),
            truncated=flag.clone(),
            shape=(n,),
            device=self.device,
        )

    # Stepping -------------------------------------------------------------------------------

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        if not self._all_started:
            row = int(np.flatnonzero(~self._started)[0])
            raise RuntimeError(
                f"`{type(self).__name__}` row {row} was stepped before its first reset: "
                "call reset() first."
            )
        action = tensordict.get("action").detach().cpu().numpy()
        if action.shape != (self.num_envs, *self._action_low.shape):
            raise ValueError(
                f"`action` must have shape {(self.num_envs, *self._action_low.shape)} for "
                f"{self.num_envs} x {self.env_id}, got {action.shape}."
            )
        action = np.clip(action, self._action_low, self._action_high, dtype=self._action_low.dtype)
        # Fresh arrays: collectors keep references to what a step returns.
        n = self.num_envs
        observation = np.empty((n, self._obs_dim))
        reward = np.zeros((n, 1))
        terminated = np.zeros((n, 1), dtype=bool)
        truncated = np.zeros((n, 1), dtype=bool)
        mask = tensordict.get("_step", None)
        if mask is None:
            rows: Any = slice(None)
            self._advance(None, action, observation, reward, terminated, truncated)
        else:
            rows = np.flatnonzero(mask.cpu().numpy().reshape(n))
            # A row that is not stepped keeps its observation and its flags, with reward 0.
            observation[:] = self._observation
            for flag, name in ((terminated, "terminated"), (truncated, "truncated")):
                if (last := tensordict.get(name, None)) is not None:
                    flag[:] = last.cpu().numpy()
            self._advance(rows, action, observation, reward, terminated, truncated)
        self._elapsed[rows] += 1
        if self.max_episode_steps is not None:
            truncated[rows, 0] |= self._elapsed[rows] >= self.max_episode_steps
        self._observation = observation
        return self._pack(observation, terminated, truncated, reward)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        del kwargs  # `options` and the like have no batched meaning
        mask = None if tensordict is None else tensordict.get("_reset", None)
        n = self.num_envs
        rows = np.arange(n) if mask is None else np.flatnonzero(mask.cpu().numpy().reshape(n))
        observation = self._observation.copy()
        self._restart(rows, observation)
        self._seeds[rows] = NO_SEED
        self._elapsed[rows] = 0
        self._started[rows] = True
        self._all_started = bool(self._started.all())
        self._observation = observation
        return self._pack(observation, np.zeros((n, 1), dtype=bool), np.zeros((n, 1), dtype=bool))

    def _pack(
        self,
        observation: NDArray[np.float64],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
        reward: NDArray[np.float64] | None = None,
    ) -> TensorDict:
        # `observation` is kept as the row memory, so that it always has to be copied.
        float32 = self.dtype is torch.float32
        kind = np.float32 if float32 else np.float64
        source = {
            "observation": torch.from_numpy(observation.astype(kind)),
            "done": torch.from_numpy(terminated | truncated),
            "terminated": torch.from_numpy(terminated),
            "truncated": torch.from_numpy(truncated),
        }
        if reward is not None:
            source["reward"] = torch.from_numpy(reward.astype(kind, copy=False))
        device = self.device
        if device is None or device.type == "cpu":
            # The shapes are known: checking them costs as much as all of the above.
            return TensorDict._new_unsafe(source, batch_size=self.batch_size, device=device)
        return TensorDict(source, batch_size=self.batch_size, device=device)

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            self._seeds[:] = NO_SEED
            return
        if seed < 0:
            raise ValueError(f"`seed` must be a non-negative integer, got {seed}.")
        self._seeds[:] = np.random.SeedSequence(seed).generate_state(self.num_envs)

    # Saving and closing ---------------------------------------------------------------------

    @property
    def supports_state(self) -> bool:
        """Tell whether the whole state can be saved; False unless a backend says otherwise."""
        return False

    def get_extra_state(self) -> dict[str, Any]:
        """Return nothing: there is no state to save; ``state_dict()`` calls it.

        It does not raise, since TorchRL asks a shadow of every environment of a ``ParallelEnv``
        for its ``state_dict()``. Who saves a run looks at :attr:`supports_state`.
        """
        return {}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Refuse a state: it can not be restored; ``load_state_dict`` calls it.

        Args:
            state: what another environment saved; empty where it could not be saved either.

        Raises:
            RuntimeError: where there is a state, unless a backend overrides it.
        """
        if state:
            raise RuntimeError(
                f"the state of `{self.env_id}` can not be restored: {self._why_no_state()}. Look "
                "at `supports_state` and start new episodes instead."
            )

    def _why_no_state(self) -> str:
        return f"`{type(self).__name__}` has no access to it"

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the simulators, their renderers and the threads.

        Args:
            raise_if_closed: raise where the environment was closed before.

        Raises:
            RuntimeError: where it was closed before, unless ``raise_if_closed`` is False.
        """
        if self.is_closed:
            if raise_if_closed:
                raise RuntimeError("trying to close a closed environment")
            return
        self.is_closed = True
        self._close_simulators()

    def __repr__(self) -> str:
        """Name the task, the number of environments and the device."""
        return (
            f"{type(self).__name__}({self.env_id!r}, num_envs={self.num_envs}, "
            f"device={self.device}, dtype={self.dtype})"
        )


def _check_count(name: str, value: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"`{name}` must be an integer of at least 1, got {value!r}.")
