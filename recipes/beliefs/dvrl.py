"""Deep variational reinforcement learning as the belief module of a recipe: a particle filter."""

from typing import Any

from beliefs import ESTIMATE, OBSERVATION, Belief
from torchrl_drbpn import ParticleFilter, ParticleFilterModule

_READ = {"observation": OBSERVATION}


def build(*, obs_dim: int, action_dim: int, **settings: Any) -> Belief:
    """Build the particle filter; its evidence lower bound is the model loss."""
    particle_filter = ParticleFilter(obs_dim, action_dim, **settings)
    module = ParticleFilterModule(particle_filter, in_keys=_READ)
    # The particles' mean; a mixture of Gaussians has no single covariance to be held to.
    written = ["features", ("belief", "log_likelihood"), ESTIMATE]
    return Belief(
        module,
        module.feature_dim,
        observing=lambda: ParticleFilterModule(particle_filter, in_keys=_READ, out_keys=written),
    )
