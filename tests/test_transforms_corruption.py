"""What the corrupting transforms promise beyond `test_transforms_requirements.py`."""

import math
from functools import partial

import pytest
import torch
from refusals import refuses
from suites import ACTION, OBS, StaircaseEnv, staircase
from suites import vectors as data
from tensordict import TensorDict
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import Compose, GymEnv, SerialEnv, Transform, TransformedEnv
from transform_cases import COMPLETE

from torchrl_drbpn.transforms import (
    FillLastObserved,
    ObservationMissingness,
    ObservationNoise,
    ObservationSpikes,
    ObservedFromNaN,
    SensorReduction,
)

MISSING = partial(ObservationMissingness, "mcar", 0.5)
MAR = partial(ObservationMissingness, "mar", 0.5)
NOISE = partial(ObservationNoise, 0.1)
SPIKES = partial(ObservationSpikes, 0.1, 5.0)


def test_specs_say_what_is_written():
    env = staircase(SPIKES(complete_key=COMPLETE), MISSING())
    bounded = StaircaseEnv().observation_spec["observation"]
    spec = env.observation_spec
    assert isinstance(spec["observation"], Unbounded)
    assert isinstance(spec["observed"], Binary)
    assert spec["observed"].dtype == torch.bool
    assert spec["observed"].shape == spec["observation"].shape == bounded.shape
    assert spec[COMPLETE] == bounded


@pytest.mark.parametrize("mechanism", ["mcar", "mar", "nmar"])
def test_several_keys_are_one_vector_cut_into_pieces(mechanism):
    make = partial(ObservationMissingness, mechanism, 0.6, seed=0)
    x = torch.randn(50, OBS, generator=torch.Generator().manual_seed(0))
    root = TensorDict({"action": torch.ones(50, ACTION)}, [50])
    expected = make()._step(root, TensorDict({"observation": x.clone()}, [50]))
    pieces = make(in_keys=["a", "b"], mask_keys=["ma", "mb"])
    after = pieces._step(root, TensorDict({"a": x[:, :2].clone(), "b": x[:, 2:].clone()}, [50]))
    assert torch.equal(torch.cat([after["ma"], after["mb"]], -1), expected["observed"])
    assert torch.equal(torch.cat([after["a"], after["b"]], -1), expected["observation"])


def test_numbers_per_component_span_several_keys():
    keys = {"in_keys": ["a", "b"], "mask_keys": ["ma", "mb"]}
    both = TensorDict({"a": torch.zeros(400, 2), "b": torch.zeros(400, 3)}, [400])
    noise = ObservationNoise([0, 0, 0, 1, 0], complete_key=["ca", "cb"], **keys)
    after = noise._call(both.clone())
    assert (after["a"] == 0).all()
    assert ((after["b"] != 0) == torch.tensor([False, True, False])).all()
    assert torch.equal(after["ca"], both["a"])
    spikes = ObservationSpikes([0, 1, 0, 1, 0], [1, 1, 1, 100, 1], **keys)
    after = spikes._call(both)
    assert ((after["a"] != 0) == torch.tensor([False, True])).all()
    assert ((after["b"] != 0) == torch.tensor([False, True, False])).all()
    assert after["b"][:, 1].std() > 50 > 5 > after["a"][:, 1].std()


def existing_mask():
    mask = torch.ones(4, OBS, dtype=torch.bool)
    mask[:, 2] = False
    return mask


@pytest.mark.parametrize(
    "transform", [ObservationNoise(1.0), ObservationSpikes(1.0, 5.0)], ids=type
)
def test_missing_entries_are_neither_changed_nor_filled(transform):
    after = transform._call(data(0.0, observed=existing_mask()))
    assert torch.equal(after["observation"] != 0, existing_mask())
    assert torch.equal(after["observed"], existing_mask())


def test_infinite_values_are_errors_and_not_gaps():
    after = ObservedFromNaN()(data(math.inf))
    assert after["observed"].all()
    assert after["observation"].isinf().all()


def test_indices_and_bools_name_the_same_sensors():
    expected = SensorReduction([1, -1])(data())["observed"]
    for same in ([False, True, False, False, True], torch.tensor([1, 4])):
        assert torch.equal(SensorReduction(same)(data())["observed"], expected)
    assert SensorReduction([])(data())["observed"].all()


