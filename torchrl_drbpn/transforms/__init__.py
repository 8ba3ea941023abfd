"""What happens to observations between the simulator and the agent."""

from torchrl_drbpn.transforms.forward_fill import FillLastObserved
from torchrl_drbpn.transforms.missingness import (
    ObservationMissingness,
    ObservedFromNaN,
    SensorReduction,
)
from torchrl_drbpn.transforms.noise import ObservationNoise, ObservationSpikes
from torchrl_drbpn.transforms.observation_timing import ObservationDelay, ObservationMultiRate
from torchrl_drbpn.transforms.outages import SensorOutages
from torchrl_drbpn.transforms.previous_action import PreviousAction
from torchrl_drbpn.transforms.seeding import seed_env
from torchrl_drbpn.transforms.sensor_faults import SensorDrift, StuckSensors

__all__ = [
    "FillLastObserved",
    "ObservationDelay",
    "ObservationMissingness",
    "ObservationMultiRate",
    "ObservationNoise",
    "ObservationSpikes",
    "ObservedFromNaN",
    "PreviousAction",
    "SensorDrift",
    "SensorOutages",
    "SensorReduction",
    "StuckSensors",
    "seed_env",
]
