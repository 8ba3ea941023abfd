"""What ObservationMissingness, ObservationNoise, SensorReduction, ObservedFromNaN promise; seed_env.

Each goes through `contracts.TransformContract`. On top: what is missing is 0 and False in the mask;
one seed gives one sequence, at resets as at steps; MAR and NMAR follow the functional law with the
action that led to the observation, zero at the first step of an episode; the complete observation
is that of the clean environment; the order of a chain is checked however it was put together;
`seed_env` reaches every generator, in workers too, and leaves the mechanism alone.
"""

from __future__ import annotations

import copy
import math
from functools import partial

import pytest
import torch
from contracts import (
    ACTION,
    OBS,
    StaircaseEnv,
    TransformContract,
    gym_env,
    parallel_env,
    saved,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Binary, LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.envs import (
    CatTensors,
    Compose,
    DoubleToFloat,
    GymEnv,
    ObservationTransform,
    RewardSum,
    SerialEnv,
    Transform,
    TransformedEnv,
)
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss

from torchrl_drbpn.functional.corruption import missing_probability, sample_observed
from torchrl_drbpn.transforms import (
    FillLastObserved,
    MaskedObservationNorm,
    ObservationMissingness,
    ObservationNoise,
    ObservedFromNaN,
    SensorReduction,
    seed_env,
)

COMPLETE = "complete_observation"


def staircase(*transforms, **kwargs):
    return TransformedEnv(StaircaseEnv(**kwargs), Compose(*transforms))


def data(value=1.0, batch=(4,), **more):
    return TensorDict({"observation": torch.full((*batch, OBS), value), **more}, batch)


# ----------------------------------------------------------------------------------- the contracts
class MaskContract(TransformContract):
    def check_output(self, before, after):
        observation, observed = after["observation"], after["observed"]
        assert observed.dtype == torch.bool
        assert observed.shape == observation.shape
        assert (observation[~observed] == 0).all()
        assert torch.isfinite(observation).all()
        if before.get("observation", None) is not None:
            assert torch.equal(observation[observed], before["observation"][observed])


class TestMcar(MaskContract):
    def make_transform(self):
        return ObservationMissingness("mcar", 0.5)


class TestNmar(MaskContract):
    keeps_float64 = ("observation", COMPLETE)

    def make_transform(self):
        return ObservationMissingness("nmar", 0.9, complete_key=COMPLETE)


class TestMar(MaskContract):
    def make_transform(self):
        return ObservationMissingness("mar", 0.9)


class TestSensorReduction(MaskContract):
    offline = "works"

    def make_transform(self):
        return SensorReduction([0, -1])

    def check_output(self, before, after):
        super().check_output(before, after)
        assert not after["observed"][..., [0, -1]].any()
        assert after["observed"][..., 1:-1].all()


class TestObservedFromNaN(MaskContract):
    offline = "works"

    def make_transform(self):
        return ObservedFromNaN()

    def make_data(self, batch, dtype=torch.float32):
        made = super().make_data(batch, dtype)
        made["observation"][..., 1] = math.nan
        return made

    def check_output(self, before, after):
        super().check_output(before, after)
        if before.get("observation", None) is not None:
            assert torch.equal(after["observed"], ~before["observation"].isnan())

    # the data holds NaN, which differs from itself
    def test_transform_inverse(self):
        made = self.make_data((3,))
        after = self.make_transform().inv(made.clone())
        assert torch.equal(after["observation"].isnan(), made["observation"].isnan())


class TestNoise(TransformContract):
    keeps_float64 = ("observation", COMPLETE)

    def make_transform(self):
        return ObservationNoise(0.1, complete_key=COMPLETE)

    def check_output(self, before, after):
        noise = after["observation"] - after[COMPLETE]
        assert after.get("observed", None) is None
        assert (noise != 0).all()
        assert (noise.abs() < 1).all()
        if before.get("observation", None) is not None:
            assert torch.equal(after[COMPLETE], before["observation"])


# ---------------------------------------------------------------------------------- keys and specs
def test_specs_say_what_is_written():
    env = staircase(
        ObservationNoise(0.1, complete_key=COMPLETE), ObservationMissingness("mcar", 0.5)
    )
    bounded = StaircaseEnv().observation_spec["observation"]
    spec = env.observation_spec
    assert isinstance(spec["observation"], Unbounded)
    assert isinstance(spec["observed"], Binary)
    assert spec["observed"].dtype == torch.bool
    assert spec["observed"].shape == spec["observation"].shape == bounded.shape
    assert spec[COMPLETE] == bounded


class SplitObservation(Transform):
    """Cut `observation` into keys."""

    def __init__(self, keys, sizes):
        super().__init__(in_keys=["observation"], out_keys=keys)
        self.sizes = sizes

    def _call(self, tensordict):
        parts = tensordict["observation"].split(self.sizes, -1)
        for key, part in zip(self.out_keys, parts, strict=True):
            tensordict.set(key, part)
        return tensordict

    def _reset(self, tensordict, tensordict_reset):
        del tensordict
        return self._call(tensordict_reset)

    def transform_observation_spec(self, spec):
        spec = spec.clone()
        leaf = spec["observation"]
        for key, size in zip(self.out_keys, self.sizes, strict=True):
            spec[key] = Unbounded(shape=(*leaf.shape[:-1], size), dtype=leaf.dtype)
        return spec


@pytest.mark.parametrize("mechanism", ["mcar", "mar", "nmar"])
def test_several_keys_are_one_vector_cut_into_pieces(mechanism):
    whole = staircase(ObservationMissingness(mechanism, 0.6))
    keys, masks = ["position", "velocity"], ["position_seen", "velocity_seen"]
    pieces = staircase(
        SplitObservation(keys, [2, 3]),
        ObservationMissingness(mechanism, 0.6, in_keys=keys, mask_keys=masks),
        CatTensors(keys, "observation", dim=-1, del_keys=False),
    )
    torch.manual_seed(0)
    expected = whole.rollout(8, break_when_any_done=False)
    torch.manual_seed(0)
    received = pieces.rollout(8, break_when_any_done=False)
    seen = torch.cat([received["next", key] for key in masks], -1)
    assert torch.equal(seen, expected["next", "observed"])
    assert torch.equal(received["next", "observation"], expected["next", "observation"])


def test_noise_per_component_spans_several_keys():
    both = TensorDict({"a": torch.zeros(4, 2), "b": torch.zeros(4, 3)}, [4])
    noise = ObservationNoise(
        [0, 0, 0, 1, 0], in_keys=["a", "b"], mask_keys=["ma", "mb"], complete_key=["ca", "cb"]
    )
    after = noise._call(both)
    assert (after["a"] == 0).all()
    assert ((after["b"] != 0) == torch.tensor([False, True, False])).all()
    assert (after["ca"] == 0).all()
    assert (after["cb"] == 0).all()
    assert after.get("ma", None) is None


def test_a_nested_observation_has_its_mask_beside_it():
    inner = TensorDict({"observation": torch.ones(2, 3, OBS)}, [2, 3])
    outer = TensorDict({"agents": inner}, [2])
    after = ObservationMissingness("mcar", 1.0, in_keys=[("agents", "observation")])._call(outer)
    assert not after["agents", "observed"].any()
    assert after.get("observed", None) is None


def test_two_observations_need_two_masks():
    with pytest.raises(ValueError, match="`mask_keys` must name one key of its own for each"):
        ObservationMissingness("mcar", 0.5, in_keys=["a", "b"])
    with pytest.raises(ValueError, match="`complete_key` must name one key of its own"):
        ObservationNoise(0.1, in_keys=["a", "b"], mask_keys=["ma", "mb"], complete_key="c")
    with pytest.raises(TypeError, match="a key must be a string"):
        ObservationMissingness("mcar", 0.5, in_keys=[3])


def test_an_observation_that_the_environment_lacks_is_named():
    env = TransformedEnv(StaircaseEnv(), ObservationMissingness("mcar", 0.5, in_keys="state"))
    with pytest.raises(KeyError, match=r"reads 'state', which is not among .*'observation'"):
        env.reset()


class Reshape(ObservationTransform):
    """Give the observation another shape or dtype."""

    def __init__(self, change):
        super().__init__(in_keys=["observation"], out_keys=["observation"])
        self.change = change

    def transform_observation_spec(self, spec):
        spec["observation"] = self.change(spec["observation"])
        return spec


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda leaf: Unbounded(shape=leaf.shape[:1], dtype=leaf.dtype), "scalar"),
        (lambda leaf: Unbounded(shape=(*leaf.shape[:1], 3, 8, 8), dtype=leaf.dtype), "image"),
        (lambda leaf: Unbounded(shape=leaf.shape, dtype=torch.int64), "integer"),
    ],
    ids=lambda part: part if isinstance(part, str) else "",
)
def test_an_observation_that_is_no_vector_of_floats_is_refused(change, what):
    del what
    for transform in (ObservationMissingness("mcar", 0.5), ObservationNoise(0.1)):
        env = staircase(Reshape(change), transform)
        with pytest.raises(ValueError, match="`observation` must be a vector of floating point"):
            _ = env.observation_spec


