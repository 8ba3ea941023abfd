"""Specification of what `GymnasiumBatchEnv` alone promises, beside test_envs.py."""

import copy
import pickle
import warnings
from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from env_tools import MARKS, TASKS, play, random_actions
from gymnasium import spaces
from suites import parallel_env, saved
from torchrl.envs import check_env_specs

from torchrl_drbpn import GymnasiumBatchEnv, SimulatorError

pytestmark = MARKS

VECTOR = spaces.Box(-1, 1, (3,), np.float32)
IMAGE = spaces.Box(0, 255, (8, 8, 3), np.uint8)


@pytest.fixture
def register(monkeypatch):
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))

    def add(entry_point, **kwargs):
        gymnasium.register("ForTest-v0", entry_point=entry_point, **kwargs)
        return "ForTest-v0"

    return add


class Counter(gymnasium.Env):
    """Count steps; fail, or return the reward NaN, where asked."""

    def __init__(self, observation=VECTOR, action=VECTOR, fails="", at=3):
        self.observation_space, self.action_space = observation, action
        self.fails, self.at, self.time = fails, at, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if self.fails == "reset":
            raise OSError("the cable\nis out")
        self.time = (options or {}).get("time", 0)
        return np.full(3, self.time, np.float32), {}

    def step(self, action):
        self.time += 1
        if self.time == self.at and self.fails == "step":
            raise ZeroDivisionError("a joint has no mass")
        reward = float(self.fails) if self.time == self.at and self.fails in ("nan", "inf") else 1.0
        return np.full(3, self.time, np.float32), reward, False, False, {}


@pytest.mark.parametrize("env_id", TASKS)
def test_trajectories_are_those_of_gymnasium_to_the_last_bit(env_id):
    steps, n, kwargs = 60, 2, {"max_episode_steps": 25}
    env, single = (
        GymnasiumBatchEnv(env_id, n, seed=3, dtype=dtype, **kwargs)
        for dtype in (torch.float64, torch.float32)
    )
    actions = random_actions(env, steps, scale=1.5)
    tensordict = env.reset()
    seen, _ = play(env, tensordict.clone(), actions)
    rounded, _ = play(single, single.reset(), actions)
    torch.testing.assert_close(rounded, seen.float().double(), rtol=0, atol=0)

    for row, seed in enumerate(np.random.SeedSequence(3).generate_state(n)):
        by_hand = gymnasium.make(env_id, **kwargs)
        space = by_hand.action_space
        observation, _ = by_hand.reset(seed=int(seed))
        np.testing.assert_array_equal(tensordict["observation"][row], observation)
        for step in range(steps):
            action = np.clip(actions[step, row].numpy(), space.low, space.high)
            observation, reward, terminated, truncated, _ = by_hand.step(action)
            after = by_hand.reset()[0] if terminated or truncated else observation
            expected = np.concatenate([observation, [reward, terminated, truncated], after])
            np.testing.assert_array_equal(seen[step, row], expected)


@pytest.mark.parametrize(
    ("own", "registered", "asked", "expected"),
    [(4, None, None, 4), (4, 7, None, 4), (7, 4, None, 4), (7, None, 5, 5), (4, 7, -1, 4),
     (None, 6, None, 6), (None, 6, -1, None)],
)  # fmt: skip
def test_the_shortest_time_limit_counts_as_in_gymnasium(register, own, registered, asked, expected):
    def make():
        env = Counter()
        return env if own is None else gymnasium.wrappers.TimeLimit(env, own)

    env_id = register(make, max_episode_steps=registered)
    by_hand = gymnasium.make(env_id, max_episode_steps=asked)
    by_hand.reset()
    ends = [by_hand.step(np.zeros(3, np.float32))[3] for _ in range(9)]
    env = GymnasiumBatchEnv(env_id, 2, max_episode_steps=asked)
    assert env.max_episode_steps == expected
    truncated = env.rollout(9)["next", "truncated"][0, :, 0].tolist()
    assert truncated == ends[: len(truncated)]
    assert True in truncated or expected is None


def test_wrappers_of_a_task_its_keywords_and_further_wrappers_are_kept(register):
    scale = gymnasium.wrappers.TransformReward.wrapper_spec(func=_doubled)
    env_id = register(Counter, additional_wrappers=(scale,))
    wrappers = [partial(gymnasium.wrappers.RescaleObservation, min_obs=0, max_obs=1)] * 2
    env = copy.deepcopy(GymnasiumBatchEnv(env_id, 2, wrappers=wrappers))
    assert env.reset()["observation"].tolist() == [[0.5] * 3] * 2
    assert (env.rollout(3)["next", "reward"] == 2).all()
    env = GymnasiumBatchEnv("Walker2d-v5", 2, frame_skip=2, render_mode="rgb_array")
    assert [sim.unwrapped.frame_skip for sim in env.envs] == [2, 2]
    assert [sim.render_mode for sim in env.envs] == ["rgb_array", "rgb_array"]


