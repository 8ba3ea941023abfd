"""An agent that a run has trained, read from its folder: the only place that builds one anew."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from beliefs import Belief
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs import TransformedEnv
from training.agent import Agent, add_primers
from training.checkpoint import last_checkpoint, load_checkpoint
from training.config import MissingnessSettings, NoiseSettings, Settings, read_settings
from training.envs import make_environment
from training.errors import UserError
from training.loop import make_agent
from training.methods import method_name
from training.run_folder import read_config
from training.sensors import sensor_names

from evaluation.episodes import BLOCK, make_evaluation_environment
from torchrl_drbpn import BeliefFilterModule


@dataclass(frozen=True)
class TrainedAgent:
    """The last checkpoint of a run, ready to act.

    Attributes:
        settings: of the run.
        belief: its belief module and what belongs to it.
        agent: with the trained weights.
        statistics: an environment that holds the trained normalisation.
        frames: environment steps of the checkpoint.
        method: what it is called in tables and figures.
    """

    settings: Settings
    belief: Belief
    agent: Agent
    statistics: TransformedEnv
    frames: int
    method: str

    @property
    def obs_dim(self) -> int:
        """Return the number of sensors."""
        return self.statistics.observation_spec["observation"].shape[-1]

    @property
    def sensors(self) -> list[str]:
        """Return the names of the sensors."""
        return sensor_names(self.settings.env.id, self.settings.env.version, self.obs_dim)

    @property
    def observing_policy(self) -> TensorDictSequential:
        """Return a policy that also writes what the belief knows of the sensors."""
        make = self.belief.observing
        return TensorDictSequential(make() if make else self.agent.belief, self.agent.actor)

    def environments(
        self,
        missingness: MissingnessSettings | None = None,
        noise: NoiseSettings | None = None,
        removed: Tensor | None = None,
        *,
        complete: bool = False,
    ) -> Callable[[int], TransformedEnv]:
        """Return what builds the environment of each block of episodes.

        Args:
            missingness: what does not arrive; None: as in training.
            noise: what is added to what arrives; None: as in training.
            removed: components that never arrive, bool of shape ``(episodes, obs)``; None: none.
            complete: whether to write ``complete_observation``, normalised alike.

        Returns:
            A function of the block's number, see :func:`evaluation.episodes.run_episodes`.
        """

        def make(block: int) -> TransformedEnv:
            gone = None
            if removed is not None:
                gone = removed.new_zeros(BLOCK, self.obs_dim)
                own = removed[block * BLOCK : (block + 1) * BLOCK]
                gone[: len(own)] = own
            return make_evaluation_environment(
                self.settings,
                self.belief,
                self.agent,
                statistics=self.statistics,
                missingness=missingness,
                noise=noise,
                complete=complete,
                removed=gone,
            )

        return make


def load_trained_agent(folder: Path, gate: float | None = None) -> TrainedAgent:
    """Read the last checkpoint of a run.

    Args:
        folder: the run folder.
        gate: standard deviations of the innovation, beyond which a reading counts as if at that
            distance; None: every reading is believed. The agent's method names it.

    Returns:
        The agent and what it was trained with.

    Raises:
        UserError: if the folder or the checkpoint can't be used, or the gate is refused.
    """
    config = read_config(folder)
    settings = read_settings(config)
    path = last_checkpoint(folder)
    state = load_checkpoint(path)
    belief, agent = make_agent(settings)
    statistics = make_environment(
        settings.env,
        settings.missingness,
        settings.noise,
        settings.normalisation,
        num_envs=1,
        num_threads=1,
        gamma=settings.loss.gamma,
        seed=settings.seed,
        after_normalisation=belief.transforms(),
    )
    add_primers(statistics, agent)
    try:
        agent.load_state_dict(state["agent"])
        statistics.load_state_dict(state["transforms"])
        frames = int(state["progress"]["frames"])
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise UserError(
            f"`{path}` does not fit {folder / 'config.yaml'}: {' '.join(str(error).split())[:300]}"
        ) from error
    trained = TrainedAgent(settings, belief, agent, statistics, frames, method_name(config))
    return trained if gate is None else _gated(trained, gate)


def _gated(trained: TrainedAgent, gate: float) -> TrainedAgent:
    module = trained.agent.belief
    if not isinstance(module, BeliefFilterModule):
        raise UserError(
            f"`gate` must be null for belief={trained.settings.belief.get('name')}, got {gate!r}: "
            "only belief=drbpn has a forecast of its readings to hold them against."
        )
    try:
        module.gate = gate
    except ValueError as error:
        raise UserError(str(error)) from error
    return replace(trained, method=f"{trained.method}, gate {gate:g}")
