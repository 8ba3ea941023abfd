"""Specification of `GymnasiumBatchEnv`: many Gymnasium environments as one TorchRL environment.

Its trajectories are those of `gymnasium.make`, to the last bit; only the rows that are asked for
are reset; the last observation of an episode is the true one; a saved state goes on to the last
bit in a fresh object; threads change nothing; bad input is answered with one clear line.
"""

from __future__ import annotations

import copy
import io
import pickle
import sys

import gymnasium
import numpy as np
import pytest
import torch
from env_tools import TASKS, play, random_actions
from gymnasium import spaces
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv, SerialEnv, StepCounter, TransformedEnv, check_env_specs

from torchrl_drbpn.envs import EnvPoolBatchEnv, GymnasiumBatchEnv

# Version 4 is tested on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:.*is out of date")


@pytest.fixture(autouse=True)
def _own_directory(tmp_path, monkeypatch):
    # MuJoCo writes the warnings of a model file into the current directory.
    monkeypatch.chdir(tmp_path)


# The same trajectories as Gymnasium's ----------------------------------------------------------


@pytest.mark.parametrize("env_id", TASKS)
def test_trajectories_are_those_of_gymnasium_to_the_last_bit(env_id):
    steps, n, limit = 60, 2, 25
    env = GymnasiumBatchEnv(env_id, n, seed=3, dtype=torch.float64, max_episode_steps=limit)
    actions = random_actions(env, steps, scale=1.5)
    tensordict = env.reset()
    seen, _ = play(env, tensordict.clone(), actions)

    for row, seed in enumerate(np.random.SeedSequence(3).generate_state(n)):
        by_hand = gymnasium.make(env_id, max_episode_steps=limit)
        space = by_hand.action_space
        observation, _ = by_hand.reset(seed=int(seed))
        np.testing.assert_array_equal(tensordict["observation"][row], observation)
        for step in range(steps):
            action = np.clip(actions[step, row].numpy(), space.low, space.high)
            observation, reward, terminated, truncated, _ = by_hand.step(action)
            after = by_hand.reset()[0] if terminated or truncated else observation
            expected = np.concatenate([observation, [reward, terminated, truncated], after])
            np.testing.assert_array_equal(seen[step, row], expected)


@pytest.mark.parametrize("env_id", TASKS)
def test_every_task_passes_check_env_specs(env_id):
    check_env_specs(GymnasiumBatchEnv(env_id, 2, seed=0), break_when_any_done="both")


@pytest.mark.parametrize("break_when_any_done", [True, False, "any", "all", "both"])
def test_specs_hold_for_every_way_of_ending_a_rollout(break_when_any_done):
    env = GymnasiumBatchEnv("InvertedPendulum-v5", 3, seed=0, max_episode_steps=2)
    check_env_specs(env, break_when_any_done=break_when_any_done)
    check_env_specs(TransformedEnv(env, StepCounter()), break_when_any_done=break_when_any_done)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_the_one_asked_for(dtype):
    env = GymnasiumBatchEnv("Reacher-v5", 2, seed=0, dtype=dtype)
    rollout = env.rollout(3)
    assert rollout["observation"].dtype == rollout["next", "reward"].dtype == dtype
    assert rollout["action"].dtype == torch.float32


def test_float32_is_the_rounded_float64():
    single, double = (
        GymnasiumBatchEnv("Walker2d-v5", 2, seed=0, dtype=dtype)
        for dtype in (torch.float32, torch.float64)
    )
    actions = random_actions(single, 20)
    low, _ = play(single, single.reset(), actions)
    high, _ = play(double, double.reset(), actions)
    torch.testing.assert_close(low, high.float().double(), rtol=0, atol=0)


def test_actions_outside_the_box_are_clipped_to_it():
    env = GymnasiumBatchEnv("Hopper-v5", 2, seed=0)
    start = env.reset()
    wild = play(env, start.clone(), [torch.full((2, 3), 7.0)])[0]
    env.set_seed(0)
    env.reset()
    at_bound = play(env, start.clone(), [torch.full((2, 3), 1.0)])[0]
    torch.testing.assert_close(wild, at_bound, rtol=0, atol=0)


def test_a_float64_policy_may_act():
    env = GymnasiumBatchEnv("Hopper-v5", 2, seed=0, dtype=torch.float64)
    tensordict = env.reset().set("action", torch.zeros(2, 3, dtype=torch.float64))
    assert env.step(tensordict)["next", "observation"].isfinite().all()


