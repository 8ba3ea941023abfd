"""What the tests of every environment over MuJoCo tasks share: the tasks, actions, stepping."""

import pytest
import torch

from torchrl_drbpn.envs import EnvPoolBatchEnv, GymnasiumBatchEnv

_NAMES = (
    "Ant HalfCheetah Hopper Humanoid InvertedDoublePendulum InvertedPendulum Reacher Swimmer "
    "Walker2d"
)
TASKS = [f"{name}-{version}" for name in _NAMES.split() for version in ("v4", "v5")]

# Version 4 is tested on purpose.
MARKS = [
    pytest.mark.usefixtures("own_directory"),
    pytest.mark.filterwarnings("ignore:.*is out of date"),
]

BACKENDS = [
    pytest.param(GymnasiumBatchEnv, id="gymnasium"),
    pytest.param(EnvPoolBatchEnv, id="envpool"),
]


def random_actions(env, steps, seed=0, scale=1.0):
    """Actions from a generator of our own, some of them outside the Box where scale > 1."""
    generator = torch.Generator().manual_seed(seed)
    low, high = env.action_spec.space.low, env.action_spec.space.high
    draws = torch.rand((steps, *low.shape), generator=generator)
    return scale * (low + (high - low) * draws)


def play(env, tensordict, actions):
    """Step with `actions`, resetting what ends.

    Returns what was seen, shape (steps, num_envs, obs + 3 + obs): the observation, reward,
    terminated, truncated, and the observation that the next step starts from.
    """
    seen = []
    for action in actions:
        tensordict.set("action", action)
        stepped, tensordict = env.step_and_maybe_reset(tensordict)
        keys = ("observation", "reward", "terminated", "truncated")
        parts = [stepped["next", key].double() for key in keys]
        seen.append(torch.cat([*parts, tensordict["observation"].double()], -1))
    return torch.stack(seen), tensordict