# ------------------------------------------------------------------------ seeds, steps and resets
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
        return sample_observed(probability, complete, generator)

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


# --------------------------------------------------------------------------- masks that exist already
def existing_mask():
    mask = torch.ones(4, OBS, dtype=torch.bool)
    mask[:, 2] = False
    return mask


@pytest.mark.parametrize(
    "transform",
    [
        ObservationMissingness("mcar", 0.3),
        ObservationMissingness("nmar", 0.3),
        SensorReduction([0]),
        ObservedFromNaN(),
    ],
    ids=["mcar", "nmar", "reduction", "nan"],
)
def test_a_mask_that_is_there_is_anded_and_garbage_beneath_it_is_harmless(transform):
    transform = transform.clone()
    root = TensorDict({"action": torch.zeros(4, ACTION)}, [4])
    before = data(1.0, observed=existing_mask())
    before["observation"][:, 2] = math.nan
    after = transform._step(root, before)
    assert not after["observed"][:, 2].any()
    assert after["observed"].any()
    assert torch.equal(after["observation"], after["observed"].float())


def test_noise_leaves_missing_entries_at_zero():
    after = ObservationNoise(1.0)._call(data(0.0, observed=existing_mask()))
    assert (after["observation"][:, 2] == 0).all()
    assert (after["observation"][:, [0, 1, 3, 4]] != 0).all()
    assert torch.equal(after["observed"], existing_mask())


