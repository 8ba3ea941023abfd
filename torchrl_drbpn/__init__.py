"""A batched, differentiable belief filter with per-component missing data, wired into TorchRL."""

from importlib.metadata import PackageNotFoundError, version

from torchrl_drbpn import functional
from torchrl_drbpn.envs import EnvPoolBatchEnv, GymnasiumBatchEnv, SimulatorError
from torchrl_drbpn.functional import select_sensors
from torchrl_drbpn.modules import (
    BeliefDivergedError,
    BeliefFilter,
    BeliefFilterModule,
    GaussianTransition,
    LinearGaussianEmission,
    MaskedObservationNorm,
    ParticleFilter,
    ParticleFilterModule,
    PolicyStep,
)
from torchrl_drbpn.objectives import BeliefModelLoss, DRBPNLoss
from torchrl_drbpn.transforms import (
    FillLastObserved,
    ObservationDelay,
    ObservationMissingness,
    ObservationMultiRate,
    ObservationNoise,
    ObservationSpikes,
    ObservedFromNaN,
    PreviousAction,
    SensorDrift,
    SensorOutages,
    SensorReduction,
    StuckSensors,
    seed_env,
)

try:
    __version__ = version("torchrl-drbpn")
except PackageNotFoundError:  # a checkout that was never installed
    __version__ = "0+unknown"

__all__ = [
    "BeliefDivergedError",
    "BeliefFilter",
    "BeliefFilterModule",
    "BeliefModelLoss",
    "DRBPNLoss",
    "EnvPoolBatchEnv",
    "FillLastObserved",
    "GaussianTransition",
    "GymnasiumBatchEnv",
    "LinearGaussianEmission",
    "MaskedObservationNorm",
    "ObservationDelay",
    "ObservationMissingness",
    "ObservationMultiRate",
    "ObservationNoise",
    "ObservationSpikes",
    "ObservedFromNaN",
    "ParticleFilter",
    "ParticleFilterModule",
    "PolicyStep",
    "PreviousAction",
    "SensorDrift",
    "SensorOutages",
    "SensorReduction",
    "SimulatorError",
    "StuckSensors",
    "functional",
    "seed_env",
    "select_sensors",
]
