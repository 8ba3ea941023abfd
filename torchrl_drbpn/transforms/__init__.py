"""What happens to observations between the simulator and the agent."""

from torchrl_drbpn.transforms.forward_fill import FillLastObserved
from torchrl_drbpn.transforms.missingness import (
    ObservationMissingness,
    ObservedFromNaN,
    SensorReduction,
)
from torchrl_drbpn.transforms.noise import ObservationNoise, ObservationSpikes
from torchrl_drbpn.transforms.outages import SensorOutages
from torchrl_drbpn.transforms.previous_action import PreviousAction
from torchrl_drbpn.transforms.seeding import seed_env

__all__ = [
    "FillLastObserved",
    "ObservationMissingness",
    "ObservationNoise",
    "ObservationSpikes",
    "ObservedFromNaN",
    "PreviousAction",
    "SensorOutages",
    "SensorReduction",
    "seed_env",
]
