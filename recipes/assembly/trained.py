"""An agent that a run has trained, read from its folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from torchrl.envs import TransformedEnv

from assembly.agent import Agent, add_primers
from assembly.beliefs import Belief
from assembly.checkpoint import last_checkpoint, load_checkpoint
from assembly.environment import make_environment
from assembly.errors import UserError
from assembly.run_folder import read_config
from assembly.settings import Settings, read_settings
from assembly.training import make_agent


@dataclass(frozen=True)
class TrainedAgent:
    """The last checkpoint of a run, ready to act.

    Attributes:
        settings: of the run.
        belief: its belief module and what belongs to it.
        agent: with the trained weights.
        statistics: an environment that holds the trained normalisation.
        frames: environment steps of the checkpoint.
    """

    settings: Settings
    belief: Belief
    agent: Agent
    statistics: TransformedEnv
    frames: int


def load_trained_agent(folder: Path) -> TrainedAgent:
    """Read the last checkpoint of a run.

    Args:
        folder: the run folder.

    Returns:
        The agent and what it was trained with.

    Raises:
        UserError: if the folder or the checkpoint can't be used.
    """
    settings = read_settings(read_config(folder))
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
    return TrainedAgent(settings, belief, agent, statistics, frames)
