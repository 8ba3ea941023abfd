"""What does collection cost beside the bare simulators, and which backend steps fastest?

All candidates step as many environments of one task in one run: Gymnasium's own SyncVectorEnv and
bare EnvPool, the package's batches by themselves with 1 and 2 threads, then TorchRL's Collector
over GymnasiumBatchEnv: random actions without transforms, with TorchRL's three, with the recipe's,
and the recipe's policy. Random actions are drawn ahead of the clock. A time of 1 over SyncVectorEnv
is "collecting costs nothing".
"""

import importlib.util
from collections.abc import Callable
from itertools import cycle
from typing import Any

import gymnasium
import torch
from gymnasium.vector import AutoresetMode
from interleaved import measure, recipe, show, start
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, InitTracker, RewardSum, StepCounter, TransformedEnv
from training.envs import COLLECTING

from torchrl_drbpn import EnvPoolBatchEnv, GymnasiumBatchEnv

BARE = "SyncVectorEnv"


class DrawnAhead(TensorDictModuleBase):
    """Random actions drawn ahead, as the bare environments have them."""

    def __init__(self, env: EnvBase, steps: int) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [], ["action"]
        self.actions = cycle([env.full_action_spec.rand()["action"] for _ in range(steps)])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the next one."""
        return tensordict.set("action", next(self.actions))


def bare(env: Any, actions: list[Any]) -> Callable[[], None]:
    """Step a vector environment that begins finished episodes by itself, nothing around it."""
    env.reset()

    def rollout() -> None:
        for action in actions:
            env.step(action)

    return rollout


def alone(env: EnvBase, steps: int) -> Callable[[], None]:
    """Step and reset a batch as TorchRL does, without a collector."""
    policy, state = DrawnAhead(env, steps), {"root": env.reset()}

    def rollout() -> None:
        for _ in range(steps):
            _, state["root"] = env.step_and_maybe_reset(policy(state["root"]))

    return rollout


def collected(env: EnvBase, steps: int) -> Callable[[], object]:
    """Collect with random actions as the recipe does with its policy."""
    collector = Collector(
        env,
        DrawnAhead(env, steps),
        frames_per_batch=env.batch_size[0] * steps,
        total_frames=-1,
        **COLLECTING,
    )
    return collector.rollout


def main() -> None:
    """Run from the command line."""
    args = start(__doc__ or "", env="walker2d", num_envs=[16, 64], env_threads=[1, 2])
    for n in [2] if args.quick else args.num_envs:
        steps = 16 if args.quick else 2048 // n
        sizes = (f"collector.num_envs={n}", f"collector.steps_per_env={steps}")
        parts = [recipe(f"env={args.env}", *sizes, "optim.minibatches=1") for _ in range(2)]
        (trained, settings), (drawn, _) = parts
        env_id = f"{settings.env.id}-{settings.env.version}"
        plain = [GymnasiumBatchEnv(env_id, n, seed=0) for _ in range(2)]
        actions = [plain[0].action_spec.rand().double().numpy() for _ in range(steps)]
        kwargs = {"autoreset_mode": AutoresetMode.SAME_STEP}
        vector = gymnasium.make_vec(env_id, n, vectorization_mode="sync", vector_kwargs=kwargs)
        candidates: dict[str, Callable[[], object]] = {BARE: bare(vector, actions)}
        with_envpool = importlib.util.find_spec("envpool") is not None
        for threads in args.env_threads:
            backends = [GymnasiumBatchEnv, EnvPoolBatchEnv] if with_envpool else [GymnasiumBatchEnv]
            for cls in backends:
                env = cls(env_id, n, seed=0, num_threads=threads)
                candidates[f"{cls.__name__}, {threads} threads"] = alone(env, steps)
            if with_envpool:
                import envpool

                pool = envpool.make_gymnasium(env_id, num_envs=n, num_threads=threads, seed=0)
                candidates[f"bare EnvPool, {threads} threads"] = bare(pool, actions)
        three = TransformedEnv(plain[1], Compose(RewardSum(), StepCounter(), InitTracker()))
        candidates |= {
            "collector, random": collected(plain[0], steps),
            "collector, random, TorchRL's three": collected(three, steps),
            "collector, random, recipe's transforms": collected(drawn.env, steps),
            "collector, policy": trained.collector.rollout,
        }
        with torch.no_grad():
            seconds = measure(candidates, args)
        title = f"{env_id}, {n} environments x {steps} steps"
        show(title, seconds, BARE, args, **{"frames/s": n * steps / seconds.median()})


if __name__ == "__main__":
    main()
