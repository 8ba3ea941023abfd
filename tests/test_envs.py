"""Specification of the batches of simulators: what holds over Gymnasium and over EnvPool."""

import numpy as np
import pytest
import torch
from env_tools import BACKENDS, MARKS, TASKS, play, random_actions
from torchrl.envs import SerialEnv, StepCounter, TransformedEnv, check_env_specs
from torchrl.testing import rollout_consistency_assertion

pytestmark = [*MARKS, pytest.mark.parametrize("backend", BACKENDS)]


@pytest.mark.parametrize("env_id", TASKS)
def test_every_task_passes_check_env_specs(backend, env_id):
    check_env_specs(backend(env_id, 2, seed=0), break_when_any_done="both")


def test_a_rollout_through_ends_is_consistent(backend):
    env = backend("InvertedPendulum-v5", 3, seed=0)
    rollout_consistency_assertion(env.rollout(60, break_when_any_done=False), done_strict=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_the_one_asked_for(backend, dtype):
    env = backend("Reacher-v5", 2, seed=0, dtype=dtype)
    rollout = env.rollout(3)
    assert rollout["observation"].dtype == rollout["next", "reward"].dtype == dtype
    assert rollout["action"].dtype == torch.float32


def test_actions_outside_the_box_are_clipped_to_it_whatever_their_dtype(backend):
    env = backend("Hopper-v5", 2, seed=0)
    wild, _ = play(env, env.reset(), [torch.full((2, 3), 7.0, dtype=torch.float64)])
    at_bound, _ = play(env, env.reset(seed=0), [torch.full((2, 3), 1.0)])
    torch.testing.assert_close(wild, at_bound, rtol=0, atol=0)


def test_a_seed_decides_each_row_and_without_one_no_two_are_alike(backend):
    starts = [
        backend("Swimmer-v5", n, seed=seed).reset()["observation"]
        for n, seed in ((2, 0), (4, 0), (4, 1), (4, 2), (2, None), (2, None))
    ]
    torch.testing.assert_close(starts[0], starts[1][:2], rtol=0, atol=0)
    assert len(torch.cat(starts[1:]).unique(dim=0)) == 16


def test_a_seed_is_used_once_and_may_be_given_to_reset(backend):
    env = backend("Swimmer-v5", 2, seed=0)
    first, second = env.reset()["observation"], env.reset()["observation"]
    assert (first != second).any()
    torch.testing.assert_close(env.reset(seed=0)["observation"], first, rtol=0, atol=0)
    torch.testing.assert_close(env.reset()["observation"], second, rtol=0, atol=0)
    wrapped = TransformedEnv(env, StepCounter())
    torch.testing.assert_close(wrapped.reset(seed=0)["observation"], first, rtol=0, atol=0)
    env.set_seed(0)
    torch.testing.assert_close(env.reset()["observation"], first, rtol=0, atol=0)


def test_the_global_generators_are_left_alone(backend):
    np.random.seed(0)
    expected = torch.get_rng_state(), np.random.get_state()[1].copy()
    env = backend("Swimmer-v5", 2)
    play(env, env.reset(), random_actions(env, 3))
    assert torch.equal(torch.get_rng_state(), expected[0])
    assert (np.random.get_state()[1] == expected[1]).all()


@pytest.mark.parametrize("threads", [2, 3, 8])
def test_threads_change_nothing(backend, threads):
    one, many = (backend("Hopper-v5", 5, seed=0, num_threads=n) for n in (1, threads))
    actions = random_actions(one, 40)
    torch.testing.assert_close(
        play(one, one.reset(), actions)[0], play(many, many.reset(), actions)[0], rtol=0, atol=0
    )
    many.close()


def test_a_partial_reset_touches_only_the_rows_asked_for_which_get_the_whole_time_limit(backend):
    # The rows that go on have to go on as if nothing had happened.
    seen = []
    for reset in (False, True):
        env = backend("HalfCheetah-v5", 4, seed=0, dtype=torch.float64, max_episode_steps=6)
        actions = random_actions(env, 8)
        _, root = play(env, env.reset(), actions[:3])
        if reset:
            mask = torch.tensor([[False], [True], [False], [True]])
            after = env.reset(root.clone().set("_reset", mask))
            same = (after["observation"] == root["observation"]).all(-1)
            assert same.tolist() == [True, False, True, False]
            root = after.exclude("_reset")
        seen.append(play(env, root, actions[3:])[0])
    torch.testing.assert_close(seen[0][:3, ::2], seen[1][:3, ::2], rtol=0, atol=0)
    assert (seen[0][:, 1::2] != seen[1][:, 1::2]).any()
    truncated = seen[1][..., 19]
    assert truncated.argmax(0).tolist() == [2, 0, 2, 0]
    assert truncated.sum(0).tolist() == [1, 0, 1, 0]  # 5 steps of 6 since their reset


def test_the_time_limit_truncates_and_leaves_the_true_last_observation(backend):
    env = backend("HalfCheetah-v5", 2, seed=0, dtype=torch.float64, max_episode_steps=4)
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


def test_the_registered_time_limit_is_the_default_and_minus_one_takes_it_off(backend):
    assert backend("Walker2d-v5", 1).max_episode_steps == 1000
    assert backend("Reacher-v4", 1).max_episode_steps == 50
    env = backend("Reacher-v4", 1, seed=0, max_episode_steps=-1)
    assert env.rollout(60).shape == (1, 60)


def test_rows_that_a_step_leaves_out_do_not_move(backend):
    env = backend("InvertedPendulum-v5", 3, seed=0)
    root = env.reset().set("action", torch.ones(3, 1))
    for mask in ([True, False, True], [False, False, False]):
        stepped = env.step(root.clone().set("_step", torch.tensor(mask)))
        same = (stepped["next", "observation"] == root["observation"]).all(-1)
        assert same.tolist() == [not moved for moved in mask]
        assert stepped["next", "reward"].flatten().tolist() == [float(moved) for moved in mask]
        root = stepped["next"].exclude("reward").set("action", torch.ones(3, 1))


def test_a_step_never_writes_into_what_an_earlier_one_returned(backend):
    env = backend("Hopper-v5", 2, seed=0, dtype=torch.float64)
    root = env.reset().set("action", torch.zeros(2, 3))
    first = env.step(root.clone())["next"]
    kept = first.clone()
    for _ in range(5):
        env.step(root.clone())
    env.reset()
    assert (first == kept).all()


def test_it_works_as_a_worker_of_a_serial_environment(backend):
    env = SerialEnv(2, lambda: backend("InvertedPendulum-v5", 3))
    check_env_specs(env)
    env.close()


COUNTS = [(name, value) for name in ("num_envs", "num_threads", "max_episode_steps")
          for value in (0, -3, 1.5, True)]  # fmt: skip


@pytest.mark.parametrize(
    ("kwargs", "use", "error", "message"),
    [
        *[({name: value}, None, ValueError, f"`{name}` must be an integer of at least 1")
          for name, value in COUNTS],
        *[({"env_id": name}, None, ValueError, r"`env_id`.*Walker2d")
          for name in ("Walker2D-v5", "Waker2d-v5", "Walker2d-v9")],
        ({"dtype": torch.float16}, None, TypeError, "`dtype`"),
        ({"seed": -1}, None, ValueError, "`seed`"),
        ({}, lambda env: env.reset(sed=1), TypeError, "'sed'"),
        ({}, lambda env: env.reset(seed=1.5), ValueError, "`seed`"),
        ({}, lambda env: env.step(env.fake_tensordict()), RuntimeError, "call reset"),
        ({}, lambda env: env.step(env.reset().set("action", torch.zeros(1, 1))), ValueError,
         r"`action` must have shape \(1, 2\)"),
    ],
)  # fmt: skip
def test_bad_input_is_refused_in_one_line(backend, kwargs, use, error, message):
    with pytest.raises(error, match=message) as caught:
        use(backend(**{"env_id": "Swimmer-v5", "num_envs": np.int64(1), **kwargs}))
    assert "\n" not in str(caught.value)


def test_closing_twice_is_an_error_unless_allowed(backend):
    env = backend("Swimmer-v5", 1)
    env.reset()
    env.close()
    env.close(raise_if_closed=False)
    with pytest.raises(RuntimeError, match="closed"):
        env.close()


@pytest.mark.gpu
def test_tensors_come_out_on_the_device_asked_for(backend):
    env = backend("Hopper-v5", 2, seed=0, device="cuda")
    check_env_specs(env)
    on_cpu = backend("Hopper-v5", 2, seed=0).reset()["observation"]
    torch.testing.assert_close(env.reset(seed=0)["observation"].cpu(), on_cpu)
