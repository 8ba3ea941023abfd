"""Which batch of simulators steps fastest, and what does TorchRL's interface cost over EnvPool?

All candidates step 16 environments of one task under the same random actions in one run:
GymnasiumBatchEnv and EnvPoolBatchEnv, stepped and reset as TorchRL's collectors do, and the bare
EnvPool loop without TorchRL, each with 1 and 2 threads. The bare loop starts finished episodes
by itself. "x" is frames per second over those of GymnasiumBatchEnv with 1 thread; "of bare" over
those of the bare EnvPool loop with as many threads.
"""

from __future__ import annotations

import statistics

import numpy as np
import torch
from timing import CLOCKS, finish, interleave, parser, start, table

from torchrl_drbpn import EnvPoolBatchEnv, GymnasiumBatchEnv

BASE = "GymnasiumBatchEnv, 1 thread"
BARE = "bare EnvPool"


class Batch:
    """One of the package's environments, stepped and reset as TorchRL does."""

    def __init__(
        self, env: EnvPoolBatchEnv | GymnasiumBatchEnv, actions: list[torch.Tensor]
    ) -> None:
        self.env, self.actions = env, actions
        self.root = env.reset()

    @torch.no_grad()
    def __call__(self) -> None:
        """Step through one rollout."""
        root = self.root
        for action in self.actions:
            root.set("action", action)
            _, root = self.env.step_and_maybe_reset(root)
        self.root = root


class Bare:
    """EnvPool's own Gymnasium interface, nothing around it."""

    def __init__(
        self, env_id: str, num_envs: int, threads: int, actions: list[torch.Tensor]
    ) -> None:
        import envpool

        self.pool = envpool.make_gymnasium(env_id, num_envs=num_envs, num_threads=threads, seed=0)
        self.pool.reset()
        self.actions = [action.numpy().astype(np.float64) for action in actions]

    def __call__(self) -> None:
        """Step through one rollout."""
        for action in self.actions:
            self.pool.step(action)


def main() -> None:
    """Run from the command line."""
    args = parser(__doc__ or "")
    args.add_argument("--tasks", nargs="+", default=["Walker2d-v5", "HalfCheetah-v5", "Ant-v5"])
    args.add_argument("--num-envs", type=int, default=16)
    args.add_argument("--env-threads", nargs="+", type=int, default=[1, 2])
    args = args.parse_args()
    run = start(args)
    tasks = args.tasks[:1] if args.quick else args.tasks
    num_envs, steps = (2, 16) if args.quick else (args.num_envs, 128)
    rounds = args.rounds or (2 if args.quick else 9)
    results = {}
    for env_id in tasks:
        spec = GymnasiumBatchEnv(env_id, num_envs).full_action_spec["action"]
        generator = torch.Generator().manual_seed(0)
        low, high = spec.space.low, spec.space.high
        actions = [
            low + (high - low) * torch.rand(low.shape, generator=generator) for _ in range(steps)
        ]
        candidates: dict[str, Batch | Bare] = {}
        bare_of = {}
        for threads in args.env_threads:
            label = f"{threads} thread{'s' * (threads > 1)}"
            bare = f"{BARE}, {label}"
            for cls in (GymnasiumBatchEnv, EnvPoolBatchEnv):
                env = cls(env_id, num_envs, seed=0, num_threads=threads)
                candidates[f"{cls.__name__}, {label}"] = Batch(env, actions)
                bare_of[f"{cls.__name__}, {label}"] = bare
            candidates[bare] = Bare(env_id, num_envs, threads, actions)
            bare_of[bare] = bare
        base = BASE if BASE in candidates else next(iter(candidates))
        times = interleave(candidates, rounds=rounds, warmup=1, clock=CLOCKS[args.clock])
        frames = num_envs * steps
        rows = [
            (
                name,
                frames / times.median(name),
                times.percent(name),
                1e6 * times.median(name) / steps,
                1 / times.ratio(name, base),
                1 / times.ratio(name, bare_of[name]),
            )
            for name in times.seconds
        ]
        table(
            f"{env_id}, {num_envs} environments, {frames} frames, {rounds} rounds, x over {base}",
            ("", "frames/s", "+-", "us/step", "x", "of bare"),
            rows,
        )
        results[env_id] = {
            name: {"frames_per_second": speed, "ratio": ratio, "of_bare": of_bare}
            for name, speed, _, _, ratio, of_bare in rows
        }
    ours = [name for name in next(iter(results.values())) if name.startswith("EnvPoolBatchEnv")]
    for name in ours:
        gain = statistics.median(result[name]["ratio"] for result in results.values())
        print(f"{name}: {gain:.3g}x in the median task")
    finish(args, run, results)


if __name__ == "__main__":
    main()
