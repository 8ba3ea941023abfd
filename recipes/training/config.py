"""Settings of a run as plain dataclasses; every value comes from conf/, none from here."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from typing import Any, TypeVar

from torchrl_drbpn.functional import outage_rates
from training.errors import UserError

T = TypeVar("T")

_SEED_LIMIT = 2**63  # of torch's generators
MECHANISMS = ("none", "mcar", "mar", "nmar", "outages")
GROUPINGS = ("sensor", "joint", "kind")


@dataclass(frozen=True)
class EnvSettings:
    """Which simulated robot; see conf/env."""

    name: str
    id: str
    version: str
    backend: str

    @property
    def env_id(self) -> str:
        """Return the full Gymnasium id, such as ``Walker2d-v5``."""
        return f"{self.id}-{self.version}"


@dataclass(frozen=True)
class MissingnessSettings:
    """Which entries do not arrive; see conf/missingness."""

    mechanism: str
    eta: float
    always_observed: float
    mechanism_seed: int
    mean_length: float
    group_by: str


@dataclass(frozen=True)
class NoiseSettings:
    """What is added to the entries that arrive; see conf/noise."""

    sigma: float
    scale: float
    spike_probability: float
    spike_std: float


@dataclass(frozen=True)
class NormalisationSettings:
    """Running statistics of observations and rewards; see conf/normalisation."""

    observation_clip: float
    reward_clip: float


@dataclass(frozen=True)
class HeadSettings:
    """Policy and value networks; see conf/heads."""

    hidden: list[int]
    hidden_gain: float
    policy_gain: float
    value_gain: float
    log_std: float
    critic_input: str


@dataclass(frozen=True)
class CollectorSettings:
    """Size of a rollout; see conf/collector."""

    num_envs: int
    steps_per_env: int
    num_threads: int

    @property
    def frames(self) -> int:
        """Return the environment steps of one rollout."""
        return self.num_envs * self.steps_per_env


@dataclass(frozen=True)
class LossSettings:
    """PPO and model likelihood; see conf/loss."""

    gamma: float
    lmbda: float
    clip_epsilon: float
    critic_coeff: float
    loss_critic_type: str
    entropy_coeff: float
    normalize_advantage: bool
    model_coeff: float
    normalize: str
    detach_belief: bool


@dataclass(frozen=True)
class OptimSettings:
    """Optimiser, epochs, minibatches; see conf/optim."""

    lr: float
    eps: float
    max_grad_norm: float
    epochs: int
    minibatches: int
    sequence_length: int
    recompute_advantages: bool


@dataclass(frozen=True)
class EvaluationSettings:
    """Episodes apart from the training ones; see conf/evaluation."""

    every_frames: int
    episodes: int
    final_episodes: int
    seed: int
    modes: list[str]


@dataclass(frozen=True)
class CheckpointSettings:
    """How often a run is saved; see conf/checkpoint."""

    every_frames: int
    keep: int


@dataclass(frozen=True)
class LoggerSettings:
    """Which of TorchRL's loggers; see conf/logger."""

    backend: str


@dataclass(frozen=True)
class Settings:
    """All settings of a run; see conf/config.yaml."""

    env: EnvSettings
    belief: dict[str, Any]
    missingness: MissingnessSettings
    noise: NoiseSettings
    normalisation: NormalisationSettings
    heads: HeadSettings
    collector: CollectorSettings
    algo: dict[str, Any]
    loss: LossSettings
    optim: OptimSettings
    evaluation: EvaluationSettings
    checkpoint: CheckpointSettings
    logger: LoggerSettings
    method: str | None
    seed: int
    total_frames: int
    threads: int
    resume: str | None


def read_settings(config: Mapping[str, Any]) -> Settings:
    """Turn a resolved configuration into checked settings.

    Args:
        config: the configuration as plain containers.

    Returns:
        The settings.

    Raises:
        UserError: if a key is missing or unknown, or a value makes no sense.
    """
    settings = _fill(Settings, config, "")
    _check(settings)
    return settings


def _fill(kind: type[T], values: Any, path: str) -> T:
    """Build a dataclass from a mapping, one nested dataclass at a time."""
    if not isinstance(values, Mapping):
        raise UserError(f"`{path}` must be a group of settings, got {values!r}.")
    hints = typing.get_type_hints(kind)
    names = [field.name for field in dataclasses.fields(typing.cast(Any, kind))]
    absent, unknown = [n for n in names if n not in values], [k for k in values if k not in names]
    if absent or unknown:
        where = f"`{path}`" if path else "the configuration"
        raise UserError(
            f"{where} must have the keys {', '.join(names)}; "
            f"missing: {absent or 'none'}, unknown: {unknown or 'none'}."
        )
    read = {
        name: _value(hints[name], values[name], f"{path}.{name}" if path else name)
        for name in names
    }
    return kind(**read)


def _value(hint: Any, value: Any, path: str) -> Any:
    """Check one value against its annotation; whole floats pass as integers and back."""
    if dataclasses.is_dataclass(hint):
        return _fill(typing.cast(type, hint), value, path)
    wrong = UserError(f"`{path}` must be {_describe(hint)}, got {value!r}.")
    if hint is float:
        if isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) != inf:
            return float(value)
    elif hint is int:
        if isinstance(value, int) and not isinstance(value, bool):
            return value
        if isinstance(value, float) and value.is_integer():
            return int(value)
    elif hint in (str, bool):
        if isinstance(value, hint):
            return value
    elif typing.get_origin(hint) is list:
        if isinstance(value, list):
            (item,) = typing.get_args(hint)
            return [_value(item, v, f"{path}[{i}]") for i, v in enumerate(value)]
    elif typing.get_origin(hint) is dict:
        if isinstance(value, Mapping):
            return dict(value)
    elif value is None or isinstance(value, str):
        return value
    raise wrong


