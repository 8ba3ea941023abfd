"""What every batch of simulators shares: specs, clipping, time limit, resets, seeds, errors.

A batch pays TorchRL's per-step Python once for all of its simulators.
"""

from abc import abstractmethod
from collections.abc import Sequence
from numbers import Integral
from typing import Any, NamedTuple, NoReturn

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

NO_SEED = -1


class SimulatorError(RuntimeError):
    """A simulator raised, or returned a reward that is not finite; says which one, and when."""


class StepArrays(NamedTuple):
    """One row an environment: the clipped action, and what a step writes."""

    action: NDArray[Any]
    observation: NDArray[np.float64]
    reward: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    truncated: NDArray[np.bool_]


class SimulatorBatch(EnvBase):
    """Step many simulators of one task as one environment, see ``GymnasiumBatchEnv``.

    A backend makes its simulators in :meth:`_build` and steps and resets them on NumPy arrays in
    :meth:`_advance` and :meth:`_restart`.
    """

    def __init__(
        self,
        env_id: str,
        num_envs: int,
        *,
        seed: int | None = None,
        device: torch.device | str | None = None,
        dtype: torch.dtype = torch.float32,
        max_episode_steps: int | None = None,
        num_threads: int = 1,
        observation_keys: Sequence[str] | None = None,
        **make_kwargs: Any,
    ) -> None:
        counts = {"num_envs": num_envs, "num_threads": num_threads}
        if max_episode_steps not in (None, -1):
            counts["max_episode_steps"] = max_episode_steps
        for name, value in counts.items():
            if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
                raise ValueError(f"`{name}` must be an integer of at least 1, got {value!r}.")
        num_envs, num_threads = int(num_envs), int(num_threads)  # NumPy's have other names
        if dtype not in (torch.float32, torch.float64):
            raise TypeError(f"`dtype` must be torch.float32 or torch.float64, got {dtype}.")
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self.env_id, self.num_envs, self.dtype = env_id, num_envs, dtype
        self.num_threads, self.make_kwargs = min(num_threads, num_envs), make_kwargs
        self.joined_keys = None if observation_keys is None else tuple(observation_keys)
        observation_space, action_space, registered, own = self._build()
        limit = registered if max_episode_steps is None else max_episode_steps
        limits = [steps for steps in (limit, own) if steps not in (None, -1)]
        self.max_episode_steps = min(limits, default=None)
        self._make_specs(observation_space, action_space)
        self.is_closed = False
        self._observation = np.zeros((num_envs, *observation_space.shape))
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._seeds = np.full(num_envs, NO_SEED, dtype=np.int64)
        self._started = np.zeros(num_envs, dtype=bool)
        self._engine_resets = np.zeros(num_envs, dtype=np.int64)
        if seed is not None:
            self.set_seed(seed)

    @abstractmethod
    def _build(self) -> tuple[Any, Any, int | None, int | None]:
        """Make the simulators; return both spaces, the registered and the task's own time limit."""

    @abstractmethod
    def _advance(self, rows: NDArray[np.int64] | None, arrays: StepArrays) -> None:
        """Step ``rows`` (None: all) and write into their rows of the arrays."""

    @abstractmethod
    def _restart(
        self, rows: NDArray[np.int64], observation: NDArray[np.float64], options: Any
    ) -> None:
        """Reset ``rows``, with their pending ``_seeds``, and write their first observations."""

    @abstractmethod
    def _close_simulators(self) -> None:
        """Free the simulators and their threads."""

    def _chosen(self, space: Any) -> Any:
        """Return the space of what is read: all, or a dictionary in the order asked for."""
        keys, known = self.joined_keys, getattr(space, "spaces", {})
        if keys is None:
            return space
        if not keys or not known.keys() >= {*keys}:
            raise ValueError(
                f"`observation_keys` must hold entries of the observation of `{self.env_id}`, got "
                f"{[*keys]}: it has {', '.join(known) or 'none, it is no dictionary'}."
            )
        return gymnasium.spaces.Dict([(key, known[key]) for key in keys])

    def _make_specs(self, observation: Any, action: Any) -> None:
        for name, space in (("observation", observation), ("action", action)):
            vector = isinstance(space, gymnasium.spaces.Box) and len(space.shape) == 1
            if not vector or not np.issubdtype(space.dtype, np.floating):
                joined = isinstance(space, gymnasium.spaces.Dict) and name == "observation"
                remedy = "name the entries to join as" if joined else "a wrapper may make it one:"
                raise ValueError(
                    f"the {name} space of `{self.env_id}` must be a vector of real numbers (a Box "
                    f"with one dimension), got {one_line(space)}: {remedy} "
                    f"`{'observation_keys' if joined else 'wrappers'}`."
                )
        if not (np.isfinite(action.low).all() and np.isfinite(action.high).all()):
            raise ValueError(
                f"the action space of `{self.env_id}` must have finite limits, got "
                f"{one_line(action)}: a policy's action is scaled into them."
            )
        n, place = self.num_envs, {"device": self.device}
        self._low, self._high = action.low, action.high
        low, high = (torch.as_tensor(x).repeat(n, 1) for x in (action.low, action.high))
        seen = Unbounded((n, *observation.shape), dtype=self.dtype, **place)
        self.observation_spec = Composite(observation=seen, shape=(n,), **place)
        self.action_spec = Bounded(low=low, high=high, dtype=low.dtype, **place)
        self.reward_spec = Unbounded((n, 1), dtype=self.dtype, **place)
        flags = {
            name: Binary(1, shape=(n, 1), dtype=torch.bool, **place)
            for name in ("done", "terminated", "truncated")
        }
        self.done_spec = Composite(flags, shape=(n,), **place)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        n = self.num_envs
        if not self._started.all():
            raise RuntimeError(
                f"`{type(self).__name__}` row {int(self._started.argmin())} was stepped before "
                "its first reset: call reset() first."
            )
        action = tensordict.get("action").detach().cpu().numpy()
        if action.shape != (n, *self._low.shape):
            raise ValueError(
                f"`action` must have shape {(n, *self._low.shape)} for {n} x {self.env_id}, got "
                f"{action.shape}."
            )
        action = np.clip(action, self._low, self._high, dtype=self._low.dtype)
        # Fresh arrays: collectors keep references to what a step returns.
        observation = np.empty_like(self._observation)
        reward = np.zeros((n, 1))
        terminated, truncated = np.zeros((n, 1), dtype=bool), np.zeros((n, 1), dtype=bool)
        mask, rows = tensordict.get("_step", None), None
        stepped: Any = slice(None)
        if mask is not None:
            stepped = rows = np.flatnonzero(mask.cpu().numpy().reshape(n))
            # A row that is not stepped keeps its observation and its flags, with reward 0.
            observation[:] = self._observation
            for flag, name in ((terminated, "terminated"), (truncated, "truncated")):
                if (last := tensordict.get(name, None)) is not None:
                    flag[:] = last.cpu().numpy()
        self._advance(rows, StepArrays(action, observation, reward, terminated, truncated))
        if not np.isfinite(reward).all():
            row = int(np.isfinite(reward[:, 0]).argmin())
            self._fail(row, f"returned the reward {reward[row, 0]} in `step`")
        self._elapsed[stepped] += 1
        if self.max_episode_steps is not None:
            truncated[stepped, 0] |= self._elapsed[stepped] >= self.max_episode_steps
        self._observation = observation
        return self._pack(observation, terminated, truncated, reward)

    def _reset(
        self,
        tensordict: TensorDictBase | None = None,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        n = self.num_envs
        rows = np.arange(n) if mask is None else np.flatnonzero(mask.cpu().numpy().reshape(n))
        if seed is not None:
            self._seeds[rows] = self._words(seed)[rows]
        observation = self._observation.copy()
        self._restart(rows, observation, options)
        self._seeds[rows] = NO_SEED
        self._elapsed[rows] = 0
        self._started[rows] = True
        self._observation = observation
        return self._pack(observation, np.zeros((n, 1), dtype=bool), np.zeros((n, 1), dtype=bool))

    def _pack(
        self,
        observation: NDArray[np.float64],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
        reward: NDArray[np.float64] | None = None,
    ) -> TensorDict:
        # `observation` is kept for rows that a reset leaves alone: what goes out is a copy.
        kind = np.float32 if self.dtype is torch.float32 else np.float64
        source = {
            "observation": torch.from_numpy(observation.astype(kind)),
            "done": torch.from_numpy(terminated | truncated),
            "terminated": torch.from_numpy(terminated),
            "truncated": torch.from_numpy(truncated),
        }
        if reward is not None:
            source["reward"] = torch.from_numpy(reward.astype(kind, copy=False))
        return TensorDict(source, batch_size=self.batch_size, device=self.device)

    def _words(self, seed: int) -> NDArray[Any]:
        if isinstance(seed, bool) or not isinstance(seed, Integral) or seed < 0:
            raise ValueError(f"`seed` must be a non-negative integer, got {seed!r}.")
        return np.random.SeedSequence(seed).generate_state(self.num_envs)

    def _set_seed(self, seed: int | None) -> None:
        self._seeds[:] = NO_SEED if seed is None else self._words(seed)

    def _fail(self, row: int, what: str, error: Exception | None = None) -> NoReturn:
        cause = "" if error is None else f": {type(error).__name__}: {one_line(error)}"
        raise SimulatorError(
            f"environment {row} of {self.num_envs} x `{self.env_id}` {what} "
            f"after {self._elapsed[row]} steps of its episode{cause}"
        ) from error

    @property
    def engine_resets(self) -> torch.Tensor:
        """Count, int64 ``(num_envs,)``, the steps in which a physics engine gave up its state."""
        return torch.from_numpy(self._engine_resets.copy())

    @property
    def supports_state(self) -> bool:
        """Whether the whole state can be saved; where it is False ``state_dict()`` is empty."""
        # not an error: TorchRL asks a shadow of every environment of a ParallelEnv for its state
        return False

    def get_extra_state(self) -> dict[str, Any]:
        """Return the state that ``state_dict()`` holds; nothing where it can not be saved."""
        return {}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that :meth:`get_extra_state` returned, or refuse it."""
        if state:
            raise RuntimeError(
                f"the state of `{self.env_id}` can not be restored by `{type(self).__name__}`: "
                "look at `supports_state` and start new episodes instead."
            )

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close simulators, renderers, threads; `raise_if_closed` forbids to do it twice."""
        if self.is_closed and raise_if_closed:
            raise RuntimeError("trying to close a closed environment")
        if not self.is_closed:
            self._close_simulators()
        self.is_closed = True

    def extra_repr(self) -> str:
        """Name task, number of environments, device and dtype."""
        return f"{self.env_id!r}, num_envs={self.num_envs}, {self.device}, {self.dtype}"


def one_line(thing: object) -> str:
    """Return the text of an object on one line."""
    return " ".join(str(thing).split())
