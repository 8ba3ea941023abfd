"""The law, the groups, the keys and the errors of `SensorOutages`."""

from __future__ import annotations

import copy
import math

import pytest
import torch
from contracts import OBS, staircase
from contracts import vectors as data
from tensordict import TensorDict

from torchrl_drbpn.functional.missingness import outage_rates, sample_working
from torchrl_drbpn.transforms import SensorOutages

GROUPS = [[0, 3], [1, -1]]


def test_masks_follow_the_chain_and_every_episode_has_its_own_start():
    transform = SensorOutages(0.5, 3, seed=0)
    env = staircase(transform)
    generator = copy.copy(transform.generator(torch.device("cpu")))
    rates, like = outage_rates(0.5, 3), torch.zeros(3, OBS)
    rollout = env.rollout(9, break_when_any_done=False)
    assert rollout["next", "done"].any(1).all()
    expected = sample_working(None, rates, like, generator)
    for t in range(9):
        assert torch.equal(rollout["observed"][:, t], expected)
        arrived = sample_working(expected, rates, like, generator)
        assert torch.equal(rollout["next", "observed"][:, t], arrived)
        over = rollout["next", "done"][:, t]
        expected = arrived
        if t < 8 and over.any():
            expected = torch.where(over, sample_working(None, rates, like, generator), arrived)


def test_from_sensors_that_all_work_the_ratio_rises_to_eta():
    eta, length = 0.5, 8.0
    rates = outage_rates(eta, length)
    env = staircase(SensorOutages(eta, length, initial="on"), batch=4000, horizon=60)
    missing = 1 - env.rollout(41)["observed"].double().mean((0, 2))
    assert missing[0] == 0
    steps = torch.arange(41, dtype=torch.float64)
    law = eta * (1 - (1 - rates.failure - rates.repair) ** steps)
    error = math.sqrt(0.25 / (4000 * OBS))
    assert ((missing - law).abs() < 4.5 * error).all()
    assert missing[-1] == pytest.approx(eta, abs=0.02)


def test_writing_into_the_mask_does_not_repair_a_sensor():
    after = SensorOutages(0.5, 5)._call(data(1.0, (50,)))
    before = after["sensor_on"].clone()
    after["observed"].fill_(True)
    assert torch.equal(after["sensor_on"], before)


def test_several_keys_are_one_vector_and_groups_reach_over_them():
    both = TensorDict({"a": torch.ones(400, 2), "b": torch.ones(400, 3)}, [400])
    outages = SensorOutages(
        0.5, 5, groups=[[0, 2], [-1]], in_keys=["a", "b"], mask_keys=["ma", "mb"], state_key="on"
    )
    after = outages._call(both)
    assert torch.equal(after["ma"][:, 0], after["on"][:, 0])
    assert torch.equal(after["mb"][:, 0], after["on"][:, 0])
    assert torch.equal(after["mb"][:, 2], after["on"][:, 1])
    assert after["ma"][:, 1].all()
    assert after["mb"][:, 1].all()
    both = torch.stack([after["on"][:, 0], after["on"][:, 1]]).double()
    assert torch.corrcoef(both)[0, 1].abs() < 4 / math.sqrt(both.shape[1])


def test_a_nested_observation_has_mask_and_state_beside_it():
    inner = TensorDict({"observation": torch.ones(2, 3, OBS)}, [2, 3])
    outer = TensorDict({"agents": inner}, [2])
    after = SensorOutages(0.5, 5, in_keys=[("agents", "observation")])._call(outer)
    assert after["agents", "sensor_on"].shape == (2, 3, OBS)
    assert after.get("sensor_on", None) is None


def test_two_of_them_need_two_states():
    with pytest.raises(ValueError, match=r"`sensor_on` is among .* Pass another key"):
        _ = staircase(SensorOutages(0.2, 5), SensorOutages(0.2, 20)).observation_spec
    env = staircase(
        SensorOutages(0.2, 5),
        SensorOutages(0.2, 20, groups=[[0, 1, 2, 3, 4]], state_key="bus_on"),
        batch=500,
        horizon=20,
    )
    rollout = env.rollout(10)
    assert torch.equal(rollout["observed"], rollout["sensor_on"] & rollout["bus_on"])
    # 1 - .8 * .8; a group is one draw for five entries
    assert (1 - rollout["observed"].double().mean()) == pytest.approx(0.36, abs=0.05)
