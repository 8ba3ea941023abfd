"""What does collection cost beside the bare simulators?

All candidates step 16 environments of one task through the same backend in one run: Gymnasium's
own SyncVectorEnv, GymnasiumBatchEnv by itself, then TorchRL's Collector over it with random
actions, with random actions and the recipe's transforms, with policy and transforms. Random actions
are drawn ahead of the clock for all of them; one more line shows what TorchRL's RandomPolicy, which
draws at every step, adds. The share is frames per second over SyncVectorEnv's: 1 is "collecting
costs nothing".
"""

from __future__ import annotations

from itertools import cycle

import gymnasium
import torch
from gymnasium.vector import AutoresetMode
from recipe import assemble, settings_of
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from timing import CLOCKS, finish, interleave, parser, start, table, verdict
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, InitTracker, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import RandomPolicy

from torchrl_drbpn import GymnasiumBatchEnv

BARE = "gymnasium SyncVectorEnv"
TARGETS = {
    "collector, random, transforms": (0.75, 0.85),
    "collector, policy, transforms": (0.50, 0.65),
}


def make_collector(env: TransformedEnv, policy: object, frames: int) -> Collector:
    """Build a collector as the recipe does."""
    return Collector(
        env,
        policy,
        frames_per_batch=frames,
        total_frames=-1,
        track_traj_ids=False,
        use_buffers=True,
        auto_register_policy_transforms=False,
    )


class Bare:
    """Gymnasium's vector environment under random actions drawn ahead.

    It resets within the step that ends an episode, as the others here do: by its default the next
    call would reset and not step, and fewer than all of its frames would be steps.
    """

    def __init__(self, env_id: str, num_envs: int, steps: int) -> None:
        self.envs = gymnasium.make_vec(
            env_id,
            num_envs,
            vectorization_mode="sync",
            vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
        )
        self.envs.reset(seed=0)
        self.envs.action_space.seed(0)
        self.actions = [self.envs.action_space.sample() for _ in range(steps)]

    def __call__(self) -> None:
        """Step through one rollout; finished episodes begin again by themselves."""
        for action in self.actions:
            self.envs.step(action)


class DrawnAhead(TensorDictModuleBase):
    """Random actions drawn ahead, as the bare environment has them."""

    def __init__(self, env: EnvBase, steps: int) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [], ["action"]
        self.actions = cycle([env.full_action_spec.rand()["action"] for _ in range(steps)])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next one."""
        return tensordict.set("action", next(self.actions))


class BareBatch:
    """GymnasiumBatchEnv by itself, stepped and reset as TorchRL does."""

    def __init__(self, env_id: str, num_envs: int, steps: int) -> None:
        self.env = GymnasiumBatchEnv(env_id, num_envs, seed=0)
        self.root = self.env.reset()
        self.actions = [self.env.full_action_spec.rand()["action"] for _ in range(steps)]

    @torch.no_grad()
    def __call__(self) -> None:
        """Step through one rollout."""
        root = self.root
        for action in self.actions:
            root.set("action", action)
            _, root = self.env.step_and_maybe_reset(root)
        self.root = root


def main() -> None:
    """Run from the command line."""
    args = parser(__doc__ or "")
    args.add_argument("--env", default="walker2d", help="an entry of conf/env")
    args.add_argument("--num-envs", type=int, default=16)
    args = args.parse_args()
    run = start(args)
    num_envs, steps = (2, 16) if args.quick else (args.num_envs, 128)
    rounds = args.rounds or (2 if args.quick else 9)
    overrides = [
        f"env={args.env}",
        f"collector.num_envs={num_envs}",
        f"collector.steps_per_env={steps}",
        "optim.minibatches=1",
    ]
    settings = settings_of(*overrides)
    env_id, frames = settings.env.env_id, num_envs * steps

    trained = assemble(settings)
    few = TransformedEnv(GymnasiumBatchEnv(env_id, num_envs, seed=0))
    for transform in (RewardSum(), StepCounter(), InitTracker()):
        few.append_transform(transform)
    random = {
        "collector, random, no transform": GymnasiumBatchEnv(env_id, num_envs, seed=0),
        "collector, random, TorchRL's three": few,
        "collector, random, transforms": assemble(settings).env,
    }
    collectors = {
        name: make_collector(env, DrawnAhead(env, steps), frames) for name, env in random.items()
    }
    drawing = assemble(settings).env
    collectors["collector, RandomPolicy, transforms"] = make_collector(
        drawing, RandomPolicy(drawing.full_action_spec), frames
    )
    collectors["collector, policy, transforms"] = trained.collector
    candidates = {
        BARE: Bare(env_id, num_envs, steps),
        "GymnasiumBatchEnv": BareBatch(env_id, num_envs, steps),
    } | {name: collector.rollout for name, collector in collectors.items()}
    times = interleave(candidates, rounds=rounds, warmup=1, clock=CLOCKS[args.clock])
    shares = {name: 1 / times.ratio(name, BARE) for name in times.seconds}
    rows = [
        (
            name,
            frames / times.median(name),
            times.percent(name),
            1e6 * times.median(name) / steps,
            shares[name],
            1 / times.ratio(name, "GymnasiumBatchEnv"),
        )
        for name in times.seconds
    ]
    table(
        f"{env_id}, {num_envs} environments, {frames} frames",
        ("", "frames/s", "+-", "us/step", f"share of {BARE}", "of GymnasiumBatchEnv"),
        rows,
    )
    for name, (must, aim) in TARGETS.items():
        print(verdict(name, shares[name], must, aim, quick=args.quick))
    for collector in collectors.values():
        collector.shutdown()
    results = {
        name: {"frames_per_second": frames / times.median(name), "share": shares[name]}
        for name in times.seconds
    }
    finish(args, run, results)


if __name__ == "__main__":
    main()