def _doubled(reward):
    return 2 * reward


def test_an_id_may_name_the_module_that_registers_it(tmp_path, monkeypatch, register):
    text = "import gymnasium\ngymnasium.register('Mine-v0', 'test_gymnasium_batch:Counter')\n"
    (tmp_path / "robots_for_test.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    assert GymnasiumBatchEnv("robots_for_test:Mine-v0", 2).rollout(3).shape == (2, 3)
    with pytest.raises(ValueError, match=r"`env_id`.*no_such_module"):
        GymnasiumBatchEnv("no_such_module:Mine-v0", 2)


def test_reset_passes_options_on_to_the_rows_it_resets(register):
    env = GymnasiumBatchEnv(register(Counter), 2)
    env.reset()
    mask = torch.tensor([[True], [False]])
    after = env.reset(env.reset().set("_reset", mask), options={"time": 5})
    assert after["observation"][:, 0].tolist() == [5, 0]


def test_a_seeded_partial_reset_gives_the_rows_what_a_whole_one_does():
    env = GymnasiumBatchEnv("Swimmer-v5", 3, seed=0)
    first = env.reset()["observation"]
    later = env.reset()
    again = env.reset(later.clone().set("_reset", torch.tensor([[False], [True], [False]])), seed=0)
    assert torch.equal(again["observation"][1], first[1])
    assert torch.equal(again["observation"][::2], later["observation"][::2])


def test_making_writes_no_log_file_and_logs_each_model_warning_once(tmp_path, caplog):
    with caplog.at_level("INFO"):
        GymnasiumBatchEnv("HalfCheetah-v5", 3)
    assert not any(tmp_path.iterdir())
    assert sum("settotalmass" in record.message for record in caplog.records) <= 1


def test_an_older_version_asked_for_by_name_gives_no_warning():
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        GymnasiumBatchEnv("Walker2d-v4", 2)
    assert not caught


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(
    ("fails", "match"),
    [
        ("step", "raised in `step` after 2 steps .*ZeroDivisionError: a joint has no mass"),
        ("nan", "returned the reward nan in `step` after 2 steps"),
        ("inf", "returned the reward inf in `step` after 2 steps"),
        ("reset", "raised in `reset` after 0 steps .*: OSError: the cable is out$"),
    ],
)
def test_a_simulator_that_fails_is_named_with_its_step_in_one_line(register, threads, fails, match):
    env = GymnasiumBatchEnv(register(Counter), 3, num_threads=threads)
    env.envs[2].unwrapped.fails = fails
    with pytest.raises(SimulatorError, match=f"environment 2 of 3 x `ForTest-v0` {match}") as error:
        env.rollout(5)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "InvertedPendulum-v5"])
@pytest.mark.parametrize("fault", ["velocity", "position", "action"])
def test_an_engine_that_resets_itself_is_counted_and_ends_the_episode_as_truncated(env_id, fault):
    env = GymnasiumBatchEnv(env_id, 2, seed=0)
    root = env.reset()
    for _ in range(3):
        root = env.step(root.set("action", torch.zeros_like(env.action_spec.zero())))["next"]
    action = env.action_spec.zero()
    if fault == "action":
        action[1] = torch.nan
    else:
        data = env.envs[1].data
        (data.qvel if fault == "velocity" else data.qpos)[0] = 1e12
    with pytest.warns(RuntimeWarning, match=f"environment 1 of `{env_id}` after 3 steps"):
        stepped, root = env.step_and_maybe_reset(root.set("action", action))
    assert stepped["next", "truncated"].flatten().tolist() == [False, True]
    assert stepped["next", "reward"].isfinite().all()
    assert env.engine_resets.tolist() == [0, 1]
    root = env.step(root.set("action", env.action_spec.zero()))
    assert not root["next", "truncated"].any()
    assert env.engine_resets.tolist() == [0, 1]


