"""The laws of late, rare, stuck, drifting and failing readings."""

import copy
import math

import pytest
import torch
from refusals import refuses
from suites import ACTION, OBS, staircase, vectors
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import StepCounter
from transform_cases import COMPLETE

from torchrl_drbpn.functional.missingness import outage_rates, sample_working
from torchrl_drbpn.transforms import (
    ObservationDelay,
    ObservationMissingness,
    ObservationMultiRate,
    SensorDrift,
    SensorOutages,
    StuckSensors,
)

GROUPS = [[0, 3], [-1]]


def collected(*transforms, steps=40, batch=3, horizon=7):
    """Steps of a collector, whose rollouts cut episodes and whose episodes end row by row."""
    env = staircase(*transforms, StepCounter(), batch=batch, horizon=horizon)
    sizes = {"frames_per_batch": batch * steps // 2, "total_frames": batch * steps}
    collector = Collector(env, **sizes, auto_register_policy_transforms=False)
    data = torch.cat([batch.clone() for batch in collector], 1)
    collector.shutdown()
    return data


@pytest.mark.parametrize(
    ("delay", "groups", "wanted"),
    [(0, None, 0), (1, None, 1), (4, None, 4), ([1, 3], GROUPS, [1, 0, 0, 1, 3])],
)
def test_a_fixed_delay_shows_what_was_there_then_in_this_episode(delay, groups, wanted):
    data = collected(ObservationDelay(delay, groups=groups, complete_key=COMPLETE))
    wanted = torch.as_tensor(wanted)  # what is in no group is in time
    arrived = (data["step_count"] >= wanted).expand(-1, -1, OBS)
    assert torch.equal(data["observed"], arrived)
    torch.testing.assert_close(
        data["observation"], (data[COMPLETE] - wanted).where(arrived, torch.tensor(0.0))
    )


@pytest.mark.parametrize("in_order", [False, True])
def test_random_delays_are_a_mailbox_in_which_the_newest_letter_counts(in_order):
    steps, late = 25, ObservationDelay(1, max_delay=4, in_order=in_order, seed=3)
    readings = torch.arange(1.0, steps + 1)[:, None].expand(steps, OBS)
    data, sent = None, []
    for reading in readings:
        generator = late.generator(torch.device("cpu")).clone_state()
        sent.append(1 + (torch.rand(OBS, generator=generator) * 4).long())
        step = TensorDict({"observation": reading.clone()})
        data = late._reset(None, step) if data is None else late._step(data, step)
        now = len(sent) - 1
        for i in range(OBS):
            arriving = [t for t in range(now + 1) if t + int(sent[t][i]) == now]
            shown = [t for t in range(now) if t + int(sent[t][i]) < now]
            newest = max(arriving, default=None)
            if in_order and newest is not None and shown and max(shown) > newest:
                newest = None
            assert bool(data["observed"][i]) == (newest is not None)
            assert float(data["observation"][i]) == (0 if newest is None else newest + 1)


def test_a_reading_that_is_missing_is_never_sent():
    gaps = ObservationMissingness("mcar", 0.4, seed=1, complete_key=COMPLETE)
    sent = collected(gaps)
    data = collected(ObservationMissingness("mcar", 0.4, seed=1, complete_key=COMPLETE),
                     ObservationDelay(2))  # fmt: skip
    assert torch.equal(data[COMPLETE], sent[COMPLETE])
    late = (data["step_count"] >= 2).expand(-1, -1, OBS)
    assert not data["observed"][~late].any()
    for key in ("observed", "observation"):
        # two steps before, which where `late` is in the same episode
        assert torch.equal(data[key][:, 2:][late[:, 2:]], sent[key][:, :-2][late[:, 2:]])


def test_a_delay_as_long_as_an_episode_is_refused_where_the_length_is_known():
    for chain in (
        (ObservationDelay(5), StepCounter(max_steps=5)),
        (StepCounter(max_steps=5), ObservationDelay([0, 6], groups=GROUPS)),
    ):
        with pytest.raises(ValueError, match=r"`delay` must be shorter .*max_steps=5"):
            staircase(*chain).reset()
    staircase(ObservationDelay(4, max_delay=9), StepCounter(max_steps=5)).reset()


def test_readings_arrive_where_the_time_since_the_reset_says():
    period, phase = torch.tensor([1, 2, 3, 4, 5]), torch.tensor([0, 1, 0, 3, 2])
    data = collected(ObservationMultiRate(period, phase=phase, complete_key=COMPLETE))
    time = data["step_count"]
    assert torch.equal(data["observed"], (time - phase) % period == 0)
    assert torch.equal(data["observation"], data[COMPLETE] * data["observed"])
    assert torch.equal(data["next", "observed"], (time + 1 - phase) % period == 0)


def test_random_phases_are_uniform_and_last_for_an_episode():
    rates = ObservationMultiRate(4, phase="random", groups=GROUPS)
    data = staircase(rates, batch=3000, horizon=20).rollout(12)
    seen = data["observed"]
    assert seen[..., [1, 2]].all()
    assert torch.equal(seen[..., 0], seen[..., 3])
    first = seen[..., [0, -1]].float().argmax(1)
    counts = torch.stack([torch.bincount(column, minlength=4) for column in first.T]).double()
    assert counts.shape == (2, 4)
    assert ((counts / 3000 - 0.25).abs() < 4.5 * math.sqrt(0.25 * 0.75 / 3000)).all()
    assert torch.equal(seen[:, 4:], seen[:, :-4])
    assert (seen[:, :4, -1].sum(1) == 1).all()


def test_a_stuck_sensor_repeats_what_it_showed_and_still_counts_as_observed():
    stuck = StuckSensors(onset=2, duration=3, groups=GROUPS, complete_key=COMPLETE)
    data = collected(stuck)
    assert "observed" not in data
    lag = (data["step_count"] - 1).where(
        (data["step_count"] >= 2) & (data["step_count"] < 5), torch.tensor(0)
    )
    wanted = torch.zeros_like(data["observation"])
    wanted[..., [0, 3, 4]] = lag.float().expand(-1, -1, 3)
    torch.testing.assert_close(data[COMPLETE] - data["observation"], wanted)
    assert torch.equal((data["stuck_steps"] > 0).any(-1), data["step_count"][..., 0] >= 2)


def test_from_sensors_that_work_the_stuck_share_follows_the_chain():
    p, length = 0.1, 8.0
    stuck = StuckSensors(p, length, complete_key=COMPLETE)
    data = staircase(stuck, batch=4000, horizon=60, dtype=torch.float64).rollout(41)
    wrong = data["stuck_steps"] > 0
    assert torch.equal(wrong, (data["observation"] != data[COMPLETE]))
    # stuck for n steps is what was there n steps ago
    torch.testing.assert_close(
        data[COMPLETE] - data["observation"], data["stuck_steps"].double(), atol=1e-6, rtol=0
    )
    steps = torch.arange(41, dtype=torch.float64)
    law = p / (p + 1 / length) * (1 - (1 - p - 1 / length) ** steps)
    error = math.sqrt(0.25 / (4000 * OBS))
    assert ((wrong.double().mean((0, 2)) - law).abs() < 4.5 * error).all()


def test_without_a_length_a_sensor_is_stuck_for_good_from_its_first_reading_on():
    data = collected(StuckSensors(onset=0, complete_key=COMPLETE))
    torch.testing.assert_close(
        data[COMPLETE] - data["observation"], data["step_count"].float().expand(-1, -1, OBS)
    )
    wrong = staircase(StuckSensors(0.3), batch=50, horizon=30).rollout(20)["stuck_steps"] > 0
    assert not (wrong[:, :-1] & ~wrong[:, 1:]).any()


def test_what_is_stuck_is_what_arrived_last():
    gaps = SensorOutages(0.5, 2, seed=1)
    data = collected(gaps, StuckSensors(onset=3, seed=2))
    for row in data.unbind(0):
        last = torch.zeros(OBS)
        for step in row.unbind(0):
            time = int(step["step_count"])
            if time == 0:
                last = torch.zeros(OBS)
            seen = step["observed"]
            if time < 3:
                last = step["observation"].where(seen, last)
            else:
                assert torch.equal(step["observation"], last * seen)


def test_a_ramp_grows_by_its_rate_and_ends_with_its_duration():
    rate = torch.tensor([0.5, -1.0, 0.0, 2.0, 0.25])
    data = collected(SensorDrift(rate=rate, onset=1, duration=4, complete_key=COMPLETE))
    time = data["step_count"].float()
    wanted = time.where((time >= 1) & (time <= 4), torch.tensor(0.0)) * rate
    torch.testing.assert_close(data["observation"] - data[COMPLETE], wanted, atol=1e-4, rtol=0)


def test_the_variance_of_a_walk_grows_with_time():
    drift = SensorDrift([0.1, 0.2, 0.0, 0.4, 1.0], groups=[[0], [1], [3]])
    bias = staircase(drift, batch=4000, horizon=30).rollout(20)["drift_bias"].double()
    steps = torch.arange(1, 21, dtype=torch.float64)[:, None]
    wanted = steps * torch.tensor([0.1, 0.2, 0, 0.4, 0], dtype=torch.float64) ** 2
    torch.testing.assert_close(bias.var(0), wanted, rtol=0.15, atol=0)
    increments = bias[..., [0, 1, 3]].diff(dim=1).flatten(0, 1)
    assert (torch.corrcoef(increments.T) - torch.eye(3)).abs().max() < 5 / len(increments) ** 0.5


def test_a_drift_that_ends_is_calibrated_and_another_starts_at_zero():
    drift = SensorDrift(rate=1.0, probability=0.3, mean_length=3, complete_key=COMPLETE)
    data = staircase(drift, batch=200, horizon=50).rollout(40)
    assert torch.equal(data["drift_bias"], data["drift_steps"].float())
    ended = (data["drift_bias"][:, :-1] > 0) & (data["drift_bias"][:, 1:] == 0)
    assert ended.any()


def test_a_state_that_got_lost_or_is_another_is_named():
    root = TensorDict({"action": torch.zeros(4, ACTION)}, [4])
    step = TensorDict({"observation": torch.ones(4, OBS)}, [4])
    with pytest.raises(KeyError, match=r"'delayed_observation', which is not there\. Start from"):
        ObservationDelay(1)._step(root, step.clone())
    root["drift_steps"] = torch.zeros(4, OBS)
    with pytest.raises(ValueError, match=r"`drift_steps` must be int64 of shape \(4, 5\)"):
        SensorDrift(1.0)._step(root, step.clone())
    with pytest.raises(KeyError, match=r"under 'sensor_on', which is not there\. Start from"):
        SensorOutages(0.5, 5)._step(root, step.clone())


test_what_no_sensor_does_is_refused_in_one_line = refuses(
    (lambda: ObservationDelay(-1), "`delay` must be a whole number of steps, at least 0"),
    (lambda: ObservationDelay(1.5), "`delay` must be a whole number .* got 1.5"),
    (lambda: ObservationDelay(True), "`delay` must be a whole number"),
    (lambda: ObservationDelay([]), "`delay` must be a whole number"),
    (lambda: ObservationDelay("2"), "`delay` must be a whole number"),
    (lambda: ObservationDelay(3, max_delay=2), "`max_delay` must not be under `delay`"),
    (lambda: ObservationDelay([0, 1], max_delay=[1, 2, 3]), "`max_delay` must have one entry"),
    (lambda: ObservationMultiRate(0), "`period` must be a whole number .* at least 1"),
    (lambda: ObservationMultiRate(2, phase=2), "`phase` must be under the period"),
    (lambda: ObservationMultiRate(2, phase="any"), "`phase` must be a whole number"),
    (lambda: StuckSensors(), "`probability` .* give one of them"),
    (lambda: StuckSensors(0.1, onset=3), "`probability` .* give one of them"),
    (lambda: StuckSensors(1.1), r"`probability` must be .* in \[0, 1\], got 1.1"),
    (lambda: StuckSensors("0.1"), "`probability` must be"),
    (lambda: StuckSensors(math.nan), "`probability` must be"),
    (lambda: StuckSensors(0.1, 0.5), "`mean_length` must be the mean length of a fault"),
    (lambda: StuckSensors(0.1, duration=3), "`duration` goes with `onset`"),
    (lambda: StuckSensors(onset=1, mean_length=3), "`mean_length` goes with `probability`"),
    (lambda: StuckSensors(onset=-1), "`onset` must be a whole number"),
    (lambda: StuckSensors(onset=[1, 2]), "`onset` must be a whole number"),
    (lambda: StuckSensors(onset=1, duration=0), "`duration` must be a whole number"),
    (lambda: SensorDrift(-1.0), "`walk_std` must be a number"),
    (lambda: SensorDrift(rate=math.inf), "`rate` must be a number"),
    (lambda: SensorDrift(probability=2.0), "`probability` must be"),
    (lambda: StuckSensors(0.1, groups=[[0], [0, True]]), "`groups` must be lists of indices"),
    (lambda: StuckSensors(0.1, state_keys="state"), "`state_keys` must be 2 keys of its own"),
    *[(lambda g=g: SensorOutages(0.5, 5, groups=g), "`groups` must ")
      for g in ([], [[]], [0, 1], [["a"]], [[True]], "legs")],
    (lambda: SensorOutages(0.9, 2), "`mean_length` must be at least eta"),
    (lambda: SensorOutages(0.5, 5, initial="off"), "`initial` must be one of .* got 'off'"),
    (lambda: SensorOutages(0.5, 5, state_keys="observed"), "`state_keys` must be a key of"),
)  # fmt: skip


@pytest.mark.parametrize(
    ("transform", "line"),
    [
        (ObservationDelay([1, 2]), "`delay` must have one entry per group .*, 5, got 2"),
        (ObservationDelay([1, 2, 3], groups=GROUPS), "`delay` must have .*, 2, got 3"),
        (ObservationMultiRate([1, 2]), "`period` must have one entry"),
        (ObservationMultiRate(3, phase=[1, 2]), "`phase` must have one entry"),
        (StuckSensors(0.1, groups=[[5]]), "`groups` must hold indices from -5 to 4"),
        (SensorOutages(0.5, 5, groups=[[0, 5]]), "`groups` must hold indices from -5 to 4"),
        (SensorOutages(0.5, 5, groups=[[4], [-1]]), "`groups` must name every component once"),
        (SensorDrift([1.0, 2.0]), "`walk_std` must have one entry per component"),
        (SensorDrift(rate=[1.0, 2.0]), "`rate` must have one entry per component"),
        (SensorDrift(1.0, groups=[[4], [-1]]), "`groups` must name every component once"),
    ],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_numbers_and_groups_that_do_not_fit_the_observation_are_refused(transform, line):
    with pytest.raises(ValueError, match=line):
        transform._reset(None, TensorDict({"observation": torch.ones(4, OBS)}, [4]))
    with pytest.raises(ValueError, match=line):
        staircase(transform).reset()


@pytest.mark.parametrize("initial", ["stationary", "on"])
def test_masks_follow_the_chain_and_every_episode_has_its_own_start(initial):
    transform = SensorOutages(0.5, 3, initial=initial, seed=0)
    env = staircase(transform)
    generator = copy.copy(transform.generator(torch.device("cpu")))
    rates, like = outage_rates(0.5, 3), torch.zeros(3, OBS)
    rollout = env.rollout(9, break_when_any_done=False)
    assert rollout["next", "done"].any(1).all()

    def start():
        if initial == "on":
            return torch.ones(3, OBS, dtype=torch.bool)
        return sample_working(None, rates, like, generator)

    expected = start()
    for t in range(9):
        assert torch.equal(rollout["observed"][:, t], expected)
        arrived = sample_working(expected, rates, like, generator)
        assert torch.equal(rollout["next", "observed"][:, t], arrived)
        over = rollout["next", "done"][:, t]
        expected = arrived
        if t < 8 and over.any():
            expected = torch.where(over, start(), arrived)


def test_writing_into_the_mask_does_not_repair_a_sensor():
    after = SensorOutages(0.5, 5)._call(vectors(1.0, (50,)))
    before = after["sensor_on"].clone()
    after["observed"].fill_(True)
    assert torch.equal(after["sensor_on"], before)


def test_several_keys_are_one_vector_and_groups_reach_over_them():
    both = TensorDict({"a": torch.ones(400, 2), "b": torch.ones(400, 3)}, [400])
    outages = SensorOutages(
        0.5, 5, groups=[[0, 2], [-1]], in_keys=["a", "b"], mask_keys=["ma", "mb"], state_keys="on"
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
    bus = SensorOutages(0.2, 20, groups=[[0, 1, 2, 3, 4]], state_keys="bus_on")
    env = staircase(SensorOutages(0.2, 5), bus, batch=500, horizon=20)
    rollout = env.rollout(10)
    assert torch.equal(rollout["observed"], rollout["sensor_on"] & rollout["bus_on"])
    # 1 - .8 * .8; a group is one draw for five entries
    assert (1 - rollout["observed"].double().mean()) == pytest.approx(0.36, abs=0.05)
