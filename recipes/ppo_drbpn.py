"""Train an agent on incomplete, noisy sensors: ``python recipes/ppo_drbpn.py env=walker2d``.

Settings and their defaults stand in conf/. A run leaves its configuration, tables, checkpoints and
versions in ``runs/<task>-<belief>-seed<seed>-<time>``; ``resume=<that folder>`` continues it.
Ctrl-C and SIGTERM save after the rollout in progress and leave with status 130 or 143.
"""

import contextlib
import sys
import time
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import hydra
import torch
from evaluation.folders import override
from evaluation.trained import evaluate_training
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from hydra_plugins.cell_sweeper import continued, run_cell
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch.linalg import LinAlgError  # type: ignore[attr-defined]
from tqdm import tqdm
from training.agent import add_primers, device_named, make_agent, start_from_pretrained
from training.checkpoint import checkpoint_frames, last_checkpoint, load_checkpoint, save_checkpoint
from training.config import build, checked, explained, one_line, run_command
from training.console import BAR, StopRequest, log_line, show, stop_request
from training.envs import env_name, make_env
from training.errors import DivergedError, EnvironmentFault, UserError
from training.ppo import add_advantages, finished_episodes, rollout_metrics
from training.reward_scale import ReturnStatistics
from training.run_folder import (
    RunLog,
    is_evaluated,
    load_config,
    locked,
    resumed_config,
    write_config,
    write_versions,
)
from training.state import Training

from torchrl_drbpn import BeliefDivergedError


def assemble(config: DictConfig) -> Training:
    """Build everything a run needs; weights and actions come from torch's global generator."""
    device = device_named(config.get("device", "cpu"))
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    env = make_env(config)
    agent = make_agent(config, env).to(device)
    if config.resume is None:
        start_from_pretrained(agent)
    add_primers(env, agent)
    loss = build("loss", config.loss, agent)
    steps = build("optim", config.optim, agent.parameters())
    gae = build("advantage", config.advantage).to(device)
    gae.set_keys(reward="scaled_reward")
    made: Any = partial(make_env, config)
    learned: Any = {"loss": loss, "steps": steps, "gae": gae, "seed": config.seed}
    return Training(
        env=env,
        agent=agent,
        collector=build("collector", config.collector, env, agent.policy, made),
        gae=gae,
        algorithm=build("algo", config.algo, agent, **learned),
        scale_reward=build("normalisation.reward", config.normalisation.reward),
        reward_statistics=ReturnStatistics.start(env.batch_size[0]),
    )


def collect(training: Training) -> TensorDictBase:
    """Collect one rollout; scale its rewards and normalise the observations after its steps."""
    try:
        with warnings.catch_warnings():
            # The simulators warn of an engine that reset itself; the loop counts and says it.
            warnings.filterwarnings("ignore", "MuJoCo gave up the state", RuntimeWarning)
            # The collector writes every rollout into the same tensors: what is entered is ours.
            data = training.collector.rollout().copy()
    except (BeliefDivergedError, LinAlgError, UserError):
        raise
    except Exception as error:  # whatever a simulator raises
        raise EnvironmentFault(f"the environment failed: {one_line(error)}") from error
    following = data.get("next")
    arrived = following["observation"].where(following["observed"], 0.0)
    for name, value in (("reward", following["reward"]), ("observation", arrived)):
        wrong = (~value.isfinite()).flatten(1).any(1).nonzero()
        if len(wrong):
            raise EnvironmentFault(f"the {name} of environment {int(wrong[0])} is not finite.")
    scaled, training.reward_statistics = training.scale_reward(
        following["reward"], following["done"], training.reward_statistics
    )
    following.set("scaled_reward", scaled)
    training.agent.norm(following)
    return data


