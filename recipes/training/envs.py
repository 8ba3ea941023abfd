"""The environment of a run: simulators, and what happens to their observations, in conf's order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
from omegaconf import DictConfig, ListConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, RenameTransform, Transform, TransformedEnv

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


def make_env(
    config: DictConfig,
    *,
    num_envs: int | None = None,
    seed: int | None = None,
    transforms: Mapping[str, Transform] | None = None,
    complete: bool | None = None,
) -> TransformedEnv:
    """Build the batched, corrupted environment of a run.

    Args:
        config: of the run.
        num_envs: simulators in the batch; None: as in training.
        seed: of episodes and corruption; None: the run's.
        transforms: by their names in ``config.transforms``, in the place of what stands there.
        complete: whether to write ``complete_observation``, what complete, noiseless sensors would
            have shown; None: where the critic reads it.

    Returns:
        The environment, batch size ``(num_envs,)``. The recurrent state's primer is not in it:
        :func:`training.agent.add_primers` appends it.

    Raises:
        UserError: if the environment does not exist or has unsuitable actions or observations.
    """
    own = {} if num_envs is None else {"num_envs": num_envs}
    base: EnvBase = build("env", config.env, **own)
    replaced = dict(transforms or {})
    if config.heads.get("critic_input") == "complete" if complete is None else complete:
        replaced["complete"] = RenameTransform(["observation"], [COMPLETE], create_copy=True)
    made: list[Transform] = []
    for name, node in config.transforms.items():
        nodes = [replaced[name]] if name in replaced else _as_list(node)
        label = (
            name if OmegaConf.is_interpolation(config.transforms, name) else f"transforms.{name}"
        )
        for part in nodes:
            if not isinstance(part, Transform):
                part = build(label, part)
            made += part if isinstance(part, list) else [part]
    env = TransformedEnv(base, Compose(*made))
    seed_env(env, config.seed if seed is None else seed)
    return env


def _as_list(node: Any) -> list[Any]:
    if node is None:
        return []
    return list(node) if isinstance(node, (list, ListConfig)) else [node]


def make_simulators(
    *,
    id: str,
    version: str | None,
    num_envs: int,
    num_threads: int,
    backend: str,
    kwargs: Mapping[str, Any],
) -> EnvBase:
    """Build many simulators of a Gymnasium task.

    Args:
        id: Gymnasium's, without the version where ``version`` holds it.
        version: such as ``v5``, or None.
        num_envs: how many.
        num_threads: threads that step them; results do not depend on it.
        backend: ``gymnasium`` or ``envpool``.
        kwargs: of the task.

    Returns:
        The environment.

    Raises:
        UserError: if it does not exist or has unsuitable actions or observations.
    """
    backends = {"gymnasium": GymnasiumBatchEnv, "envpool": EnvPoolBatchEnv}
    if backend not in backends:
        raise UserError(f"`env.backend` must be gymnasium or envpool, got {backend!r}.")
    name = f"{id}-{version}" if version else id
    try:
        return backends[backend](name, num_envs, num_threads=num_threads, **kwargs)
    except (ValueError, TypeError, ModuleNotFoundError, gymnasium.error.Error) as error:
        raise UserError(f"`env.id={name}`: {one_line(error)}") from error


def env_name(config: DictConfig) -> str:
    """Return the whole Gymnasium id of a run's task, such as ``Walker2d-v5``.

    Args:
        config: of the run.
    """
    env = config.env
    return f"{env.id}-{env.version}" if env.version else str(env.id)


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
    """Make what is wrong with the entries that arrive: drift, noise, spikes, then what is stuck.

    Args:
        sigma: standard deviation of white noise in units of ``scale``.
        scale: raw simulator units.
        spike_probability: of a large error, an entry and step.
        spike_std: standard deviation of that error, raw simulator units.
        stuck_probability: that a sensor gets stuck at its last value, a step.
        stuck_mean_length: of the time that it is stuck, steps; None: to the end of the episode.
        drift_std: of a step of the random walk of a bias, raw simulator units.
        drift_rate: of the bias's ramp, raw simulator units a step.
        group_by: what gets stuck together: ``sensor``, ``joint`` or ``kind``.
        id: task whose sensors have names to group by.
        version: of the task.

    Returns:
        The transforms, none where nothing is wrong.
    """
    made: list[Transform] = []
    if drift_std != 0 or drift_rate != 0:
        made.append(SensorDrift(drift_std, drift_rate))
    if sigma != 0:
        made.append(ObservationNoise(scale * sigma))
    if spike_probability != 0:
        made.append(ObservationSpikes(spike_probability, spike_std))
    if stuck_probability != 0:
        groups = sensor_groups(named_sensors(id, version), group_by)
        made.append(StuckSensors(stuck_probability, stuck_mean_length, groups=groups))
    return made


def make_outages(
    *,
    eta: float,
    mean_length: float,
    group_by: str,
    id: str,
    version: str | None,
    state_key: str | None = None,
) -> SensorOutages:
    """Make sensors fail for a while, alone or together.

    Args:
        eta: long-run share of the steps that a sensor is off.
        mean_length: of an outage, steps.
        group_by: what fails together: ``sensor``, ``joint`` or ``kind``.
        id: task whose sensors have names to group by.
        version: of the task.
        state_key: where which of them work is kept; two in one environment need two.

    Returns:
        The transform.
    """
    groups = sensor_groups(named_sensors(id, version), group_by)
    return SensorOutages(eta, mean_length, groups=groups, state_key=state_key)


def make_delay(
    *,
    delay: int,
    max_delay: int | None,
    in_order: bool,
    group_by: str,
    id: str,
    version: str | None,
) -> ObservationDelay:
    """Make readings arrive late.

    Args:
        delay: steps.
        max_delay: of delays that are drawn for every reading; None: all are as late.
        in_order: whether to drop readings that arrive after one taken later.
        group_by: what travels in one packet: ``sensor``, ``joint`` or ``kind``.
        id: task whose sensors have names to group by.
        version: of the task.

    Returns:
        The transform.

    Raises:
        UserError: if the task's episodes end before anything can arrive.
    """
    groups = sensor_groups(named_sensors(id, version), group_by)
    made = ObservationDelay(delay, max_delay=max_delay, in_order=in_order, groups=groups)
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
    """Make sensors deliver now and then.

    Args:
        period: steps from one reading to the next.
        phase: step of the first reading; None: drawn for every group and episode.
        group_by: what delivers together: ``sensor``, ``joint`` or ``kind``.
        id: task whose sensors have names to group by.
        version: of the task.

    Returns:
        The transform.
    """
    groups = sensor_groups(named_sensors(id, version), group_by)
    return ObservationMultiRate(period, phase="random" if phase is None else phase, groups=groups)


def make_collector(
    env: TransformedEnv, policy: TensorDictModuleBase, *, num_envs: int, steps_per_env: int
) -> Collector:
    """Make TorchRL's collector of one rollout after the other.

    Args:
        env: batch size ``(num_envs,)``.
        policy: what acts.
        num_envs: simulators.
        steps_per_env: of a rollout.

    Returns:
        The collector.
    """
    return Collector(
        env,
        policy,
        frames_per_batch=num_envs * steps_per_env,
        total_frames=-1,
        track_traj_ids=False,
        use_buffers=True,
        auto_register_policy_transforms=False,
    )
