"""Evaluation of the agent of a run while it trains, and at its end."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from omegaconf import DictConfig
from training.run_folder import EVALUATION_COLUMNS
from training.state import Training

from evaluation.episodes import evaluate, over_episodes
from evaluation.trained import TrainedAgent


def evaluate_training(
    config: DictConfig, training: Training, kind: str, episodes: int, stop: Callable[[], bool]
) -> list[dict[str, Any]] | None:
    """Evaluate the agent of a run as it is now; nothing of the training changes.

    Returns a row for each kind of action, or None where ``stop``, asked at every step, gave the
    evaluation up.
    """
    make_env = TrainedAgent(config, training.agent, training.frames).environments()
    how: Any = {"episodes": episodes, "seed": config.evaluation.seed, "stop": stop}
    rows = []
    for mode in config.evaluation.modes:
        result = evaluate(training.agent.policy, make_env, mode=mode, **how)
        if result is None:
            return None
        result = result.assign(frames=training.frames, kind=kind, mode=mode)
        table = over_episodes(result, ["frames", "kind", "mode"])
        table = table.fillna({"return_std": 0.0})  # of one episode
        (row,) = table.astype(object).to_dict("records")
        rows.append({c: None if row[c] != row[c] else row[c] for c in EVALUATION_COLUMNS})
    return rows
