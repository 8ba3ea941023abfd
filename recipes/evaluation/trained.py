"""An agent that a run has trained, read from its folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from beliefs import Belief
from torchrl.envs import TransformedEnv
from training.agent import Agent, add_primers
from training.checkpoint import checkpoint_frames, last_checkpoint, load_checkpoint
from training.config import Settings, read_settings
from training.console import say
from training.envs import make_environment
from training.errors import UserError
from training.loop import make_agent
from training.methods import method_name
from training.run_folder import read_config

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
        method: what it is called in tables and figures, see :mod:`training.methods`.
    """

    settings: Settings
    belief: Belief
    agent: Agent
    statistics: TransformedEnv
    frames: int
    method: str


def load_trained_agent(folder: Path) -> TrainedAgent:
    """Read the last checkpoint of a run.

    Args:
        folder: the run folder.

    Returns:
        The agent and what it was trained with.

    Raises:
        UserError: if the folder or the checkpoint can't be used.
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
    return TrainedAgent(settings, belief, agent, statistics, frames, method_name(config))


def gated(trained: TrainedAgent, gate: float | None) -> TrainedAgent:
    """Let an agent bound what a reading far from its forecast does to its belief.

    Args:
        trained: the agent; its belief module is changed in place.
        gate: standard deviations of the innovation; None: every reading is believed.

    Returns:
        The agent. Its method names the gate, so that no table or figure takes it for the one
        without.

    Raises:
        UserError: if its belief forecasts no readings, or the gate is refused.
    """
    if gate is None:
        return trained
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


def with_checkpoint(folders: Sequence[Path]) -> list[Path]:
    """Leave out runs that have not got to their first checkpoint, and say so.

    Args:
        folders: run folders.

    Returns:
        Those with a checkpoint; all, where none has one: reading the first says what is wrong.
    """
    found = [folder for folder in folders if checkpoint_frames(folder) is not None]
    if not found:
        return list(folders)
    for folder in folders:
        if folder not in found:
            say(f"{folder.name}: left out, it has no checkpoint yet")
    return found
