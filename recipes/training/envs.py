"""The environment of a run: simulators, corruption, normalisation, in the order they need."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import gymnasium
from torchrl.envs import (
    Compose,
    InitTracker,
    RewardSum,
    StepCounter,
    Transform,
    TransformedEnv,
)

from torchrl_drbpn import (
    MaskedObservationNorm,
    ObservationMissingness,
    ObservationNoise,
    ObservationSpikes,
    PreviousAction,
    RunningReturnScale,
    SensorOutages,
    seed_env,
)
from torchrl_drbpn.envs import EnvPoolBatchEnv, GymnasiumBatchEnv
from training.config import (
    EnvSettings,
    MissingnessSettings,
    NoiseSettings,
    NormalisationSettings,
)
from training.errors import UserError
from training.sensor_groups import sensor_groups
from training.sensors import sensor_names

_MECHANISMS: dict[str, Literal["mcar", "mar", "nmar"]] = {
    "mcar": "mcar",
    "mar": "mar",
    "nmar": "nmar",
}

_BACKENDS: dict[str, type[EnvPoolBatchEnv] | type[GymnasiumBatchEnv]] = {
    "gymnasium": GymnasiumBatchEnv,
    "envpool": EnvPoolBatchEnv,
}


def make_environment(
    env: EnvSettings,
    missingness: MissingnessSettings,
    noise: NoiseSettings,
    normalisation: NormalisationSettings,
    *,
    num_envs: int,
    num_threads: int,
    gamma: float,
    seed: int,
    before_normalisation: Sequence[Transform] = (),
    after_normalisation: Sequence[Transform] = (),
    complete: bool = False,
) -> TransformedEnv:
    """Build the batched, corrupted, normalised environment of a run.

    Args:
        env: which robot.
        missingness: which entries of an observation do not arrive.
        noise: what is added to the entries that arrive.
        normalisation: clips of the running statistics.
        num_envs: simulators in the batch.
        num_threads: threads that step them; results do not depend on it.
        gamma: discount of the return whose deviation scales the reward.
        seed: seed of episodes and corruption.
        before_normalisation: further transforms that take entries away.
        after_normalisation: further transforms that a belief module asks for.
        complete: whether to write ``complete_observation`` too: what complete, noiseless sensors
            would have shown, normalised with the same statistics. No policy reads it.

    Returns:
        The environment, batch size ``(num_envs,)``. The recurrent state's primer is not in it:
        :func:`training.agent.add_primers` appends it.

    Raises:
        UserError: if the environment does not exist or has unsuitable actions or observations.
    """
    base = _make_base(env, num_envs, num_threads)
    transforms: list[Transform] = [PreviousAction()]
    # The first transform that corrupts writes down what it was given.
    key = "complete_observation" if complete else None
    if noise.sigma > 0:
        transforms.append(ObservationNoise(noise.scale * noise.sigma, complete_key=key))
        key = None
    if noise.spike_probability > 0:
        spikes = ObservationSpikes(noise.spike_probability, noise.spike_std, complete_key=key)
        transforms.append(spikes)
        key = None
    transforms += [
        make_missingness(env, missingness, base.observation_spec["observation"].shape[-1], key),
        *before_normalisation,
        MaskedObservationNorm(clip=normalisation.observation_clip),
        *after_normalisation,
        RunningReturnScale(
            gamma=gamma,
            clip=normalisation.reward_clip,
            in_keys=["reward"],
            out_keys=["scaled_reward"],
        ),
        RewardSum(in_keys=["reward"], out_keys=["episode_reward"]),
        StepCounter(),
        InitTracker(),
    ]
    out = TransformedEnv(base, Compose(*transforms))
    seed_env(out, seed)
    return out


def make_missingness(
    env: EnvSettings, missingness: MissingnessSettings, obs_dim: int, complete_key: str | None
) -> Transform:
    """Build the transform that takes entries away; it writes ``observed`` in every case.

    Args:
        env: which robot; its sensors' names say what fails together.
        missingness: which entries do not arrive.
        obs_dim: components of an observation.
        complete_key: where the complete observation is recorded; None: nowhere.

    Returns:
        The transform.
    """
    if missingness.mechanism == "outages":
        return SensorOutages(
            missingness.eta,
            missingness.mean_length,
            groups=sensor_groups(sensor_names(env.id, env.version, obs_dim), missingness.group_by),
            complete_key=complete_key,
        )
    none = missingness.mechanism == "none"
    return ObservationMissingness(
        "mcar" if none else _MECHANISMS[missingness.mechanism],
        0.0 if none else missingness.eta,
        always_observed=missingness.always_observed,
        mechanism_seed=missingness.mechanism_seed,
        complete_key=complete_key,
    )


def task_dims(env: EnvSettings) -> tuple[int, int]:
    """Return the sizes of a task.

    Args:
        env: which robot.

    Returns:
        Components of an observation and of an action.

    Raises:
        UserError: if the environment does not exist or has unsuitable actions or observations.
    """
    base = _make_base(env, 1, 1)
    dims = base.observation_spec["observation"].shape[-1], base.action_spec.shape[-1]
    base.close()
    return dims


def _make_base(
    env: EnvSettings, num_envs: int, num_threads: int
) -> EnvPoolBatchEnv | GymnasiumBatchEnv:
    """Build the simulators; what can't be used is the user's to mend."""
    try:
        return _BACKENDS[env.backend](env.env_id, num_envs, num_threads=num_threads)
    except (ValueError, ModuleNotFoundError, gymnasium.error.Error) as error:
        raise UserError(" ".join(str(error).split())) from error


def normalisers(env: TransformedEnv) -> list[Transform]:
    """Return the transforms of an environment that learn statistics.

    Args:
        env: the environment.

    Returns:
        Its observation and reward normalisers.
    """
    return [t for t in env.transform if isinstance(t, (MaskedObservationNorm, RunningReturnScale))]


def copy_statistics(source: TransformedEnv, target: TransformedEnv) -> None:
    """Give an environment the frozen statistics of another.

    Args:
        source: the environment that learned them.
        target: the environment that uses them; it learns no more.
    """
    for learned, frozen in zip(normalisers(source), normalisers(target), strict=True):
        frozen.load_state_dict(learned.state_dict())
        frozen.freeze()
