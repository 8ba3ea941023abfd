"""Many simulators as one TorchRL environment."""

from torchrl_drbpn.envs.envpool_batch import EnvPoolBatchEnv
from torchrl_drbpn.envs.gymnasium_batch import GymnasiumBatchEnv
from torchrl_drbpn.envs.simulator_batch import SimulatorError

__all__ = ["EnvPoolBatchEnv", "GymnasiumBatchEnv", "SimulatorError"]