def _describe(hint: Any) -> str:
    if typing.get_origin(hint) is list:
        return "a list"
    names = {float: "a finite number", int: "a whole number", str: "text", bool: "true or false"}
    return names.get(hint, "text or null")


def _check(s: Settings) -> None:
    """Reject values that make no sense, one line each."""
    choices = {
        "env.backend": (s.env.backend, ("gymnasium", "envpool")),
        "env.version": (s.env.version, ("v4", "v5")),
        "missingness.mechanism": (s.missingness.mechanism, MECHANISMS),
        "missingness.group_by": (s.missingness.group_by, GROUPINGS),
        "heads.critic_input": (s.heads.critic_input, ("features", "complete")),
        "loss.loss_critic_type": (s.loss.loss_critic_type, ("l1", "l2", "smooth_l1")),
        "loss.normalize": (s.loss.normalize, ("entry", "step")),
        "logger.backend": (s.logger.backend, ("csv", "tensorboard")),
    }
    for name, (given, valid) in choices.items():
        if given not in valid:
            raise UserError(f"`{name}` must be one of {', '.join(valid)}, got {given!r}.")
    for mode in s.evaluation.modes:
        check_mode(mode)
    check_outages(s.missingness)
    unit_interval = {
        "missingness.eta": s.missingness.eta,
        "missingness.always_observed": s.missingness.always_observed,
        "noise.spike_probability": s.noise.spike_probability,
        "loss.gamma": s.loss.gamma,
        "loss.lmbda": s.loss.lmbda,
    }
    for name, value in unit_interval.items():
        if not 0 <= value <= 1:
            raise UserError(f"`{name}` must lie in [0, 1], got {value}.")
    positive = {
        "total_frames": s.total_frames,
        "threads": s.threads,
        "collector.num_envs": s.collector.num_envs,
        "collector.steps_per_env": s.collector.steps_per_env,
        "collector.num_threads": s.collector.num_threads,
        "optim.epochs": s.optim.epochs,
        "optim.minibatches": s.optim.minibatches,
        "optim.sequence_length": s.optim.sequence_length,
        "optim.max_grad_norm": s.optim.max_grad_norm,
        "optim.eps": s.optim.eps,
        "checkpoint.every_frames": s.checkpoint.every_frames,
        "checkpoint.keep": s.checkpoint.keep,
        "normalisation.observation_clip": s.normalisation.observation_clip,
        "normalisation.reward_clip": s.normalisation.reward_clip,
        "loss.clip_epsilon": s.loss.clip_epsilon,
    }
    for name, value in positive.items():
        if not value > 0:
            raise UserError(f"`{name}` must be positive, got {value}.")
    not_negative = {
        "seed": s.seed,
        "noise.sigma": s.noise.sigma,
        "noise.scale": s.noise.scale,
        "noise.spike_std": s.noise.spike_std,
        "optim.lr": s.optim.lr,
        "loss.critic_coeff": s.loss.critic_coeff,
        "loss.entropy_coeff": s.loss.entropy_coeff,
        "loss.model_coeff": s.loss.model_coeff,
        "missingness.mechanism_seed": s.missingness.mechanism_seed,
        "evaluation.seed": s.evaluation.seed,
        "evaluation.every_frames": s.evaluation.every_frames,
        "evaluation.episodes": s.evaluation.episodes,
        "evaluation.final_episodes": s.evaluation.final_episodes,
    }
    for name, value in not_negative.items():
        if not value >= 0:
            raise UserError(f"`{name}` must be 0 or more, got {value}.")
    for name in ("seed", "missingness.mechanism_seed", "evaluation.seed"):
        if not_negative[name] >= _SEED_LIMIT:
            raise UserError(f"`{name}` must be under 2**63, got {not_negative[name]}.")
    if s.collector.steps_per_env % s.optim.sequence_length:
        raise UserError(
            f"`optim.sequence_length` must divide `collector.steps_per_env`, "
            f"got {s.optim.sequence_length} and {s.collector.steps_per_env}."
        )
    sequences = s.collector.frames // s.optim.sequence_length
    if sequences % s.optim.minibatches:
        raise UserError(
            f"`optim.minibatches` must divide the {sequences} sequences of a rollout, "
            f"got {s.optim.minibatches}."
        )


def check_outages(missingness: MissingnessSettings) -> None:
    """Check that there is a Markov chain with the ratio and the mean length of an outage.

    Args:
        missingness: any; only outages are looked at.

    Raises:
        UserError: if there is none.
    """
    if missingness.mechanism != "outages":
        return
    try:
        outage_rates(missingness.eta, missingness.mean_length)
    except ValueError as error:
        raise UserError(f"missingness=outages: {error}") from error


def missingness_name(missingness: MissingnessSettings) -> str:
    """Return missingness as a point, such as ``mcar:0.5`` or ``outages:0.5:20:sensor``.

    Args:
        missingness: mechanism, eta and, of outages, their length and groups.

    Returns:
        Text that :func:`evaluation.conditions.parse_condition` reads back.
    """
    m = missingness
    if m.mechanism == "outages":
        return f"outages:{m.eta:g}:{m.mean_length:g}:{m.group_by}"
    return f"{m.mechanism}:{0.0 if m.mechanism == 'none' else m.eta:g}"


def check_mode(mode: str) -> None:
    """Check the name of a kind of action.

    Args:
        mode: ``sampled`` or ``mean``.

    Raises:
        UserError: if it is neither.
    """
    if mode not in ("sampled", "mean"):
        raise UserError(f"`modes` must hold sampled and mean, got {mode!r}.")
