"""Parameters and keys: the learned state-space model and the belief filter as a TensorDictModule."""

from torchrl_drbpn.modules.belief_filter import BeliefFilter
from torchrl_drbpn.modules.belief_filter_module import BeliefFilterModule
from torchrl_drbpn.modules.state_space import GaussianTransition, LinearGaussianEmission

__all__ = ["BeliefFilter", "BeliefFilterModule", "GaussianTransition", "LinearGaussianEmission"]