# Seeds -----------------------------------------------------------------------------------------


def test_one_seed_gives_one_result_and_rows_differ():
    first, again = (
        GymnasiumBatchEnv("Swimmer-v5", 3, seed=5).rollout(5, auto_reset=True) for _ in "ab"
    )
    torch.testing.assert_close(first["observation"][:, 0], again["observation"][:, 0])
    assert len(first["observation"][:, 0].unique(dim=0)) == 3


def test_neighbouring_seeds_share_no_row():
    starts = [GymnasiumBatchEnv("Swimmer-v5", 4, seed=s).reset()["observation"] for s in (0, 1, 2)]
    assert len(torch.cat(starts).unique(dim=0)) == 12


def test_the_first_rows_do_not_depend_on_the_number_of_environments():
    few, many = (GymnasiumBatchEnv("Swimmer-v5", n, seed=0).reset()["observation"] for n in (2, 5))
    torch.testing.assert_close(few, many[:2], rtol=0, atol=0)


def test_a_seed_is_used_once():
    env = GymnasiumBatchEnv("Swimmer-v5", 2, seed=0)
    first, second = env.reset()["observation"], env.reset()["observation"]
    assert (first != second).any()
    env.set_seed(0)
    torch.testing.assert_close(env.reset()["observation"], first, rtol=0, atol=0)


def test_the_global_generators_are_left_alone():
    torch.manual_seed(0)
    np.random.seed(0)
    expected = torch.get_rng_state(), np.random.get_state()[1].copy()
    env = GymnasiumBatchEnv("Swimmer-v5", 2)
    play(env, env.reset(), random_actions(env, 3))
    assert torch.equal(torch.get_rng_state(), expected[0])
    assert (np.random.get_state()[1] == expected[1]).all()


# Episodes --------------------------------------------------------------------------------------


def test_a_partial_reset_touches_only_the_rows_asked_for():
    env = GymnasiumBatchEnv("Hopper-v5", 4, seed=0, dtype=torch.float64)
    tensordict = env.reset()
    _, tensordict = play(env, tensordict, random_actions(env, 3))
    before = [sim.data.qpos.copy() for sim in env.envs]
    mask = torch.tensor([[False], [True], [False], [True]])
    after = env.reset(tensordict.clone().set("_reset", mask))
    same = (after["observation"] == tensordict["observation"]).all(-1)
    assert same.tolist() == [True, False, True, False]
    moved = [bool((sim.data.qpos != old).any()) for sim, old in zip(env.envs, before, strict=True)]
    assert moved == [False, True, False, True]


def test_the_time_limit_truncates_and_leaves_the_true_last_observation():
    env = GymnasiumBatchEnv("HalfCheetah-v5", 2, seed=0, dtype=torch.float64, max_episode_steps=4)
    rollout = env.rollout(9, break_when_any_done=False)
    ends = rollout["next", "truncated"][0, :, 0]
    assert ends.nonzero().flatten().tolist() == [3, 7]
    assert not rollout["next", "terminated"].any()
    assert torch.equal(rollout["next", "done"], rollout["next", "truncated"])
    # Within an episode the next observation is the following root; at its end it is not.
    same = (rollout["next", "observation"][:, :-1] == rollout["observation"][:, 1:]).all(-1)
    assert torch.equal(same[0], ~ends[:-1])
    # The simulator moves on smoothly, so that the true one is close to the one before.
    jump = (rollout["next", "observation"] - rollout["observation"])[:, 3, :8].abs().max()
    assert jump < 1.0


def test_a_reset_row_gets_the_whole_time_limit_again():
    env = GymnasiumBatchEnv("HalfCheetah-v5", 2, seed=0, max_episode_steps=5)
    tensordict = env.reset()
    _, tensordict = play(env, tensordict, random_actions(env, 3))
    tensordict = env.reset(tensordict.set("_reset", torch.tensor([[True], [False]])))
    tensordict.pop("_reset", None)
    seen, _ = play(env, tensordict, random_actions(env, 5))
    assert seen[:, 0, 19].nonzero().flatten().tolist() == [4]
    assert seen[:, 1, 19].nonzero().flatten().tolist() == [1]


