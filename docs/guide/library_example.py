"""Balance a pole with 30 % of the sensor readings missing: a belief filter in a plain TorchRL PPO.

Needs torchrl, gymnasium, mujoco and torchrl_drbpn, nothing else; takes about half a minute on one
core. The page belief_in_your_ppo.md walks through it.
"""

import torch
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import Compose, DoubleToFloat, GymEnv, RewardSum, SerialEnv, TransformedEnv
from torchrl.modules import (
    IndependentNormal,
    ProbabilisticActor,
    ValueOperator,
    set_recurrent_mode,
)
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from torchrl_drbpn import (
    BeliefFilter,
    BeliefFilterModule,
    BeliefModelLoss,
    DRBPNLoss,
    ObservationMissingness,
    PreviousAction,
    seed_env,
)

NUM_ENVS, STEPS, SEQUENCE = 8, 128, 16  # environments; steps of each in a rollout; in a sequence
TOTAL_FRAMES, EPOCHS, MINIBATCHES = 24_576, 8, 4


def make_env() -> TransformedEnv:
    """Build eight pendulums whose sensors fail, as a batch."""
    pendulums = SerialEnv(NUM_ENVS, lambda: GymEnv("InvertedPendulum-v5"))
    return TransformedEnv(
        pendulums,
        Compose(
            DoubleToFloat(),
            PreviousAction(),
            ObservationMissingness("mcar", 0.3),
            RewardSum(),
        ),
    )


def make_modules(
    obs_dim: int, action_dim: int
) -> tuple[BeliefFilterModule, ProbabilisticActor, ValueOperator]:
    """Build the belief filter, and the two heads that read its `features`."""
    belief = BeliefFilterModule(BeliefFilter(obs_dim, action_dim))
    width = belief.feature_dim
    location = nn.Sequential(nn.Linear(width, 64), nn.Tanh(), nn.Linear(64, action_dim))
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(location, AddStateIndependentNormalScale(action_dim)),
            in_keys=["features"],
            out_keys=["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    value = nn.Sequential(nn.Linear(width, 64), nn.Tanh(), nn.Linear(64, 1))
    critic = ValueOperator(value, in_keys=["features"])
    return belief, actor, critic


def train() -> list[float]:
    """Train and return the return of every finished episode, in the order of time."""
    torch.manual_seed(0)
    env = make_env()
    seed_env(env, 0)
    belief, actor, critic = make_modules(
        env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    )

    collector = Collector(
        env,
        TensorDictSequential(belief, actor),
        frames_per_batch=NUM_ENVS * STEPS,
        total_frames=TOTAL_FRAMES,
        auto_register_policy_transforms=True,
    )

    gae = GAE(
        gamma=0.99,
        lmbda=0.95,
        value_network=TensorDictSequential(belief, critic),
        deactivate_vmap=True,
    )
    ppo = ClipPPOLoss(
        actor, critic, entropy_bonus=False, critic_coeff=0.5, normalize_advantage=True
    )
    loss = DRBPNLoss(belief, ppo, BeliefModelLoss(), model_coeff=1.0)
    parameters = [*belief.parameters(), *actor.parameters(), *critic.parameters()]
    optimizer = torch.optim.Adam(parameters, lr=1e-3)

    returns: list[float] = []
    for data in collector:
        with torch.no_grad(), set_recurrent_mode(True):
            gae(data)
        data["final"] = torch.zeros(*data.shape, 1, dtype=torch.bool)
        data["final"][:, -1] = True
        sequences = data.reshape(-1, SEQUENCE)

        for _ in range(EPOCHS):
            for rows in torch.randperm(len(sequences)).chunk(MINIBATCHES):
                terms = loss(sequences[rows])
                total = sum(value for key, value in terms.items() if key.startswith("loss"))
                optimizer.zero_grad()
                total.backward()
                nn.utils.clip_grad_norm_(parameters, 0.5)
                optimizer.step()

        done = data["next", "done"].squeeze(-1).T  # time first
        returns += data["next", "episode_reward"].squeeze(-1).T[done].tolist()
        missing = 1 - data["observed"].float().mean()
        print(f"{len(returns)} episodes, missing {missing:.2f}, last {returns[-1]:.0f}")
    collector.shutdown()
    return returns


if __name__ == "__main__":
    returns = train()
    first, last = sum(returns[:20]) / 20, sum(returns[-20:]) / 20
    print(f"mean return of the first 20 episodes {first:.1f}, of the last 20 {last:.1f}")
    assert last > 3 * first, "the agent has not learned"