def test_each_row_may_lack_sensors_of_its_own():
    rows = torch.rand(4, OBS, generator=torch.Generator().manual_seed(0)) < 0.5
    reduction = SensorReduction(rows)
    assert torch.equal(reduction(data())["observed"], ~rows)
    after = reduction(data(observed=existing_mask()))
    assert torch.equal(after["observed"], ~rows & existing_mask())
    after["observed"].fill_(True)
    assert torch.equal(reduction(data())["observed"], ~rows)  # the data does not hold the choice
    after = SensorReduction([1])(data())
    after["observed"][0, 0] = False
    assert after["observed"][1, 0]  # nor do rows share memory
    env = staircase(SensorReduction(rows), batch=4)
    assert torch.equal(env.rollout(3)["next", "observed"], (~rows).unsqueeze(1).expand(4, 3, OBS))


def nested(first, second):
    return TransformedEnv(StaircaseEnv(), Compose(Compose(first), Compose(second)))


def appended(first, second):
    return TransformedEnv(StaircaseEnv(), first).append_transform(second)


def inserted(first, second):
    return staircase(second).insert_transform(0, first)


def wrapped_twice(first, second):
    return TransformedEnv(TransformedEnv(StaircaseEnv(), first), second, auto_unwrap=False)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (FillLastObserved, MISSING, "`FillLastObserved` stands before `ObservationMissingness`"),
        (FillLastObserved, ObservedFromNaN, "`FillLastObserved` stands before `ObservedFromNaN`"),
        (FillLastObserved, NOISE, "`FillLastObserved` stands before `ObservationNoise`"),
        (NOISE, partial(MISSING, complete_key=COMPLETE), "has corrupted the observation before"),
        (
            partial(NOISE, complete_key=COMPLETE),
            partial(SPIKES, in_keys="other", complete_key=COMPLETE),
            "`complete_observation` is among the observations of the environment already",
        ),
    ],
    ids=["fill", "fill NaN", "fill noise", "complete", "two writers"],
)
@pytest.mark.parametrize("put_together", [staircase, nested, appended, inserted, wrapped_twice])
def test_a_wrong_order_is_refused_at_the_first_use(before, after, message, put_together):
    if "already" in message:
        pair = Copy(), Compose(before(), after())
    elif "Fill" in message:
        pair = Compose(SensorReduction([0]), before()), after()
    else:
        pair = before(), after()
    with pytest.raises(ValueError, match=message):
        put_together(*pair).rollout(2)


class Copy(Transform):
    """Write the observation under `other` as well."""

    def _call(self, tensordict):
        return tensordict.set("other", tensordict["observation"].clone())

    def _reset(self, tensordict, tensordict_reset):
        del tensordict
        return self._call(tensordict_reset)

    def transform_observation_spec(self, spec):
        return spec.set("other", spec["observation"].clone())


def test_the_order_of_the_recipe_is_accepted_and_other_keys_do_not_matter():
    noise = partial(NOISE, complete_key=COMPLETE)
    for chain in (
        [noise(), SPIKES(), MISSING()],
        [ObservedFromNaN(), noise(), MISSING(), FillLastObserved()],
        [Copy(), MISSING(), FillLastObserved(), MISSING(in_keys="other", mask_keys="other_seen")],
    ):
        rollout = staircase(*chain).rollout(2)
        assert {"observation", "observed"} <= set(rollout.keys())


def test_a_writer_inside_the_workers_is_found_through_the_specs():
    env = SerialEnv(2, lambda: staircase(NOISE(complete_key=COMPLETE)))
    with pytest.raises(ValueError, match="is among the observations of the environment already"):
        TransformedEnv(env, MISSING(complete_key=COMPLETE)).reset()
    env.close()


@pytest.mark.parametrize("eta", [-0.1, 1.1, math.nan, True, "0.5", None])
def test_a_missing_rate_lies_in_the_unit_interval(eta):
    with pytest.raises(ValueError, match=r"`eta` must be a missing rate in \[0, 1\]"):
        ObservationMissingness("mcar", eta)
    env = staircase(ObservationMissingness("mcar", 0.0))
    assert env.reset()["observed"].all()
    with pytest.raises(ValueError, match=r"`eta` must be a missing rate in \[0, 1\]"):
        env.transform[0].eta = eta
    env.transform[0].eta = 1.0
    assert not env.reset()["observed"].any()


