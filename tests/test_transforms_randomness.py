"""What the random transforms promise about seeds, steps, resets and states, and `seed_env`.

One seed gives one sequence, at resets as at steps; MAR and NMAR follow the functional law with the
action that led to the observation, zero at the first step of an episode; the complete observation
is that of the clean environment; a state carries the mechanism; `seed_env` reaches every generator,
in workers too, and leaves the mechanism alone.
"""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
import torch
from contracts import (
    ACTION,
    OBS,
    StaircaseEnv,
    gym_env,
    parallel_env,
    saved,
)
from tensordict import TensorDict
from torchrl.envs import (
    Compose,
    DoubleToFloat,
    GymEnv,
    SerialEnv,
    TransformedEnv,
)

from torchrl_drbpn.functional.missingness import missing_probability, sample_mask
from torchrl_drbpn.transforms import (
    ObservationMissingness,
    ObservationNoise,
    seed_env,
)

COMPLETE = "complete_observation"


def staircase(*transforms, **kwargs):
    return TransformedEnv(StaircaseEnv(**kwargs), Compose(*transforms))


def data(value=1.0, batch=(4,), **more):
    return TensorDict({"observation": torch.full((*batch, OBS), value), **more}, batch)


# -------------------------------------------------------------------------- seeds, steps and resets
def masks_of(env, steps=8):
    return env.rollout(steps, break_when_any_done=False)["observed"]


def test_one_seed_is_one_sequence_of_masks():
    def of(seed):
        return masks_of(staircase(ObservationMissingness("mcar", 0.5, seed=seed)))

    assert torch.equal(of(3), of(3))
    assert not torch.equal(of(3), of(4))
    assert not torch.equal(of(3)[:, 0], of(3)[:, 1])


def test_set_seed_starts_the_sequence_again():
    env = staircase(ObservationMissingness("mcar", 0.5, seed=3))
    first = masks_of(env)
    env.transform[0].set_seed(3)
    assert torch.equal(masks_of(env), first)


def test_noise_and_masks_of_one_seed_are_unrelated():
    noise, mask = ObservationNoise(1.0, seed=5), ObservationMissingness("mcar", 0.5, seed=5)
    zeros = torch.zeros(8000, OBS)
    drawn = noise._call(TensorDict({"observation": zeros}, [8000]))["observation"].double()
    arrived = mask._call(TensorDict({"observation": zeros}, [8000]))["observed"].double()
    for law in (drawn, drawn.abs()):
        correlation = torch.corrcoef(torch.stack([arrived.flatten(), law.flatten()]))[0, 1]
        assert correlation.abs() < 4 / math.sqrt(zeros.numel())


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("mechanism", ["mcar", "nmar"])
def test_data_on_a_gpu_stays_there_with_the_same_mechanism(mechanism):
    root = TensorDict({"action": torch.zeros(4, ACTION)}, [4])
    here, there = (ObservationMissingness(mechanism, 0.5) for _ in range(2))
    here._step(root, data())
    first = there._step(root.to("cuda"), data().to("cuda"))
    assert first["observation"].is_cuda
    assert first["observed"].is_cuda
    assert torch.equal(first["observation"] == 1, first["observed"])
    if mechanism != "mcar":
        assert all(map(torch.equal, here.mechanism_parameters, there.mechanism_parameters))


@pytest.mark.parametrize("mechanism", ["mcar", "mar", "nmar"])
def test_the_first_observation_of_an_episode_is_corrupted_too(mechanism):
    env = staircase(ObservationMissingness(mechanism, 0.9), batch=50)
    observed = env.reset()["observed"]
    assert 0.2 < 1 - observed.double().mean() < 1


@pytest.mark.parametrize("mechanism", ["mar", "nmar"])
def test_masks_follow_the_law_with_the_action_that_led_there(mechanism):
    transform = ObservationMissingness(mechanism, 0.8, complete_key=COMPLETE, mechanism_seed=2)
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


