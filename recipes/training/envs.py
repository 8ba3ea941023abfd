"""The environment of a run: simulators, and what happens to their observations, in conf's order."""

from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import gymnasium
import torch
from omegaconf import DictConfig, ListConfig, OmegaConf
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import Bounded
from torchrl.envs import (
    CatTensors,
    Compose,
    DoubleToFloat,
    EnvBase,
    ParallelEnv,
    RandomTruncationTransform,
    RenameTransform,
    SerialEnv,
    Transform,
    TransformedEnv,
)

from torchrl_drbpn import (
    ObservationDelay,
    ObservationMultiRate,
    ObservationNoise,
    ObservationSpikes,
    SensorDrift,
    SensorOutages,
    StuckSensors,
    seed_env,
)
from torchrl_drbpn.envs import EnvPoolBatchEnv, GymnasiumBatchEnv
from training.config import build, one_line
from training.errors import UserError
from training.sensors import named_sensors, sensor_groups

# Written by the environment on request, read by a critic on request, by a policy never.
COMPLETE = "complete_observation"
# How every collector collects. Read-only: TorchRL's Ray backend writes into what it is given.
COLLECTING: Mapping[str, Any] = MappingProxyType(
    {"track_traj_ids": False, "use_buffers": True, "auto_register_policy_transforms": False}
)


def make_env(
    config: DictConfig,
    *,
    num_envs: int | None = None,
    seed: int | None = None,
    transforms: Mapping[str, Transform] | None = None,
    complete: bool | None = None,
) -> TransformedEnv:
    """Build the batched, corrupted environment of a run, batch size ``(num_envs,)``.

    What is None is the configuration's. ``transforms`` take the place of what stands at their names
    in ``config.transforms``; ``complete``: whether to write `COMPLETE`, what complete, noiseless
    sensors would have shown (None: where the critic reads it).
    """
    size = {} if num_envs is None else {"num_envs": num_envs}
    base: EnvBase = build("env", config.env, **size)
    replaced = dict(transforms or {})
    if config.heads.get("critic_input") == "complete" if complete is None else complete:
        replaced["complete"] = RenameTransform(["observation"], [COMPLETE], create_copy=True)
    made: list[Transform] = []
    for name, node in config.transforms.items():
        own = name if OmegaConf.is_interpolation(config.transforms, name) else f"transforms.{name}"
        node = replaced.get(name, node)
        for part in node if isinstance(node, ListConfig) else [] if node is None else [node]:
            part = part if isinstance(part, Transform) else build(own, part)
            made += part if isinstance(part, list) else [part]
    env = base if isinstance(base, TransformedEnv) else TransformedEnv(base, Compose())
    for transform in made:
        written = env.observation_spec.keys(True, True)
        if isinstance(transform, RenameTransform) and {*transform.in_keys} - {*written}:
            raise UserError(
                f"`transforms`: {', '.join(transform.in_keys)} is to be read, and the environment "
                f"writes {', '.join(map(str, written))}: give the entry's name, such as "
                "'transforms.sensors.in_keys=[mask]'."
            )
        env.append_transform(transform)
    seed_env(env, config.seed if seed is None else seed)
    return env


def make_simulators(
    *,
    id: str,
    version: str | None,
    num_envs: int,
    num_threads: int,
    backend: str,
    kwargs: Mapping[str, Any],
    # Of runs that do not name them:
    observation_keys: Sequence[str] | None = None,
    wrappers: Sequence[Callable[[gymnasium.Env[Any, Any]], gymnasium.Env[Any, Any]]] = (),
) -> EnvBase:
    """Build many simulators of a Gymnasium task, see conf/env/gym.yaml."""
    backends = {"gymnasium": GymnasiumBatchEnv, "envpool": EnvPoolBatchEnv}
    if backend not in backends:
        raise UserError(f"`env.backend` must be gymnasium or envpool, got {backend!r}.")
    name = f"{id}-{version}" if version else id
    more = {**kwargs, "wrappers": wrappers} if wrappers else kwargs
    try:
        return backends[backend](
            name, num_envs, num_threads=num_threads, observation_keys=observation_keys, **more
        )
    except (ValueError, TypeError, ModuleNotFoundError, gymnasium.error.Error) as error:
        raise UserError(f"`env.id={name}`: {one_line(error)}") from error


def make_torchrl_env(
    *,
    id: str,
    version: str | None,
    make: Callable[[], EnvBase],
    num_envs: int,
    parallel: bool,
    observation_keys: Sequence[str],
) -> TransformedEnv:
    """Build any environment of TorchRL, see conf/env/torchrl.yaml."""
    del id, version  # its name in folders and tables
    try:
        base = make()
        if not base.batch_size:
            base.close()
            base = (ParallelEnv if parallel else SerialEnv)(num_envs, make)
    except (ValueError, ImportError, RuntimeError, gymnasium.error.Error) as error:
        raise UserError(f"`env.make`: {one_line(error)}") from error
    if base.batch_size != (num_envs,):
        raise UserError(
            f"`env.make` gives a batch of {tuple(base.batch_size)} environments: set "
            f"collector.num_envs={base.batch_size.numel()}, got {num_envs}."
        )
    action = base.action_spec
    if not isinstance(action, Bounded) or not action.dtype.is_floating_point or action.ndim != 2:
        raise UserError(
            f"`env.make` must give an environment whose action is a vector of bounded real "
            f"numbers, got {type(action).__name__} of {action.dtype}, shape {tuple(action.shape)}."
        )
    known = [key for key in base.observation_spec.keys(True, True) if isinstance(key, str)]
    if unknown := [key for key in observation_keys if key not in known]:
        raise UserError(
            f"`env.observation_keys` must hold entries of the observation, {', '.join(known)}; "
            f"got {', '.join(unknown)}."
        )
    parts: list[Transform] = [_ClippedAction(action.space.low, action.space.high), DoubleToFloat()]
    if [*observation_keys] != ["observation"]:
        parts.append(CatTensors([*observation_keys], "observation"))
    return TransformedEnv(base, Compose(*parts))


