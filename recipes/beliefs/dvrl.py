"""Deep variational reinforcement learning as the belief module of a recipe: a particle filter."""

from __future__ import annotations

from collections.abc import Sequence

from beliefs import ESTIMATE, OBSERVATION, Belief
from torchrl_drbpn import ParticleFilter, ParticleFilterModule

_READ = {"observation": OBSERVATION}


def build(
    *,
    obs_dim: int,
    action_dim: int,
    num_particles: int,
    hidden_dim: int,
    latent_dim: int,
    encoder_sizes: Sequence[int],
    action_width: int,
    min_std: float,
    latent_min_std: float,
    noise_seed: int,
) -> Belief:
    """Build the particle filter; its evidence lower bound is the model loss.

    Args:
        obs_dim: components of an observation.
        action_dim: components of an action.
        num_particles: how many particles.
        hidden_dim: components of a particle's memory, and of the features.
        latent_dim: components of a particle's latent.
        encoder_sizes: units of the two layers that read an observation.
        action_width: units of the layer that reads an action.
        min_std: floor of the emission's standard deviation, normalised observation units.
        latent_min_std: floor of the latent's.
        noise_seed: of the noise table.

    Returns:
        The belief.
    """
    particle_filter = ParticleFilter(
        obs_dim,
        action_dim,
        num_particles=num_particles,
        hidden_dim=hidden_dim,
        latent_dim=latent_dim,
        encoder_sizes=encoder_sizes,
        action_width=action_width,
        min_std=min_std,
        latent_min_std=latent_min_std,
        noise_seed=noise_seed,
    )
    module = ParticleFilterModule(particle_filter, in_keys=_READ)
    # The particles' mean; a mixture of Gaussians has no single covariance to be held to.
    written = ["features", ("belief", "log_likelihood"), ESTIMATE]
    return Belief(
        module,
        module.feature_dim,
        observing=lambda: ParticleFilterModule(particle_filter, in_keys=_READ, out_keys=written),
    )
