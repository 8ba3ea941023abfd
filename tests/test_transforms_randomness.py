"""What the random transforms promise about seeds, steps, resets and states, and `seed_env`."""

import contextlib
import copy
import math
from functools import partial

import numpy as np
import pytest
import torch
from suites import ACTION, OBS, gym_env, saved, staircase
from suites import vectors as data
from tensordict import TensorDict
from torchrl.envs import Compose, ParallelEnv, SerialEnv, TransformedEnv
from transform_cases import CASES, COMPLETE

from torchrl_drbpn.functional.missingness import missing_probability, sample_mask
from torchrl_drbpn.transforms import (
    ObservationDelay,
    ObservationMissingness,
    ObservationMultiRate,
    ObservationNoise,
    ObservationSpikes,
    SensorDrift,
    SensorOutages,
    StuckSensors,
    seed_env,
)

RANDOM = ["nmar", "noise", "spikes", "outages", "delay", "multi_rate"]


def corrupted_gym(**kwargs):
    noise = ObservationNoise(0.1, complete_key=COMPLETE)
    chain = Compose(noise, ObservationMissingness("mcar", 0.5), SensorOutages(0.3, 3, **kwargs))
    return gym_env().append_transform(chain)


def zero_policy(tensordict):
    return tensordict.set("action", torch.zeros(*tensordict.batch_size, 1))


WORKERS = ["serial", *(pytest.param(k, marks=pytest.mark.slow) for k in ("fork", "spawn"))]


@contextlib.contextmanager
def batched(kind, **kwargs):
    """Two corrupted environments, in this process or in two others."""
    if kind == "serial":
        env = SerialEnv(2, corrupted_gym)
    else:
        env = ParallelEnv(2, corrupted_gym, mp_start_method=kind, **kwargs)
    try:
        yield env
    finally:
        env.close(raise_if_closed=False)


def drawn(env, seed=None):
    """Roll out after `torch.manual_seed` and `env.set_seed`; noise where observed, and masks."""
    if seed is not None:
        torch.manual_seed(seed)
        env.set_seed(seed)
    rollout = env.rollout(12, zero_policy, break_when_any_done=False)
    noise = rollout["observation"] - rollout[COMPLETE].where(rollout["observed"], 0.0)
    return torch.cat([noise, rollout["observed"], rollout["sensor_on"]], -1)


@pytest.mark.parametrize("kind", WORKERS)
def test_without_a_seed_the_global_seeds_make_a_run_and_workers_differ(kind):
    with batched(kind) as env:
        unseeded, *runs = drawn(env), drawn(env, 3), drawn(env, 3), drawn(env, 4)
    with batched(kind) as env:
        runs.append(drawn(env, 3))
    assert torch.equal(runs[0], runs[1])
    assert torch.equal(runs[0], runs[3])
    assert not torch.equal(runs[0], runs[2])
    assert not torch.equal(runs[0][0], runs[0][1])
    assert not torch.equal(unseeded[0], unseeded[1])


@pytest.mark.slow
def test_forked_workers_that_set_seed_does_not_reach_differ_too():
    # without shared buffers TorchRL's workers leave torch's global generator alone
    with batched("fork", use_buffers=False) as env:
        run = drawn(env, 3)
    assert not torch.equal(run[0], run[1])


@pytest.mark.parametrize(
    "make",
    [*(partial(CASES[name].make, seed=None) for name in RANDOM), partial(SensorDrift, 0.1)],
    ids=[*RANDOM, "drift"],
)
def test_without_a_seed_two_transforms_differ_and_the_global_seed_repeats_them(make):
    def draw(transform, seed=None):
        if seed is not None:
            torch.manual_seed(seed)
        return transform._call(data(batch=(50,)))["observation"]

    first, second = make(), make()
    assert not torch.equal(draw(first), draw(second))
    assert torch.equal(draw(first, 3), draw(second, 3))
    first.set_seed(5)
    state = saved(first.state_dict())
    second.load_state_dict(state)
    assert torch.equal(draw(first, 3), draw(second, 4))  # they have generators of their own now
    second.load_state_dict(saved(make().state_dict()))
    assert second.seed is None


def lose(x, g):
    return x.where(torch.rand(x.shape, generator=g) >= 0.3, 0.0)


@pytest.mark.parametrize(
    ("make", "stream", "draw"),
    [
        (partial(ObservationNoise, 2.0), 1, lambda x, g: x + 2 * torch.randn(x.shape, generator=g)),
        (partial(ObservationMissingness, "mcar", 0.3), 2, lose),
        (partial(SensorOutages, 0.3, 5), 3, lose),
    ],
    ids=["noise", "mcar", "outages"],
)
def test_a_seed_always_stands_for_the_same_numbers(make, stream, draw):
    # neighbouring seeds are spread by the golden ratio, classes by another odd number
    mixed = 7 * 0x9E3779B97F4A7C15 + stream * 0xD1B54A32D192ED03
    generator = torch.Generator().manual_seed(mixed % 2**63)
    transform = make(seed=7)
    for _ in range(2):
        received = transform._reset(TensorDict(), data())["observation"]
        assert torch.equal(received, draw(data()["observation"], generator))


