"""A training run from its first frame, or from its last checkpoint, to its final evaluation."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from evaluation.episodes import Episodes, evaluate, make_evaluation_environment
from torch.linalg import LinAlgError  # type: ignore[attr-defined]
from torchrl.envs import TransformedEnv
from torchrl.record.loggers import get_logger
from torchrl.record.loggers.common import Logger

from torchrl_drbpn import BeliefDivergedError
from torchrl_drbpn.functional import native_status
from training.checkpoint import last_checkpoint, load_checkpoint, save_checkpoint
from training.config import Settings, read_settings
from training.console import ProgressBar, say
from training.errors import UserError
from training.interruption import StopRequest
from training.loop import (
    Training,
    assemble,
    metric_columns,
    restore,
    train_rollout,
    training_state,
)
from training.run_folder import EVALUATION_COLUMNS, Table, write_config, write_versions


def run(config: Mapping[str, Any], folder: Path) -> int:
    """Train an agent and evaluate it.

    Args:
        config: the resolved configuration as plain containers; ``resume`` names ``folder`` to go
            on from its last checkpoint.
        folder: the run folder.

    Returns:
        Exit status: 0, or 130 or 143 where Ctrl-C or SIGTERM stopped the run. It was saved then.

    Raises:
        UserError: if a setting, the folder or a checkpoint can't be used.
    """
    settings = read_settings(config)
    torch.set_num_threads(settings.threads)
    state, source = None, ""
    if settings.resume is not None:
        path = last_checkpoint(folder)
        state, source = load_checkpoint(path), str(path)
    training = assemble(settings)
    if state is not None:
        restore(training, state, source)
        if state["simulators"] is None:
            say(
                f"env.backend={settings.env.backend} can't save the state of "
                f"{settings.env.env_id}: going on with new episodes"
            )
    slower = native_status() if settings.belief["name"] == "drbpn" else None
    if slower is not None:
        say(f"the belief filter runs in PyTorch, which is slower than in C: {slower}")
    folder.mkdir(parents=True, exist_ok=True)
    write_config(folder, {**config, "resume": None})
    write_versions(folder)
    with StopRequest() as stop:
        _Run(settings, folder, training, stop, resumed=state is not None).go()
    training.collector.shutdown()
    return stop.exit_code


class _Run:
    """The loop of one run, and where its numbers go."""

    def __init__(
        self,
        settings: Settings,
        folder: Path,
        training: Training,
        stop: StopRequest,
        *,
        resumed: bool,
    ) -> None:
        self.settings, self.folder = settings, folder
        self.training, self.stop = training, stop
        frames = training.progress.frames if resumed else None
        self.metrics = Table(folder / "metrics.csv", metric_columns(training), frames)
        # Evaluations that the checkpoint does not know of are made again, the final one included.
        evaluated = training.progress.evaluated_frames if resumed else None
        self.evaluations = Table(folder / "evaluation.csv", EVALUATION_COLUMNS, evaluated)
        self.episodes = Table(folder / "episodes.csv", ("frames", "return", "length"), frames)
        self.logger: Logger = get_logger(
            settings.logger.backend, logger_name=str(folder), experiment_name="logs"
        )
        self.clock = time.perf_counter()
        self.saved_frames = training.progress.frames if resumed else -1

    def go(self) -> None:
        """Train to the end, or until a signal; save; evaluate."""
        settings, progress = self.settings, self.training.progress
        say(f"run folder: {self.folder}")
        first_frames, first_seconds = progress.frames, progress.train_seconds
        self.clock = time.perf_counter()
        with ProgressBar(settings.total_frames, progress.frames) as bar:
            self._evaluate_when_due(bar)  # one that a signal cut short
            while progress.frames < settings.total_frames and not self.stop:
                row, finished = self._timed_rollout()
                self.metrics.append([row])
                self.episodes.append(finished)
                self._log(row)
                bar.update(row)
                self._evaluate_when_due(bar)
                self._save_when_due()
        if progress.frames != self.saved_frames:
            self._save()
        seconds = progress.train_seconds - first_seconds
        if seconds > 0:
            speed = (progress.frames - first_frames) / seconds
            say(
                f"{speed:.0f} steps/s from the first collected frame to the last update, "
                "start-up and evaluation excluded"
            )
        if self.stop:
            say(f"stopped and saved; continue with resume={self.folder}")
            return
        self._final_evaluation()

    def _timed_rollout(self) -> tuple[dict[str, Any], list[dict[str, Any]]]:
        progress = self.training.progress
        before = progress.frames
        try:
            row, finished = train_rollout(self.training, self.settings)
        except (BeliefDivergedError, LinAlgError) as error:
            raise UserError(
                f"training diverged at {before:,} steps: {error} The last checkpoint is in "
                f"{self.folder}; a lower optim.lr starts anew."
            ) from error
        # Logging and saving since the last update count; evaluation has moved the clock on.
        now = time.perf_counter()
        seconds, self.clock = now - self.clock, now
        progress.train_seconds += seconds
        row["steps_per_second"] = (progress.frames - before) / seconds
        row["wall_time"] = progress.train_seconds
        return row, finished

    def _log(self, row: Mapping[str, Any], prefix: str = "train") -> None:
        for key, value in row.items():
            if isinstance(value, (int, float)) and key != "frames":
                self.logger.log_scalar(f"{prefix}/{key}", value, step=row["frames"])

    # Evaluation --------------------------------------------------------------------------------

    def _evaluate_when_due(self, bar: ProgressBar) -> None:
        every = self.settings.evaluation.every_frames
        progress = self.training.progress
        if not every or not self.settings.evaluation.episodes:
            return
        if progress.frames // every == max(progress.evaluated_frames, 0) // every:
            return
        if progress.frames >= self.settings.total_frames:
            return  # the final evaluation follows
        rows = self._evaluate("training", self.settings.evaluation.episodes)
        if rows is None:
            return  # stopped: due again when the run is resumed
        progress.evaluated_frames = progress.frames
        bar.say(_summary(rows))

    def _final_evaluation(self) -> None:
        episodes = self.settings.evaluation.final_episodes
        if not episodes:
            return
        rows = self._evaluate("final", episodes)
        if rows is not None:
            say(_summary(rows))

    def _evaluate(self, kind: str, episodes: int) -> list[dict[str, Any]] | None:
        start = time.perf_counter()
        try:
            return self._evaluate_modes(kind, episodes)
        finally:
            self.clock += time.perf_counter() - start

    def _evaluate_modes(self, kind: str, episodes: int) -> list[dict[str, Any]] | None:
        settings, training = self.settings, self.training

        def make_env(_: int) -> TransformedEnv:
            return make_evaluation_environment(
                settings, training.belief, training.agent, statistics=training.env
            )

        rows = []
        for mode in settings.evaluation.modes:
            result = evaluate(
                training.agent.policy,
                make_env,
                episodes=episodes,
                mode=mode,
                seed=settings.evaluation.seed,
                stop=lambda: bool(self.stop),
            )
            if result is None:
                return None
            rows.append(
                {"frames": training.progress.frames, "kind": kind, "mode": mode}
                | evaluation_row(result)
            )
        self.evaluations.append(rows)
        for row in rows:
            self._log(row, f"evaluation_{row['mode']}")
        return rows

    # Saving ------------------------------------------------------------------------------------

    def _save_when_due(self) -> None:
        every = self.settings.checkpoint.every_frames
        if self.training.progress.frames // every > max(self.saved_frames, 0) // every:
            self._save()

    def _save(self) -> None:
        frames = self.training.progress.frames
        save_checkpoint(
            self.folder,
            frames,
            training_state(self.training),
            keep=self.settings.checkpoint.keep,
        )
        self.saved_frames = frames


def evaluation_row(result: Episodes) -> dict[str, Any]:
    """Return the numbers of an evaluation.

    Args:
        result: its episodes.

    Returns:
        Columns and values.
    """
    return {
        "episodes": len(result.returns),
        "return_mean": result.mean_return,
        "return_std": result.std_return,
        "length_mean": sum(result.lengths) / len(result.lengths),
        "missing_ratio": result.missing_ratio,
        "log_likelihood": result.log_likelihood,
    }


def _summary(rows: list[dict[str, Any]]) -> str:
    parts = [
        f"{row['mode']} actions {row['return_mean']:.1f} +- {row['return_std']:.1f}" for row in rows
    ]
    first = rows[0]
    return (
        f"{first['kind']} evaluation at {first['frames']:,} steps, {first['episodes']} episodes, "
        f"missing {first['missing_ratio']:.3f}: {', '.join(parts)}"
    )
