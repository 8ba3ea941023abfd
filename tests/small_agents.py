"""A small actor-critic on InvertedPendulum-v5 around any belief module, from TorchRL's parts.

Shared by the tests of losses and pipelines. Three environments in one batch; the poles fall after
some steps (terminated) or the time limit comes first (truncated), so that a rollout of 24 steps
holds both ends inside rows, and the second one begins in mid-episode.
"""

from dataclasses import dataclass

import torch
from suite_environments import with_belief_entries
from tensordict.nn import (
    NormalParamExtractor,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import Compose, TransformedEnv
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator, set_recurrent_mode
from torchrl.objectives.value import GAE

from torchrl_drbpn import BeliefFilter, GaussianTransition, GymnasiumBatchEnv

OBS, ACTION, ENVS, TIME, LIMIT = 4, 1, 3, 24, 9
GAMMA, LMBDA = 0.99, 0.95


@dataclass
class Agent:
    """A belief module and the heads that read its features."""

    belief: TensorDictModuleBase
    actor: ProbabilisticActor
    critic: ValueOperator
    norm: TensorDictModuleBase | None = None

    @property
    def policy(self):
        first = [] if self.norm is None else [self.norm]
        return ProbabilisticTensorDictSequential(*first, self.belief, *self.actor.module)

    @property
    def value(self):
        return TensorDictSequential(self.belief, self.critic)


def make_filter(obs, action, dtype=None, state=None, cov_network=False, **kwargs):
    """A filter of fixed parameters, all away from their starting values."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        if cov_network:
            kwargs["transition"] = GaussianTransition(
                state, action, hidden_sizes=(8,), cov="full", cov_network=True, dtype=dtype
            )
        belief = BeliefFilter(obs, action, state, dtype=dtype, **kwargs)
        with torch.no_grad():
            for parameter in belief.parameters():
                parameter += 0.1 * torch.randn_like(parameter)
    if belief.covariance == "propagated":
        belief.refresh_jacobian(belief.initial_mean, belief.initial_mean.new_zeros(action))
    return belief


def make_agent(
    belief, feature_dim, *, features="features", dtype=torch.float64, actions=ACTION, norm=None
):
    """Heads of fixed weights; a wide policy makes the poles fall soon."""
    with torch.random.fork_rng():
        torch.manual_seed(1)
        first = nn.Linear(feature_dim, 8, dtype=dtype), nn.Tanh()
        last = nn.Linear(8, 2 * actions, dtype=dtype), NormalParamExtractor("biased_softplus_2.0")
        head = TensorDictModule(nn.Sequential(*first, *last), [features], ["loc", "scale"])
        options = {"distribution_class": IndependentNormal, "return_log_prob": True}
        actor = ProbabilisticActor(head, in_keys=["loc", "scale"], **options)
        critic = ValueOperator(nn.Linear(feature_dim, 1, dtype=dtype), in_keys=[features])
    return Agent(belief, actor, critic, norm)


def make_env(dtype=torch.float64, seed=0):
    """Three pendulums, half of the entries missing; the primer is left to the collector."""
    base = GymnasiumBatchEnv(
        "InvertedPendulum-v5", ENVS, seed=seed, dtype=dtype, max_episode_steps=LIMIT
    )
    return with_belief_entries(TransformedEnv(base, Compose()), to_float32=False)


def collect(agent, batches=2, dtype=torch.float64, env=None):
    """The last of some batches of (ENVS, TIME) steps: rows that start in mid-episode."""
    with torch.random.fork_rng():
        torch.manual_seed(2)
        env = make_env(dtype) if env is None else env
        sizes = {"frames_per_batch": ENVS * TIME, "total_frames": batches * ENVS * TIME}
        collector = Collector(env, agent.policy, **sizes, auto_register_policy_transforms=True)
        try:
            data = [batch.clone() for batch in collector][-1]
        finally:
            collector.shutdown()
    return data


def make_gae(agent, **kwargs):
    keys = {"value_network": agent.value, "deactivate_vmap": True} | kwargs
    return GAE(gamma=GAMMA, lmbda=LMBDA, **keys)


def add_advantages(agent, data):
    with set_recurrent_mode(True), torch.no_grad():
        make_gae(agent)(data)
    return data
