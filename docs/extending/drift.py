"""A transform of one's own: sensors whose zero point drifts away in the course of an episode."""

from __future__ import annotations

from tensordict import TensorDictBase
from torchrl.envs import ObservationTransform


class Drift(ObservationTransform):
    """Add ``rate`` times the step's number to every reading; what did not arrive stays 0.

    Args:
        rate: raw simulator units a step.
    """

    def __init__(self, rate: float) -> None:
        super().__init__(in_keys=["observation"], out_keys=["observation"])
        self.rate = rate

    def _reset(self, _: TensorDictBase, reset: TensorDictBase) -> TensorDictBase:
        return reset  # nothing has drifted at the first step

    def _step(self, tensordict: TensorDictBase, following: TensorDictBase) -> TensorDictBase:
        drift = self.rate * (tensordict["step_count"] + 1)
        value = following["observation"] + drift * following["observed"]
        return following.set("observation", value)
