"""A small particle filter of fixed parameters, and frames for it."""

import torch
from suites import ACTION, OBS, BeliefModuleSuite

from torchrl_drbpn import ParticleFilter
from torchrl_drbpn.functional import ParticleNoise

K, HIDDEN, LATENT = 4, 6, 3
OPTIONAL = (("belief", "observation"), ("belief", "latent"), ("belief", "effective_sample_size"))


def make_filter(obs=OBS, action=ACTION, dtype=None, **kwargs):
    sizes = {"num_particles": K, "hidden_dim": HIDDEN, "latent_dim": LATENT}
    sizes |= {"encoder_sizes": (7, 5), "action_width": 3}
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return ParticleFilter(obs, action, dtype=dtype, **(sizes | kwargs))


def make_frames(shape, seed=0):
    return BeliefModuleSuite().make_frames(shape, torch.float64, seed)


def sample_noise(shape, particles, latent, seed):
    g = torch.Generator().manual_seed(seed)
    proposal = torch.randn(*shape, particles, latent, generator=g, dtype=torch.float64)
    return ParticleNoise(proposal, torch.rand(*shape, 1, generator=g, dtype=torch.float64))
