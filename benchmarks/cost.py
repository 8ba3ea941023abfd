"""What does each belief cost, in training and at a decision?

Every entry of conf/belief in the same recipe on the same task, taking turns within one run: seconds
per 1000 environment steps of complete training rollouts (2048 frames collected, 10 epochs of
updates; simulators, transforms and heads included), and microseconds from the observation that
arrived to the action, for one robot and for as many as are collected from at once. Ratios are over
drbpn within a round. The first rollouts of a run are timed: episodes are short and resets frequent,
alike for all. What a belief leaves to the environment (fill's filling) counts in training only.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

import torch
from recipe import Training, assemble, settings_of, train_rollout
from tensordict import TensorDictBase
from timing import CLOCKS, ROOT, Times, finish, interleave, parser, start, table
from torchrl.envs import ExplorationType, set_exploration_type

BASE = "drbpn"


def main() -> None:
    """Run from the command line."""
    args = parser(__doc__ or "")
    known = sorted(path.stem for path in (ROOT / "conf" / "belief").glob("*.yaml"))
    args.add_argument("--env", default="walker2d", help="an entry of conf/env")
    args.add_argument("--beliefs", nargs="+", default=known, choices=known, metavar="BELIEF")
    args = args.parse_args()
    run = start(args)
    rounds = args.rounds or (1 if args.quick else 5)
    warnings.filterwarnings("ignore", category=FutureWarning)
    size = ["collector.num_envs=2", "collector.steps_per_env=16", "optim.epochs=1"]
    small = [*size, "optim.minibatches=2"] if args.quick else []
    names = [BASE, *(name for name in args.beliefs if name != BASE)]
    trainings: dict[str, Training] = {}
    rollouts: dict[str, Callable[[], object]] = {}
    rows: dict[str, TensorDictBase] = {}
    for name in names:
        settings = settings_of(
            f"env={args.env}", f"belief={name}", f"threads={args.threads}", *small
        )
        training = trainings[name] = assemble(settings)
        rollouts[name] = lambda t=training, s=settings: train_rollout(t, s)
        # Inside an episode, so that a memory has something in it.
        rows[name] = training.collector.rollout()[:, settings.collector.steps_per_env // 2].clone()
    frames, robots = settings.collector.frames, settings.collector.num_envs
    clock = CLOCKS[args.clock]
    trained = interleave(rollouts, rounds=rounds, warmup=1, clock=clock)
    decided = {
        batch: decisions(trainings, rows, batch, rounds=rounds, quick=args.quick, clock=clock)
        for batch in (1, robots)
    }
    for training in trainings.values():
        training.collector.shutdown()
    per_1000 = {name: 1000 / frames * trained.median(name) for name in names}
    columns = ["belief", "parameters", "s / 1000 steps", "+-", f"/ {BASE}"]
    for batch in decided:
        columns += [f"us, batch {batch}", "+-", f"/ {BASE}"]
    table(
        f"{settings.env.env_id}, {frames} frames and {settings.optim.epochs} epochs a rollout",
        columns,
        [
            (
                name,
                count_parameters(trainings[name]),
                per_1000[name],
                trained.percent(name),
                trained.ratio(name, BASE),
                *(
                    cell
                    for times in decided.values()
                    for cell in (
                        1e6 * times.median(name),
                        times.percent(name),
                        times.ratio(name, BASE),
                    )
                ),
            )
            for name in names
        ],
    )
    results = {
        name: {
            "parameters": count_parameters(trainings[name]),
            "seconds_per_1000_steps": per_1000[name],
            "training_ratio": trained.ratio(name, BASE),
            **{f"decision_us_batch_{b}": 1e6 * t.median(name) for b, t in decided.items()},
        }
        for name in names
    }
    finish(args, run, results)


def decisions(
    trainings: dict[str, Training],
    rows: dict[str, TensorDictBase],
    batch: int,
    *,
    rounds: int,
    quick: bool,
    clock: Callable[[], float],
) -> Times:
    """Time the policies on what some robots sensed, one step each."""
    candidates: dict[str, Callable[[], object]] = {}
    for name, training in trainings.items():
        policy = training.agent.policy.eval()
        source = rows[name][:batch].select(*policy.in_keys, strict=False)
        candidates[name] = lambda policy=policy, source=source: policy(source.copy())
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return interleave(
            candidates, rounds=rounds, sample_seconds=0.0 if quick else 0.1, clock=clock
        )


def count_parameters(training: Training) -> int:
    """Return how many numbers the belief module has learned, the heads left out."""
    return sum(parameter.numel() for parameter in training.agent.belief.parameters())


if __name__ == "__main__":
    main()