def test_the_mechanism_is_the_same_for_every_seed_and_another_for_another_mechanism_seed():
    def parameters(**kwargs):
        transform = ObservationMissingness("nmar", 0.5, **kwargs)
        staircase(transform).reset()
        return transform.mechanism_parameters

    assert all(map(torch.equal, parameters(seed=1), parameters(seed=2)))
    assert not torch.equal(parameters().bias, parameters(mechanism_seed=1).bias)


def test_the_mechanism_drawn_from_data_alone_is_that_of_the_environment():
    inside, outside = (ObservationMissingness("nmar", 0.5) for _ in range(2))
    staircase(inside).reset()
    outside._reset(data(), data())
    assert outside.mechanism_parameters is None
    outside._step(TensorDict({"action": torch.zeros(4, ACTION)}, [4]), data())
    assert all(map(torch.equal, inside.mechanism_parameters, outside.mechanism_parameters))


def test_the_realised_ratio_of_mcar_in_an_environment_is_eta():
    masks = masks_of(staircase(ObservationMissingness("mcar", 0.3), batch=300), 10)
    error = math.sqrt(0.3 * 0.7 / masks.numel())
    assert abs(1 - masks.double().mean() - 0.3) < 3 * error


@pytest.mark.parametrize("mechanism", ["mcar", "mar", "nmar"])
def test_eta_zero_changes_nothing(mechanism):
    clean = staircase().rollout(8, break_when_any_done=False)
    rollout = staircase(ObservationMissingness(mechanism, 0.0)).rollout(
        8, break_when_any_done=False
    )
    assert rollout["next", "observed"].all()
    assert torch.equal(rollout["next", "observation"], clean["next", "observation"])


def test_eta_may_be_changed_between_episodes():
    env = staircase(ObservationMissingness("mcar", 0.0))
    assert env.reset()["observed"].all()
    env.transform[0].eta = 1.0
    assert not env.reset()["observed"].any()
    with pytest.raises(ValueError, match=r"`eta` must be a missing rate in \[0, 1\]"):
        env.transform[0].eta = 1.5


def test_the_complete_observation_is_that_of_the_clean_environment():
    clean = gym_env("Hopper-v5")
    noisy = TransformedEnv(
        GymEnv("Hopper-v5"),
        Compose(
            DoubleToFloat(),
            ObservationNoise(0.1, complete_key=COMPLETE),
            ObservationMissingness("nmar", 0.5),
        ),
    )
    rollouts = []
    for env in (clean, noisy):
        env.set_seed(0)
        env.action_spec.seed = None
        torch.manual_seed(0)
        rollouts.append(env.rollout(30))
    assert torch.equal(rollouts[0]["action"], rollouts[1]["action"])
    for part in ((), ("next",)):
        expected = rollouts[0][(*part, "observation")]
        assert torch.equal(rollouts[1][(*part, COMPLETE)], expected)
        arrived = rollouts[1][(*part, "observed")]
        assert 0 < arrived.double().mean() < 1
        assert not torch.equal(rollouts[1][(*part, "observation")][arrived], expected[arrived])


# -------------------------------------------------------------------------------------------- state
def test_a_state_carries_the_mechanism_and_refuses_another_environment():
    first = ObservationMissingness("nmar", 0.5, mechanism_seed=1)
    staircase(first).rollout(3)
    second = ObservationMissingness("nmar", 0.5, seed=9, mechanism_seed=1)
    second.load_state_dict(saved(first.state_dict()))
    assert all(map(torch.equal, first.mechanism_parameters, second.mechanism_parameters))
    env = TransformedEnv(StaircaseEnv(obs=7), second)
    with pytest.raises(ValueError, match=r"must have 5 components .* another environment"):
        env.reset()


def test_a_state_of_another_mechanism_seed_is_refused():
    first = ObservationMissingness("mar", 0.5, mechanism_seed=1)
    staircase(first).rollout(3)
    other = ObservationMissingness("mar", 0.5, mechanism_seed=9)
    before = other.seed
    with pytest.raises(ValueError, match="mechanism_seed 1, this transform has mechanism_seed 9"):
        other.load_state_dict(saved(first.state_dict()))
    assert other.seed == before
    assert other.mechanism_parameters is None or not torch.equal(
        other.mechanism_parameters.bias, first.mechanism_parameters.bias
    )


