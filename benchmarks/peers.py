"""How fast does the recipe train and decide beside what a user could pick instead?

Training: complete rollouts (frames collected, epochs learned) of every candidate in turns:

- the recipe with its defaults, with experiment=paper, and with every belief of conf/belief, on
  corrupted sensors;
- stable-baselines3's PPO and sb3-contrib's RecurrentPPO as they are set (10 epochs of minibatches
  of 64, two layers or an LSTM of width 64; 16 environments), clean sensors;
- TorchRL's PPO as its MuJoCo example is set (1 environment, 10 epochs of 32 minibatches, GAE every
  epoch).

``--peer-epochs 5`` gives the peers as many epochs as the recipe's defaults take.

Decisions: the policies of the beliefs from what one robot, and what all of a batch, sensed. Peers
that are not installed are left out: pip install -e '.[peers]'.
"""

import importlib.util
import warnings
from collections.abc import Callable
from typing import Any

import pandas as pd
import torch
from interleaved import ROOT, measure, recipe, show, start
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs import ClipTransform, Compose, DoubleToFloat, GymEnv, TransformedEnv, VecNorm
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

SB3, RECURRENT, TORCHRL = "stable-baselines3 PPO", "sb3-contrib RecurrentPPO", "TorchRL PPO"
DEFAULTS = "defaults"


def stable_baselines(env_id: str, frames: int, epochs: int, recurrent: bool) -> Callable[[], Any]:
    """Make stable-baselines3's PPO, or RecurrentPPO, on 16 environments."""
    from stable_baselines3.common.env_util import make_vec_env

    n = min(16, frames // 16)
    kwargs: dict[str, Any] = {"n_steps": frames // n, "batch_size": min(64, frames)}
    kwargs |= {"n_epochs": epochs, "seed": 0, "device": "cpu"}
    envs = make_vec_env(env_id, n_envs=n, seed=0)
    if recurrent:
        from sb3_contrib import RecurrentPPO

        lstm = {"lstm_hidden_size": 64}
        model = RecurrentPPO("MlpLstmPolicy", envs, policy_kwargs=lstm, **kwargs)
    else:
        from stable_baselines3 import PPO

        model = PPO("MlpPolicy", envs, **kwargs)
    return lambda: model.learn(frames, reset_num_timesteps=False)


class TorchRLRecipe:
    """PPO from TorchRL's parts with the settings of its MuJoCo example (Schulman et al. 2017)."""

    def __init__(self, env_id: str, frames: int, epochs: int) -> None:
        norm = VecNorm(in_keys=["observation"], decay=0.99999, eps=1e-2)
        clip = ClipTransform(in_keys=["observation"], low=-10, high=10)
        parts = Compose(norm, clip, DoubleToFloat(in_keys=["observation"]))
        env = TransformedEnv(GymEnv(env_id), parts)
        obs, spec = env.observation_spec["observation"].shape[-1], env.action_spec_unbatched
        action = spec.shape[-1]
        cells: dict[str, Any] = {"num_cells": [64, 64], "activation_class": torch.nn.Tanh}
        policy, value = (MLP(in_features=obs, out_features=n, **cells) for n in (action, 1))
        scale = AddStateIndependentNormalScale(action, scale_lb=1e-8)
        network = torch.nn.Sequential(policy, scale)
        actor = ProbabilisticActor(
            TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
            in_keys=["loc", "scale"],
            spec=env.full_action_spec_unbatched,
            distribution_class=TanhNormal,
            distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
            return_log_prob=True,
        )
        critic = ValueOperator(value, in_keys=["observation"])
        self.batches = iter(
            Collector(
                env,
                actor,
                frames_per_batch=frames,
                total_frames=-1,
                auto_register_policy_transforms=False,
            )
        )
        self.buffer = TensorDictReplayBuffer(
            storage=LazyTensorStorage(frames),
            sampler=SamplerWithoutReplacement(),
            batch_size=min(64, frames),
        )
        self.advantage = GAE(gamma=0.99, lmbda=0.95, value_network=critic, average_gae=False)
        self.loss = ClipPPOLoss(
            actor, critic, entropy_coeff=0.0, critic_coeff=0.25, normalize_advantage=True,
            loss_critic_type="l2",
        )  # fmt: skip
        parameters = [*actor.parameters(), *critic.parameters()]
        self.optimizer = torch.optim.Adam(parameters, lr=3e-4, eps=1e-5)
        self.epochs = epochs

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
                (out["loss_critic"] + out["loss_objective"] + out["loss_entropy"]).backward()
                self.optimizer.step()


def main() -> None:
    """Run from the command line."""
    known = sorted({path.stem for path in (ROOT / "conf/belief").glob("*.yaml")} - {"drbpn"})
    args = start(__doc__ or "", env="walker2d", beliefs=known, peer_epochs=10)
    warnings.filterwarnings("ignore", category=FutureWarning)  # VecNorm
    small = ["collector.num_envs=2", "collector.steps_per_env=16", "optim.epochs=1"]
    small += ["optim.minibatches=2", "optim.compile=false"]
    common = [f"env={args.env}", "env.version=v5", *(small * args.quick)]
    cases = {DEFAULTS: [], "experiment=paper": ["experiment=paper"]}
    cases |= {f"belief={name}": [f"belief={name}"] for name in args.beliefs}
    ours = {name: recipe(*extra, *common) for name, extra in cases.items()}
    training, settings = ours[DEFAULTS]
    env_id = f"{settings.env.id}-{settings.env.version}"
    epochs = 1 if args.quick else args.peer_epochs
    frames = settings.collector.num_envs * settings.collector.steps_per_env
    candidates: dict[str, Callable[[], Any]] = {n: train(*parts) for n, parts in ours.items()}
    for name, package in ((SB3, "stable_baselines3"), (RECURRENT, "sb3_contrib")):
        if importlib.util.find_spec(package) is None:
            print(f"{name} left out: not installed (pip install -e '.[peers]').")
        else:
            candidates[name] = stable_baselines(env_id, frames, epochs, name == RECURRENT)
    candidates[TORCHRL] = TorchRLRecipe(env_id, frames, epochs)
    torch.set_num_threads(args.threads)  # whatever a peer set at its construction
    seconds = measure(candidates, args)
    learned = {n: sum(x.numel() for x in p.agent.belief.parameters()) for n, (p, _) in ours.items()}
    show(
        f"{env_id}, rollouts of {frames} frames, epochs: peers {epochs}, defaults "
        f"{settings.optim.epochs}", seconds, DEFAULTS, args,
        **{"steps/s": frames / seconds.median(), "parameters of the belief": pd.Series(learned)},
    )  # fmt: skip
    # In the middle of a rollout, so that a memory has something in it.
    middle = {n: p.collector.rollout()[:, 8].clone() for n, (p, _) in ours.items()}
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for rows in (1, training.env.batch_size[0]):
            policies = {n: decide(p.agent.policy, middle[n][:rows]) for n, (p, _) in ours.items()}
            seconds = measure(policies, args, calls=200)
            show(f"a decision, {rows} robots", seconds, DEFAULTS, args)


def train(training: Any, config: Any) -> Callable[[], object]:
    """Make the call that collects one rollout and learns from it."""
    from ppo_drbpn import train_rollout

    return lambda: train_rollout(training, config)


def decide(policy: Any, row: Any) -> Callable[[], object]:
    """Make the call that decides from what some robots sensed."""
    source = row.select(*policy.in_keys, strict=False)
    return lambda: policy(source.copy())


if __name__ == "__main__":
    main()
