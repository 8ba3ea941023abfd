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


# ------------------------------------------------------------------------------ densities, weights
def diagonal_log_density(
    value: Tensor, gaussian: DiagonalGaussian, observed: Tensor | None = None
) -> Tensor:
    r"""Evaluate log N(value; mean, diag(variance)) on the observed entries.

    .. math:: \log p = -\tfrac12 \sum_{i: m_i}
        \left( (x_i - \mu_i)^2 / v_i + \log v_i + \log 2\pi \right)

    Of ``value`` x ``(*batch, dim)``, a Gaussian that broadcasts with it, and the bool mask m, None:
    everything arrived. Nats, ``(*batch,)``; with nothing observed exactly 0.

    Example:
        >>> gaussian = DiagonalGaussian(torch.zeros(2), torch.ones(2))
        >>> x, seen = torch.tensor([1.0, float("nan")]), torch.tensor([True, False])
        >>> one = torch.distributions.Normal(0.0, 1.0).log_prob(x[0])
        >>> bool(torch.isclose(diagonal_log_density(x, gaussian, seen), one))
        True
    """
    mean, variance = gaussian
    if observed is not None:
        # Before any arithmetic: a NaN under a False mask must reach neither value nor gradient.
        value = zero_missing(value, observed)
    terms = (value - mean).square() / variance + variance.log() + LOG_2PI
    return -0.5 * (terms if observed is None else zero_missing(terms, observed)).sum(-1)


def log_mean_weight(log_weight: Tensor) -> Tensor:
    r"""Estimate the likelihood of a step: the log of the particles' mean weight.

    .. math:: \log \hat p(x_t \mid x_{<t}) = \log \frac1K \sum_k w_t^k

    §3.2 [DVRL 2018]: its sum over time is, in expectation, a lower bound of the marginal
    log-likelihood. From ``(*batch, particles)`` to ``(*batch,)``, nats.

    Example:
        >>> log_mean_weight(torch.tensor([2.0, 4.0]).log()).exp().item()
        3.0
    """
    return log_weight.logsumexp(-1) - math.log(log_weight.shape[-1])


def effective_sample_size(log_weight: Tensor) -> Tensor:
    r"""Count the equally weighted particles that would estimate as well as these.

    .. math:: \mathrm{ESS} = 1 / \sum_k \bar w_k^2

    From log-weights ``(*batch, particles)``, which need not be normalised, to ``(*batch,)``.

    Example:
        >>> round(effective_sample_size(torch.zeros(8)).item(), 4)
        8.0
    """
    return 1.0 / log_weight.softmax(-1).square().sum(-1)


# -------------------------------------------------------------------------------------- resampling
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


def resample(values: Tensor, ancestors: Tensor) -> Tensor:
    """Let each particle take over what its ancestor holds.

    Values ``(*batch, particles, dim)``, int64 ancestors ``(*batch, particles)``; the gradient goes
    to the ancestors.

    Example:
        >>> resample(torch.tensor([[1.0], [2.0], [3.0]]), torch.tensor([0, 0, 2])).tolist()
        [[1.0], [1.0], [3.0]]
    """
    return values.gather(-2, ancestors.unsqueeze(-1).expand_as(values))


# --------------------------------------------------------------------------- one step, one sequence
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
    hidden = resample(hidden, systematic_ancestors(log_weight, noise.resampling))
    proposal, transition = model.propose(hidden, inputs)
    latent = proposal.mean + proposal.variance.sqrt() * noise.proposal
    step = model.step(latent, hidden, inputs)
    # log p - log q: the constants cancel, and (z - mean_q)^2 / variance_q is the noise squared.
    surprise = (latent - transition.mean).square() / transition.variance
    ratio = noise.proposal.square() - surprise + (proposal.variance / transition.variance).log()
    seen = diagonal_log_density(observation.unsqueeze(-2), step.emission, observed.unsqueeze(-2))
    log_weight = 0.5 * ratio.sum(-1) + seen
    return ParticleOutput(
        step.hidden,
        log_weight,
        log_mean_weight(log_weight),
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
