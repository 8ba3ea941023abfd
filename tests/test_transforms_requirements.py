"""What every transform must do, each requirement once for all of them."""

import copy
import math
import pickle
from functools import partial

import pytest
import torch
from suites import ACTION, OBS, AgentsEnv, StaircaseEnv, gym_env, parallel_env, saved
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, SerialEnv, TransformedEnv
from torchrl.envs.utils import check_env_specs
from transform_cases import CASES, COMPLETE

every = pytest.mark.parametrize("case", CASES.values(), ids=CASES)
OBSERVING = {name: case for name, case in CASES.items() if name != "previous_action"}
of_observations = pytest.mark.parametrize("case", OBSERVING.values(), ids=OBSERVING)
CARRYING = {name: case for name, case in CASES.items() if hasattr(case.make(), "state_keys")}


def assert_same(first, second):
    assert set(first.keys(True, True)) == set(second.keys(True, True))
    for key in first.keys(True, True):
        torch.testing.assert_close(first[key], second[key], rtol=0, atol=0, equal_nan=True)


def simulator():
    return gym_env("InvertedPendulum-v5")


def corrupted_simulator(case):
    env = simulator()
    for make in (*case.needs, case.make):
        env = env.append_transform(make())
    return env


@every
@pytest.mark.parametrize("batched", [False, True])
def test_specs_are_met_in_one_environment(case, batched):
    env = case.env(StaircaseEnv()) if batched else corrupted_simulator(case)
    check_env_specs(env, break_when_any_done="both")
    reset = env.reset()
    stepped = env.rand_step(reset)["next"]
    for data in (reset, stepped):
        case.check(TensorDict(), data)
        assert env.full_observation_spec.is_in(
            data.select(*env.full_observation_spec.keys(True, True))
        )


@every
@pytest.mark.parametrize("where", ["inside", "outside"])
@pytest.mark.parametrize(
    "workers",
    [SerialEnv, pytest.param(parallel_env, marks=pytest.mark.slow)],
    ids=["serial", "parallel"],
)
def test_specs_are_met_in_workers_and_outside_of_them(case, workers, where):
    if where == "inside":
        env = workers(2, partial(corrupted_simulator, case))
    else:
        env = case.env(workers(2, simulator))
    try:
        check_env_specs(env)
    finally:
        env.close(raise_if_closed=False)


@every
@pytest.mark.parametrize("batch", [(), (3,), (2, 3), (4096,)], ids=str)
def test_any_number_of_rows_is_treated_at_once(case, batch):
    data = case.data(batch)
    if "previous_action" not in case.keys:
        first = case.make()._reset(data.empty(), data.clone())
        assert first.batch_size == data.batch_size
        case.check(data, first)
    after = case.make()._step(case.root(batch), data.clone())
    assert after.batch_size == data.batch_size
    case.check(data, after)
    composed = Compose(Compose(case.make()))._step(case.root(batch), data.clone())
    assert_same(after, composed)


@every
def test_the_state_of_the_next_step_needs_no_number_of_this_one(case):
    # the meta device has shapes and dtypes, and raises where a value is asked for
    data, root = (part.to("meta") for part in (case.data((3,)), case.root((3,))))
    expected = case.make()._step(case.root((3,)), case.data((3,)))
    after = case.make()._step(root, data)
    for key, value in expected.items(True, True):
        assert after[key].device.type == "meta"
        assert (after[key].shape, after[key].dtype) == (value.shape, value.dtype)


@every
def test_a_replay_buffer_is_served_or_refused_with_nothing_left_in_it(case):
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(6), batch_size=4)
    transform, data = case.make(), case.data((6,)).set("action", torch.zeros(6, ACTION))
    buffer.append_transform(transform)
    keys, name = set(data.keys()), type(transform).__name__
    if case.offline:
        buffer.extend(data)
        sample = buffer.sample()
        case.check(data[sample["index"]], sample)
        return
    for use in (buffer.extend, lambda data: buffer.add(data[0])):
        with pytest.raises(NotImplementedError, match=f"`{name}` .* replay buffer"):
            use(data)
    assert len(buffer) == 0
    assert set(data.keys()) == keys


@every
def test_in_front_of_a_model_it_works_or_is_refused(case):
    module = TensorDictModule(nn.Linear(OBS, 1), ["observation"], ["value"])
    data, transform = case.data((3,)), case.make()
    if not case.offline:
        with pytest.raises(NotImplementedError, match=f"`{type(transform).__name__}`"):
            nn.Sequential(transform, module)(data)
        return
    after = nn.Sequential(transform, module)(data.clone())
    case.check(data, after)
    assert_same(transform.inv(data), data)


@pytest.mark.parametrize("name", ["reduction", "nan"])
def test_keys_under_next_are_a_vector_of_their_own(name):
    case = CASES[name]
    more = {} if name == "nan" else {"complete_key": [COMPLETE, ("next", COMPLETE)]}
    transform = case.make(in_keys=["observation", ("next", "observation")], **more)
    data = case.data((4,)).set("next", case.data((4,)))
    after = transform(data.clone())
    case.check(data, after)
    case.check(data["next"], after["next"])


@every
def test_float64_is_kept(case):
    after = case.make()._step(case.root((3,), torch.float64), case.data((3,), torch.float64))
    for key in case.keys:
        assert after[key].dtype == torch.float64


