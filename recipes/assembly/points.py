"""Evaluate a trained agent under several kinds of missingness."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

from assembly.errors import UserError
from assembly.evaluation import Episodes, evaluate, make_evaluation_environment
from assembly.settings import MissingnessSettings, check_mode
from assembly.trained import TrainedAgent

_MECHANISMS = ("none", "mcar", "mar", "nmar")
_TRAINED = "trained"


def read_point(text: str, trained: MissingnessSettings) -> MissingnessSettings:
    """Read a point such as ``mcar:0.5``.

    Args:
        text: ``mechanism:eta``, or ``trained`` for what the agent was trained with.
        trained: gives what the text leaves open: mechanism seed, always observed share.

    Returns:
        The missingness.

    Raises:
        UserError: if the text can't be read.
    """
    if text == _TRAINED:
        return trained
    mechanism, _, number = text.partition(":")
    try:
        eta = float(number)
    except ValueError:
        eta = float("nan")
    if mechanism not in _MECHANISMS or not 0 <= eta <= 1:
        raise UserError(
            f"`points` must hold {_TRAINED} or mechanism:eta such as mcar:0.5, with one of "
            f"{', '.join(_MECHANISMS)} and eta in [0, 1]; got {text!r}."
        )
    return dataclasses.replace(trained, mechanism=mechanism, eta=eta)


def evaluate_points(
    trained: TrainedAgent,
    points: Sequence[str],
    *,
    episodes: int,
    modes: Sequence[str],
    seed: int,
) -> Iterator[tuple[MissingnessSettings, str, Episodes]]:
    """Evaluate an agent at each point with each kind of action, on the noise it was trained with.

    Args:
        trained: the agent.
        points: see :func:`read_point`.
        episodes: per point and kind of action.
        modes: ``sampled``, ``mean``, or both.
        seed: of episodes, corruption and sampled actions; the same for every point.

    Yields:
        Missingness, kind of action, episodes.

    Raises:
        UserError: if a point or a kind of action can't be read, or ``episodes`` is not positive.
    """
    if episodes < 1:
        raise UserError(f"`episodes` must be positive, got {episodes}.")
    for mode in modes:
        check_mode(mode)
    settings = trained.settings
    read = [read_point(point, settings.missingness) for point in points]
    for missingness in read:
        env = make_evaluation_environment(
            settings, trained.belief, trained.agent, episodes=episodes, missingness=missingness
        )
        for mode in modes:
            result = evaluate(
                trained.agent.policy, env, mode=mode, seed=seed, statistics=trained.statistics
            )
            assert result is not None  # nothing asks it to stop
            yield missingness, mode, result
        env.close()


def episode_rows(
    trained: TrainedAgent, missingness: MissingnessSettings, mode: str, result: Episodes
) -> list[dict[str, Any]]:
    """Return one row an episode.

    Args:
        trained: the agent.
        missingness: what did not arrive.
        mode: kind of action.
        result: the episodes.

    Returns:
        Columns and values, the same columns for every evaluation.
    """
    settings = trained.settings
    common = {
        "env": settings.env.env_id,
        "belief": settings.belief.get("name", ""),
        "training_seed": settings.seed,
        "frames": trained.frames,
        "trained_mechanism": settings.missingness.mechanism,
        "trained_eta": settings.missingness.eta,
        "noise_sigma": settings.noise.sigma,
        "mechanism": missingness.mechanism,
        "eta": missingness.eta,
        "mechanism_seed": missingness.mechanism_seed,
        "mode": mode,
    }
    likelihoods: Sequence[float | None] = result.log_likelihoods or [None] * len(result.returns)
    columns = zip(result.returns, result.lengths, result.missing_ratios, likelihoods, strict=True)
    return [
        common
        | {
            "episode": index,
            "return": value,
            "length": length,
            "missing_ratio": missing,
            "log_likelihood": likelihood,
        }
        for index, (value, length, missing, likelihood) in enumerate(columns)
    ]
