"""Many EnvPool simulators as one TorchRL environment, one TensorDict a step.

EnvPool steps its simulators in C++ threads of its own, without the interpreter between them. It
starts the next episode by itself when a finished simulator is stepped, and it calls an episode
that terminates on the last step of the time limit truncated. Both are avoided here: its own time
limit is set out of reach and kept by `BatchedSimulators`, and finished rows are reset by number.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchrl_drbpn.envs.batched import NO_SEED, BatchedSimulators
from torchrl_drbpn.envs.making import check_spaces, near_ids

__all__ = ["EnvPoolBatchEnv"]

# Not the largest int32: EnvPool adds one to it.
_NO_LIMIT = 2**30


class EnvPoolBatchEnv(BatchedSimulators):
    r"""Step many EnvPool simulators as one TorchRL environment with batch size ``[num_envs]``.

    Keys, specs and the manners of an episode's end are those of
    :class:`~torchrl_drbpn.GymnasiumBatchEnv`: where an episode ends,
    ``("next", "observation")`` holds its true last observation, only the rows asked for are
    reset, and actions outside the Box are clipped to it. The package is an extra:
    ``pip install 'torchrl-drbpn[envpool]'``; it is imported when the first object is made.

    What differs from ``GymnasiumBatchEnv``:

    - EnvPool 1.2.5 carries MuJoCo 3.6, so that trajectories from equal states agree with those of
      Gymnasium on MuJoCo 4.0 closely, not exactly, and its random numbers are others: a seed gives
      other first observations. Rewards are rounded to ``float32`` inside.
    - The seeds of EnvPool are fixed where the simulators are made. ``set_seed`` therefore makes
      them anew at the next reset, and every row has to be reset before the next step.
    - A terminated row can not be stepped on: EnvPool would start the next episode unasked.
    - The state can not be saved: :attr:`supports_state` is False, ``state_dict()`` is empty, and
      the caller has to start new episodes. A copy or a pickle starts new episodes too.
    - There is no rendering, and there are no keyword arguments for the task.

    Args:
        env_id: an id of EnvPool with a vector observation and a Box action, for example
            ``"Walker2d-v5"``.
        num_envs: number of environments, at least 1.

    Keyword Args:
        seed: seed as in ``set_seed``: sub-environment ``i`` gets the ``i``-th word of
            ``numpy.random.SeedSequence(seed)``. Default: None, seeds from the operating system.
        device: device of the tensors that come out. The simulators run on the CPU.
        dtype: ``torch.float32`` or ``torch.float64``, of observations and rewards. Actions are
            ``torch.float32``, as those of the Gymnasium tasks.
        max_episode_steps: steps after which an episode is truncated. Default: None, as registered;
            -1: no limit.
        num_threads: C++ threads that step the environments while the caller waits; the results do
            not depend on it.

    Raises:
        ModuleNotFoundError: where EnvPool is not installed.
        ValueError: where the id is unknown, the observation is not a vector, the action is not a
            vector of bounded numbers, or a number is out of range.
        TypeError: where ``dtype`` is not ``torch.float32`` or ``torch.float64``.

    Examples:
        >>> env = EnvPoolBatchEnv("InvertedPendulum-v5", 3, seed=0)
        >>> rollout = env.rollout(20, break_when_any_done=False)
        >>> rollout["next", "reward"].shape
        torch.Size([3, 20, 1])
        >>> again = EnvPoolBatchEnv("InvertedPendulum-v5", 3, seed=0)
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
    ) -> None:
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

    def _find_limit(self) -> int:
        envpool = _import_envpool()
        known = envpool.list_all_envs()
        if self.env_id not in known:
            hint = near_ids(self.env_id, known) or "envpool.list_all_envs() names them."
            raise ValueError(f"`env_id` must be an id of EnvPool, got {self.env_id!r}: {hint}")
        return int(envpool.make_spec(self.env_id).config.max_episode_steps)

    def _build(self) -> None:
        """Look up the sizes; the simulators are made at the first reset, when seeds are known."""
        spec = _import_envpool().make_spec(self.env_id)
        observation: Any = spec.gymnasium_observation_space
        action: Any = spec.gymnasium_action_space
        check_spaces(self.env_id, observation, action)
        self._obs_dim = observation.shape[0]
        self._action_low = action.low.astype(np.float32)
        self._action_high = action.high.astype(np.float32)
        self._pool: Any = None

    def _make_pool(self) -> None:
        """Make the simulators with the pending seeds, or with fresh ones where there are none."""
        envpool = _import_envpool()
        config: dict[str, Any] = {}
        if hasattr(envpool.make_spec(self.env_id).config, "post_constraint"):
            # Gymnasium computes contact forces in every version, EnvPool by default in v5 only:
            # those in the observation of Humanoid-v4 would stay 0.
            config["post_constraint"] = True
        fresh = np.random.SeedSequence().generate_state(self.num_envs)
        words = np.where(self._seeds == NO_SEED, fresh, self._seeds).astype(np.uint32)
        self._pool = envpool.make_gymnasium(
            self.env_id,
            num_envs=self.num_envs,
            # EnvPool takes signed numbers of 32 bits and feeds their bits to its generators.
            env_seed=words.view(np.int32),
            num_threads=self.num_threads,
            max_episode_steps=_NO_LIMIT,
            **config,
        )

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        self._pool = None
        self._forget_episodes()

    # Stepping -------------------------------------------------------------------------------

    def _forget_episodes(self) -> None:
        super()._forget_episodes()
        self._over = np.zeros(self.num_envs, dtype=bool)

    def _advance(
        self,
        rows: NDArray[np.int64] | None,
        action: NDArray[Any],
        observation: NDArray[np.float64],
        reward: NDArray[np.float64],
        terminated: NDArray[np.bool_],
        truncated: NDArray[np.bool_],
    ) -> None:
        del truncated  # EnvPool's own limit is out of reach
        over = self._over if rows is None else self._over[rows]
        if over.any():
            row = int(over.argmax()) if rows is None else int(rows[over][0])
            raise RuntimeError(
                f"`{type(self).__name__}` row {row} has terminated and was stepped on: EnvPool "
                "would start the next episode. Reset it first, as step_and_maybe_reset does."
            )
        if rows is None:
            seen, gained, ended, _, _ = self._pool.step(action)
            observation[:], reward[:, 0], terminated[:, 0] = seen, gained, ended
            self._over = ended
        elif len(rows):
            seen, gained, ended, _, _ = self._pool.step(action[rows], rows)
            observation[rows], reward[rows, 0], terminated[rows, 0] = seen, gained, ended
            self._over[rows] = ended

    def _restart(self, rows: NDArray[np.int64], observation: NDArray[np.float64]) -> None:
        if self._pool is None:
            self._make_pool()
        if len(rows):
            observation[rows], _ = self._pool.reset(rows.astype(np.int32))
            self._over[rows] = False

    # Saving and closing ---------------------------------------------------------------------

    def _why_no_state(self) -> str:
        return "EnvPool keeps its simulators and their random generators to itself"

    def __getstate__(self) -> dict[str, Any]:
        """Return what a pickle or a deep copy needs: everything but the simulators."""
        state = self.__dict__.copy()
        state["_pool"] = None
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Put the settings back; the simulators are made at the next reset."""
        super().__setstate__(state)
        self._forget_episodes()

    def _close_simulators(self) -> None:
        # EnvPool ends its threads where the last reference goes.
        self._pool = None


def _import_envpool() -> Any:
    try:
        import envpool
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "`EnvPoolBatchEnv` needs EnvPool, which is not installed: "
            "pip install 'torchrl-drbpn[envpool]'."
        ) from error
    return envpool
