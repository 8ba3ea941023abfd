"""Many Gymnasium environments as one TorchRL environment, one TensorDict a step.

A wrapper around one environment pays TorchRL's per-step Python once for every simulator step;
this class pays it once for ``num_envs`` of them. The simulators are stepped in a plain loop into
NumPy arrays and cross into torch once.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_drbpn.envs.making import find_limit, make_simulators
from torchrl_drbpn.envs.simulator_state import (
    is_mujoco,
    load_simulator_state,
    simulator_state,
)

__all__ = ["GymnasiumBatchEnv"]

_NO_SEED = -1


class GymnasiumBatchEnv(EnvBase):
    r"""Step many Gymnasium environments as one TorchRL environment with batch size ``[num_envs]``.

    The trajectories are those of ``gymnasium.make(env_id)``, bit for bit in ``float64``: the same
    time limit, the same seeding, no change of reward or observation. There is no automatic reset
    inside: where an episode ends, ``("next", "observation")`` holds its true last observation,
    and TorchRL's ``step_and_maybe_reset``, ``rollout`` and collectors reset the finished rows.
    Actions outside the Box are clipped to it before the step.

    Seeds: ``set_seed(s)`` gives sub-environment ``i`` the ``i``-th word of
    ``numpy.random.SeedSequence(s)``, so that neighbouring seeds share no sub-environment (as
    ``s + i`` would) and the first rows do not depend on ``num_envs``. The next reset of a row uses
    its seed, once; later resets go on from there.

    Saving: ``state_dict()`` holds the whole state of MuJoCo environments, and a run that goes on
    from it is the same to the last bit. Where :attr:`supports_state` is False it raises, and the
    caller has to start new episodes.

    Args:
        env_id: a registered Gymnasium id with a vector observation and a Box action, for example
            ``"Walker2d-v5"``.
        num_envs: number of environments, at least 1.

    Keyword Args:
        seed: seed as in ``set_seed``. Default: None, seeds from the operating system.
        device: device of the tensors that come out. The simulators run on the CPU.
        dtype: ``torch.float32`` or ``torch.float64``, of observations and rewards. Actions have
            the dtype of the Gymnasium action space.
        max_episode_steps: steps after which an episode is truncated. Default: None, as registered;
            -1: no limit.
        num_threads: threads that step the environments, each its own share; the results do not
            depend on it. MuJoCo runs outside the interpreter lock, so that a second thread pays
            where a second core is free.
        **make_kwargs: passed to ``gymnasium.make``, for example ``render_mode="rgb_array"``.

    Raises:
        ValueError: where the id is unknown, the observation is not a vector, the action is not a
            vector of bounded numbers, or a number is out of range.
        TypeError: where ``dtype`` is not ``torch.float32`` or ``torch.float64``.

    Examples:
        >>> env = GymnasiumBatchEnv("InvertedPendulum-v5", 3, seed=0)
        >>> rollout = env.rollout(20, break_when_any_done=False)
        >>> rollout["next", "reward"].shape
        torch.Size([3, 20, 1])
        >>> again = GymnasiumBatchEnv("InvertedPendulum-v5", 3, seed=0)
        >>> bool((again.reset()["observation"] == rollout["observation"][:, 0]).all())
        True
    """

    # `frame_skip` in `make_kwargs` belongs to the simulator: TorchRL must not add its own.
    _has_frame_skip = True

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
        **make_kwargs: Any,
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
        self.make_kwargs = make_kwargs
        registered = find_limit(env_id)
        self.max_episode_steps = registered if max_episode_steps is None else max_episode_steps
        if self.max_episode_steps == -1:
            self.max_episode_steps = None
        self._build()
        self._elapsed = np.zeros(num_envs, dtype=np.int64)
        self._seeds = np.full(num_envs, _NO_SEED, dtype=np.int64)
        self._started = np.zeros(num_envs, dtype=bool)
        self._all_started = False
        self._make_specs()
        if seed is not None:
            self.set_seed(seed)

    # Construction ---------------------------------------------------------------------------

    def _build(self) -> None:
        """Make the Gymnasium environments and look up what the hot loop needs."""
        self.envs = make_simulators(self.env_id, self.num_envs, self.make_kwargs)
        self._steps = [env.step for env in self.envs]
        self._pool: ThreadPoolExecutor | None = None
        share = -(-self.num_envs // self.num_threads)
        starts = range(0, self.num_envs, share)
        self._shares = [range(i, min(i + share, self.num_envs)) for i in starts]
        action: Any = self.envs[0].action_space
        self._action_low, self._action_high = action.low, action.high
        observation: Any = self.envs[0].observation_space
        self._obs_dim: int = observation.shape[0]
        self._observation = np.zeros((self.num_envs, self._obs_dim))
        self.is_closed = False

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
        arrays = (action, observation, reward, terminated, truncated)
        mask = tensordict.get("_step", None)
        if mask is not None:
            rows: Any = np.flatnonzero(mask.cpu().numpy().reshape(n))
            # A row that is not stepped keeps its observation and its flags, with reward 0.
            observation[:] = self._observation
            for flag, name in ((terminated, "terminated"), (truncated, "truncated")):
                if (last := tensordict.get(name, None)) is not None:
                    flag[:] = last.cpu().numpy()
            self._step_rows(rows.tolist(), *arrays)
            self._elapsed[rows] += 1
        else:
            if self.num_threads == 1:
                self._step_rows(self._shares[0], *arrays)
            else:
                self._step_threads(*arrays)
            self._elapsed += 1
            rows = slice(None)
        if self.max_episode_steps is not None:
            truncated[rows, 0] |= self._elapsed[rows] >= self.max_episode_steps
        self._observation = observation
        return self._pack(observation, terminated, truncated, reward)

    def _step_rows(
        self,
        rows: Sequence[int],
        action: NDArray[Any],
        observation: NDArray[np.float64],
        reward: NDArray[np.float64],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
    ) -> None:
        """Step the environments ``rows`` one after the other and write what they return."""
        steps = self._steps
        for i in rows:
            observation[i], reward[i], terminated[i], truncated[i], _ = steps[i](action[i])

    def _step_threads(self, *arrays: NDArray[Any]) -> None:
        """Step the shares in threads; each writes rows of its own, so their order is free."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(len(self._shares) - 1, "gymnasium-batch")
        others = [self._pool.submit(self._step_rows, s, *arrays) for s in self._shares[1:]]
        self._step_rows(self._shares[0], *arrays)
        for other in others:
            other.result()

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        del kwargs  # `options` and the like have no batched meaning
        mask = None if tensordict is None else tensordict.get("_reset", None)
        n = self.num_envs
        rows = range(n) if mask is None else np.flatnonzero(mask.cpu().numpy().reshape(n)).tolist()
        observation = self._observation.copy()
        for i in rows:
            seed = int(self._seeds[i])
            observation[i], _ = self.envs[i].reset(seed=None if seed == _NO_SEED else seed)
            self._seeds[i] = _NO_SEED
            self._elapsed[i] = 0
            self._started[i] = True
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
        device, dtype = self.device, self.dtype
        # `observation` is kept as the row memory, so that float64 needs a copy of its own.
        source = {
            "observation": torch.from_numpy(observation).to(device, dtype, copy=True),
            "done": torch.from_numpy(terminated | truncated),
            "terminated": torch.from_numpy(terminated),
            "truncated": torch.from_numpy(truncated),
        }
        if reward is not None:
            source["reward"] = torch.from_numpy(reward).to(device, dtype)
        return TensorDict(source, batch_size=self.batch_size, device=device)

    def _set_seed(self, seed: int | None) -> None:
        if seed is None:
            self._seeds[:] = _NO_SEED
            return
        if seed < 0:
            raise ValueError(f"`seed` must be a non-negative integer, got {seed}.")
        self._seeds[:] = np.random.SeedSequence(seed).generate_state(self.num_envs)

    # Saving ---------------------------------------------------------------------------------

    @property
    def supports_state(self) -> bool:
        """Tell whether the whole state can be saved: True for plain MuJoCo environments."""
        return all(is_mujoco(env) for env in self.envs)

    def get_extra_state(self) -> dict[str, Any]:
        """Return the whole state as tensors: simulators, generators, clocks and pending seeds.

        ``state_dict()`` calls it. Everything is a tensor, so that ``torch.load`` reads it back
        with ``weights_only=True``.

        Returns:
            ``simulators`` (see below), ``elapsed`` int64 ``(num_envs,)`` steps since the reset,
            ``seeds`` int64 ``(num_envs,)`` seeds that the next reset uses (-1: none), ``started``
            bool ``(num_envs,)``, and ``observation`` float64 ``(num_envs, obs)``.

        Raises:
            RuntimeError: where :attr:`supports_state` is False.
        """
        if not self.supports_state:
            raise RuntimeError(
                f"`{self.env_id}` is not a plain MuJoCo environment and its state can not be "
                "saved: look at `supports_state` and start new episodes instead."
            )
        return {
            "simulators": simulator_state(self.envs),
            "elapsed": torch.from_numpy(self._elapsed.copy()),
            "seeds": torch.from_numpy(self._seeds.copy()),
            "started": torch.from_numpy(self._started.copy()),
            "observation": torch.from_numpy(self._observation.copy()),
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that :meth:`get_extra_state` returned; ``load_state_dict`` calls it.

        Args:
            state: the tensors that :meth:`get_extra_state` returned.

        Raises:
            ValueError: where the state is of another environment, another number of
                environments, or incomplete.
            RuntimeError: where :attr:`supports_state` is False.
        """
        if not self.supports_state:
            raise RuntimeError(
                f"`{self.env_id}` is not a plain MuJoCo environment and has no state to restore."
            )
        shapes = {
            "elapsed": (self.num_envs,),
            "seeds": (self.num_envs,),
            "started": (self.num_envs,),
            "observation": (self.num_envs, self._obs_dim),
        }
        for name, shape in shapes.items():
            given = tuple(state[name].shape) if name in state else "nothing"
            if given != shape:
                raise ValueError(
                    f"`state[{name!r}]` must have shape {shape} for {self.num_envs} x "
                    f"{self.env_id}, got {given}: is it the state of another environment?"
                )
        if "simulators" not in state:
            raise ValueError("`state` must hold `simulators`: is the file complete?")
        load_simulator_state(self.envs, state["simulators"])
        self._elapsed = state["elapsed"].cpu().numpy().astype(np.int64)
        self._seeds = state["seeds"].cpu().numpy().astype(np.int64)
        self._started = state["started"].cpu().numpy().astype(bool)
        self._all_started = bool(self._started.all())
        self._observation = state["observation"].cpu().numpy().astype(np.float64)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a pickle or a deep copy needs: Gymnasium's own pickles lose the state."""
        state = self.__dict__.copy()
        for name in ("envs", "_steps", "_pool"):
            del state[name]
        state["_saved"] = self.get_extra_state() if self.supports_state else None
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make the simulators again and put them where they were, if their state was saved."""
        saved = state.pop("_saved")
        super().__setstate__(state)
        self._build()
        if saved is not None:
            self.set_extra_state(saved)
        else:
            self._started[:] = False
            self._all_started = False

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
        for env in self.envs:
            env.close()
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def __repr__(self) -> str:
        """Name the task, the number of environments and the device."""
        return (
            f"{type(self).__name__}({self.env_id!r}, num_envs={self.num_envs}, "
            f"device={self.device}, dtype={self.dtype})"
        )


def _check_count(name: str, value: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"`{name}` must be an integer of at least 1, got {value!r}.")
