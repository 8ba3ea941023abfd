"""A particle filter with a learned proposal: weights, resampling, one step, a whole sequence.

The filter of deep variational reinforcement learning ([DVRL 2018]: Igl, Zintgraf, Le, Wood and
Whiteson, *Deep Variational Reinforcement Learning for POMDPs*, ICML 2018). A particle is a
deterministic memory h and a stochastic latent z. No random number is drawn here: the noise of a
step is an argument. k counts particles, K is their number, q the proposal, p the model.
"""

import math
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import LOG_2PI, zero_missing


class DiagonalGaussian(NamedTuple):
    """Hold N(mean, diag(variance)), both ``(*batch, dim)`` or what broadcasts to it."""

    mean: Tensor
    variance: Tensor


class ParticleNoise(NamedTuple):
    """Hold the random numbers of a step; given them the filter is deterministic.

    Args:
        proposal: standard normal, shape ``(*batch, [time,] particles, latent)``.
        resampling: uniform on [0, 1), shape ``(*batch, [time,] 1)``.
    """

    proposal: Tensor
    resampling: Tensor


class ProposalOutput(NamedTuple):
    """Hold q(z | h, x, a) and p(z | h, a), each ``(*batch, particles, latent)``."""

    proposal: DiagonalGaussian
    transition: DiagonalGaussian


class ParticleStep(NamedTuple):
    """Hold p(x | h, z, a) over ``obs``, the next h, and further features, of every particle."""

    emission: DiagonalGaussian
    hidden: Tensor
    embedding: Tensor


class ParticleModel(Protocol):
    """Declare what a model offers: two functions of all particles of all rows at once.

    ``inputs``, ``(*batch, n)``, is what it computes from a step's observation, mask and action.
    """

    def propose(self, hidden: Tensor, inputs: tuple[Tensor, ...]) -> ProposalOutput:
        """Return q(z | h, x, a) and p(z | h, a)."""

    def step(self, latent: Tensor, hidden: Tensor, inputs: tuple[Tensor, ...]) -> ParticleStep:
        """Return p(x | h, z, a) and the next h."""


class ParticleOutput(NamedTuple):
    """Hold the particles after a step, or after every step of a sequence.

    Args:
        hidden: h, shape ``(*batch, [time,] particles, hidden)``.
        log_weight: unnormalised, of this step alone, shape ``(*batch, [time,] particles)``, nats.
        log_likelihood: log of the mean weight, shape ``(*batch, [time])``, nats.
        embedding: shape ``(*batch, [time,] particles, embedding)``.
        latent: z, shape ``(*batch, [time,] particles, latent)``.
        expected: mean of the emission, shape ``(*batch, [time,] particles, obs)``.
    """

    hidden: Tensor
    log_weight: Tensor
    log_likelihood: Tensor
    embedding: Tensor
    latent: Tensor
    expected: Tensor


@torch.no_grad()
def systematic_ancestors(log_weight: Tensor, uniform: Tensor) -> Tensor:
    r"""Choose the particles that go on, by systematic resampling.

    .. math:: a_k = \min \{ j : \sum_{i \le j} \bar w_i > (k + u) / K \}, \qquad k = 0..K-1

    Particle j has K w_j offspring in expectation, and that rounded up or down in every draw. No
    gradient flows through the choice, as in [DVRL 2018]. From log-weights ``(*batch, particles)``,
    which need not be normalised, and u on [0, 1), ``(*batch, 1)``, to ascending int64 ancestors
    ``(*batch, particles)``.

    Example:
        >>> log_weight = torch.tensor([0.5, 0.0, 0.25, 0.25]).log()
        >>> systematic_ancestors(log_weight, torch.tensor([0.5])).tolist()
        [0, 0, 2, 3]
    """
    count = log_weight.shape[-1]
    total = log_weight.softmax(-1).cumsum(-1)
    total = total / total[..., -1:]  # rounding leaves the last sum a little off 1
    place = torch.arange(count, dtype=uniform.dtype, device=uniform.device)
    position = ((place + uniform) / count).to(total.dtype)
    return torch.searchsorted(total, position, right=True).clamp_max(count - 1)