def test_the_registered_time_limit_is_the_default_and_minus_one_takes_it_off():
    assert GymnasiumBatchEnv("Walker2d-v5", 1).max_episode_steps == 1000
    assert GymnasiumBatchEnv("Reacher-v4", 1).max_episode_steps == 50
    env = GymnasiumBatchEnv("Reacher-v4", 1, seed=0, max_episode_steps=-1)
    assert env.rollout(60).shape == (1, 60)


def test_rows_that_a_step_leaves_out_do_not_move():
    env = GymnasiumBatchEnv("InvertedPendulum-v5", 3, seed=0)
    tensordict = env.reset().set("action", torch.ones(3, 1))
    tensordict.set("_step", torch.tensor([True, False, True]))
    stepped = env.step(tensordict)
    same = (stepped["next", "observation"] == stepped["observation"]).all(-1)
    assert same.tolist() == [False, True, False]
    assert stepped["next", "reward"].flatten().tolist() == [1.0, 0.0, 1.0]


def test_a_step_never_writes_into_what_an_earlier_one_returned():
    env = GymnasiumBatchEnv("Hopper-v5", 2, seed=0, dtype=torch.float64)
    start = env.reset()
    tensordict = start.clone().set("action", torch.zeros(2, 3))
    first = env.step(tensordict.clone())["next"]
    kept = first.clone()
    env.step(tensordict.clone())
    env.reset()
    assert (first == kept).all()


def test_a_collector_fills_whole_batches():
    env = GymnasiumBatchEnv("InvertedPendulum-v5", 4, seed=0)
    collector = Collector(
        env, None, frames_per_batch=80, total_frames=160, auto_register_policy_transforms=True
    )
    batches = [batch.clone() for batch in collector]
    assert [batch.shape for batch in batches] == [(4, 20), (4, 20)]
    done = batches[0]["next", "done"][:, :-1, 0]
    assert done.any()
    same = (batches[0]["next", "observation"][:, :-1] == batches[0]["observation"][:, 1:]).all(-1)
    assert torch.equal(same, ~done)
    collector.shutdown()


def test_it_works_as_a_worker_of_a_serial_environment():
    env = SerialEnv(2, lambda: GymnasiumBatchEnv("InvertedPendulum-v5", 3))
    check_env_specs(env)
    env.close()


@pytest.mark.parametrize("threads", [2, 3, 8])
def test_threads_change_nothing(threads):
    one = GymnasiumBatchEnv("Hopper-v5", 5, seed=0)
    many = GymnasiumBatchEnv("Hopper-v5", 5, seed=0, num_threads=threads)
    actions = random_actions(one, 40)
    torch.testing.assert_close(
        play(one, one.reset(), actions)[0], play(many, many.reset(), actions)[0], rtol=0, atol=0
    )
    many.close()


def test_an_error_in_a_thread_reaches_the_caller():
    env = GymnasiumBatchEnv("Hopper-v5", 2, seed=0, num_threads=2)
    tensordict = env.reset().set("action", torch.zeros(2, 3))
    env.envs[1].model = None
    with pytest.raises(Exception, match="None"):
        env.step(tensordict)


def test_a_single_environment_renders_off_screen():
    env = GymnasiumBatchEnv("InvertedPendulum-v5", 2, render_mode="rgb_array")
    assert [sim.render_mode for sim in env.envs] == ["rgb_array", "rgb_array"]


def test_making_writes_no_log_file_and_says_each_model_warning_once(tmp_path, caplog):
    with caplog.at_level("INFO"):
        GymnasiumBatchEnv("HalfCheetah-v5", 3)
    assert not any(tmp_path.iterdir())
    assert sum("settotalmass" in record.message for record in caplog.records) <= 1


def test_make_kwargs_reach_the_simulator():
    env = GymnasiumBatchEnv("Walker2d-v5", 1, seed=0, frame_skip=2, terminate_when_unhealthy=False)
    assert type(env) is GymnasiumBatchEnv
    assert env.envs[0].frame_skip == 2


# Saving ----------------------------------------------------------------------------------------


def through_a_file(state):
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)