@pytest.mark.parametrize(
    "mask", [torch.ones(4, 1, dtype=torch.bool), torch.ones(4, OBS)], ids=["shape", "dtype"]
)
def test_a_mask_of_the_wrong_shape_or_dtype_is_refused(mask):
    for transform in (ObservationMissingness("mcar", 0.5), ObservationNoise(0.1)):
        with pytest.raises(ValueError, match=r"`observed` must be bool of shape .* = \(4, 5\)"):
            transform._call(data(observed=mask))


def test_infinite_values_are_errors_and_not_gaps():
    after = ObservedFromNaN()(data(math.inf))
    assert after["observed"].all()
    assert after["observation"].isinf().all()


# --------------------------------------------------------------------------------- SensorReduction
def test_indices_and_bools_name_the_same_sensors():
    expected = SensorReduction([1, -1])(data())
    as_bool = SensorReduction([False, True, False, False, True])(data())
    as_tensor = SensorReduction(torch.tensor([1, 4]))(data())
    for after in (as_bool, as_tensor):
        assert torch.equal(after["observed"], expected["observed"])
    assert SensorReduction([])(data())["observed"].all()


def test_rows_of_a_mask_do_not_share_memory():
    after = SensorReduction([1])(data())
    after["observed"][0, 0] = False
    assert after["observed"][1, 0]