@every
@pytest.mark.parametrize("batch", [3, 4096])
def test_a_partial_reset_leaves_the_other_rows_alone(case, batch):
    env = case.env(StaircaseEnv(batch=batch, dtype=torch.float64))
    root = env.rand_step(env.reset())["next"].exclude("reward")
    rows = torch.arange(batch) % 2 == 0
    after = env.reset(root.clone().set("_reset", rows[:, None]))
    for key in env.full_observation_spec.keys(True, True):
        assert torch.equal(after[key][~rows], root[key][~rows]), key
    case.check(TensorDict(), after)


@every
def test_rollouts_pass_over_the_ends_of_episodes(case):
    env = case.env(StaircaseEnv())
    data = env.rollout(12, break_when_any_done=False)
    assert data["next", "done"].any()
    # what the policy reads at t + 1 is what arrived at t, except where an episode began
    going_on = ~data["next", "done"][:, :-1, 0]
    for key in env.full_observation_spec.keys(True, True):
        assert torch.equal(data[key][:, 1:][going_on], data["next", key][:, :-1][going_on]), key


@every
def test_a_saved_state_goes_on_as_if_never_stopped(case):
    data, root = case.data((3,)), case.root((3,))
    first, second = case.make(), case.make()
    first._step(root, data.clone())
    second.load_state_dict(saved(first.state_dict()))
    assert_same(first._step(root, data.clone()), second._step(root, data.clone()))


@every
@pytest.mark.parametrize(
    "duplicate",
    [lambda t: t.clone(), copy.deepcopy, lambda t: pickle.loads(pickle.dumps(t))],
    ids=["clone", "deepcopy", "pickle"],
)
def test_a_copy_goes_its_own_way_from_the_same_state(case, duplicate):
    data, root = case.data((3,)), case.root((3,))
    first = case.make()
    first._step(root, data.clone())
    second = duplicate(first)
    assert second.container is None
    # stepping the copy first must not advance the original
    received = second._step(root, data.clone())
    assert_same(received, first._step(root, data.clone()))


@every
def test_with_a_seed_the_global_generator_is_neither_read_nor_advanced(case):
    data, root, results = case.data((3,)), case.root((3,)), []
    for seed in (1, 2):
        torch.manual_seed(seed)
        state = torch.get_rng_state()
        results.append(case.make()._step(root, data.clone()))
        assert torch.equal(torch.get_rng_state(), state)
    assert_same(*results)


@of_observations
def test_a_mask_that_is_there_is_anded(case):
    data, root = case.data((4,)), case.root((4,))
    hidden = torch.zeros(4, OBS, dtype=torch.bool)
    hidden[:, 2] = True
    expected = case.make()._step(root, data.clone())
    seen = expected.get("observed", ~hidden)
    data["observed"] = data.get("observed", ~hidden) & ~hidden
    data["observation"] = data["observation"].where(~hidden, 0.0)
    after = case.make()._step(root, data)
    assert torch.equal(after["observed"], seen & ~hidden)
    keep = after["observed"]
    assert torch.equal(after["observation"][keep], expected["observation"][keep])


@of_observations
def test_an_absent_observation_is_named(case):
    transform = case.make()
    with pytest.raises(KeyError, match=rf"`{type(transform).__name__}` reads 'observation', which"):
        transform._step(case.root((3,)), TensorDict({}, [3]))
    env = TransformedEnv(StaircaseEnv(), case.make(in_keys="state"))
    with pytest.raises(KeyError, match=r"reads 'state', which is not among .*'observation'"):
        env.reset()


@of_observations
@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("observation", torch.Tensor.long, "`observation` must be a vector of floating"),
        ("observation", torch.Tensor.bool, "`observation` must be a vector of floating"),
        ("observed", lambda x: x[..., :1] > 0, r"`observed` must be bool of .* \(4, 5\)"),
        ("observed", torch.ones_like, r"`observed` must be bool of .* \(4, 5\)"),
    ],
    ids=["integer", "bool", "mask of another shape", "mask of numbers"],
)  # fmt: skip
def test_entries_of_wrong_dtype_or_shape_are_refused(case, key, change, message):
    data = case.data((4,))
    data[key] = change(data["observation"])
    with pytest.raises(ValueError, match=message):
        case.make()._step(case.root((4,)), data)


@of_observations
def test_what_lies_under_a_false_mask_is_never_read(case):
    results = []
    for junk in (0.0, math.nan, math.inf, 1e30):
        data = case.data((4,))
        hidden = torch.zeros(4, OBS, dtype=torch.bool)
        hidden[:, 2] = True
        data["observed"] = ~hidden
        data["observation"][:, 2] = junk
        root = case.root((4,))
        results.append(case.make()._step(root, data).exclude(COMPLETE))
        assert not results[-1]["observed"][:, 2].any()
        assert results[-1]["observation"].isfinite().all()
        assert_same(results[0], results[-1])


@pytest.mark.parametrize("case", CARRYING.values(), ids=CARRYING)
def test_what_it_carries_stands_with_the_agents_whose_sensors_they_are(case):
    env = case.env(AgentsEnv(), in_keys=[("agents", "observation")])
    check_env_specs(env)
    assert env.rollout(2)["agents"].batch_size == (3, 2, 2)


@every
def test_keys_must_come_in_pairs(case):
    if "previous_action" in case.keys:
        with pytest.raises(ValueError, match="`out_keys` must name one key of its own"):
            case.make("action", ["a", "b"])
        return
    with pytest.raises(ValueError, match="`mask_keys` must name one key of its own for each"):
        case.make(in_keys=["a", "b"])
    with pytest.raises(TypeError, match="a key must be a string"):
        case.make(in_keys=[3])
    nested = case.make(in_keys=[["agents", "observation"]])  # as configurations write it
    assert nested.in_keys == [("agents", "observation")]
    assert nested.mask_keys == [("agents", "observed")]