def train_rollout(
    training: Training, config: DictConfig
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Collect one rollout and learn from it; return its numbers, and a row a finished episode."""
    if training.frames == 0:
        # First statistics, from a rollout that is not trained on.
        training.agent.after_rollout(collect(training))
        training.start_episodes()
    remaining = max(0.0, 1 - training.frames / config.total_frames)
    data = collect(training)
    add_advantages(data, training.agent, training.gae)
    metrics = rollout_metrics(data)
    update = training.algorithm.update(data, remaining)
    training.agent.after_rollout(data)
    training.frames += data.numel()
    finished = finished_episodes(data, training.frames)
    training.episodes += len(finished)
    training.returns.extend(episode["return"] for episode in finished)
    recent = training.returns
    row = {
        "frames": training.frames,
        "episodes": training.episodes,
        "return": sum(recent) / len(recent) if recent else None,
        "engine_resets": training.engine_resets,
        **metrics,
        **training.agent.summary(),
    }
    # The rollout's own log-likelihood, of data not yet learned from, goes before the update's.
    return update | row, finished


def train(config: DictConfig, folder: Path) -> int:
    """Train an agent to the end, save and evaluate it; return the exit status.

    The status is 130 or 143 where Ctrl-C or SIGTERM stopped the run; it was saved then.
    """
    training = assemble(config)
    with locked(folder), stop_request() as stop:
        frames = evaluated = None
        if config.resume is None:
            if (folder / "config.yaml").exists():
                ended = "that ended before its first checkpoint: remove it, or name another folder"
                goes_on = f"already: name another folder, or {override('resume', folder)}"
                there = checkpoint_frames(folder) is not None
                raise UserError(f"`{folder}` holds a run {goes_on if there else ended}.")
        else:
            path = last_checkpoint(folder)
            training.load_state_dict(load_checkpoint(path), str(path))
            frames, evaluated = training.frames, training.evaluated_frames
            # A run ends with a whole rollout, which may be past what was asked for.
            if config.total_frames < min(frames, load_config(folder).total_frames):
                raise UserError(
                    f"`total_frames` must be at least the {frames:,} that `{folder}` has been "
                    f"trained for, got {config.total_frames:,}."
                )
            if frames >= config.total_frames and is_evaluated(folder, config):
                log_line(f"`{folder}` is at its end; more total_frames go on with it")
                return 0
            if not training.keeps_simulators:
                log_line(
                    f"{env_name(config)} can't save its state here: going on with new episodes"
                )
        log = RunLog(folder, config, list(training.agent.summary()), frames, evaluated)
        write_config(folder, config)
        write_versions(folder)
        log_line(f"run folder: {folder}")
        _loop(training, config, folder, log, stop)
    training.collector.shutdown()
    return stop.exit_code


def _loop(
    training: Training, config: DictConfig, folder: Path, log: RunLog, stop: StopRequest
) -> None:
    saved = first = training.frames
    first_seconds, resets = training.seconds, training.engine_resets
    keep, save_every = config.checkpoint.keep, config.checkpoint.every_frames

    def save(simulators: bool = True) -> None:
        nonlocal saved
        state = training.state_dict(simulators=simulators)
        save_checkpoint(folder, training.frames, state, keep=keep)
        saved = training.frames

    def evaluate_when_due() -> None:
        every, episodes = config.evaluation.every_frames, config.evaluation.episodes
        due = every and training.frames // every > max(training.evaluated_frames, 0) // every
        if not due or not episodes or training.frames >= config.total_frames:
            return  # the final evaluation follows the last frame
        rows = evaluate_training(config, training, "training", episodes, lambda: bool(stop))
        if rows is not None:  # stopped: due again when the run is resumed
            training.evaluated_frames = training.frames
            log.evaluation(rows)
            bar.clear()
            log_line(_summary(rows))

    with tqdm(
        total=config.total_frames, initial=training.frames, unit="step", unit_scale=True,
        dynamic_ncols=True, smoothing=0.1, mininterval=1.0, bar_format=BAR,
    ) as bar:  # fmt: skip
        evaluate_when_due()  # one that a signal cut short
        while training.frames < config.total_frames and not stop:
            before, clock = training.frames, time.perf_counter()
            try:
                row, finished = train_rollout(training, config)
            except EnvironmentFault as error:
                if before > saved:  # without the simulators: a resumed run starts new episodes
                    save(simulators=False)
                raise _stopped(error, before, saved, folder) from error
            except (DivergedError, BeliefDivergedError, LinAlgError, ValueError) as error:
                raise _stopped(error, before, saved, folder) from error
            seconds = time.perf_counter() - clock
            training.seconds += seconds
            row["steps_per_second"] = (training.frames - before) / seconds
            row["wall_time"] = training.seconds
            log.rollout(row, finished)
            show(bar, row)
            if not resets and row["engine_resets"]:
                resets = row["engine_resets"]
                bar.clear()
                log_line(
                    "an engine gave up its simulation's state and reset it: that episode ended as "
                    "truncated; metrics.csv counts `engine_resets`"
                )
            evaluate_when_due()
            if training.frames // save_every > saved // save_every:
                save()
    if training.frames != saved:
        save()
    if training.seconds > first_seconds:
        speed = (training.frames - first) / (training.seconds - first_seconds)
        log_line(f"{speed:.0f} steps/s in collection and update, start-up and evaluation excluded")
    if stop and not training.frames:
        log_line("stopped before the first rollout: nothing to go on with")
    elif stop:
        log_line(f"stopped and saved; continue with {override('resume', folder)}")
    elif episodes := config.evaluation.final_episodes:
        rows = evaluate_training(config, training, "final", episodes, lambda: bool(stop))
        if rows is not None:
            log.evaluation(rows)
            log_line(_summary(rows))


def _stopped(error: Exception, before: int, saved: int, folder: Path) -> UserError:
    kept = f" Its last checkpoint, at {saved:,} steps, is in {folder}." if saved else ""
    return UserError(f"training stopped at {before:,} steps: {one_line(error)}{kept}")


def _summary(rows: list[dict[str, Any]]) -> str:
    parts = [
        f"{row['mode']} actions {row['return_mean']:.1f} +- {row['return_std']:.1f}" for row in rows
    ]
    first = rows[0]
    return (
        f"{first['kind']} evaluation at {first['frames']:,} steps, {first['episodes']} episodes, "
        f"missing {first['missing_ratio']:.3f}: {', '.join(parts)}"
    )


def job(config: DictConfig, words: Sequence[str], folder: Path) -> int:
    """Run one job of the command line, by the words of it."""
    config = checked(config, words)
    if config.resume is not None:
        config = resumed_config(config, words, folder)
    return train(config, folder)


def cell(config: DictConfig, words: Sequence[str], folder: Path) -> int:
    """Run one job of a sweep, from wherever its folder stands."""
    wanted = continued(checked(config, words), folder)
    if wanted is None:
        return 0
    status = train(wanted, folder)
    if not status:
        log_line(f"{folder.name}: done")
    return status


@hydra.main(version_base="1.3", config_path="../conf", config_name="config")
def main(config: DictConfig) -> tuple[str, str] | None:
    """Start from the command line."""
    hydra_config = HydraConfig.get()
    folder, words = Path(hydra_config.runtime.output_dir), list(hydra_config.overrides.task)
    sweeping = hydra_config.mode == RunMode.MULTIRUN
    outcome = run_cell(lambda: cell(config, words, folder), folder) if sweeping else None
    status = 0 if sweeping else explained(lambda: job(config, words, folder))
    # Hydra makes the folder before any setting is looked at: leave none behind for a bad one.
    with contextlib.suppress(OSError):
        folder.rmdir()
    if status:
        sys.exit(status)
    return outcome


if __name__ == "__main__":
    run_command(main)
