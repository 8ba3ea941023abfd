"""Specification of `EnvPoolBatchEnv`: EnvPool's simulators with the manners of GymnasiumBatchEnv.

EnvPool 1.2.5 carries MuJoCo 3.6. With Gymnasium on MuJoCo 3.6 too, every task agrees to 1e-10 over
20 steps; on MuJoCo 4.0 the bodies with a free joint (Ant, Humanoid) differ by about 1e-6 at once,
and a contact that begins a step earlier multiplies that by a thousand. For them every single step
is compared from equal states, and the first steps of a run.
"""

import copy
import pickle

import mujoco
import numpy as np
import pytest
import torch
from env_tools import MARKS, TASKS, play, random_actions
from refusals import refuses
from torchrl.envs import check_env_specs

from torchrl_drbpn.envs import EnvPoolBatchEnv, GymnasiumBatchEnv

pytestmark = MARKS

FREE_JOINT = [task for task in TASKS if task.startswith(("Ant", "Humanoid"))]
OTHERS = [task for task in TASKS if task not in FREE_JOINT]


def positions_and_velocities(env_id, observation, nq, nv):
    """The state that an observation determines; positions it leaves out move nothing and are 0."""
    if env_id.startswith("InvertedDoublePendulum"):
        angles = np.arctan2(observation[1:3], observation[3:5])
        return np.append(observation[:1], angles), observation[5:8]
    if env_id.startswith("Reacher"):
        angles = np.arctan2(observation[2:4], observation[:2])
        return np.append(angles, observation[4:6]), np.append(observation[6:8], [0.0, 0.0])
    free = {"Ant": 2, "Humanoid": 2, "Swimmer": 2, "InvertedPendulum": 0}
    hidden = free.get(env_id[:-3], 1)
    seen = nq - hidden
    return np.append(np.zeros(hidden), observation[:seen]), observation[seen : seen + nv]


def put_where(env, observations):
    """Put the simulators of a GymnasiumBatchEnv where the observations are."""
    for sim, observation in zip(env.envs, observations.numpy(), strict=True):
        mujoco.mj_resetData(sim.model, sim.data)
        qpos, qvel = positions_and_velocities(env.env_id, observation, sim.model.nq, sim.model.nv)
        sim.set_state(qpos, qvel)
        if hasattr(sim, "goal"):
            sim.goal = qpos[2:]


def both(env_id, n, **kwargs):
    """The two backends, reset, Gymnasium's simulators where EnvPool's are."""
    pool, gym = (
        cls(env_id, n, seed=0, dtype=torch.float64, **kwargs)
        for cls in (EnvPoolBatchEnv, GymnasiumBatchEnv)
    )
    start = pool.reset()
    start_gym = gym.reset()
    put_where(gym, start["observation"])
    return pool, gym, start, start_gym


@pytest.mark.parametrize("env_id", TASKS)
def test_specs_time_limit_and_first_observations_are_those_of_gymnasium(env_id):
    pool, gym, start, _ = both(env_id, 4)
    for name in ("observation_spec", "action_spec", "reward_spec", "done_spec"):
        assert getattr(pool, name) == getattr(gym, name)
    assert pool.max_episode_steps == gym.max_episode_steps
    for sim, observation in zip(gym.envs, start["observation"].numpy(), strict=True):
        np.testing.assert_allclose(sim._get_obs(), observation, rtol=0, atol=1e-12)


@pytest.mark.parametrize("env_id", OTHERS)
def test_from_equal_states_twenty_steps_are_the_same_to_1e_6(env_id):
    pool, gym, root, root_gym = both(env_id, 8)
    running = torch.ones(8, dtype=torch.bool)
    ends = 0
    for action in random_actions(pool, 20, scale=1.3):
        root, root_gym = (
            env.step(r.set("action", action).set("_step", running))["next"]
            for env, r in ((pool, root), (gym, root_gym))
        )
        # Rewards are rounded to float32 inside EnvPool.
        torch.testing.assert_close(root, root_gym, rtol=1e-6, atol=1e-6)
        ends += int(root["done"].sum())
        running = running & ~root["done"].squeeze(-1)
    falls = env_id.startswith(("Hopper", "Inverted"))
    assert (ends > 0) == falls or env_id.startswith("Walker2d")


@pytest.mark.parametrize("env_id", FREE_JOINT)
def test_every_step_from_an_equal_state_is_the_same_to_1e_2(env_id):
    pool, gym, root, root_gym = both(env_id, 8)
    columns = gym.envs[0].model.nq + gym.envs[0].model.nv - 2
    for action in random_actions(pool, 20):
        put_where(gym, root["observation"])
        stepped, root = pool.step_and_maybe_reset(root.set("action", action))
        stepped_gym = gym.step(root_gym.set("action", action))
        seen, expected = stepped["next", "observation"], stepped_gym["next", "observation"]
        state = (..., slice(columns))
        torch.testing.assert_close(seen[state], expected[state], rtol=0, atol=1e-2)
        # Beside the state: inertias, forces and contact forces, in the thousands for Humanoid.
        torch.testing.assert_close(seen, expected, rtol=1e-2, atol=1e-1)