@pytest.mark.parametrize("missing", [[5], [-6], [True, False]])
def test_sensors_that_do_not_exist_are_refused(missing):
    with pytest.raises(ValueError, match="`missing` "):
        _ = staircase(SensorReduction(missing)).observation_spec
    with pytest.raises(ValueError, match="`missing` "):
        SensorReduction(missing)(data())
    with pytest.raises(ValueError, match="`missing` must be a list of indices"):
        SensorReduction([0.5])


# ------------------------------------------------------------------------------------------- order
NORM, FILL = MaskedObservationNorm, FillLastObserved
NOISE = partial(ObservationNoise, 0.1)
MISSING = partial(ObservationMissingness, "mcar", 0.5)
REDUCED = partial(SensorReduction, [0])
WRONG = [
    ([NORM, NOISE], "`MaskedObservationNorm` stands before `ObservationNoise`"),
    ([NORM, MISSING], "`MaskedObservationNorm` stands before `ObservationMissingness`"),
    ([NORM, REDUCED], "`MaskedObservationNorm` stands before `SensorReduction`"),
    ([NORM, ObservedFromNaN], "`MaskedObservationNorm` stands before `ObservedFromNaN`"),
    ([FILL, MISSING], "`FillLastObserved` stands before `ObservationMissingness`"),
    ([FILL, ObservedFromNaN], "`FillLastObserved` stands before `ObservedFromNaN`"),
    (
        [partial(NOISE, complete_key=COMPLETE), partial(MISSING, complete_key=COMPLETE)],
        "`complete_observation` is written by two transforms",
    ),
    ([NOISE, partial(MISSING, complete_key=COMPLETE)], "has corrupted the observation before it"),
]
WRONG_IDS = [f"{i}" for i in range(len(WRONG))]


def in_compose(first, second):
    return Compose(first, RewardSum(), second)


def in_nested_compose(first, second):
    return Compose(Compose(first, RewardSum()), Compose(second))


def in_environment(first, second):
    return TransformedEnv(StaircaseEnv(), Compose(first, second))


def appended(first, second):
    return TransformedEnv(StaircaseEnv(), first).append_transform(second)


def inserted(first, second):
    return staircase(RewardSum(), second).insert_transform(0, first)


def wrapped_twice(first, second):
    inner = TransformedEnv(StaircaseEnv(), first)
    return TransformedEnv(inner, second, auto_unwrap=False)


@pytest.mark.parametrize(("chain", "message"), WRONG, ids=WRONG_IDS)
@pytest.mark.parametrize(
    "put_together",
    [in_compose, in_nested_compose, in_environment, appended, inserted, wrapped_twice],
)
def test_a_wrong_order_is_refused_however_it_comes_about(chain, message, put_together):
    first, second = (make() for make in chain)
    with pytest.raises(ValueError, match=message):
        put_together(first, second)


def test_an_environment_is_left_as_it_was_by_what_it_refuses():
    env = staircase(MaskedObservationNorm())
    with pytest.raises(ValueError, match="stands before"):
        env.append_transform(MISSING())
    assert [type(part) for part in env.transform] == [MaskedObservationNorm]
    assert env.rollout(2).get("observed", None) is None
    env.insert_transform(0, MISSING())
    assert env.rollout(2).get("observed", None) is not None


def test_the_order_of_the_recipe_is_accepted_and_other_keys_do_not_matter():
    staircase(partial(NOISE, complete_key=COMPLETE)(), MISSING(), NORM())
    staircase(ObservedFromNaN(), partial(NOISE, complete_key=COMPLETE)(), MISSING(), FILL(), NORM())
    staircase(NORM(in_keys=["other"]), MISSING())


def test_a_writer_inside_the_workers_is_found_through_the_specs():
    env = TransformedEnv(SerialEnv(2, corrupted_gym), MISSING(complete_key=COMPLETE))
    with pytest.raises(ValueError, match="is among the observations of the environment already"):
        env.reset()
    env.close()


