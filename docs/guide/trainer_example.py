"""The pole of library_example.py, trained by TorchRL's PPOTrainer in the place of a loop.

Needs what library_example.py needs, and that file beside it; takes about half a minute on one
core. The page ppo_trainer.md walks through it.
"""

import torch
from library_example import EPOCHS, MINIBATCHES, NUM_ENVS, SEQUENCE, STEPS, make_env, make_modules
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import SliceSamplerWithoutReplacement
from torchrl.objectives import ClipPPOLoss
from torchrl.trainers.algorithms import PPOTrainer

from torchrl_drbpn import BeliefModelLoss, DRBPNLoss, seed_env

TOTAL_FRAMES = 24_576


def mark(data: TensorDictBase) -> TensorDictBase:
    """Number the sequences of a rollout, and mark the steps that no other step follows."""
    count = data.numel() // SEQUENCE
    data["sequence"] = torch.arange(count).repeat_interleave(SEQUENCE).reshape(data.shape)
    data["final"] = data["next", "done"].clone()
    data["final"][..., -1, :] = True
    return data


def make_trainer() -> PPOTrainer:
    """Build the trainer and everything that it holds."""
    torch.manual_seed(0)
    env = make_env()
    seed_env(env, 0)
    belief, actor, critic = make_modules(
        env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    )
    ppo = ClipPPOLoss(
        actor,
        critic,
        entropy_bonus=False,
        critic_coeff=0.5,
        normalize_advantage=True,
        log_explained_variance=False,
    )
    loss = DRBPNLoss(belief, ppo, BeliefModelLoss(), model_coeff=1.0)
    loss.make_value_estimator(gamma=0.99, lmbda=0.95)

    collector = Collector(
        env,
        loss.actor_network,
        frames_per_batch=NUM_ENVS * STEPS,
        total_frames=TOTAL_FRAMES,
        auto_register_policy_transforms=True,
        postproc=mark,
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(NUM_ENVS * STEPS),
        sampler=SliceSamplerWithoutReplacement(slice_len=SEQUENCE, traj_key="sequence"),
        batch_size=NUM_ENVS * STEPS // MINIBATCHES,
    )
    return PPOTrainer(
        collector=collector,
        total_frames=TOTAL_FRAMES,
        frame_skip=1,
        loss_module=loss,
        optimizer=torch.optim.Adam(loss.parameters(), lr=1e-3),
        gae=loss.value_estimator,
        replay_buffer=buffer,
        num_epochs=EPOCHS,
        optim_steps_per_batch=None,
        clip_norm=0.5,
        progress_bar=False,
    )


def train() -> list[float]:
    """Train and return the return of every finished episode, in the order of time."""
    trainer, returns = make_trainer(), []

    def note(data: TensorDictBase) -> None:
        done = data["next", "done"].squeeze(-1).T  # time first
        returns.extend(data["next", "episode_reward"].squeeze(-1).T[done].tolist())
        missing = 1 - data["observed"].float().mean()
        print(f"{len(returns)} episodes, missing {missing:.2f}, last {returns[-1]:.0f}")

    trainer.register_op("batch_process", note)
    trainer.train()
    return returns


if __name__ == "__main__":
    returns = train()
    first, last = sum(returns[:20]) / 20, sum(returns[-20:]) / 20
    print(f"mean return of the first 20 episodes {first:.1f}, of the last 20 {last:.1f}")
    assert last > 3 * first, "the agent has not learned"
