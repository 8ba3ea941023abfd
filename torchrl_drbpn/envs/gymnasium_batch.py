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

from torchrl_drbpn.envs.batched import NO_SEED, BatchedSimulators
from torchrl_drbpn.envs.making import find_limit, make_simulators
from torchrl_drbpn.envs.simulator_state import (
    is_mujoco,
    load_simulator_state,
    simulator_state,
)

__all__ = ["GymnasiumBatchEnv"]


class GymnasiumBatchEnv(BatchedSimulators):
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
    from it is the same to the last bit. Where :attr:`supports_state` is False it is empty, and the
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
        self.make_kwargs = make_kwargs
        super().__init__(
            env_id,
            num_envs,
            seed=seed,
            device=device,
            dtype=dtype,
            max_episode_steps=max_episode_steps,
            num_threads=num_threads,
        )

    # Construction ---------------------------------------------------------------------------

    def _find_limit(self) -> int | None:
        return find_limit(self.env_id)

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
        self._obs_dim = observation.shape[0]

    # Stepping -------------------------------------------------------------------------------

    def _advance(self, rows: NDArray[np.int64] | None, *arrays: NDArray[Any]) -> None:
        if rows is not None:
            self._step_rows(rows.tolist(), *arrays)
        elif self.num_threads == 1:
            self._step_rows(self._shares[0], *arrays)
        else:
            self._step_threads(*arrays)

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

    def _restart(self, rows: NDArray[np.int64], observation: NDArray[np.float64]) -> None:
        for i in rows.tolist():
            seed = int(self._seeds[i])
            observation[i], _ = self.envs[i].reset(seed=None if seed == NO_SEED else seed)

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
            bool ``(num_envs,)``, and ``observation`` float64 ``(num_envs, obs)``. Empty where
            :attr:`supports_state` is False.
        """
        if not self.supports_state:
            return super().get_extra_state()
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
            RuntimeError: for a state where :attr:`supports_state` is False.
        """
        if not self.supports_state:
            super().set_extra_state(state)
            return
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

    def _why_no_state(self) -> str:
        return "it is not a plain MuJoCo environment"

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
        self.is_closed = False
        if saved is not None:
            self.set_extra_state(saved)
        else:
            self._forget_episodes()

    def _close_simulators(self) -> None:
        for env in self.envs:
            env.close()
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None