@pytest.mark.parametrize("env_id", TASKS)
def test_a_restored_run_goes_on_to_the_last_bit_in_a_fresh_object(env_id):
    kwargs = {"dtype": torch.float64, "max_episode_steps": 70}
    env = GymnasiumBatchEnv(env_id, 2, seed=0, **kwargs)
    actions = random_actions(env, 240)
    _, tensordict = play(env, env.reset(), actions[:40])
    saved, start = through_a_file(env.state_dict()), tensordict.clone()
    expected, _ = play(env, tensordict, actions[40:])
    assert expected[:, :, -1].isfinite().all()

    fresh = GymnasiumBatchEnv(env_id, 2, seed=99, **kwargs)
    play(fresh, fresh.reset(), actions[:7])  # a past of its own must leave no trace
    fresh.load_state_dict(saved)
    again, _ = play(fresh, start.clone(), actions[40:])
    torch.testing.assert_close(again, expected, rtol=0, atol=0)

    never_reset = GymnasiumBatchEnv(env_id, 2, **kwargs)
    never_reset.load_state_dict(saved)
    again, _ = play(never_reset, start.clone(), actions[40:80])
    torch.testing.assert_close(again, expected[:40], rtol=0, atol=0)


def test_saving_does_not_disturb_the_run():
    plain, saved = (GymnasiumBatchEnv("Ant-v5", 2, seed=0) for _ in "ab")
    actions = random_actions(plain, 20)
    expected, _ = play(plain, plain.reset(), actions)
    tensordict, parts = saved.reset(), []
    for action in actions:
        part, tensordict = play(saved, tensordict, [action])
        saved.state_dict()
        parts.append(part)
    torch.testing.assert_close(torch.cat(parts), expected, rtol=0, atol=0)


def test_a_pending_seed_is_saved():
    env = GymnasiumBatchEnv("Swimmer-v5", 2, seed=0)
    fresh = GymnasiumBatchEnv("Swimmer-v5", 2, seed=1)
    fresh.load_state_dict(env.state_dict())
    torch.testing.assert_close(fresh.reset()["observation"], env.reset()["observation"])


def test_numbers_that_a_task_holds_are_saved():
    env = GymnasiumBatchEnv("Reacher-v5", 1, seed=0)
    env.reset()
    env.envs[0].count, env.envs[0].level = 3, np.float64(0.1)
    fresh = GymnasiumBatchEnv("Reacher-v5", 1)
    fresh.load_state_dict(through_a_file(env.state_dict()))
    np.testing.assert_array_equal(fresh.envs[0].goal, env.envs[0].goal)
    assert fresh.envs[0].count == 3
    assert isinstance(fresh.envs[0].level, np.float64)
    assert fresh.envs[0].level == 0.1


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_where_the_original_is(duplicate):
    env = GymnasiumBatchEnv("Hopper-v5", 2, seed=0, num_threads=2)
    actions = random_actions(env, 30)
    _, tensordict = play(env, env.reset(), actions[:10])
    twin = duplicate(env)
    expected, _ = play(env, tensordict.clone(), actions[10:])
    again, _ = play(twin, tensordict.clone(), actions[10:])
    torch.testing.assert_close(again, expected, rtol=0, atol=0)


@pytest.mark.parametrize(("env_id", "n"), [("Walker2d-v5", 2), ("Hopper-v5", 3)])
def test_a_foreign_state_is_refused(env_id, n):
    env = GymnasiumBatchEnv("Hopper-v5", 2, seed=0)
    env.reset()
    other = GymnasiumBatchEnv(env_id, n)
    with pytest.raises(ValueError, match="another environment"):
        other.load_state_dict(env.state_dict())


@pytest.mark.parametrize("key", ["elapsed", "observation", "simulators"])
def test_an_incomplete_state_is_refused(key):
    env = GymnasiumBatchEnv("Hopper-v5", 2, seed=0)
    env.reset()
    state = env.state_dict()
    del state["_extra_state"][key]
    with pytest.raises(ValueError, match=key):
        env.load_state_dict(state)


def test_damaged_generators_are_refused():
    env = GymnasiumBatchEnv("Hopper-v5", 2, seed=0)
    env.reset()
    state = env.state_dict()
    simulators = state["_extra_state"]["simulators"]
    simulators["generators"] = simulators["generators"][:-9]
    with pytest.raises(ValueError, match="`generators`"):
        env.load_state_dict(state)


def test_a_task_without_mujoco_says_that_it_can_not_be_saved():
    env = GymnasiumBatchEnv("Pendulum-v1", 2, seed=0)
    check_env_specs(env)
    assert not env.supports_state
    assert not any(env.state_dict().values())
    other = GymnasiumBatchEnv("InvertedPendulum-v5", 2, seed=0)
    other.reset()
    with pytest.raises(RuntimeError, match=r"can not be restored.*supports_state"):
        env.load_state_dict(other.state_dict())


