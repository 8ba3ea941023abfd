"""Many Gymnasium environments as one TorchRL environment, one TensorDict a step."""

import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import flatten, flatten_space
from gymnasium.wrappers import OrderEnforcing, TransformObservation
from numpy.typing import NDArray

from torchrl_drbpn.envs.mujoco_engine import (
    bad_state_counters,
    load_state,
    model_warnings_once,
    save_state,
)
from torchrl_drbpn.envs.simulator_batch import NO_SEED, SimulatorBatch, StepArrays, one_line


class GymnasiumBatchEnv(SimulatorBatch):
    r"""Step many Gymnasium environments as one TorchRL environment with batch size ``[num_envs]``.

    The trajectories are those of ``gymnasium.make(env_id)``, bit for bit in ``float64``: the same
    wrappers, time limits and seeding, no change of reward or observation. Where an episode ends,
    ``("next", "observation")`` holds its true last observation, and TorchRL's
    ``step_and_maybe_reset``, ``rollout`` and collectors reset the finished rows. Actions outside
    the Box are clipped to it before the step.

    Seeds: ``set_seed(s)`` and ``reset(seed=s)`` give sub-environment ``i`` the ``i``-th word of
    ``numpy.random.SeedSequence(s)``, so that neighbouring seeds share no sub-environment (as
    ``s + i`` would). The next reset of a row uses its seed, once; later resets go on from there.

    Faults: where MuJoCo gives up its state (it resets itself after huge velocities, and drops
    controls that are NaN), the step is counted in :attr:`engine_resets`, a first one warns, and the
    episode ends as truncated. A simulator that raises, or returns a reward that is not finite,
    raises :class:`SimulatorError`.

    Saving: ``state_dict()`` holds the whole state of MuJoCo environments, for runs that go on from
    it to the last bit. Where :attr:`supports_state` is False it is empty: start new episodes.

    Args:
        env_id: a Gymnasium id with a vector observation and a Box action, for example
            ``"Walker2d-v5"``, or ``"module:Name-v0"`` where the module registers it.
        num_envs: number of environments, at least 1.

    Keyword Args:
        seed: seed as in ``set_seed``. Default: None, seeds from the operating system.
        device: device of the tensors that come out. The simulators run on the CPU.
        dtype: ``torch.float32`` or ``torch.float64``, of observations and rewards.
        max_episode_steps: steps after which an episode is truncated. Default: None, as registered;
            -1: no limit. A task's own ``TimeLimit``, in its entry point, counts in every case.
        num_threads: threads that step the environments, each its own share; the results do not
            depend on it.
        observation_keys: entries of a dictionary observation that are joined into one vector.
        wrappers: callables that take an environment and return it wrapped, the innermost first.
        **make_kwargs: passed to ``gymnasium.make``, for example ``render_mode="rgb_array"``.

    Raises:
        ValueError: if the id is unknown, the observation is not a vector, the action is not a
            vector of bounded numbers, or a number is out of range.

    Examples:
        >>> env = GymnasiumBatchEnv("InvertedPendulum-v5", 3, seed=0)
        >>> rollout = env.rollout(20, break_when_any_done=False)
        >>> rollout["next", "reward"].shape
        torch.Size([3, 20, 1])
        >>> again = env.reset(seed=0)
        >>> bool((again["observation"] == rollout["observation"][:, 0]).all())
        True
    """

    def _build(self) -> tuple[Any, Any, int | None, int | None]:
        """Make the environments, without the outermost time limit, which the batch keeps."""
        try:
            with model_warnings_once():
                self.envs = [self._make() for _ in range(self.num_envs)]
            limit = gymnasium.spec(self.env_id.rpartition(":")[2]).max_episode_steps
        except (gymnasium.error.Error, ImportError) as error:
            raise ValueError(
                f"`env_id` must be a registered Gymnasium environment, got {self.env_id!r}: "
                f"{one_line(error)}"
            ) from error
        self._steps = [env.step for env in self.envs]
        self._warned = [bad_state_counters(env) for env in self.envs]
        shares = np.array_split(np.arange(self.num_envs), self.num_threads)
        self._shares: list[list[int]] = [share.tolist() for share in shares]
        self._pool = ThreadPoolExecutor(self.num_threads, "gymnasium-batch")
        env = self.envs[0]
        own = None if env.spec is None else env.spec.max_episode_steps  # a TimeLimit in the task
        return env.observation_space, env.action_space, limit, own

    def _make(self) -> gymnasium.Env[Any, Any]:
        wanted = dict(self.make_kwargs)
        wrappers = wanted.pop("wrappers", ())
        with warnings.catch_warnings():  # a version that was asked for by name is no mistake
            warnings.filterwarnings("ignore", ".*is out of date", DeprecationWarning)
            env = gymnasium.make(
                self.env_id, max_episode_steps=-1, disable_env_checker=True, **wanted
            )
        # The batch itself refuses a step before the first reset.
        env = env.env if isinstance(env, OrderEnforcing) else env
        for wrapper in wrappers:
            env = wrapper(env)
        if self.joined_keys is None:
            return env
        chosen = self._chosen(env.observation_space)
        return TransformObservation(
            env, lambda seen: flatten(chosen, {key: seen[key] for key in chosen}),
            flatten_space(chosen),
        )  # fmt: skip

    def _advance(self, rows: NDArray[np.int64] | None, arrays: StepArrays) -> None:
        shares = self._shares if rows is None else [rows.tolist()]
        # Each thread writes rows of its own, so that their order is free.
        others = [self._pool.submit(self._step_rows, share, arrays) for share in shares[1:]]
        self._step_rows(shares[0], arrays)
        for other in others:
            other.result()

    def _step_rows(self, rows: Sequence[int], arrays: StepArrays) -> None:
        """Step the environments ``rows`` one after the other and write what they return."""
        action, observation, reward, terminated, truncated = arrays
        steps, warned, i = self._steps, self._warned, -1
        try:
            for i in rows:
                observation[i], reward[i], terminated[i], truncated[i], _ = steps[i](action[i])
                if any(warned[i]):
                    truncated[i] = True
                    self._count_engine_reset(i, reward)
        except Exception as error:
            self._fail(i, "raised in `step`", error)

    def _count_engine_reset(self, row: int, reward: NDArray[np.float64]) -> None:
        for k in range(len(self._warned[row])):
            self._warned[row][k] = 0
        if not np.isfinite(reward[row, 0]):
            reward[row] = 0.0
        if not self._engine_resets.any():
            warnings.warn(
                f"MuJoCo gave up the state of environment {row} of `{self.env_id}` after "
                f"{self._elapsed[row]} steps (huge or NaN positions, velocities or actions): such "
                "an episode ends as truncated; `engine_resets` counts them.",
                RuntimeWarning,
                stacklevel=2,
            )
        self._engine_resets[row] += 1

    def _restart(
        self, rows: NDArray[np.int64], observation: NDArray[np.float64], options: Any
    ) -> None:
        for i in rows.tolist():
            seed = None if self._seeds[i] == NO_SEED else int(self._seeds[i])
            try:
                observation[i], _ = self.envs[i].reset(seed=seed, options=options)
            except Exception as error:
                self._fail(i, "raised in `reset`", error)

    def _close_simulators(self) -> None:
        for env in self.envs:
            env.close()
        self._pool.shutdown()

    @property
    def supports_state(self) -> bool:
        """Whether the whole state can be saved: True for MuJoCo environments without wrappers."""
        return all(isinstance(env, MujocoEnv) for env in self.envs)

    def _rows_state(self) -> dict[str, NDArray[Any]]:
        names = ("elapsed", "seeds", "started", "observation", "engine_resets")
        return {name: getattr(self, f"_{name}") for name in names}

    def get_extra_state(self) -> dict[str, Any]:
        """Return the whole state as tensors, which ``torch.load(weights_only=True)`` reads."""
        if not self.supports_state:
            return super().get_extra_state()
        rows = {name: torch.from_numpy(array.copy()) for name, array in self._rows_state().items()}
        return {"simulators": save_state(self.envs), **rows}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Go on from a state that :meth:`get_extra_state` returned, or refuse it."""
        if not self.supports_state:
            super().set_extra_state(state)
            return
        rows = self._rows_state()
        for name, array in rows.items():
            given = tuple(state[name].shape) if name in state else "nothing"
            if given != array.shape:
                raise ValueError(
                    f"`state[{name!r}]` must have shape {array.shape} for {self.num_envs} x "
                    f"{self.env_id}, got {given}: is it the state of another environment?"
                )
        if "simulators" not in state:
            raise ValueError("`state` must hold `simulators`: is the file complete?")
        load_state(self.envs, state["simulators"])
        for name, array in rows.items():
            array[...] = state[name].cpu().numpy()

    def __getstate__(self) -> dict[str, Any]:
        """Return what a pickle or a deep copy needs: Gymnasium's own pickles lose the state."""
        state = self.__dict__.copy()
        for name in ("envs", "_steps", "_warned", "_pool"):
            del state[name]
        return state | {"_saved": self.get_extra_state()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Make the simulators again, in the state that was saved, if any."""
        saved = state.pop("_saved")
        super().__setstate__(state)
        self._build()
        self.is_closed = False
        if saved:
            self.set_extra_state(saved)
        else:
            self._started[:] = False
