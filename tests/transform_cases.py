"""Every transform, and what it makes of an observation; see test_transforms_requirements.py."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import torch
from suites import ACTION, OBS
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, Transform, TransformedEnv

from torchrl_drbpn import transforms as T

COMPLETE = "complete_observation"
Check = Callable[[TensorDictBase, TensorDictBase], None]


def complete(before, after):
    """The complete observation is what came."""
    if COMPLETE in after and "observation" in before:
        assert torch.equal(after[COMPLETE], before["observation"])


def masked(before, after):
    """What is missing is 0 and False in the mask, the rest is what came."""
    observation, observed = after["observation"], after["observed"]
    assert observed.dtype == torch.bool
    assert observed.shape == observation.shape
    assert torch.equal(observation, after.get(COMPLETE, observation).where(observed, 0.0))
    complete(before, after)


def reduced(before, after):
    masked(before, after)
    assert not after["observed"][..., [0, -1]].any()
    assert after["observed"][..., 1:-1].all()


def from_nan(before, after):
    masked(before, after)
    if "observation" in before:
        assert torch.equal(after["observed"], ~before["observation"].isnan())


def noisy(before, after):
    noise = after["observation"] - after[COMPLETE]
    assert "observed" not in after
    assert (noise != 0).all()
    assert (noise.abs() < 1).all()
    complete(before, after)


def spiked(before, after):
    assert "observed" not in after
    hit = after["observation"] != after[COMPLETE]
    assert hit.any()
    assert not hit.all()
    complete(before, after)


def grouped(before, after):
    masked(before, after)
    on, observed = after["sensor_on"], after["observed"]
    assert on.shape[-1] == 2
    assert torch.equal(observed[..., [0, 1]], on[..., :1].expand(*on.shape[:-1], 2))
    assert torch.equal(observed[..., -1], on[..., 1])
    assert observed[..., 2:-1].all()


def delayed(before, after):
    observation, observed = after["observation"], after["observed"]
    assert (observation[~observed] == 0).all()
    assert after["delayed_observation"].shape == (*observation.shape[:-1], 2, observation.shape[-1])
    # what is in no group is never late
    assert torch.equal(observation[..., 2], after[COMPLETE][..., 2])
    complete(before, after)


def stuck(before, after):
    works = after["stuck_steps"] <= 0
    assert "observed" not in after
    assert torch.equal(after["observation"], after["stuck_observation"])
    assert torch.equal(after["observation"][works], after[COMPLETE][works])
    complete(before, after)


def drifting(before, after):
    assert "observed" not in after
    assert torch.equal(after["observation"], after[COMPLETE] + after["drift_bias"])
    assert torch.equal(after["drift_bias"][..., [0, -1]] != 0, after["drift_steps"] > 0)
    assert (after["drift_bias"][..., 1:-1] == 0).all()
    complete(before, after)


def filled(before, after):
    values, observed = after["observation"], after["observed"]
    assert torch.equal(values, after["last_observation"])
    if "observation" in before:
        assert torch.equal(observed, before["observed"])
        assert torch.equal(values[observed], before["observation"][observed])


def previous(before, after):
    del before
    assert after["previous_action"].shape[:-1] == after.batch_size
    assert after["previous_action"].isfinite().all()


@dataclass
class Case:
    """A transform and what it makes of an observation."""

    make: Callable[..., Transform]  # with a seed where it takes one
    check: Check  # asserts what is made of `before`, which is empty where it is not known
    offline: bool = False  # whether it works on a replay buffer
    nan: bool = False  # whether it is made for NaN
    needs: list[Callable[..., Transform]] = field(default_factory=list)  # that stand before it
    keys: tuple[str, ...] = ("observation",)  # float64 where the observation is

    def data(self, batch, dtype=torch.float32):
        """Return what an environment's step would give to the transform."""
        generator = torch.Generator().manual_seed(1)
        made = torch.randn(*batch, OBS, generator=generator, dtype=dtype)
        data = TensorDict({"observation": made}, batch)
        if self.nan:
            made[..., 1] = math.nan
        if self.needs:
            data["observed"] = torch.rand(made.shape, generator=generator) < 0.5
            data["observation"] = made.where(data["observed"], 0.0)
        return data

    def root(self, batch, dtype=torch.float32):
        """Return the data at the step before, with the action that led to `data`."""
        data = self.data(batch, dtype)
        data["action"] = torch.full((*batch, ACTION), 0.5, dtype=dtype)
        reset = data.clone()
        if "previous_action" in self.keys:
            return reset
        return self.make()._reset(data.empty(), reset)

    def env(self, base, **keys):
        parts = [make(**keys) for make in (*self.needs, self.make)]
        return TransformedEnv(base, Compose(*parts))


mcar = partial(T.ObservationMissingness, "mcar", 0.5, seed=0)
seeded = partial(partial, seed=0, complete_key=COMPLETE)  # of a class and its arguments
ENDS = [[0, 1], [-1]]
CASES = {
    "mcar": Case(partial(mcar, complete_key=COMPLETE), masked, keys=("observation", COMPLETE)),
    "mar": Case(seeded(T.ObservationMissingness, "mar", 0.7), masked),
    "nmar": Case(seeded(T.ObservationMissingness, "nmar", 0.7), masked),
    "reduction": Case(
        partial(T.SensorReduction, [0, -1], complete_key=COMPLETE), reduced, offline=True
    ),
    "nan": Case(T.ObservedFromNaN, from_nan, offline=True, nan=True),
    "noise": Case(seeded(T.ObservationNoise, 0.1), noisy, keys=("observation", COMPLETE)),
    "spikes": Case(seeded(T.ObservationSpikes, 0.3, 50.0), spiked),
    "outages": Case(seeded(T.SensorOutages, 0.5, 5), masked),
    "groups": Case(seeded(T.SensorOutages, 0.4, 3, groups=ENDS, initial="on"), grouped),
    "delay": Case(
        seeded(T.ObservationDelay, 0, max_delay=2, groups=ENDS),
        delayed,
        keys=("observation", "delayed_observation"),
    ),
    "multi_rate": Case(
        seeded(T.ObservationMultiRate, [1, 2, 3], phase="random", groups=[[0, 1], [2], [-1]]),
        masked,
    ),
    "stuck": Case(seeded(T.StuckSensors, 0.5, 3), stuck, keys=("observation", "stuck_observation")),
    "drift": Case(
        seeded(T.SensorDrift, 0.1, 0.5, probability=0.5, groups=[[0], [-1]]),
        drifting,
        keys=("observation", "drift_bias"),
    ),
    "fill": Case(T.FillLastObserved, filled, needs=[mcar]),
    "previous_action": Case(T.PreviousAction, previous, keys=("previous_action",)),
}
