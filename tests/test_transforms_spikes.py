"""What `ObservationSpikes` promises: its contract, its law, what it leaves alone, keys and errors.

The transform goes through `contracts.TransformContract`. On top: a reading is hit with its
probability at resets as at steps, keeps its True in the mask, and everything else keeps its bits;
missing entries are neither hit nor filled; several keys count as one vector; the record of hits is
written on request alone; one seed gives one sequence.
"""

from __future__ import annotations

import math

import pytest
import torch
from contracts import OBS, StaircaseEnv, TransformContract
from tensordict import TensorDict
from torchrl.data import Binary, Unbounded
from torchrl.envs import Compose, TransformedEnv

from torchrl_drbpn.transforms import (
    MaskedObservationNorm,
    ObservationMissingness,
    ObservationNoise,
    ObservationSpikes,
    seed_env,
)

COMPLETE = "complete_observation"


def staircase(*transforms, **kwargs):
    return TransformedEnv(StaircaseEnv(**kwargs), Compose(*transforms))


def data(value=1.0, batch=(4,), **more):
    return TensorDict({"observation": torch.full((*batch, OBS), value), **more}, batch)


class TestSpikes(TransformContract):
    keeps_float64 = ("observation", COMPLETE)

    def make_transform(self):
        return ObservationSpikes(0.3, 50.0, complete_key=COMPLETE, spiked_key="spiked")

    def check_output(self, before, after):
        assert after.get("observed", None) is None
        assert after["spiked"].dtype == torch.bool
        same = after["observation"] == after[COMPLETE]
        assert torch.equal(same, ~after["spiked"])
        if before.get("observation", None) is not None:
            assert torch.equal(after[COMPLETE], before["observation"])


def test_readings_are_hit_with_their_probability_at_resets_as_at_steps():
    env = staircase(
        ObservationSpikes(0.05, 20.0, complete_key=COMPLETE, spiked_key="hit"),
        batch=3000,
        horizon=9,
    )
    rollout = env.rollout(5)
    share = rollout["hit"].double().mean((0, 2))
    assert ((share - 0.05).abs() < 4 * math.sqrt(0.05 * 0.95 / (3000 * OBS))).all()
    error = (rollout["observation"] - rollout[COMPLETE])[rollout["hit"]].double()
    assert abs(error.mean()) < 4 * 20 / math.sqrt(len(error))
    assert abs(error.std() - 20) < 4 * 20 / math.sqrt(2 * len(error))


def test_a_spiked_entry_has_arrived():
    env = staircase(
        ObservationSpikes(1.0, 5.0, complete_key=COMPLETE, spiked_key="hit"),
        ObservationMissingness("mcar", 0.5),
    )
    after = env.reset()
    arrived = after["observed"]
    assert after["hit"].all()
    assert 0 < arrived.double().mean() < 1
    assert (after["observation"][arrived] != after[COMPLETE][arrived]).all()


def test_missing_entries_are_neither_hit_nor_filled():
    mask = torch.ones(4, OBS, dtype=torch.bool)
    mask[:, 2] = False
    before = data(0.0, observed=mask)
    before["observation"][:, 2] = math.nan
    after = ObservationSpikes(1.0, 5.0, spiked_key="hit")._call(before)
    assert (after["observation"][:, 2] == 0).all()
    assert torch.equal(after["hit"], mask)
    assert torch.equal(after["observed"], mask)


@pytest.mark.parametrize(("probability", "std"), [(0.0, 5.0), (1.0, 0.0)])
def test_no_probability_and_no_deviation_change_nothing(probability, std):
    after = ObservationSpikes(probability, std)._call(data(1.5))
    assert torch.equal(after["observation"], data(1.5)["observation"])


def test_probability_and_deviation_per_component_span_several_keys():
    both = TensorDict({"a": torch.zeros(400, 2), "b": torch.zeros(400, 3)}, [400])
    spikes = ObservationSpikes(
        [0, 1, 0, 1, 0],
        [1, 1, 1, 100, 1],
        in_keys=["a", "b"],
        mask_keys=["ma", "mb"],
        spiked_key=["ha", "hb"],
    )
    after = spikes._call(both)
    assert ((after["a"] != 0) == torch.tensor([False, True])).all()
    assert torch.equal(after["ha"], after["a"] != 0)
    assert torch.equal(after["hb"], after["b"] != 0)
    assert after["b"][:, 1].std() > 50 > 5 > after["a"][:, 1].std()
    assert after.get("ma", None) is None


def test_specs_say_what_is_written():
    env = staircase(ObservationSpikes(0.1, 5.0, spiked_key="hit"))
    spec = env.observation_spec
    assert isinstance(spec["observation"], Unbounded)
    assert isinstance(spec["hit"], Binary)
    assert spec["hit"].shape == spec["observation"].shape
    assert "hit" not in staircase(ObservationSpikes(0.1, 5.0)).observation_spec
    with pytest.raises(ValueError, match=r"`hit` is among the observations .* spiked_key"):
        _ = staircase(
            ObservationSpikes(0.1, 5.0, spiked_key="hit"),
            ObservationSpikes(0.1, 5.0, seed=1, spiked_key="hit"),
        ).observation_spec


def test_spikes_stand_before_the_normaliser_as_noise_does():
    with pytest.raises(ValueError, match="`MaskedObservationNorm` stands before `ObservationSp"):
        staircase(MaskedObservationNorm(), ObservationSpikes(0.1, 5.0))


def test_seed_env_reproduces_spikes_unrelated_to_the_noise():
    noise = ObservationNoise(1.0, complete_key=COMPLETE)
    env = staircase(noise, ObservationSpikes(0.5, 1e3, spiked_key="hit"), batch=2000)

    def hits(seed):
        seed_env(env, seed)
        rollout = env.rollout(3)
        return rollout["hit"], rollout["observation"] - rollout[COMPLETE]

    (first, change), (again, _), (other, _) = hits(1), hits(1), hits(2)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    quiet = change[~first].double()
    assert abs(quiet.std() - 1) < 0.05  # what is not hit has the noise alone


@pytest.mark.parametrize("probability", [-0.1, 1.1, math.nan, "often", None, [[0.1]]])
def test_a_probability_lies_in_the_unit_interval(probability):
    with pytest.raises(ValueError, match="`probability` must be a number or one per component"):
        ObservationSpikes(probability, 1.0)


@pytest.mark.parametrize("std", [-1.0, math.nan, math.inf, "much", [[1.0]]])
def test_a_deviation_is_finite_and_not_negative(std):
    with pytest.raises(ValueError, match="`spike_std` must be a number or one number per"):
        ObservationSpikes(0.1, std)


def test_numbers_per_component_are_as_many_as_components():
    for transform, name in (
        (ObservationSpikes([0.1, 0.2], 1.0), "probability"),
        (ObservationSpikes(0.1, [1.0, 2.0]), "spike_std"),
    ):
        with pytest.raises(ValueError, match=f"`{name}` must have one entry per component, 5"):
            transform._call(data())
        with pytest.raises(ValueError, match=f"`{name}` must have one entry per component, 5"):
            _ = staircase(transform).observation_spec


def test_the_record_of_hits_has_a_key_of_its_own():
    with pytest.raises(ValueError, match="`spiked_key` must name keys of its own"):
        ObservationSpikes(0.1, 1.0, spiked_key="observed")
