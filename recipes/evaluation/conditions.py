"""Points of an evaluation: what is taken away or falsified there, and how an agent fares."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from training.config import (
    GROUPINGS,
    MissingnessSettings,
    NoiseSettings,
    Settings,
    check_mode,
    check_outages,
    missingness_name,
)
from training.errors import UserError

from evaluation.episodes import Episodes, evaluate, make_evaluation_environment
from evaluation.sensor_choice import kept_sensors
from evaluation.stopping import StoppingPolicy
from evaluation.trained import TrainedAgent

_MECHANISMS = ("none", "mcar", "mar", "nmar")
_SELECTIONS = ("model", "random")
_TRAINED = "trained"
_READABLE = (
    "`points` must hold trained or mechanism:eta such as mcar:0.5, with one of none, mcar, mar, "
    "nmar and eta in [0, 1], outages:eta:mean_length[:sensor, joint or kind], "
    "reduction:ratio:model or random, noise:sigma or spikes:probability[:std]; got {!r}."
)


@dataclass(frozen=True)
class Point:
    """What an agent is evaluated under; what a point does not name stays as in training.

    Attributes:
        name: in full, such as ``outages:0.5:20:sensor``: it reads back to the same point.
        family: the part before the first colon.
        missingness: which entries do not arrive.
        noise: what is added to those that do.
        ratio: share of the sensors that is taken away for good.
        selection: ``model`` or ``random``, which sensors stay; empty: all.
    """

    name: str
    family: str
    missingness: MissingnessSettings
    noise: NoiseSettings
    ratio: float = 0.0
    selection: str = ""


# Reading --------------------------------------------------------------------------------------


def read_point(text: str, trained: MissingnessSettings) -> MissingnessSettings:
    """Read a point that says which entries do not arrive, such as ``mcar:0.5``.

    Args:
        text: ``mechanism:eta``, ``outages:eta:mean_length[:group_by]``, or ``trained`` for what the
            agent was trained with.
        trained: gives what the text leaves open: mechanism seed, always observed share.

    Returns:
        The missingness.

    Raises:
        UserError: if the text can't be read.
    """
    if text == _TRAINED:
        return trained
    family, *words = text.split(":")
    if family == "outages" and len(words) in (2, 3):
        group_by = words[2] if len(words) == 3 else "sensor"
        eta, length = _number(words[0], 1.0), _number(words[1])
        if eta is not None and length is not None and group_by in GROUPINGS:
            outages = dataclasses.replace(
                trained, mechanism="outages", eta=eta, mean_length=length, group_by=group_by
            )
            check_outages(outages)
            return outages
    elif family in _MECHANISMS and len(words) == 1:
        eta = _number(words[0], 1.0)
        if eta is not None:
            return dataclasses.replace(trained, mechanism=family, eta=eta)
    raise UserError(_READABLE.format(text))


def parse_point(text: str, settings: Settings, *, spike_std: float) -> Point:
    """Read any point.

    Args:
        text: see conf/evaluate.yaml.
        settings: of the run: what the point does not name stays.
        spike_std: deviation of spikes where the text gives none, raw units.

    Returns:
        The point.

    Raises:
        UserError: if the text can't be read.
    """
    missingness, noise = settings.missingness, settings.noise
    family, *words = text.split(":")
    first = _number(words[0]) if words else None
    if family == "noise" and first is not None and len(words) == 1:
        changed = dataclasses.replace(noise, sigma=first)
        return Point(f"noise:{first:g}", family, missingness, changed)
    if family == "spikes" and first is not None and first <= 1 and len(words) <= 2:
        std = _number(words[1]) if len(words) == 2 else spike_std
        if std is not None:
            changed = dataclasses.replace(noise, spike_probability=first, spike_std=std)
            return Point(f"spikes:{first:g}:{std:g}", family, missingness, changed)
    if family == "reduction" and len(words) == 2 and first is not None and first <= 1:
        if words[1] in _SELECTIONS:
            nothing = dataclasses.replace(missingness, mechanism="none", eta=0.0)
            name = f"reduction:{first:g}:{words[1]}"
            return Point(name, family, nothing, noise, first, words[1])
        raise UserError(_READABLE.format(text))
    try:
        read = read_point(text, missingness)
    except UserError as error:
        if family in ("noise", "spikes"):
            raise UserError(_READABLE.format(text)) from error
        raise
    return Point(missingness_name(read), read.mechanism, read, noise)


def _number(text: str, most: float = math.inf) -> float | None:
    """Read a number from 0 to ``most``; None where there is none."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0 <= value <= most and value < math.inf else None


# Evaluating -----------------------------------------------------------------------------------


def check_reduction_seed(seed: Any) -> None:
    """Check the seed of sensors that are removed at random.

    Args:
        seed: as it was given.

    Raises:
        UserError: if it is no whole number, or negative.
    """
    if not isinstance(seed, int) or isinstance(seed, bool) or seed < 0:
        raise UserError(f"`reduction_seed` must be a whole number of at least 0, got {seed!r}.")


