"""What the corrupting transforms promise: their contracts, keys, specs, masks and errors.

Each of ObservationMissingness, ObservationNoise, SensorReduction and ObservedFromNaN goes through
`contracts.TransformContract`. On top: what is missing is 0 and False in the mask; a mask that is
there already is ANDed, and garbage beneath it is harmless; several observation keys count as one
vector; specs say what is written; bad input gives one clear error; TorchRL's DQN parts work on it.
"""

from __future__ import annotations

import math

import pytest
import torch
from contracts import (
    ACTION,
    OBS,
    StaircaseEnv,
    TransformContract,
)
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Binary, LazyTensorStorage, TensorDictReplayBuffer, Unbounded
from torchrl.envs import (
    CatTensors,
    Compose,
    GymEnv,
    ObservationTransform,
    Transform,
    TransformedEnv,
)
from torchrl.modules import QValueActor
from torchrl.objectives import DQNLoss

from torchrl_drbpn.transforms import (
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


# ------------------------------------------------------------------------------------ the contracts
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


# ----------------------------------------------------------------------------------- keys and specs
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


def test_a_nested_key_may_come_as_a_list_as_configurations_write_it():
    missing = ObservationMissingness("mcar", 0.5, in_keys=[["agents", "observation"]])
    assert missing.in_keys == [("agents", "observation")]
    assert missing.mask_keys == [("agents", "observed")]


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


# ------------------------------------------------------------------------- masks that exist already
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


def test_garbage_beneath_a_mask_does_not_enter_the_law():
    root = TensorDict({"action": torch.zeros(4, ACTION)}, [4])
    drawn = []
    for beneath in (0.0, math.nan, math.inf, 1e6):
        before = data(1.0, observed=existing_mask())
        before["observation"][:, 2] = beneath
        drawn.append(ObservationMissingness("nmar", 0.9)._step(root, before)["observed"])
    assert not drawn[0].all(0)[[0, 1, 3, 4]].all()
    assert all(torch.equal(mask, drawn[0]) for mask in drawn)


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


# ---------------------------------------------------------------------------------- SensorReduction
def test_indices_and_bools_name_the_same_sensors():
    expected = SensorReduction([1, -1])(data())
    as_bool = SensorReduction([False, True, False, False, True])(data())
    as_tensor = SensorReduction(torch.tensor([1, 4]))(data())
    for after in (as_bool, as_tensor):
        assert torch.equal(after["observed"], expected["observed"])
    assert SensorReduction([])(data())["observed"].all()


def test_each_row_may_lack_sensors_of_its_own():
    rows = torch.rand(4, OBS, generator=torch.Generator().manual_seed(0)) < 0.5
    reduction = SensorReduction(rows)
    assert torch.equal(reduction(data())["observed"], ~rows)
    after = reduction(data(observed=existing_mask()))
    assert torch.equal(after["observed"], ~rows & existing_mask())
    after["observed"].fill_(True)
    assert torch.equal(reduction(data())["observed"], ~rows)  # the data does not hold the choice
    env = staircase(SensorReduction(rows), batch=4)
    assert torch.equal(env.rollout(3)["next", "observed"], (~rows).unsqueeze(1).expand(4, 3, OBS))


@pytest.mark.parametrize("shape", [(3, OBS), (1, OBS), (2, 4, OBS)])
def test_rows_for_another_batch_are_refused(shape):
    rows = torch.zeros(shape, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"`missing` with a row .* = \(4, 5\), got"):
        SensorReduction(rows)(data())
    with pytest.raises(ValueError, match="`missing` must be a list of indices, or bool"):
        SensorReduction(torch.zeros(shape, dtype=torch.int64))


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


@pytest.mark.parametrize("std", [-1.0, math.nan, math.inf, [0.1, -0.1], [[0.1]], "much", None])
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
