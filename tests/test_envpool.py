"""Specification of `EnvPoolBatchEnv`: EnvPool's simulators with the manners of GymnasiumBatchEnv.

Parity with Gymnasium: the same specs and limits; from equal states the same observations, rewards
and ends; resets drawn from the same distribution; lengths and returns of random episodes alike.
Manners: only the rows asked for are reset, the last observation of an episode is the true one,
termination and truncation are told apart on the last step of the limit too; no next episode starts
unasked; the state can not be saved, and that is said.

EnvPool 1.2.5 carries MuJoCo 3.6. With Gymnasium on MuJoCo 3.6 too, every task agrees to 1e-10 over
20 steps; on MuJoCo 4.0 the bodies with a free joint (Ant, Humanoid) differ by about 1e-6 at once,
and a contact that begins a step earlier multiplies that by a thousand. For them every single step
is compared from equal states, and the first steps of a run.
"""

from __future__ import annotations

import copy
import pickle

import mujoco
import numpy as np
import pytest
import torch
from env_tools import TASKS, play, random_actions
from torchrl.collectors import Collector
from torchrl.envs import SerialEnv, StepCounter, TransformedEnv, check_env_specs

from torchrl_drbpn.envs import EnvPoolBatchEnv, GymnasiumBatchEnv

pytest.importorskip(
    "envpool", reason="EnvPool is not installed: pip install 'torchrl-drbpn[envpool]'"
)

# Version 4 is tested on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date")

FREE_JOINT = [task for task in TASKS if task.startswith(("Ant", "Humanoid"))]
OTHERS = [task for task in TASKS if task not in FREE_JOINT]


@pytest.fixture(autouse=True)
def _own_directory(tmp_path, monkeypatch):
    # MuJoCo writes the warnings of a model file into the current directory.
    monkeypatch.chdir(tmp_path)


# Parity with Gymnasium -------------------------------------------------------------------------


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
def test_specs_and_time_limit_are_those_of_gymnasium(env_id):
    pool, gym = EnvPoolBatchEnv(env_id, 2), GymnasiumBatchEnv(env_id, 2)
    for name in ("observation_spec", "action_spec", "reward_spec", "done_spec"):
        assert getattr(pool, name) == getattr(gym, name)
    assert pool.max_episode_steps == gym.max_episode_steps


@pytest.mark.parametrize("env_id", TASKS)
def test_the_first_observation_is_gymnasiums_of_the_same_state(env_id):
    _, gym, start, _ = both(env_id, 4)
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


@pytest.mark.parametrize("env_id", FREE_JOINT)
def test_from_equal_states_five_steps_are_the_same_to_1e_2(env_id):
    pool, gym, start, start_gym = both(env_id, 4)
    actions = random_actions(pool, 5)
    seen, _ = play(pool, start, actions)
    expected, _ = play(gym, start_gym, actions)
    torch.testing.assert_close(seen, expected, rtol=0, atol=1e-2)


@pytest.mark.parametrize("env_id", ["Hopper-v5", "InvertedDoublePendulum-v4", "Walker2d-v4"])
def test_episodes_from_equal_states_end_on_the_same_step(env_id):
    lengths = []
    pool, gym, start, start_gym = both(env_id, 16)
    actions = random_actions(pool, 150)
    for env, root in ((pool, start), (gym, start_gym)):
        seen, _ = play(env, root, actions)
        terminated = seen[:, :, env.observation_spec["observation"].shape[-1] + 1]
        assert terminated.any(0).all()
        lengths.append(terminated.double().argmax(0))
    assert torch.equal(*lengths)
    assert len(lengths[0].unique()) > 1


def test_contact_forces_are_computed_in_version_4_too():
    env = EnvPoolBatchEnv("Humanoid-v4", 4, seed=0)
    seen, _ = play(env, env.reset(), random_actions(env, 15))
    assert seen[..., 376 - 84 : 376].any()  # the last 14 x 6 components


@pytest.mark.parametrize("env_id", TASKS)
def test_first_observations_have_gymnasiums_distribution(env_id):
    # 1500 each: mean and standard deviation of every component within 5 standard errors.
    rows, times = 50, 30
    draws = []
    for cls in (EnvPoolBatchEnv, GymnasiumBatchEnv):
        env = cls(env_id, rows, seed=1, dtype=torch.float64)
        draws.append(torch.cat([env.reset()["observation"] for _ in range(times)]))
    seen, expected = draws
    n, deviation = rows * times, expected.std(0)
    margin = 5 * deviation * (2 / n) ** 0.5 + 1e-9
    assert ((seen.mean(0) - expected.mean(0)).abs() <= margin).all()
    # The variance of a sample variance is (kurtosis - 1) sigma^4 / n.
    fourth = (expected - expected.mean(0)).pow(4).mean(0)
    spread = (fourth - deviation.pow(4)).clamp_min(0).mul(2 / n).sqrt()
    assert ((seen.var(0) - expected.var(0)).abs() <= 5 * spread + 1e-9).all()