def removed_sensors(
    point: Point, trained: TrainedAgent, *, episodes: int, reduction_seed: int
) -> Tensor | None:
    """Return the sensors that a point takes away for good.

    At random, every episode lacks sensors of its own: a mean over episodes is one over choices too,
    and its interval holds their spread. The order in which an episode loses sensors is drawn from
    ``reduction_seed`` and its number alone, so that every agent of a task meets the same choices,
    and those of a smaller ratio are among those of a larger one. The stream is not that of the
    missingness mechanisms, whose always observed components come from seeds of the same size.

    Args:
        point: the point.
        trained: the agent, whose model may choose; its one choice holds for every episode.
        episodes: how many.
        reduction_seed: of the random choices, not negative.

    Returns:
        Bool of shape ``(episodes, obs)``, True where there is no sensor; None: all are there.

    Raises:
        UserError: if the model is to choose and there is none.
    """
    if not point.selection:
        return None
    obs_dim = trained.statistics.observation_spec["observation"].shape[-1]
    count = round(point.ratio * obs_dim)
    removed = torch.zeros(episodes, obs_dim, dtype=torch.bool)
    if point.selection == "model":
        removed[:] = True
        removed[:, kept_sensors(trained, obs_dim - count)] = False
        return removed
    for episode, row in enumerate(removed):
        # NumPy's generator takes both numbers as its seed; torch's takes one.
        order = np.random.default_rng((reduction_seed, episode)).permutation(obs_dim)
        row[torch.from_numpy(order[:count])] = True
    return removed


def evaluate_points(
    trained: TrainedAgent,
    points: Sequence[Point],
    *,
    episodes: int,
    modes: Sequence[str],
    seed: int,
    reduction_seed: int = 0,
) -> Iterator[tuple[Point, str, Episodes]]:
    """Evaluate an agent at each point with each kind of action.

    Args:
        trained: the agent.
        points: see :func:`parse_point`.
        episodes: per point and kind of action.
        modes: ``sampled``, ``mean``, or both.
        seed: of episodes, corruption and sampled actions; the same for every point.
        reduction_seed: see :func:`removed_sensors`.

    Yields:
        Point, kind of action, episodes.

    Raises:
        UserError: if a kind of action can't be read, ``episodes`` is not positive, or a point needs
            a model that the agent lacks.
    """
    if episodes < 1:
        raise UserError(f"`episodes` must be positive, got {episodes}.")
    for mode in modes:
        check_mode(mode)
    removed = [
        removed_sensors(point, trained, episodes=episodes, reduction_seed=reduction_seed)
        for point in points
    ]
    policy = StoppingPolicy(trained.agent)
    for point, sensors in zip(points, removed, strict=True):
        env = make_evaluation_environment(
            trained.settings,
            trained.belief,
            trained.agent,
            episodes=episodes,
            missingness=point.missingness,
            noise=point.noise,
            removed=sensors,
        )
        for mode in modes:
            result = evaluate(policy, env, mode=mode, seed=seed, statistics=trained.statistics)
            assert result is not None  # nothing asks it to stop
            yield point, mode, result
        env.close()


def identity(trained: TrainedAgent) -> dict[str, Any]:
    """Return the columns that tell agents apart, whatever their folders are called.

    Args:
        trained: the agent.

    Returns:
        Columns and values.
    """
    settings = trained.settings
    return {
        "env": settings.env.env_id,
        "belief": settings.belief.get("name", ""),
        "method": trained.method,
        "training_seed": settings.seed,
        "frames": trained.frames,
        "trained_on": missingness_name(settings.missingness),
        "trained_noise_sigma": settings.noise.sigma,
    }


def episode_rows(
    trained: TrainedAgent, point: Point, mode: str, result: Episodes, *, run: str = ""
) -> list[dict[str, Any]]:
    """Return one row an episode.

    Args:
        trained: the agent.
        point: what it was evaluated under.
        mode: kind of action.
        result: the episodes.
        run: name of its folder.

    Returns:
        Columns and values, the same columns for every evaluation; None where a column says nothing.
    """
    missing, noise = point.missingness, point.noise
    outages, spikes = missing.mechanism == "outages", noise.spike_probability > 0
    common = {"run": run} | identity(trained)
    common |= {
        "point": point.name,
        "family": point.family,
        "mechanism": missing.mechanism,
        "eta": 0.0 if missing.mechanism == "none" else missing.eta,
        "mechanism_seed": missing.mechanism_seed,
        "mean_length": missing.mean_length if outages else None,
        "group_by": missing.group_by if outages else None,
        "removed_ratio": point.ratio if point.selection else None,
        "removed_by": point.selection or None,
        "noise_sigma": noise.sigma,
        "spike_probability": noise.spike_probability,
        "spike_std": noise.spike_std if spikes else None,
        "mode": mode,
    }
    likelihoods: Sequence[float | None] = result.log_likelihoods or [None] * len(result.returns)
    columns = zip(
        result.returns,
        result.lengths,
        result.missing_ratios,
        likelihoods,
        result.diverged,
        strict=True,
    )
    return [
        common
        | {
            "episode": index,
            "return": value,
            "length": length,
            "missing_ratio": ratio,
            "log_likelihood": None if diverged else likelihood,
            "diverged": int(diverged),
        }
        for index, (value, length, ratio, likelihood, diverged) in enumerate(columns)
    ]