@pytest.mark.parametrize("env_id", TASKS)
def test_a_restored_run_goes_on_to_the_last_bit_in_a_fresh_object(env_id):
    make = partial(GymnasiumBatchEnv, env_id, 2, dtype=torch.float64, max_episode_steps=70)
    env, undisturbed = make(seed=0), make(seed=1)
    undisturbed.load_state_dict(env.state_dict())  # with the seed that waits for a reset
    actions = random_actions(env, 160)
    _, tensordict = play(env, env.reset(), actions[:40])
    env.envs[0].count = 3  # what a task holds is saved with it
    state, start = saved(env.state_dict()), tensordict.clone()
    expected, _ = play(env, tensordict, actions[40:])
    assert expected[:, :, -1].isfinite().all()
    whole, _ = play(undisturbed, undisturbed.reset(), actions)
    torch.testing.assert_close(whole[40:], expected, rtol=0, atol=0)

    with_a_past, never_reset = make(seed=99), make()
    play(with_a_past, with_a_past.reset(), actions[:7])  # which must leave no trace
    for fresh in (with_a_past, never_reset):
        fresh.load_state_dict(state)
        again, _ = play(fresh, start.clone(), actions[40:])
        torch.testing.assert_close(again, expected, rtol=0, atol=0)
        assert fresh.envs[0].count == 3


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_goes_on_where_the_original_is(duplicate):
    env = GymnasiumBatchEnv("Hopper-v5", 2, seed=0, num_threads=2)
    actions = random_actions(env, 30)
    _, tensordict = play(env, env.reset(), actions[:10])
    twin = duplicate(env)
    expected, _ = play(env, tensordict.clone(), actions[10:])
    again, _ = play(twin, tensordict.clone(), actions[10:])
    torch.testing.assert_close(again, expected, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("env_id", "n", "spoilt", "match"),
    [
        ("Walker2d-v5", 2, None, "another environment"),
        ("Hopper-v5", 3, None, "another environment"),
        *[("Hopper-v5", 2, key, key) for key in ("elapsed", "observation", "simulators")],
        ("Hopper-v5", 2, "generators", "generators"),
    ],
)
def test_a_foreign_incomplete_or_damaged_state_is_refused(env_id, n, spoilt, match):
    env = GymnasiumBatchEnv("Hopper-v5", 2, seed=0)
    env.reset()
    state = env.state_dict()
    extra = state["_extra_state"]
    if spoilt == "generators":
        extra["simulators"][spoilt] = extra["simulators"][spoilt][:-9]
    else:
        extra.pop(spoilt, None)
    with pytest.raises(ValueError, match=match):
        GymnasiumBatchEnv(env_id, n).load_state_dict(state)


def test_a_task_without_mujoco_says_that_it_can_not_be_saved():
    make = partial(GymnasiumBatchEnv, "Pendulum-v1", 3, seed=0)
    env = make()
    check_env_specs(env)
    assert not env.supports_state
    assert not any(env.state_dict().values())
    other = GymnasiumBatchEnv("InvertedPendulum-v5", 3, seed=0)
    other.reset()
    with pytest.raises(RuntimeError, match=r"can not be restored.*supports_state"):
        env.load_state_dict(other.state_dict())
    # TorchRL asks a shadow of each worker's environment for its state_dict.
    env = parallel_env(2, make)
    try:
        assert env.rollout(3)["observation"].shape == (2, 3, 3, 3)
    finally:
        env.close(raise_if_closed=False)


def test_entries_of_a_dictionary_are_joined_in_the_order_asked_for(register):
    two = spaces.Dict(a=spaces.Box(-1, 1, (1,)), b=spaces.Box(-1, 1, (2,)), c=VECTOR)

    def halves(seen):
        return {"b": 2 * seen[:2], "c": seen, "a": seen[:1]}

    env_id = register(lambda: gymnasium.wrappers.TransformObservation(Counter(), halves, two))
    env = GymnasiumBatchEnv(env_id, 2, observation_keys=["b", "a"])
    rollout = env.rollout(2, break_when_any_done=False)
    assert rollout["next", "observation"][0].tolist() == [[2, 2, 1], [4, 4, 2]]
    for keys in (["b", "x"], []):
        with pytest.raises(ValueError, match=r"`observation_keys` .* it has a, b, c\.$"):
            GymnasiumBatchEnv(env_id, 2, observation_keys=keys)


@pytest.mark.parametrize(
    ("observation", "action", "match"),
    [
        (IMAGE, VECTOR, r"observation space .* got Box\(0, 255, \(8, 8, 3\), uint8\)"),
        (spaces.Box(0, 9, (3,), np.int64), VECTOR, r"observation space .* got Box.*int64"),
        (spaces.Dict(a=VECTOR), VECTOR, r"observation space .* got Dict\('a'"),
        (VECTOR, spaces.Discrete(3), r"action space .* got Discrete\(3\): a wrapper may make"),
        (VECTOR, spaces.MultiDiscrete([2, 3]), r"action space .* got MultiDiscrete"),
        (VECTOR, spaces.Box(-np.inf, np.inf, (2,), np.float32), "action space .* finite limits"),
    ],
)
def test_spaces_that_are_not_vectors_are_refused_by_name(register, observation, action, match):
    env_id = register(Counter, kwargs={"observation": observation, "action": action})
    with pytest.raises(ValueError, match=match) as error:
        GymnasiumBatchEnv(env_id, 1)
    assert "\n" not in str(error.value)
