"""The learned state-space model, the belief filter, and its TensorDictModule."""

from torchrl_drbpn.modules.belief_checks import BeliefDivergedError
from torchrl_drbpn.modules.belief_filter import BeliefFilter
from torchrl_drbpn.modules.belief_filter_module import BeliefFilterModule
from torchrl_drbpn.modules.normalization import MaskedObservationNorm
from torchrl_drbpn.modules.particle_filter import ParticleFilterModule
from torchrl_drbpn.modules.particle_model import ParticleFilter
from torchrl_drbpn.modules.policy_step import PolicyStep
from torchrl_drbpn.modules.state_space import GaussianTransition, LinearGaussianEmission

__all__ = [
    "BeliefDivergedError",
    "BeliefFilter",
    "BeliefFilterModule",
    "GaussianTransition",
    "LinearGaussianEmission",
    "MaskedObservationNorm",
    "ParticleFilter",
    "ParticleFilterModule",
    "PolicyStep",
]
