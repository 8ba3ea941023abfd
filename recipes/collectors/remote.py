"""Rollouts of one run from several processes or machines, by Ray: ``collector=ray``."""

import importlib
import logging
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import Transform, TransformedEnv
from torchrl.modules.utils import get_primers_from_module
from training.config import one_line
from training.envs import COLLECTING, spread_episodes
from training.errors import EnvironmentFault, UserError

_RECIPES = Path(__file__).parents[1]
_PATIENCE = 20  # seconds for a cluster to answer


class RayRollouts:
    """Collect rollouts in Ray's workers, see conf/collector/ray.yaml.

    What TorchRL's ``Collector(backend="ray")`` needs to stand in the training loop. The policy's
    parameters and buffers, statistics of normalisation among them, are sent before each rollout.
    The workers start at the first one, seeded from torch's global generator: so many workers and
    one seed make one run, and a resumed run doesn't repeat its first episodes.
    """

    def __init__(
        self,
        env: TransformedEnv,
        policy: TensorDictModuleBase,
        make_env: Callable[..., TransformedEnv],
        *,
        num_envs: int,
        steps_per_env: int,
        workers: int,
        cpus_per_worker: int,
        address: str | None,
        spread: bool = False,  # of runs that do not say
    ) -> None:
        if num_envs % workers:
            raise UserError(
                f"`collector.workers` must divide `collector.num_envs`, got {workers} and "
                f"{num_envs}."
            )
        if next(policy.parameters()).device.type != "cpu":
            raise UserError("`collector=ray` needs device=cpu: its workers run the policy there.")
        self._ray = _connect(address, workers * cpus_per_worker)
        primers = get_primers_from_module(policy, warn=False)
        self._make_env = partial(_worker_env, make_env, num_envs // workers, primers, spread)
        self._policy, self._cpus = policy, cpus_per_worker
        self._num_envs, self._steps, self._workers = num_envs, steps_per_env, workers
        self._counts = hasattr(env.base_env, "engine_resets")
        self.engine_resets = torch.zeros(1)
        self._collector: Any = None
        self._rollouts: Iterator[TensorDictBase] = iter(())

    def rollout(self) -> TensorDictBase:
        """Return a rollout ``(environments, time)`` of the policy as it is."""
        errors = self._ray.exceptions
        try:
            if self._collector is None:
                self._start()
            self._count()  # Ray says who has died; the weights' transport, that a socket is closed
            self._collector.update_policy_weights_()
            data = next(self._rollouts).flatten(0, 1)
            self._count()
            return data
        except errors.RayTaskError as error:  # what environment or policy raised there
            self.shutdown()
            raise error.cause from error
        except errors.RayError as error:
            self.shutdown()
            died = f"a worker of `collector=ray` died: {one_line(error)}"
            raise EnvironmentFault(died) from error

    def reset(self) -> None:
        """Begin new episodes in every environment."""
        if self._collector is not None:
            self._collector.map_fn("reset")

    def shutdown(self) -> None:
        """End the workers; Ray ends with the process."""
        if self._collector is not None:
            self._collector.shutdown()
            self._collector = None

    def _count(self) -> None:
        if self._counts:
            resets = self._collector.get_distant_attr("env.base_env.engine_resets")
            self.engine_resets = torch.stack([each.sum() for each in resets])
        else:
            self._collector.get_distant_attr("worker_idx")

    def _start(self) -> None:
        seeds = torch.randint(2**62, (self._workers,))
        path = [str(_RECIPES), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
        variables = {"PYTHONPATH": os.pathsep.join(os.path.abspath(part) for part in path if part)}
        resources = {"num_cpus": self._cpus, "scheduling_strategy": "SPREAD"}
        resources["runtime_env"] = {"env_vars": variables}
        self._collector = Collector(
            [partial(self._make_env, int(seed)) for seed in seeds],
            self._policy,
            backend="ray",
            sync=True,
            frames_per_batch=self._num_envs * self._steps,
            total_frames=math.inf,
            backend_options={"collector_kwargs": dict(COLLECTING), "remote_configs": resources},
        )
        self._rollouts = iter(self._collector)


def _worker_env(
    make_env: Callable[..., TransformedEnv],
    num_envs: int,
    primers: Transform | None,
    spread: bool,
    seed: int,
) -> TransformedEnv:
    """Build the environment of a worker, in it; actions are drawn from torch's generator there."""
    torch.manual_seed(seed)
    env = make_env(num_envs=num_envs, seed=seed)
    if primers is not None:
        env.append_transform(primers)
    if spread:
        spread_episodes(env)
    return env


def _connect(address: str | None, cpus: int) -> Any:
    """Return ray, connected to a cluster that has so many processors."""
    try:
        ray: Any = importlib.import_module("ray")
    except ImportError as error:
        raise UserError("`collector=ray` needs Ray: pip install 'ray>=2.60'.") from error
    if not ray.is_initialized():
        where = {"address": address} if address else {"address": "local", "num_cpus": cpus}
        if address:
            _reach(address)
        try:
            ray.init(**where, logging_level=logging.ERROR, log_to_driver=False)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise UserError(f"`collector.address={address}`: {one_line(error)}") from error
    there = ray.cluster_resources().get("CPU", 0)
    if there < cpus:
        raise UserError(
            f"`collector.workers` times `collector.cpus_per_worker` must be at most the {there:g} "
            f"processors of the cluster, got {cpus}."
        )
    return ray


def _reach(address: str) -> None:
    """Refuse a cluster that does not answer: ray.init would try for minutes, in many lines."""
    check = [sys.executable, "-m", "ray.scripts.scripts", "health-check"]
    words = [] if address == "auto" else ["--address", address]
    try:
        subprocess.run([*check, *words], check=True, capture_output=True, timeout=_PATIENCE)
    except subprocess.SubprocessError as error:
        raise UserError(
            f"`collector.address={address}`: no Ray cluster answers there. It must be host:port of "
            "`ray start --head`, auto for the one of this machine, or null for a new one."
        ) from error
