"""An agent that a run has trained, read from its folder: the only place that builds one anew."""

import copy
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs import TransformedEnv
from training.agent import Agent, add_primers, make_agent
from training.checkpoint import fitting, last_checkpoint, load_checkpoint
from training.envs import env_name, make_env
from training.errors import UserError
from training.run_folder import EVALUATION_COLUMNS, load_config, whole
from training.sensors import sensor_names
from training.state import Training

from evaluation.episodes import BLOCK, evaluate, over_episodes
from evaluation.points import method_name, missingness_name
from torchrl_drbpn import BeliefFilterModule, SensorReduction
from torchrl_drbpn.functional.robust import check_robust

WEIGHTS = "agent.safetensors"  # of an agent that was saved by itself


@dataclass(frozen=True)
class TrainedAgent:
    """An agent, ready to act: configuration of its run, weights, environment steps, ``robust``."""

    settings: DictConfig
    agent: Agent
    frames: int
    robust: str = ""

    @property
    def method(self) -> str:
        """Return what it is called in tables and figures."""
        return method_name(self.settings) + (self.robust and f", {self.robust}")

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

    def columns(self) -> dict[str, Any]:
        """Return the columns of a table that identify the agent, whatever its folder is called."""
        settings = self.settings
        return {
            "task": env_name(settings),
            "belief": settings.belief.get("name", ""),
            "method": self.method,
            "training_seed": settings.seed,
            "frames": self.frames,
            "trained_on": missingness_name(settings.missingness),
            "noise_sigma": settings.noise.sigma,
        }

    def environments(
        self,
        missingness: DictConfig | None = None,
        noise: DictConfig | None = None,
        removed: Tensor | None = None,
        *,
        complete: bool = False,
    ) -> Callable[[int], TransformedEnv]:
        """Return what builds the environment of a block of episodes.

        What is None stays as in training; ``removed``, bool of shape ``(episodes, obs)``, never
        arrives. ``complete``: whether to write ``complete_observation``.
        """
        changed = self.settings.copy()
        changed.missingness = missingness or changed.missingness
        changed.noise = noise or changed.noise

        def make(block: int) -> TransformedEnv:
            replaced = {}
            if removed is not None:
                here = removed[block * BLOCK : (block + 1) * BLOCK]
                rest = removed.new_zeros(BLOCK - len(here), self.obs_dim)
                replaced["reduction"] = SensorReduction(torch.cat([here, rest]))
            own: Any = {"num_envs": BLOCK, "seed": changed.evaluation.seed}
            env = make_env(changed, **own, complete=complete, transforms=replaced)
            add_primers(env, self.agent)
            return env

        return make


def load_trained_agent(
    folder: Path, robust: str | None = None, threshold: float = 4.0
) -> TrainedAgent:
    """Read the last checkpoint of a run, or an agent that recipes/save_agent.py saved.

    ``robust``: "huber", "imq" or "none", the update that it acts with; None: as in training.
    ``threshold``: where its weights begin to fall, standard deviations.
    """
    config = load_config(folder)
    path, state, frames = _read_weights(folder)
    with closing(make_env(config, num_envs=1)) as env:
        agent = make_agent(config, env)
    with fitting(str(path)):
        agent.load_state_dict(state)
    trained = TrainedAgent(config, agent, frames)
    if robust is None:
        return trained
    if not isinstance(agent.belief, BeliefFilterModule):
        raise UserError(
            f"`robust` must be null for belief={config.belief.name}, got {robust!r}: "
            "only belief=drbpn has a forecast of its readings to compare them with."
        )
    update: Any = None if robust == "none" else robust
    try:
        check_robust(update, threshold, agent.belief.filter.mask_model)
    except ValueError as error:
        raise UserError(str(error)) from error
    agent.belief.filter.robust, agent.belief.filter.robust_threshold = update, threshold
    return replace(trained, robust=f"{robust} {threshold:g}" if update else "not robust")


def save_weights(folder: Path, trained: TrainedAgent) -> None:
    """Write the weights of an agent whole, the statistics of its normalisation among them."""
    tensors = {name: value.contiguous() for name, value in trained.agent.state_dict().items()}
    with whole(folder / WEIGHTS) as temporary:
        save_file(tensors, temporary, metadata={"frames": str(trained.frames)})


def _read_weights(folder: Path) -> tuple[Path, dict[str, Tensor], int]:
    """Return the file of an agent's weights, what it holds, and the environment steps trained."""
    path = folder / WEIGHTS
    if not path.is_file():
        path = last_checkpoint(folder)
        checkpoint = load_checkpoint(path)
        return path, checkpoint["agent"], checkpoint["progress"]["frames"]
    try:
        with safe_open(path, "pt") as file:
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
            return path, weights, int(file.metadata()["frames"])
    except (SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise UserError(f"`{path}` can't be read as weights: is it damaged?") from error


def evaluate_training(
    config: DictConfig, training: Training, kind: str, episodes: int, stop: Callable[[], bool]
) -> list[dict[str, Any]] | None:
    """Evaluate the agent of a run on the CPU: a row for each mode, None if ``stop`` ended it."""
    make_env = TrainedAgent(config, training.agent, training.frames).environments()
    policy = training.agent.policy
    if next(policy.parameters()).device.type != "cpu":
        policy = copy.deepcopy(policy).cpu()
    how: Any = {"episodes": episodes, "seed": config.evaluation.seed, "stop": stop}
    rows = []
    for mode in config.evaluation.modes:
        result = evaluate(policy, make_env, mode=mode, **how)
        if result is None:
            return None
        result = result.assign(frames=training.frames, kind=kind, mode=mode)
        table = over_episodes(result, ["frames", "kind", "mode"])
        table = table.fillna({"return_std": 0.0})  # of one episode
        (row,) = table.astype(object).to_dict("records")
        rows.append({c: None if row[c] != row[c] else row[c] for c in EVALUATION_COLUMNS})
    return rows
