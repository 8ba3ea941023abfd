"""An agent that a run has trained, read from its folder: the only place that builds one anew."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from omegaconf import DictConfig
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs import TransformedEnv
from training.agent import Agent, load_agent
from training.envs import make_env
from training.errors import UserError
from training.methods import method_name
from training.run_folder import load_config
from training.sensors import sensor_names

from evaluation.episodes import BLOCK, make_evaluation_environment
from torchrl_drbpn import BeliefFilterModule


@dataclass(frozen=True)
class TrainedAgent:
    """The last checkpoint of a run, ready to act.

    Attributes:
        settings: configuration of the run.
        agent: with the trained weights.
        frames: environment steps of the checkpoint.
        method: what it is called in tables and figures.
    """

    settings: DictConfig
    agent: Agent
    frames: int
    method: str

    @property
    def obs_dim(self) -> int:
        """Return the number of sensors."""
        return self.agent.norm.obs_dim

    @property
    def sensors(self) -> list[str]:
        """Return the names of the sensors."""
        return sensor_names(self.settings.env.id, self.settings.env.version, self.obs_dim)

    @property
    def observing_policy(self) -> TensorDictSequential:
        """Return a policy that also writes what the belief knows of the sensors."""
        make, agent = self.agent.observing, self.agent
        return TensorDictSequential(agent.norm, make() if make else agent.belief, agent.actor)

    def environments(
        self,
        missingness: DictConfig | None = None,
        noise: DictConfig | None = None,
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
                self.agent,
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
    config = load_config(folder)
    with closing(make_env(config, num_envs=1)) as env:
        agent, frames = load_agent(folder, config, env)
    trained = TrainedAgent(config, agent, frames, method_name(config))
    return trained if gate is None else _gated(trained, gate)


def _gated(trained: TrainedAgent, gate: float) -> TrainedAgent:
    module = trained.agent.belief
    if not isinstance(module, BeliefFilterModule):
        raise UserError(
            f"`gate` must be null for belief={trained.settings.belief.name}, got {gate!r}: "
            "only belief=drbpn has a forecast of its readings to hold them against."
        )
    try:
        module.gate = gate
    except ValueError as error:
        raise UserError(str(error)) from error
    return replace(trained, method=f"{trained.method}, gate {gate:g}")
