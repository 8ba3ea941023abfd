"""How fast does the whole recipe train beside what a user could pick instead?

Environment steps per second of complete training rollouts (2048 frames collected, 10 epochs of
updates) on the same task with the same threads, one rollout of each per round:

- ours, defaults (16 environments, 8 minibatches) and experiment=paper (32), corrupted sensors;
- stable-baselines3 PPO (16 environments, 32 minibatches of 64, networks 2 x 64), clean sensors;
- sb3-contrib RecurrentPPO (the same with an LSTM of width 64), clean sensors;
- TorchRL's PPO as its MuJoCo example is set (1 environment, 32 minibatches, GAE every epoch).

A peer that is not installed is left out: pip install -e '.[peers]'.
"""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Callable
from typing import Any

import torch
from recipe import assemble, settings_of, train_rollout
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from timing import CLOCKS, finish, interleave, parser, start, table, verdict
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.envs import (
    ClipTransform,
    DoubleToFloat,
    GymEnv,
    RewardSum,
    StepCounter,
    TransformedEnv,
    VecNorm,
)
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss, group_optimizers
from torchrl.objectives.value import GAE

SB3, RECURRENT, TORCHRL = "stable-baselines3 PPO", "sb3-contrib RecurrentPPO", "TorchRL PPO recipe"
PAPER, DEFAULTS = "ours, experiment=paper", "ours, defaults"
TARGETS = (
    (PAPER, SB3, 0.6, 1.0),
    (PAPER, RECURRENT, 5.0, 10.0),
    (PAPER, TORCHRL, 4.0, 8.0),
    (DEFAULTS, SB3, 1.2, 2.0),
)


class Size:
    """How much every candidate collects and learns in a rollout."""

    def __init__(self, quick: bool) -> None:
        self.envs, self.steps, self.epochs, self.batch = (
            (2, 16, 1, 16) if quick else (16, 128, 10, 64)
        )
        self.frames = self.envs * self.steps


def ours(size: Size, *overrides: str) -> Callable[[], object]:
    """Make our recipe's rollout and update."""
    settings = settings_of(
        *overrides,
        f"collector.num_envs={size.envs}",
        f"collector.steps_per_env={size.steps}",
        f"optim.epochs={size.epochs}",
    )
    training = assemble(settings)
    return lambda: train_rollout(training, settings)


def stable_baselines(env_id: str, size: Size, recurrent: bool) -> Callable[[], object]:
    """Make stable-baselines3's PPO, or RecurrentPPO, on as many environments."""
    from stable_baselines3.common.env_util import make_vec_env

    envs = make_vec_env(env_id, n_envs=size.envs, seed=0)
    kwargs: dict[str, Any] = {
        "n_steps": size.steps,
        "batch_size": size.batch,
        "n_epochs": size.epochs,
        "seed": 0,
        "device": "cpu",
    }
    if recurrent:
        from sb3_contrib import RecurrentPPO

        policy = {"lstm_hidden_size": 64}
        model = RecurrentPPO("MlpLstmPolicy", envs, policy_kwargs=policy, **kwargs)
    else:
        from stable_baselines3 import PPO

        model = PPO("MlpPolicy", envs, **kwargs)
    return lambda: model.learn(size.frames, reset_num_timesteps=False)


