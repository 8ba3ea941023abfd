"""An agent that a run has trained, read from its folder: the only place that builds one anew."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

from omegaconf import DictConfig
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs import TransformedEnv
from training.agent import Agent, load_agent, make_agent
from training.checkpoint import fitting
from training.envs import make_env
from training.errors import UserError
from training.methods import method_name
from training.run_folder import load_config
from training.sensors import sensor_names

from evaluation.episodes import BLOCK, make_evaluation_environment
from torchrl_drbpn import BeliefFilterModule

WEIGHTS = "agent.safetensors"  # of an agent that was saved by itself


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
    """Read the last checkpoint of a run, or an agent that was saved by itself.

    Args:
        folder: the run folder, or one of ``recipes/save_agent.py``.
        gate: standard deviations of the innovation, beyond which a reading counts as if at that
            distance; None: every reading is believed. The agent's method names it.

    Returns:
        The agent and what it was trained with.

    Raises:
        UserError: if the folder or the checkpoint can't be used, or the gate is refused.
    """
    config, weights = load_config(folder), folder / WEIGHTS
    with closing(make_env(config, num_envs=1)) as env:
        if weights.is_file():
            agent = make_agent(config, env)
            frames = _load_weights(weights, agent)
        else:
            agent, frames = load_agent(folder, config, env)
    trained = TrainedAgent(config, agent, frames, method_name(config))
    return trained if gate is None else _gated(trained, gate)


def save_weights(folder: Path, trained: TrainedAgent) -> None:
    """Write the weights of an agent whole, the statistics of its normalisation among them.

    Args:
        folder: an existing folder.
        trained: the agent.
    """
    tensors = {name: value.contiguous() for name, value in trained.agent.state_dict().items()}
    temporary = folder / f".{WEIGHTS}.tmp"
    save_file(tensors, temporary, metadata={"frames": str(trained.frames)})
    temporary.replace(folder / WEIGHTS)


def _load_weights(path: Path, agent: Agent) -> int:
    """Give an agent its weights; return the environment steps that it was trained for."""
    try:
        with safe_open(path, "pt") as file:
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            frames = int(file.metadata()["frames"])
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"`{path}` can't be read as weights: is it damaged?") from error
    with fitting(str(path)):
        agent.load_state_dict(weights)
    return frames


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