class _ClippedAction(Transform):
    """Keep sampled actions within their limits, as our own simulators do; the stored one stays.

    TorchRL's ClipTransform takes one number for all components.
    """

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])
        self.limits = low, high

    def _inv_apply_transform(self, action: Tensor) -> Tensor:
        return action.clamp(*self.limits)


def env_name(config: Mapping[Any, Any]) -> str:
    """Return the whole Gymnasium id of a run's task, such as ``Walker2d-v5``."""
    env = config["env"]
    return f"{env['id']}-{env['version']}" if env["version"] else str(env["id"])


def make_noise(
    *,
    sigma: float,
    scale: float,
    spike_probability: float = 0.0,
    spike_std: float = 0.0,
    stuck_probability: float = 0.0,
    stuck_mean_length: float | None = None,
    drift_std: float = 0.0,
    drift_rate: float = 0.0,
    group_by: str = "sensor",
    id: str = "",
    version: str | None = None,
) -> list[Transform]:
    """Make what is wrong with the entries that arrive, in this order; see conf/noise."""
    made: list[Transform] = []
    if drift_std != 0 or drift_rate != 0:
        made.append(SensorDrift(drift_std, drift_rate))
    if sigma != 0:
        made.append(ObservationNoise(scale * sigma))
    if spike_probability != 0:
        made.append(ObservationSpikes(spike_probability, spike_std))
    if stuck_probability != 0:
        groups = _groups(id, version, group_by)
        made.append(StuckSensors(stuck_probability, stuck_mean_length, groups=groups))
    return made


def make_outages(*, group_by: str, id: str, version: str | None, **settings: Any) -> SensorOutages:
    """Make sensors fail for a while, alone or together, see conf/missingness/outages.yaml."""
    return SensorOutages(groups=_groups(id, version, group_by), **settings)


def make_delay(
    *, delay: int, group_by: str, id: str, version: str | None, **settings: Any
) -> ObservationDelay:
    """Make readings arrive late, see conf/missingness/delay.yaml."""
    made = ObservationDelay(delay, groups=_groups(id, version, group_by), **settings)
    task = gymnasium.registry.get(f"{id}-{version}" if version else id)
    steps = task and task.max_episode_steps
    if steps and delay >= steps:
        raise UserError(
            f"`missingness.delay` must be shorter than the {steps} steps of an episode, got {delay}"
            ": nothing would arrive before its end."
        )
    return made


def make_multi_rate(
    *, period: int, phase: int | None, group_by: str, id: str, version: str | None
) -> ObservationMultiRate:
    """Make sensors deliver now and then, see conf/missingness/multi_rate.yaml."""
    groups = _groups(id, version, group_by)
    return ObservationMultiRate(period, phase="random" if phase is None else phase, groups=groups)


def _groups(id: str, version: str | None, by: str) -> list[list[int]] | None:
    return sensor_groups(named_sensors(id, version), by)


class SpreadEpisodes(RandomTruncationTransform):
    """Cut the first episode of every simulator at a random step, no other one.

    Robots that never fall would begin all their episodes in one rollout of many, and what is
    learned of beginnings be forgotten in between (staggered resets, [Bharthulwar et al. 2025]).
    TorchRL's horizons are in no state_dict of its own: this alone knows their private names.
    """

    def _reset(self, before: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if before.get("_reset", None) is None:  # all begin anew: a run starts, or starts again
            self._initialized = False
        return super()._reset(before, tensordict_reset)

    def get_extra_state(self) -> Tensor | None:
        """Return the steps at which episodes are cut: a resumed run goes on with them."""
        return self._horizons

    def set_extra_state(self, state: Tensor | None) -> None:
        """Take up what :meth:`get_extra_state` returned."""
        if state is not None:
            self._horizons, self._initialized = state.clone(), True
            self._first_episode = torch.ones_like(state, dtype=torch.bool)


def spread_episodes(env: TransformedEnv) -> None:
    """Spread the episodes of Gymnasium's tasks; other environments do not tell their longest."""
    simulators = env.base_env
    if isinstance(simulators, GymnasiumBatchEnv | EnvPoolBatchEnv) and simulators.max_episode_steps:
        env.append_transform(SpreadEpisodes(1, simulators.max_episode_steps))


def make_collector(
    env: TransformedEnv,
    policy: TensorDictModuleBase,
    _: Callable[..., TransformedEnv],
    *,
    num_envs: int,
    steps_per_env: int,
    spread: bool = False,  # of runs that do not say
) -> Collector:
    """Make TorchRL's collector of one rollout after the other, kept where the policy is."""
    if spread:
        spread_episodes(env)
    frames, device = num_envs * steps_per_env, next(policy.parameters()).device
    places: dict[str, Any] = {}
    if device.type != "cpu":
        places = {"policy_device": device, "storing_device": device}
        places["env_device"] = env.device or torch.device("cpu")
    return Collector(env, policy, frames_per_batch=frames, total_frames=-1, **places, **COLLECTING)