class TorchRLRecipe:
    """PPO from TorchRL's parts with the settings of its MuJoCo example (Schulman et al. 2017)."""

    def __init__(self, env_id: str, size: Size) -> None:
        env = TransformedEnv(GymEnv(env_id))
        for transform in (
            VecNorm(in_keys=["observation"], decay=0.99999, eps=1e-2),
            ClipTransform(in_keys=["observation"], low=-10, high=10),
            RewardSum(),
            StepCounter(),
            DoubleToFloat(in_keys=["observation"]),
        ):
            env.append_transform(transform)
        obs = env.observation_spec["observation"].shape[-1]
        spec = env.action_spec_unbatched
        action = spec.shape[-1]
        policy, value = (
            MLP(
                in_features=obs,
                out_features=out,
                num_cells=[64, 64],
                activation_class=torch.nn.Tanh,
            )
            for out in (action, 1)
        )
        for network, gain in ((policy, 1.0), (value, 0.01)):
            for layer in network.modules():
                if isinstance(layer, torch.nn.Linear):
                    torch.nn.init.orthogonal_(layer.weight, gain)
                    torch.nn.init.zeros_(layer.bias)
        actor = ProbabilisticActor(
            TensorDictModule(
                torch.nn.Sequential(policy, AddStateIndependentNormalScale(action, scale_lb=1e-8)),
                in_keys=["observation"],
                out_keys=["loc", "scale"],
            ),
            in_keys=["loc", "scale"],
            spec=env.full_action_spec_unbatched,
            distribution_class=TanhNormal,
            distribution_kwargs={
                "low": spec.space.low,
                "high": spec.space.high,
                "tanh_loc": False,
            },
            return_log_prob=True,
        )
        critic = ValueOperator(value, in_keys=["observation"])
        self.collector = Collector(
            env,
            actor,
            frames_per_batch=size.frames,
            total_frames=-1,
            max_frames_per_traj=-1,
            auto_register_policy_transforms=False,
        )
        self.batches = iter(self.collector)
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(size.frames),
            sampler=SamplerWithoutReplacement(),
            batch_size=size.batch,
        )
        self.advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=False)
        self.loss = ClipPPOLoss(
            actor_network=actor,
            critic_network=critic,
            clip_epsilon=0.2,
            loss_critic_type="l2",
            entropy_coeff=0.0,
            critic_coeff=0.25,
            normalize_advantage=True,
        )
        self.optimizer = group_optimizers(
            *(
                torch.optim.Adam(part.parameters(), lr=torch.tensor(3e-4), eps=1e-5)
                for part in (actor, critic)
            )
        )
        self.epochs = size.epochs

    def __call__(self) -> None:
        """Collect one rollout and learn from it."""
        data = next(self.batches)
        for _ in range(self.epochs):
            with torch.no_grad():
                data = self.advantage(data)
            self.buffer.extend(data.reshape(-1))
            for batch in self.buffer:
                self.optimizer.zero_grad(set_to_none=True)
                out = self.loss(batch)
                total = out["loss_critic"] + out["loss_objective"] + out["loss_entropy"]
                total.backward()
                self.optimizer.step()


def main() -> None:
    """Run from the command line."""
    args = parser(__doc__ or "")
    args.add_argument("--env", default="walker2d", help="an entry of conf/env, version v5")
    args = args.parse_args()
    run = start(args)
    # The example itself uses VecNorm, which TorchRL deprecates.
    warnings.filterwarnings("ignore", category=FutureWarning)
    size = Size(args.quick)
    rounds = args.rounds or (1 if args.quick else 5)
    common = [f"env={args.env}", "env.version=v5", f"threads={args.threads}"]
    few = ["optim.minibatches=2"] if args.quick else []
    env_id = settings_of(*common).env.env_id
    candidates = {
        DEFAULTS: ours(size, *common, *few),
        PAPER: ours(size, "experiment=paper", *common, *few),
        "ours, belief=none": ours(size, "belief=none", *common, *few),
    }
    for name, package, recurrent in (
        (SB3, "stable_baselines3", False),
        (RECURRENT, "sb3_contrib", True),
    ):
        if importlib.util.find_spec(package) is None:
            print(f"{name} left out: not installed (pip install -e '.[peers]').")
        else:
            candidates[name] = stable_baselines(env_id, size, recurrent)
    candidates[TORCHRL] = TorchRLRecipe(env_id, size)
    torch.set_num_threads(args.threads)  # whatever a peer set at its construction
    times = interleave(candidates, rounds=rounds, warmup=1, clock=CLOCKS[args.clock])
    speed = {name: size.frames / times.median(name) for name in times.seconds}
    ratios = {(a, b): times.ratio(b, a) for a in times.seconds for b in times.seconds}
    base = SB3 if SB3 in speed else DEFAULTS
    table(
        f"{env_id}, {size.frames} frames and {size.epochs} epochs a rollout",
        ("", "steps/s", "+-", f"x {base}"),
        [(name, speed[name], times.percent(name), ratios[name, base]) for name in speed],
    )
    for name, peer, must, aim in TARGETS:
        if peer in speed:
            print(verdict(f"{name} / {peer}", ratios[name, peer], must, aim, quick=args.quick))
    results = {
        "steps_per_second": speed,
        "ratios": {f"{a} / {b}": value for (a, b), value in ratios.items() if a != b},
    }
    finish(args, run, results)


if __name__ == "__main__":
    main()