@pytest.mark.parametrize("number", [-1.0, math.nan, math.inf, [0.1, -0.1], [[0.1]], "much", None])
@pytest.mark.parametrize(
    ("make", "name"),
    [
        (ObservationNoise, "noise_std"),
        (partial(ObservationSpikes, 0.1), "spike_std"),
        (partial(ObservationSpikes, spike_std=1.0), "probability"),
    ],
    ids=["noise_std", "spike_std", "probability"],
)
def test_numbers_are_finite_not_negative_and_as_many_as_components(make, name, number):
    with pytest.raises(ValueError, match=f"`{name}` must be a number or one number per component"):
        make(number)
    for use in (staircase(make([0.1, 0.2])).reset, lambda: make([0.1, 0.2])._call(data())):
        with pytest.raises(ValueError, match=f"`{name}` must have one entry per component, 5"):
            use()


def test_a_configuration_names_a_nested_action_by_a_list():
    keys = {"in_keys": [["agents", "observation"]], "action_key": ["agents", "action"]}
    flat, nested = MAR(seed=0), MAR(seed=0, **keys)
    action = TensorDict({"action": torch.ones(4, ACTION)}, [4])
    one = flat._step(action, data())
    other = nested._step(TensorDict({"agents": action}, [4]), TensorDict({"agents": data()}, [4]))
    assert torch.equal(other["agents", "observed"], one["observed"])


def use_keys_of_different_batch():
    nested = TensorDict({"observation": torch.ones(2, 3, OBS)}, [2, 3])
    both = TensorDict({"agents": nested, "observation": torch.ones(2, OBS)}, [2])
    MISSING(in_keys=["observation", ("agents", "observation")])._call(both)


def use_spec(transform, shape, dtype=torch.float32):
    spec = Composite(observation=Unbounded(shape=(4, *shape), dtype=dtype), shape=(4,))
    transform.transform_observation_spec(spec)


test_what_cannot_be_is_refused_in_one_line = refuses(
    (use_keys_of_different_batch, r"must share their batch .* \[\(2, 5\), \(2, 3, 5\)\]"),
    *[(lambda make=make, spec=spec: use_spec(make(), *spec),
       "`observation` must be a vector of floating point")
      for make in (MISSING, NOISE) for spec in (((),), ((3, 8, 8),), ((OBS,), torch.int64))],
    *[(lambda shape=shape: SensorReduction(torch.zeros(shape).bool())(data()),
       r"`missing` with a row .* = \(4, 5\), got") for shape in ((3, OBS), (1, OBS), (2, 4, OBS))],
    (lambda: SensorReduction(torch.zeros(3, OBS).long()),
     "`missing` must be a list of indices, or bool"),
    (lambda: SensorReduction([0.5]), "`missing` must be a list of indices"),
    *[(lambda m=m: SensorReduction(m)(data()), "`missing` ") for m in ([5], [-6], [True, False])],
    (lambda: staircase(SensorReduction([5])).observation_spec, "`missing` "),
    (lambda: ObservationSpikes(1.1, 1.0), "`probability` must .* got 1.1"),
    (lambda: staircase(NOISE(complete_key="observation")).reset(),
     "`observation` is among the observations"),
    (lambda: ObservationMissingness("random", 0.5),
     r"`mechanism` must be one of .*'mcar'.* got 'random'"),
    *[(lambda s=s: MAR(always_observed=s),
       r"`always_observed` must be a share in \[0, 1\)") for s in (-0.1, 1.0, 2, math.nan)],
    (lambda: staircase(MAR(always_observed=0.95)).reset(),
     r"`always_observed` must be a share that leaves .* 0.95 of 5 entries"),
    (lambda: MAR()._step(TensorDict({}, [4]), data()), KeyError,
     "`ObservationMissingness` reads 'action', which is not"),
    (lambda: staircase(MAR(action_key="torque")).rollout(2), KeyError,
     "reads 'torque', which is not"),
    (lambda: TransformedEnv(GymEnv("CartPole-v1", categorical_action_encoding=True), MAR())
     .rollout(2), r"`action` must be a vector .* one-hot actions"),
)  # fmt: skip