def random_episodes(cls, env_id, limit):
    """Lengths and returns of 100 episodes with random actions, each counted whole."""
    rows, outcomes = 25, []
    env = cls(env_id, rows, seed=2, dtype=torch.float64, max_episode_steps=limit)
    for batch in range(100 // rows):
        actions = random_actions(env, limit, seed=10 + batch)
        root, total = env.reset(), torch.zeros(rows, 2)
        running = torch.ones(rows, dtype=torch.bool)
        for action in actions:
            root = env.step(root.set("action", action).set("_step", running))["next"]
            total += torch.stack([running, root["reward"].squeeze(-1) * running], -1)
            running = running & ~root["done"].squeeze(-1)
            if not running.any():
                break
        outcomes.append(total)
    return torch.cat(outcomes)


@pytest.mark.parametrize("env_id", [task for task in TASKS if task.endswith("v5")])
def test_random_episodes_are_as_long_and_as_good_as_gymnasiums(env_id):
    limit = 30 if env_id.startswith("Ant") else 60
    seen, expected = (
        random_episodes(cls, env_id, limit) for cls in (EnvPoolBatchEnv, GymnasiumBatchEnv)
    )
    error = ((seen.var(0) + expected.var(0)) / 100).sqrt()
    assert ((seen.mean(0) - expected.mean(0)).abs() <= 3 * error + 1e-6).all()
    assert (seen[:, 1].std() / expected[:, 1].std()).log().abs() < 0.5


@pytest.mark.parametrize("env_id", TASKS)
def test_every_task_passes_check_env_specs(env_id):
    check_env_specs(EnvPoolBatchEnv(env_id, 2, seed=0), break_when_any_done="both")


# Ends and resets -------------------------------------------------------------------------------


@pytest.mark.parametrize("break_when_any_done", [True, False, "any", "all", "both"])
def test_specs_hold_for_every_way_of_ending_a_rollout(break_when_any_done):
    env = EnvPoolBatchEnv("InvertedPendulum-v5", 3, seed=0, max_episode_steps=2)
    check_env_specs(env, break_when_any_done=break_when_any_done)
    check_env_specs(TransformedEnv(env, StepCounter()), break_when_any_done=break_when_any_done)


def test_the_time_limit_truncates_and_leaves_the_true_last_observation():
    pool, gym, start, start_gym = both("HalfCheetah-v5", 2, max_episode_steps=4)
    actions = random_actions(pool, 9)
    seen, _ = play(pool, start, actions)
    expected, _ = play(gym, start_gym, actions)
    # Up to the reset everything but what comes after the last step is the same.
    torch.testing.assert_close(seen[:4, :, :20], expected[:4, :, :20], rtol=1e-6, atol=1e-6)
    terminated, truncated, root = seen[..., 18], seen[..., 19], seen[..., 20:]
    assert truncated[:, 0].nonzero().flatten().tolist() == [3, 7]
    assert not terminated.any()
    same = (seen[..., :17] == root).all(-1)
    assert torch.equal(same, ~truncated.bool())


def test_an_episode_that_terminates_on_the_last_step_of_the_limit_does_both():
    env = EnvPoolBatchEnv("InvertedPendulum-v5", 1, seed=0)
    push = torch.full((1, 1, 1), 3.0).repeat(60, 1, 1)
    seen, _ = play(env, env.reset(), push)
    length = int(seen[:, 0, 5].nonzero()[0]) + 1
    env = EnvPoolBatchEnv("InvertedPendulum-v5", 1, seed=0, max_episode_steps=length)
    seen, _ = play(env, env.reset(), push[:length])
    assert seen[:-1, 0, 5:7].sum() == 0
    assert seen[-1, 0, 5:7].tolist() == [1.0, 1.0]


def test_a_partial_reset_touches_only_the_rows_asked_for():
    # The rows that go on have to go on as if nothing had happened.
    actions = None
    ends = []
    for reset in (False, True):
        env = EnvPoolBatchEnv("Hopper-v5", 4, seed=0, dtype=torch.float64)
        actions = random_actions(env, 8) if actions is None else actions
        _, root = play(env, env.reset(), actions[:3])
        if reset:
            mask = torch.tensor([[False], [True], [False], [True]])
            after = env.reset(root.clone().set("_reset", mask))
            same = (after["observation"] == root["observation"]).all(-1)
            assert same.tolist() == [True, False, True, False]
            root = after.exclude("_reset")
        seen, _ = play(env, root, actions[3:])
        ends.append(seen)
    torch.testing.assert_close(ends[0][:, ::2], ends[1][:, ::2], rtol=0, atol=0)
    assert (ends[0][:, 1::2] != ends[1][:, 1::2]).any()


def test_a_reset_row_gets_the_whole_time_limit_again():
    env = EnvPoolBatchEnv("HalfCheetah-v5", 2, seed=0, max_episode_steps=5)
    _, root = play(env, env.reset(), random_actions(env, 3))
    root = env.reset(root.set("_reset", torch.tensor([[True], [False]]))).exclude("_reset")
    seen, _ = play(env, root, random_actions(env, 5))
    assert seen[:, 0, 19].nonzero().flatten().tolist() == [4]
    assert seen[:, 1, 19].nonzero().flatten().tolist() == [1]


def test_minus_one_takes_the_limit_off_and_a_truncated_row_may_be_stepped_on():
    env = EnvPoolBatchEnv("Reacher-v4", 1, seed=0, max_episode_steps=-1)
    assert env.rollout(60).shape == (1, 60)
    env = EnvPoolBatchEnv("Reacher-v4", 1, seed=0, max_episode_steps=2)
    root = env.reset().set("action", torch.zeros(1, 2))
    done = []
    for _ in range(4):
        root = env.step(root)["next"].set("action", torch.zeros(1, 2))
        done.append(root["truncated"].item())
    assert done == [False, True, True, True]


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


def test_rows_that_a_step_leaves_out_do_not_move():
    env = EnvPoolBatchEnv("InvertedPendulum-v5", 3, seed=0)
    root = env.reset().set("action", torch.ones(3, 1))
    for mask in ([True, False, True], [False, False, False]):
        stepped = env.step(root.clone().set("_step", torch.tensor(mask)))
        same = (stepped["next", "observation"] == root["observation"]).all(-1)
        assert same.tolist() == [not moved for moved in mask]
        assert stepped["next", "reward"].flatten().tolist() == [float(moved) for moved in mask]
        root = stepped["next"].exclude("reward").set("action", torch.ones(3, 1))


def test_a_step_never_writes_into_what_an_earlier_one_returned():
    env = EnvPoolBatchEnv("Hopper-v5", 2, seed=0, dtype=torch.float64)
    root = env.reset().set("action", torch.zeros(2, 3))
    first = env.step(root.clone())["next"]
    kept = first.clone()
    for _ in range(5):
        env.step(root.clone())
    env.reset()
    assert (first == kept).all()


def test_a_collector_fills_whole_batches():
    env = EnvPoolBatchEnv("InvertedPendulum-v5", 4, seed=0)
    collector = Collector(
        env, None, frames_per_batch=80, total_frames=160, auto_register_policy_transforms=True
    )
    batches = [batch.clone() for batch in collector]
    done = batches[0]["next", "done"][:, :-1, 0]
    assert done.any()
    same = (batches[0]["next", "observation"][:, :-1] == batches[0]["observation"][:, 1:]).all(-1)
    assert torch.equal(same, ~done)
    collector.shutdown()


def test_it_works_as_a_worker_of_a_serial_environment():
    env = SerialEnv(2, lambda: EnvPoolBatchEnv("InvertedPendulum-v5", 3))
    check_env_specs(env)
    env.close()


# Actions, dtypes, threads, seeds ---------------------------------------------------------------


def test_actions_outside_the_box_are_clipped_to_it():
    env = EnvPoolBatchEnv("Hopper-v5", 2, seed=0)
    wild, _ = play(env, env.reset(), [torch.full((2, 3), 7.0)])
    env.set_seed(0)
    at_bound, _ = play(env, env.reset(), [torch.full((2, 3), 1.0)])
    torch.testing.assert_close(wild, at_bound, rtol=0, atol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_the_one_asked_for(dtype):
    env = EnvPoolBatchEnv("Reacher-v5", 2, seed=0, dtype=dtype)
    rollout = env.rollout(3)
    assert rollout["observation"].dtype == rollout["next", "reward"].dtype == dtype
    assert rollout["action"].dtype == torch.float32


@pytest.mark.parametrize("threads", [2, 8])
def test_threads_change_nothing(threads):
    one = EnvPoolBatchEnv("Hopper-v5", 5, seed=0)
    many = EnvPoolBatchEnv("Hopper-v5", 5, seed=0, num_threads=threads)
    actions = random_actions(one, 40)
    torch.testing.assert_close(
        play(one, one.reset(), actions)[0], play(many, many.reset(), actions)[0], rtol=0, atol=0
    )


def test_one_seed_gives_one_result_and_neighbouring_seeds_share_no_row():
    starts = [EnvPoolBatchEnv("Swimmer-v5", 4, seed=s).reset()["observation"] for s in (0, 0, 1, 2)]
    torch.testing.assert_close(starts[0], starts[1], rtol=0, atol=0)
    assert len(torch.cat(starts[1:]).unique(dim=0)) == 12


def test_without_a_seed_no_two_objects_are_alike():
    starts = [EnvPoolBatchEnv("Swimmer-v5", 2).reset()["observation"] for _ in "ab"]
    assert len(torch.cat(starts).unique(dim=0)) == 4


def test_the_first_rows_do_not_depend_on_the_number_of_environments():
    few, many = (EnvPoolBatchEnv("Swimmer-v5", n, seed=0).reset()["observation"] for n in (2, 5))
    torch.testing.assert_close(few, many[:2], rtol=0, atol=0)


def test_a_seed_is_used_once_and_asks_for_a_reset_of_every_row():
    env = EnvPoolBatchEnv("Swimmer-v5", 2, seed=0)
    first, second = env.reset()["observation"], env.reset()["observation"]
    assert (first != second).any()
    env.set_seed(0)
    root = env.fake_tensordict().exclude("next")
    with pytest.raises(RuntimeError, match="row 0 was stepped before its first reset"):
        env.step(root)
    env.reset(root.set("_reset", torch.tensor([[True], [False]])))
    with pytest.raises(RuntimeError, match="row 1 was stepped before its first reset"):
        env.step(root)
    env.set_seed(0)
    torch.testing.assert_close(env.reset()["observation"], first, rtol=0, atol=0)


def test_the_global_generators_are_left_alone():
    torch.manual_seed(0)
    np.random.seed(0)
    expected = torch.get_rng_state(), np.random.get_state()[1].copy()
    env = EnvPoolBatchEnv("Swimmer-v5", 2)
    play(env, env.reset(), random_actions(env, 3))
    assert torch.equal(torch.get_rng_state(), expected[0])
    assert (np.random.get_state()[1] == expected[1]).all()


# Saving ----------------------------------------------------------------------------------------


def test_the_state_can_not_be_saved_and_that_is_said():
    env = EnvPoolBatchEnv("Hopper-v5", 2, seed=0)
    env.reset()
    assert not env.supports_state
    assert not any(env.state_dict().values())
    env.load_state_dict(env.state_dict())
    other = GymnasiumBatchEnv("Hopper-v5", 2, seed=0)
    other.reset()
    with pytest.raises(RuntimeError, match=r"can not be restored.*EnvPool.*`supports_state`"):
        env.load_state_dict(other.state_dict())


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


# Errors ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ["Walker2D-v5", "Waker2d-v5", "Walker2d-v9", "Walker2d"])
def test_an_unknown_id_is_answered_with_near_ones_in_one_line(env_id):
    with pytest.raises(ValueError, match=r"`env_id`.*did you mean .*Walker2d-v5") as error:
        EnvPoolBatchEnv(env_id, 1)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("env_id", "match"),
    [("CartPole-v1", "continuous action"), ("CheetahRun-v1", "vector observation")],
)
def test_tasks_that_are_not_vectors_are_refused(env_id, match):
    with pytest.raises(ValueError, match=match):
        EnvPoolBatchEnv(env_id, 1)


@pytest.mark.parametrize("name", ["num_envs", "num_threads", "max_episode_steps"])
@pytest.mark.parametrize("value", [0, 1.5, True])
def test_counts_below_one_are_refused(name, value):
    kwargs = {"num_envs": 1, name: value}
    with pytest.raises(ValueError, match=f"`{name}` must be an integer of at least 1"):
        EnvPoolBatchEnv("Swimmer-v5", **kwargs)


def test_other_dtypes_and_a_negative_seed_are_refused():
    with pytest.raises(TypeError, match="`dtype`"):
        EnvPoolBatchEnv("Swimmer-v5", 1, dtype=torch.float16)
    with pytest.raises(ValueError, match="`seed`"):
        EnvPoolBatchEnv("Swimmer-v5", 1, seed=-1)


def test_a_step_before_the_first_reset_is_refused():
    env = EnvPoolBatchEnv("Swimmer-v5", 2)
    with pytest.raises(RuntimeError, match="call reset"):
        env.step(env.fake_tensordict().exclude("next"))


def test_an_action_of_the_wrong_size_is_refused():
    env = EnvPoolBatchEnv("Swimmer-v5", 2, seed=0)
    with pytest.raises(ValueError, match=r"`action` must have shape \(2, 2\)"):
        env.step(env.reset().set("action", torch.zeros(2, 1)))


def test_closing_twice_is_an_error_unless_allowed():
    env = EnvPoolBatchEnv("Swimmer-v5", 1)
    env.reset()
    env.close()
    env.close(raise_if_closed=False)
    with pytest.raises(RuntimeError, match="closed"):
        env.close()
