"""Many EnvPool simulators as one TorchRL environment, one TensorDict a step.

EnvPool steps in C++ threads of its own. It starts the next episode by itself when a finished
simulator is stepped, and calls an episode that terminates on the last step of the time limit
truncated. Both are avoided: its own limit is out of reach and finished rows are reset by number.
"""

import difflib
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from torchrl_drbpn.envs.simulator_batch import NO_SEED, SimulatorBatch, StepArrays

# Not the largest int32: EnvPool adds one to it.
_NO_LIMIT = 2**30


class EnvPoolBatchEnv(SimulatorBatch):
    r"""Step many EnvPool simulators as one TorchRL environment with batch size ``[num_envs]``.

    Arguments, keys, specs and the way an episode ends are those of
    :class:`~torchrl_drbpn.GymnasiumBatchEnv`, with ids of EnvPool and without ``make_kwargs``; the
    threads are EnvPool's own. The package is an extra: ``pip install 'torchrl-drbpn[envpool]'``.

    What differs:

    - EnvPool 1.2.5 carries MuJoCo 3.6, so that trajectories from equal states agree with those of
      Gymnasium on MuJoCo 4.0 closely, not exactly, and its random numbers are others: a seed gives
      other first observations. Rewards are rounded to ``float32`` inside.
    - A new seed makes the simulators anew at the next reset, and every row has to be reset before
      the next step.
    - A terminated row can not be stepped on: EnvPool would start the next episode.
    - The state can not be saved: :attr:`supports_state` is False; a copy or a pickle starts new
      episodes. Resets of MuJoCo by itself can not be seen: :attr:`engine_resets` stays 0.

    Examples:
        >>> env = EnvPoolBatchEnv("InvertedPendulum-v5", 3, seed=0)
        >>> bool((env.reset(seed=0)["observation"] == env.reset(seed=0)["observation"]).all())
        True
    """

    def _build(self) -> tuple[Any, Any, int | None, int | None]:
        """Look up the sizes; the simulators are made at the first reset, when seeds are known."""
        if self.make_kwargs:
            raise TypeError(f"`EnvPoolBatchEnv` takes no {sorted(self.make_kwargs)}.")
        try:
            import envpool
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                "`EnvPoolBatchEnv` needs EnvPool, which is not installed: "
                "pip install 'torchrl-drbpn[envpool]'."
            ) from error
        known = envpool.list_all_envs()
        if self.env_id not in known:
            near = ", ".join(difflib.get_close_matches(self.env_id, known, n=4, cutoff=0.5))
            raise ValueError(
                f"`env_id` must be an id of EnvPool, got {self.env_id!r}: "
                + (f"did you mean {near}?" if near else "envpool.list_all_envs() names them.")
            )
        spec = envpool.make_spec(self.env_id)
        self._pool: Any = None
        self._over = np.zeros(self.num_envs, dtype=bool)
        # Gymnasium computes contact forces in every version, EnvPool by default in v5 only: those
        # in the observation of Humanoid-v4 would stay 0.
        contacts = hasattr(spec.config, "post_constraint")
        self._config = {"post_constraint": True} if contacts else {}
        action = spec.gymnasium_action_space
        if isinstance(action, gymnasium.spaces.Box):  # of float64 in EnvPool
            low, high = action.low.astype(np.float32), action.high.astype(np.float32)
            action = gymnasium.spaces.Box(low, high)
        seen = self._chosen(spec.gymnasium_observation_space)
        if self.joined_keys is not None:
            seen = gymnasium.spaces.flatten_space(seen)
        return seen, action, int(spec.config.max_episode_steps), None

    def _set_seed(self, seed: int | None) -> None:
        super()._set_seed(seed)
        self._pool = None
        self._started[:] = False

    def _restart(
        self, rows: NDArray[np.int64], observation: NDArray[np.float64], options: Any
    ) -> None:
        if options:
            raise ValueError(f"EnvPool's simulators take no `options` at a reset, got {options}.")
        if self._pool is None or (self._seeds[rows] != NO_SEED).any():
            self._make_pool()
        if len(rows):
            observation[rows] = self._vectors(self._pool.reset(rows.astype(np.int32))[0])
            self._over[rows] = False

    def _make_pool(self) -> None:
        """Make the simulators with the pending seeds, or with fresh ones where there are none."""
        import envpool

        fresh = np.random.SeedSequence().generate_state(self.num_envs)
        words = np.where(self._seeds == NO_SEED, fresh, self._seeds).astype(np.uint32)
        self._pool = envpool.make_gymnasium(
            self.env_id,
            num_envs=self.num_envs,
            # EnvPool takes signed numbers of 32 bits and feeds their bits to its generators.
            env_seed=words.view(np.int32),
            num_threads=self.num_threads,
            max_episode_steps=_NO_LIMIT,
            **self._config,
        )
        self._over[:] = self._started[:] = False

    def _vectors(self, seen: Any) -> Any:
        if self.joined_keys is None:
            return seen
        return np.concatenate([seen[k].reshape(len(seen[k]), -1) for k in self.joined_keys], 1)

    def _advance(self, rows: NDArray[np.int64] | None, arrays: StepArrays) -> None:
        chosen = np.arange(self.num_envs) if rows is None else rows
        if self._over[chosen].any():
            row = chosen[self._over[chosen]][0]
            raise RuntimeError(
                f"`{type(self).__name__}` row {row} has terminated and was stepped on: EnvPool "
                "would start the next episode. Reset it first, as step_and_maybe_reset does."
            )
        if len(chosen):
            numbered = () if rows is None else (rows,)
            seen, gained, ended, _, _ = self._pool.step(arrays.action[chosen], *numbered)
            # EnvPool's own limit, which would truncate, is out of reach
            arrays.observation[chosen], arrays.reward[chosen, 0] = self._vectors(seen), gained
            arrays.terminated[chosen, 0] = ended
            self._over[chosen] = ended

    def _close_simulators(self) -> None:
        # EnvPool ends its threads where the last reference goes.
        self._pool = None

    def __getstate__(self) -> dict[str, Any]:
        """Return what a pickle or a deep copy needs: everything but the simulators."""
        return self.__dict__ | {"_pool": None, "_started": np.zeros_like(self._started)}
