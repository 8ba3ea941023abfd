"""Evaluation of the agent of a run while it trains, and at its end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from omegaconf import DictConfig
from training.state import Training

from evaluation.episodes import Episodes, evaluate
from evaluation.trained import TrainedAgent


def evaluate_training(
    config: DictConfig,
    training: Training,
    kind: str,
    episodes: int,
    stop: Callable[[], bool],
) -> list[dict[str, Any]] | None:
    """Evaluate the agent of a run as it is now; nothing of the training changes.

    Returns a row for each kind of action (:data:`training.run_folder.EVALUATION_COLUMNS`), or None
    where ``stop``, asked at every step, gave the evaluation up.
    """
    make_env = TrainedAgent(config, training.agent, training.frames).environments()
    rows = []
    for mode in config.evaluation.modes:
        result = evaluate(
            training.agent.policy,
            make_env,
            episodes=episodes,
            mode=mode,
            seed=config.evaluation.seed,
            stop=stop,
        )
        if result is None:
            return None
        rows.append({"frames": training.frames, "kind": kind, "mode": mode} | _numbers(result))
    return rows


def _numbers(result: Episodes) -> dict[str, Any]:
    return {
        "episodes": len(result.returns),
        "return_mean": result.mean_return,
        "return_std": result.std_return,
        "length_mean": sum(result.lengths) / len(result.lengths),
        "missing_ratio": result.missing_ratio,
        "log_likelihood": result.log_likelihood,
    }