def test_a_state_of_another_mechanism_leaves_the_mechanism_alone():
    first = ObservationMissingness("mar", 0.5)
    staircase(first).rollout(3)
    for other in ("mcar", "nmar"):
        second = ObservationMissingness(other, 0.5)
        second.load_state_dict(saved(first.state_dict()))
        assert second.mechanism_parameters is None


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


# ----------------------------------------------------------------------------------------- seed_env
def corrupted_gym():
    return gym_env("InvertedPendulum-v5").append_transform(
        Compose(
            ObservationNoise(0.1, complete_key=COMPLETE),
            ObservationMissingness("nmar", 0.9),
        )
    )


def zero_policy(tensordict):
    return tensordict.set("action", torch.zeros(*tensordict.batch_size, 1))


def corruption_of(env, seed):
    next_seed = seed_env(env, seed)
    rollout = env.rollout(6, zero_policy, break_when_any_done=False)
    noise = rollout["observation"] - rollout[COMPLETE].where(rollout["observed"], 0.0)
    return next_seed, rollout["observed"], noise, rollout


@pytest.mark.parametrize("kind", ["single", "serial", "parallel", "outside"])
def test_seed_env_reproduces_everything_and_gives_every_worker_its_own(kind):
    if kind == "single":
        env = corrupted_gym()
    elif kind == "serial":
        env = SerialEnv(2, corrupted_gym)
    elif kind == "parallel":
        env = parallel_env(2, corrupted_gym)
    else:
        env = TransformedEnv(SerialEnv(2, corrupted_gym), ObservationNoise(0.5))
    try:
        first, again, other = (corruption_of(env, seed) for seed in (3, 3, 4))
        assert isinstance(first[0], int)
        assert first[0] == again[0] != other[0]
        assert (first[3] == again[3]).all()
        assert not torch.equal(first[1], other[1])
        if kind != "single":
            assert not torch.equal(first[1][0], first[1][1])
            assert not torch.equal(first[2][0], first[2][1])
            states = env.base_env.state_dict() if kind == "outside" else env.state_dict()
            biases = {
                tuple(worker["transforms.2._extra_state"]["mechanism.bias"].tolist())
                for worker in states.values()
            }
            assert len(biases) == 1
    finally:
        env.close(raise_if_closed=False)


def test_seed_env_reaches_the_same_generators_in_serial_and_parallel_environments():
    serial, parallel = SerialEnv(2, corrupted_gym), parallel_env(2, corrupted_gym)
    try:
        seed_env(serial, 5)
        seed_env(parallel, 5)
        seeds = [
            [
                int(state[f"worker{worker}"][f"transforms.{place}._extra_state"]["seed"])
                for worker in range(2)
                for place in (1, 2)
            ]
            for state in (serial.state_dict(), parallel.state_dict())
        ]
        assert seeds[0] == seeds[1]
        assert len(set(seeds[0])) == 4
    finally:
        serial.close()
        parallel.close()


def test_seed_env_reaches_through_environments_that_are_wrapped_twice():
    inner = staircase(ObservationNoise(0.1))
    env = TransformedEnv(inner, ObservationMissingness("mcar", 0.5), auto_unwrap=False)
    seed_env(env, 3)
    assert env.transform.seed != 0
    assert inner.transform[0].seed != 0
    assert env.transform.seed != inner.transform[0].seed


@pytest.mark.parametrize(("seed", "error"), [(-1, ValueError), (1.5, TypeError), (True, TypeError)])
def test_a_seed_is_an_integer_and_not_negative(seed, error):
    with pytest.raises(error, match="`seed` must"):
        seed_env(staircase(), seed)
    with pytest.raises(error, match="`seed` must"):
        ObservationNoise(0.1, seed=seed)
    with pytest.raises(error, match="`mechanism_seed` must"):
        ObservationMissingness("mar", 0.1, mechanism_seed=seed)


def test_numbers_of_numpy_are_numbers():
    missing = ObservationMissingness("mcar", np.float32(0.5), seed=np.int64(3))
    assert (missing.eta, missing.seed) == (0.5, 3)
    assert seed_env(staircase(missing), np.int64(4)) is not None