def test_classes_with_the_same_seed_are_unrelated():
    kinds = [ObservationNoise, ObservationMissingness, SensorOutages, ObservationSpikes]
    kinds += [ObservationDelay, ObservationMultiRate, StuckSensors, SensorDrift]
    assert len({kind.stream for kind in kinds}) == len(kinds)
    ones = data(batch=(8000,))
    noise = ObservationNoise(1.0, seed=5)._call(ones.clone())["observation"].double() - 1
    masks = [
        make(seed=5)._call(ones.clone())["observed"].double()
        for make in (partial(ObservationMissingness, "mcar", 0.5), partial(SensorOutages, 0.5, 2))
    ]
    drawn = torch.stack([part.flatten() for part in (noise, noise.abs(), *masks)])
    assert (torch.corrcoef(drawn) - torch.eye(4)).abs().max() < 4 / math.sqrt(8000 * OBS)


@pytest.mark.gpu
@pytest.mark.parametrize("seed", [None, 0])
@pytest.mark.parametrize("mechanism", ["mcar", "nmar"])
def test_data_on_a_gpu_stays_there_with_the_same_mechanism(mechanism, seed):
    root = TensorDict({"action": torch.zeros(4, ACTION)}, [4])
    here, there = (ObservationMissingness(mechanism, 0.5, seed=seed) for _ in range(2))
    here._step(root, data())
    first = there._step(root.to("cuda"), data().to("cuda"))
    assert first["observation"].is_cuda
    assert first["observed"].is_cuda
    assert torch.equal(first["observation"] == 1, first["observed"])
    if mechanism != "mcar":
        on_gpu = [part.cpu() for part in there.mechanism_parameters]
        assert all(map(torch.equal, here.mechanism_parameters, on_gpu))


@pytest.mark.parametrize("mechanism", ["mar", "nmar"])
def test_masks_follow_the_law_with_the_action_that_led_there(mechanism):
    transform = ObservationMissingness(
        mechanism, 0.8, seed=0, complete_key=COMPLETE, mechanism_seed=2
    )
    env = staircase(transform, dtype=torch.float64)
    generator = copy.copy(transform.generator(torch.device("cpu")))
    rollout = env.rollout(9, break_when_any_done=False)
    assert rollout["next", "done"].any(1).all()
    parameters = transform.mechanism_parameters

    def draw(complete, action):
        probability = missing_probability(parameters, complete, action, 0.8)
        return sample_mask(probability, complete, generator)

    assert torch.equal(rollout["observed"][:, 0], draw(rollout[COMPLETE][:, 0], None))
    for t in range(9):
        step = rollout[:, t]
        arrived = draw(step["next", COMPLETE], step["action"])
        assert torch.equal(step["next", "observed"], arrived)
        over = step["next", "done"][:, 0]
        if t < 8 and over.any():
            # rows that begin an episode are drawn anew without an action, the others are kept
            follow = rollout[:, t + 1]
            complete = torch.where(over[:, None], follow[COMPLETE], step["next", COMPLETE])
            arrived = torch.where(over[:, None], draw(complete, None), arrived)
            assert torch.equal(follow["observed"], arrived)


def test_the_mechanism_is_that_of_its_own_seed_alone():
    def parameters(**kwargs):
        transform = ObservationMissingness("nmar", 0.5, **kwargs)
        env = staircase(transform)
        seed_env(env, 7)
        env.rollout(1)
        return transform.mechanism_parameters

    assert all(map(torch.equal, parameters(seed=1), parameters(seed=2)))
    assert not torch.equal(parameters().bias, parameters(mechanism_seed=1).bias)


def test_a_state_of_another_kind_of_device_starts_again_with_a_warning():
    first = ObservationMissingness("mcar", 0.5, seed=3)
    expected = first._call(data())["observed"]
    state = first.state_dict()
    state["_extra_state"]["generator"] = torch.zeros(16, dtype=torch.uint8)
    second = ObservationMissingness("mcar", 0.5)
    second.load_state_dict(state)
    with pytest.warns(UserWarning, match="saved on another kind of device"):
        received = second._call(data())["observed"]
    assert torch.equal(received, expected)


@pytest.mark.parametrize("kind", ["single", "outside", "twice", *WORKERS])
def test_seed_env_reproduces_everything_and_gives_every_worker_its_own(kind):
    def run(env, seed):
        torch.seed()  # nothing depends on the global generator
        return seed_env(env, seed), drawn(env)

    with contextlib.ExitStack() as stack:
        if kind == "single":
            env = corrupted_gym()
        elif kind == "twice":
            env = TransformedEnv(corrupted_gym(), ObservationNoise(0.5), auto_unwrap=False)
        elif kind == "outside":
            env = stack.enter_context(batched("serial"))
            env = TransformedEnv(env, ObservationNoise(0.5))
        else:
            env = stack.enter_context(batched(kind))
        first, again, other = run(env, 3), run(env, 3), run(env, 4)
    assert isinstance(first[0], int)
    assert first[0] == again[0] != other[0]
    assert torch.equal(first[1], again[1])
    assert not torch.equal(first[1], other[1])
    if kind not in ("single", "twice"):
        assert not torch.equal(first[1][0], first[1][1])
    if kind == "fork":
        with batched("serial") as env:
            assert torch.equal(run(env, 3)[1], first[1])


@pytest.mark.parametrize(("seed", "error"), [(-1, ValueError), (1.5, TypeError), (True, TypeError)])
def test_a_seed_is_an_integer_and_not_negative(seed, error):
    with pytest.raises(error, match="`seed` must"):
        seed_env(staircase(), seed)
    with pytest.raises(error, match="`seed` must"):
        ObservationNoise(0.1, seed=seed)
    with pytest.raises(error, match="`mechanism_seed` must"):
        ObservationMissingness("mar", 0.1, mechanism_seed=seed)
    assert ObservationMissingness("mcar", np.float32(0.5), seed=np.int64(3)).seed == 3