# -------------------------------------------------------------------------------------------- state
def test_a_state_carries_the_mechanism_and_refuses_another_environment():
    first = ObservationMissingness("nmar", 0.5, mechanism_seed=1)
    staircase(first).rollout(3)
    second = ObservationMissingness("nmar", 0.5, mechanism_seed=9)
    second.load_state_dict(saved(first.state_dict()))
    assert all(map(torch.equal, first.mechanism_parameters, second.mechanism_parameters))
    env = TransformedEnv(StaircaseEnv(obs=7), second)
    with pytest.raises(ValueError, match=r"must have 5 components .* another environment"):
        env.reset()


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


# ------------------------------------------------------------------------------------------ seed_env
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


# ------------------------------------------------------------------------------------------- errors
@pytest.mark.parametrize("eta", [-0.1, 1.1, math.nan, "0.5", None])
def test_a_missing_rate_lies_in_the_unit_interval(eta):
    with pytest.raises(ValueError, match=r"`eta` must be a missing rate in \[0, 1\]"):
        ObservationMissingness("mcar", eta)


def test_unknown_mechanisms_and_shares_are_refused():
    with pytest.raises(ValueError, match=r"`mechanism` must be one of .*'mcar'.* got 'random'"):
        ObservationMissingness("random", 0.5)
    with pytest.raises(ValueError, match="`always_observed` must be a share"):
        ObservationMissingness("mar", 0.5, always_observed=2)


@pytest.mark.parametrize("std", [-1.0, math.nan, math.inf, [0.1, -0.1], [[0.1]]])
def test_a_standard_deviation_is_finite_and_not_negative(std):
    with pytest.raises(ValueError, match="`noise_std` must be a number or one number"):
        ObservationNoise(std)


def test_standard_deviations_are_as_many_as_components():
    with pytest.raises(ValueError, match="`noise_std` must have one entry per component, 5"):
        _ = staircase(ObservationNoise([0.1, 0.2])).observation_spec
    with pytest.raises(ValueError, match="`noise_std` must have one entry per component, 5"):
        ObservationNoise([0.1, 0.2])._call(data())


def test_mar_needs_an_action_that_is_a_vector():
    transform = ObservationMissingness("mar", 0.5)
    with pytest.raises(KeyError, match="reads the action under 'action', which is not there"):
        transform._step(TensorDict({}, [4]), data())
    env = TransformedEnv(GymEnv("CartPole-v1", categorical_action_encoding=True), transform)
    with pytest.raises(ValueError, match="`action` must be a vector"):
        env.reset()
    env = staircase(ObservationMissingness("mar", 0.5, action_key="torque"))
    with pytest.raises(KeyError, match=r"'torque', which is not among the actions \['action'\]"):
        env.reset()


# ------------------------------------------------------------------------- in a pipeline of TorchRL
@pytest.mark.parametrize("mechanism", ["mcar", "nmar"])
def test_dqn_of_torchrl_fits_masked_cartpole_observations(mechanism):
    # no filter anywhere: one-hot actions, a replay buffer, DQNLoss with a fixed target
    env = TransformedEnv(
        GymEnv("CartPole-v1"),
        Compose(ObservationNoise(0.01), ObservationMissingness(mechanism, 0.3)),
    )
    seed_env(env, 0)
    torch.manual_seed(0)
    cat = TensorDictModule(
        lambda x, m: torch.cat([x, m.to(x.dtype)], -1), ["observation", "observed"], ["input"]
    )
    net = nn.Sequential(nn.Linear(8, 32), nn.ReLU(), nn.Linear(32, 2))
    policy = QValueActor(net, in_keys=["input"], spec=env.action_spec)
    actor = TensorDictSequential(cat, policy)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(200), batch_size=64)
    quiet = {"auto_register_policy_transforms": False}
    collector = Collector(env, actor, frames_per_batch=100, total_frames=200, **quiet)
    for batch in collector:
        assert 0 < batch["observed"].double().mean() < 1
        buffer.extend(batch.reshape(-1))
    loss_module = DQNLoss(actor, action_space=env.action_spec, delay_value=True)
    optimiser = torch.optim.Adam(loss_module.parameters(), 1e-2)
    losses = []
    sample = buffer.sample()
    for _ in range(20):
        loss = loss_module(sample)["loss"]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] / 2
    collector.shutdown()