def particle_step(
    model: ParticleModel,
    hidden: Tensor,
    log_weight: Tensor,
    inputs: tuple[Tensor, ...],
    observation: Tensor,
    observed: Tensor,
    noise: ParticleNoise,
) -> ParticleOutput:
    r"""Resample, propose, weigh: one step of every particle of every row.

    .. math::
        h' = h^{a_k}, \quad a \sim w_{t-1}; \qquad z \sim q(z \mid h', x_t, a_{t-1}); \qquad
        \log w_t = \log p(z \mid h', a_{t-1}) - \log q(z \mid h', x_t, a_{t-1})
        + \log p(x_t^{obs} \mid h', z, a_{t-1})

    Algorithm 1 [DVRL 2018]; differs from it in the last term, which counts the entries that
    arrived. With nothing observed the weight is p / q alone. ``hidden`` and ``log_weight`` are in
    the :class:`ParticleOutput` of the step before, zeros at a start; ``observation`` and the bool
    ``observed``, True = arrived, are ``(*batch, obs)``. :func:`particle_sequence` has an example.
    """
    ancestors = systematic_ancestors(log_weight, noise.resampling)
    hidden = hidden.gather(-2, ancestors.unsqueeze(-1).expand_as(hidden))
    proposal, transition = model.propose(hidden, inputs)
    latent = proposal.mean + proposal.variance.sqrt() * noise.proposal
    step = model.step(latent, hidden, inputs)
    # log p - log q: the constants cancel, and (z - mean_q)^2 / variance_q is the noise squared.
    surprise = (latent - transition.mean).square() / transition.variance
    ratio = noise.proposal.square() - surprise + (proposal.variance / transition.variance).log()
    # Filled before any arithmetic: a NaN under a False mask must reach neither value nor gradient.
    arrived = zero_missing(observation, observed).unsqueeze(-2)
    mean, variance = step.emission
    terms = (arrived - mean).square() / variance + variance.log() + LOG_2PI
    log_weight = 0.5 * (ratio.sum(-1) - zero_missing(terms, observed.unsqueeze(-2)).sum(-1))
    return ParticleOutput(
        step.hidden,
        log_weight,
        log_weight.logsumexp(-1) - math.log(log_weight.shape[-1]),
        step.embedding,
        latent,
        step.emission.mean,
    )


def particle_sequence(
    model: ParticleModel,
    hidden: Tensor,
    log_weight: Tensor,
    begin: Tensor,
    inputs: tuple[Tensor, ...],
    observation: Tensor,
    observed: Tensor,
    noise: ParticleNoise,
) -> ParticleOutput:
    """Run :func:`particle_step` over time, the last dimension of the batch of all arguments.

    ``begin``, bool ``(*batch, time)``, says where a step starts from the ``hidden`` and
    ``log_weight`` given for it, as the first one does, not from those of the step before. Zeros are
    an episode's start.

    Example:
        >>> class Walk:  # z = h + noise, seen with noise; proposed from the transition itself
        ...     def propose(self, hidden, inputs):
        ...         moved = DiagonalGaussian(hidden, torch.ones_like(hidden))
        ...         return ProposalOutput(moved, moved)
        ...     def step(self, latent, hidden, inputs):
        ...         seen = DiagonalGaussian(latent, torch.ones_like(latent))
        ...         return ParticleStep(seen, latent, latent)
        >>> noise = ParticleNoise(torch.randn(2, 5, 8, 3), torch.rand(2, 5, 1))
        >>> h, x = torch.zeros(2, 5, 8, 3), torch.zeros(2, 5, 3)
        >>> out = particle_sequence(Walk(), h, h[..., 0], x[..., 0] > 0, (), x, x > 0, noise)
        >>> bool((out.log_likelihood.abs() < 1e-6).all())  # q = p and nothing seen: weight 1
        True
    """
    dim = observation.ndim - 2  # time
    steps = zip(
        *(x.unbind(dim) for x in (hidden, log_weight, begin.unsqueeze(-1), observation, observed)),
        *(x.unbind(dim) for x in (*noise, *inputs)),
        strict=True,
    )
    outs: list[ParticleOutput] = []
    for given, weight, begins, x, m, proposal, resampling, *step_inputs in steps:
        if outs:
            given = torch.where(begins.unsqueeze(-1), given, outs[-1].hidden)
            weight = torch.where(begins, weight, outs[-1].log_weight)
        step_noise = ParticleNoise(proposal, resampling)
        outs.append(particle_step(model, given, weight, tuple(step_inputs), x, m, step_noise))
    return ParticleOutput(*(torch.stack(parts, dim) for parts in zip(*outs, strict=True)))