def test_a_task_that_can_not_be_saved_runs_in_parallel_environments():
    # TorchRL asks a shadow of each worker's environment for its state_dict.
    env = ParallelEnv(2, lambda: GymnasiumBatchEnv("Pendulum-v1", 3, seed=0))
    try:
        assert env.rollout(3)["observation"].shape == (2, 3, 3, 3)
    finally:
        env.close(raise_if_closed=False)


# Errors ----------------------------------------------------------------------------------------


class _Odd(gymnasium.Env):
    """An environment with spaces of the caller's choice."""

    def __init__(self, observation_space, action_space):
        self.observation_space, self.action_space = observation_space, action_space


IMAGE = spaces.Box(0, 1, (3, 4), np.float32)
VECTOR = spaces.Box(-1, 1, (3,), np.float32)


@pytest.mark.parametrize(
    ("observation_space", "action_space", "match"),
    [
        (IMAGE, VECTOR, "vector observation"),
        (spaces.Box(0, 9, (3,), np.int64), VECTOR, "vector observation"),
        (spaces.Dict(a=VECTOR), VECTOR, "vector observation"),
        (VECTOR, spaces.Discrete(3), "discrete actions"),
        (VECTOR, IMAGE, "continuous action"),
        (VECTOR, spaces.Box(-np.inf, np.inf, (2,), np.float32), "finite limits"),
    ],
)
def test_spaces_that_are_not_vectors_are_refused(observation_space, action_space, match):
    gymnasium.register(
        "OddForTest-v0",
        entry_point=_Odd,
        kwargs={"observation_space": observation_space, "action_space": action_space},
    )
    try:
        with pytest.raises(ValueError, match=match):
            GymnasiumBatchEnv("OddForTest-v0", 1)
    finally:
        del gymnasium.registry["OddForTest-v0"]


@pytest.mark.parametrize("env_id", ["Walker2D-v5", "Waker2d-v5", "Walker2d-v9", "Walker2d"])
def test_an_unknown_id_is_answered_with_near_ones_in_one_line(env_id):
    with pytest.raises(ValueError, match=r"`env_id`.*did you mean .*Walker2d-v5") as error:
        GymnasiumBatchEnv(env_id, 1)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["num_envs", "num_threads", "max_episode_steps"])
@pytest.mark.parametrize("value", [0, -3, 1.5, True])
def test_counts_below_one_are_refused(name, value):
    kwargs = {"num_envs": 1, name: value}
    with pytest.raises(ValueError, match=f"`{name}` must be an integer of at least 1"):
        GymnasiumBatchEnv("Swimmer-v5", **kwargs)


def test_other_dtypes_are_refused():
    with pytest.raises(TypeError, match="`dtype`"):
        GymnasiumBatchEnv("Swimmer-v5", 1, dtype=torch.float16)


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError, match="`seed`"):
        GymnasiumBatchEnv("Swimmer-v5", 1, seed=-1)


def test_a_step_before_the_first_reset_is_refused():
    env = GymnasiumBatchEnv("Swimmer-v5", 2)
    with pytest.raises(RuntimeError, match="call reset"):
        env.step(env.fake_tensordict().exclude("next"))


def test_an_action_of_the_wrong_size_is_refused():
    env = GymnasiumBatchEnv("Swimmer-v5", 2, seed=0)
    with pytest.raises(ValueError, match=r"`action` must have shape \(2, 2\)"):
        env.step(env.reset().set("action", torch.zeros(2, 1)))


def test_closing_twice_is_an_error_unless_allowed():
    env = GymnasiumBatchEnv("Swimmer-v5", 1)
    env.close()
    env.close(raise_if_closed=False)
    with pytest.raises(RuntimeError, match="closed"):
        env.close()


def test_the_environment_over_envpool_names_its_extra_where_envpool_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "envpool", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'torchrl-drbpn\[envpool\]'"):
        EnvPoolBatchEnv("Walker2d-v5", 2)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_tensors_come_out_on_the_device_asked_for():
    env = GymnasiumBatchEnv("Hopper-v5", 2, seed=0, device="cuda")
    check_env_specs(env)
    on_cpu = GymnasiumBatchEnv("Hopper-v5", 2, seed=0).reset()["observation"]
    assert torch.equal(env.reset()["observation"].cpu().isfinite(), on_cpu.isfinite())