def test_contact_forces_are_computed_in_version_4_too():
    env = EnvPoolBatchEnv("Humanoid-v4", 4, seed=0)
    seen, _ = play(env, env.reset(), random_actions(env, 15))
    assert seen[..., 376 - 84 : 376].any()  # the last 14 x 6 components


def test_an_episode_that_terminates_on_the_last_step_of_the_limit_does_both():
    push, length = torch.full((60, 1, 1), 3.0), 60
    for _ in range(2):  # the second time with the limit on the step of the termination
        env = EnvPoolBatchEnv("InvertedPendulum-v5", 1, seed=0, max_episode_steps=length)
        seen, _ = play(env, env.reset(), push[:length])
        length = int(seen[:, 0, 5].nonzero()[0]) + 1
    assert seen[:-1, 0, 5:7].sum() == 0
    assert seen[-1, 0, 5:7].tolist() == [1.0, 1.0]


def test_a_truncated_row_may_be_stepped_on():
    env = EnvPoolBatchEnv("Reacher-v4", 1, seed=0, max_episode_steps=2)
    root, done = env.reset(), []
    for _ in range(4):
        root = env.step(root.set("action", torch.zeros(1, 2)))["next"]
        done.append(root["truncated"].item())
    assert done == [False, True, True, True]


test_what_envpool_does_not_have_is_refused = refuses(
    (lambda: EnvPoolBatchEnv("CartPole-v1", 1), "action space .* got Discrete"),
    (lambda: EnvPoolBatchEnv("CheetahRun-v1", 1), "got Dict.*`observation_keys`"),
    (lambda: EnvPoolBatchEnv("Swimmer-v5", 1, render_mode="rgb_array"), TypeError,
     r"takes no \['render_mode'\]"),
    (lambda: EnvPoolBatchEnv("Swimmer-v5", 1).reset(options={"x": 1}), "no `opti"),
)  # fmt: skip


def test_a_task_of_dm_control_is_a_vector_of_the_entries_asked_for():
    env = EnvPoolBatchEnv("CheetahRun-v1", 2, observation_keys=["position", "velocity"])
    check_env_specs(env)
    joined = env.reset(seed=0)["observation"]
    speeds = EnvPoolBatchEnv("CheetahRun-v1", 2, observation_keys=["velocity"]).reset(seed=0)
    assert joined.shape == (2, 17)
    assert torch.equal(joined[:, 8:], speeds["observation"])


def test_stepping_on_after_a_termination_is_refused_rather_than_a_new_episode():
    env = EnvPoolBatchEnv("InvertedPendulum-v5", 3, seed=0)
    root, push = env.reset(), torch.tensor([[0.0], [3.0], [0.0]])
    while not root["terminated"].any():
        root = env.step(root.set("action", push))["next"]
    assert root["terminated"].flatten().tolist() == [False, True, False]
    with pytest.raises(RuntimeError, match="row 1 has terminated"):
        env.step(root.set("action", push))
    # The others go on without it, and it does after a reset.
    env.step(root.clone().set("_step", ~root["terminated"].squeeze(-1)))
    with pytest.raises(RuntimeError, match="row 1 has terminated"):
        env.step(root.clone().set("_step", root["terminated"].squeeze(-1)))
    root = env.reset(root.set("_reset", root["terminated"].clone())).exclude("_reset")
    env.step(root.set("action", push))


def test_a_seed_is_used_once_and_asks_for_a_reset_of_every_row():
    env = EnvPoolBatchEnv("Swimmer-v5", 2, seed=0)
    first = env.reset()["observation"]
    root = env.fake_tensordict().exclude("next")
    one = root.clone().set("_reset", torch.tensor([[True], [False]]))
    env.set_seed(0)
    with pytest.raises(RuntimeError, match="row 0 was stepped before its first reset"):
        env.step(root)
    for seed in (None, 0):
        env.reset(one.clone(), seed=seed)
        with pytest.raises(RuntimeError, match="row 1 was stepped before its first reset"):
            env.step(root)
    torch.testing.assert_close(env.reset(seed=0)["observation"], first, rtol=0, atol=0)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_starts_new_episodes_and_leaves_the_original_alone(duplicate):
    env, same = (EnvPoolBatchEnv("Hopper-v5", 2, seed=0, max_episode_steps=7) for _ in "ab")
    actions = random_actions(env, 20)
    expected, _ = play(same, same.reset(), actions)
    first, root = play(env, env.reset(), actions[:10])
    twin = duplicate(env)
    assert twin.max_episode_steps == 7
    with pytest.raises(RuntimeError, match="call reset"):
        twin.step(root.clone().set("action", actions[0]))
    twin.reset()
    rest, _ = play(env, root, actions[10:])
    torch.testing.assert_close(torch.cat([first, rest]), expected, rtol=0, atol=0)
