"""The networks of deep variational reinforcement learning, and their particle filter on tensors."""

import functools
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, softplus

from torchrl_drbpn.functional import (
    DiagonalGaussian,
    ParticleNoise,
    ParticleOutput,
    ParticleStep,
    ProposalOutput,
    particle_sequence,
    zero_missing,
)
from torchrl_drbpn.functional.gaussian import check_observed
from torchrl_drbpn.modules.belief_checks import checked
from torchrl_drbpn.modules.state_space import check_dim

_ENTRIES = 1 << 18  # places in the noise table: 1 MB in float32
_WORD, _MIX = (1 << 32) - 1, (0x7FB5D329728EA185, 0x1B03738712FAD5C9)


class ParticleFilter(nn.Module):
    r"""Filter with particles whose proposal, transition and emission are learned.

    .. math::
        z_t \sim q(z \mid h_{t-1}, x_t^{obs}, m_t, a_{t-1}), \qquad
        h_t = \mathrm{GRU}(h_{t-1}, [z_t, x_t^{obs}, m_t, a_{t-1}]), \qquad
        w_t = \frac{p(z_t \mid h_{t-1}, a_{t-1})\; p(x_t^{obs} \mid h_{t-1}, z_t, a_{t-1})}
                   {q(z_t \mid \cdot)}

    §3 [DVRL 2018] with the networks and widths of its authors' code for vector observations.
    Every step begins by resampling the particles of the step before (systematic); a recurrent
    network over the particles, each with its weight, makes the features. Differs from it: the
    encoder reads the mask beside the observation, the emission counts the entries that arrived,
    and variances have a floor, without which the likelihood of clean data has no bound.

    Args:
        obs_dim, action_dim: components of an observation, of an action.
        num_particles: K; one particle is a sequential variational auto-encoder.
        hidden_dim: components of h, and of the features.
        latent_dim: components of z.
        encoder_sizes: units of the two layers that read an observation; the decoder mirrors them.
        action_width: units of the layer that reads an action.
        min_std: floor of the emission's standard deviation, observation units.
        latent_min_std: floor of the proposal's and the transition's.
        noise_seed: of the table that the noise is read from, see :meth:`noise`.
        validate: as in :class:`~torchrl_drbpn.BeliefFilter`.
        device, dtype: of the parameters.

    Raises:
        ValueError: for a size under 1, a negative floor, or inputs of the wrong shape.

    Example:
        >>> filter = ParticleFilter(5, 2, num_particles=4, hidden_dim=8, latent_dim=3)
        >>> step = torch.zeros(6, 2), torch.randn(6, 5), torch.rand(6, 5) < 0.7
        >>> noise = filter.noise(*step, torch.zeros(6, 1).long())
        >>> out = filter.step(torch.zeros(6, 4, 8), torch.zeros(6, 4), *step, noise)
        >>> filter.features(out).shape, out.log_likelihood.shape
        (torch.Size([6, 8]), torch.Size([6]))
    """

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        *,
        num_particles: int = 10,
        hidden_dim: int = 128,
        latent_dim: int = 256,
        encoder_sizes: Sequence[int] = (64, 64),
        action_width: int = 64,
        min_std: float = 1e-2,
        latent_min_std: float = 1e-3,
        noise_seed: int = 0,
        validate: bool = True,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        sizes = {"obs_dim": obs_dim, "action_dim": action_dim, "num_particles": num_particles}
        sizes |= {"hidden_dim": hidden_dim, "latent_dim": latent_dim, "action_width": action_width}
        sizes |= {f"encoder_sizes[{i}]": size for i, size in enumerate(encoder_sizes)}
        for name, size in sizes.items():
            check_dim(name, size)
        if len(encoder_sizes) != 2:
            raise ValueError(f"`encoder_sizes` must be two sizes, got {list(encoder_sizes)}.")
        for name, value in (("min_std", min_std), ("latent_min_std", latent_min_std)):
            if not value >= 0:
                raise ValueError(f"`{name}` must be at least 0, got {value}.")
        self.obs_dim, self.action_dim = obs_dim, action_dim
        self.num_particles, self.hidden_dim, self.latent_dim = num_particles, hidden_dim, latent_dim
        self.min_std, self.latent_min_std = min_std, latent_min_std
        self.noise_seed, self.validate = noise_seed, validate

        first, last = encoder_sizes
        given: dict[str, Any] = {"device": device, "dtype": dtype}
        self.encoder = _layers([2 * obs_dim, first, last], given)
        self.action_encoder = _layers([action_dim, action_width], given)
        self.latent_encoder = _layers([latent_dim, hidden_dim], given)
        self.proposal = nn.Linear(hidden_dim + last + action_width, hidden_dim, **given)
        self.proposal_head = nn.Linear(hidden_dim, 2 * latent_dim, **given)
        self.transition = nn.Linear(hidden_dim + action_width, hidden_dim, **given)
        self.transition_head = nn.Linear(hidden_dim, 2 * latent_dim, **given)
        self.emission = nn.Linear(2 * hidden_dim + action_width, last, **given)
        self.decoder = _layers([last, first], given)
        self.emission_head = nn.Linear(first, 2 * obs_dim, **given)
        self.memory = nn.GRUCell(hidden_dim + last + action_width, hidden_dim, **given)
        particle = 2 * hidden_dim + 1
        # Weights of a GRU over the particles; torch.compile does not let an nn.GRU hold them.
        self.aggregator: nn.Linear | nn.GRUCell = (
            nn.Linear(particle, hidden_dim, **given)
            if num_particles == 1
            else nn.GRUCell(particle, hidden_dim, **given)
        )
        self.reset_parameters()

        generator = torch.Generator().manual_seed(noise_seed)
        window = num_particles * latent_dim
        table = torch.randn(_ENTRIES + window - 1, generator=generator, dtype=dtype)
        words = 2 * obs_dim + action_dim + 1
        multipliers = torch.randint(-(1 << 62), 1 << 62, (words,), generator=generator)
        # They follow from the seed: no checkpoint has to hold them.
        self.noise_table = nn.Buffer(table.to(device), persistent=False)
        self.noise_multipliers = nn.Buffer((2 * multipliers + 1).to(device), persistent=False)

    def reset_parameters(self) -> None:
        """Start again: orthogonal weights and zero biases, as the authors' code has them."""
        gain = nn.init.calculate_gain("relu")
        for name, parameter in self.memory.named_parameters():
            (nn.init.orthogonal_ if "weight" in name else nn.init.zeros_)(parameter)
        if isinstance(self.aggregator, nn.GRUCell):
            self.aggregator.reset_parameters()  # PyTorch's own, in the authors' code too
        for name, part in self.named_modules():
            if isinstance(part, nn.Linear):
                # A head is two layers in one: mean and variance are orthogonal each by itself.
                for block in part.weight.chunk(2 if name.endswith("_head") else 1):
                    nn.init.orthogonal_(block, gain)
                nn.init.zeros_(part.bias)

    def forward(
        self,
        hidden: Tensor,
        log_weight: Tensor,
        begin: Tensor,
        previous_action: Tensor,
        observation: Tensor,
        observed: Tensor,
        noise: ParticleNoise,
    ) -> ParticleOutput:
        """Filter sequences: :func:`~torchrl_drbpn.functional.particle_sequence` of the networks.

        ``hidden`` and ``log_weight`` are read at the first step and where ``begin`` says so; zeros
        start an episode. ``observation``, ``observed``, True = arrived, and ``previous_action`` are
        ``(*batch, time, n)``; for ``noise`` see :meth:`noise`. A ValueError for a mask of another
        shape, or values that are not finite.
        """
        check_observed(observation, observed)
        zeroed = zero_missing(observation, observed)
        seen = self.encoder(torch.cat([zeroed, observed.to(zeroed.dtype)], -1))
        action = self.action_encoder(previous_action)
        given = (hidden, log_weight, begin, (seen, action), zeroed, observed, noise)
        run = functools.partial(particle_sequence, _Networks(self), *given)
        others = {"previous_action": previous_action, "hidden": hidden}
        return checked(run, self.validate, observation, observed, **others)

    def step(
        self,
        hidden: Tensor,
        log_weight: Tensor,
        previous_action: Tensor,
        observation: Tensor,
        observed: Tensor,
        noise: ParticleNoise,
    ) -> ParticleOutput:
        """Filter one step, any batch: :meth:`forward` without time in arguments and results."""
        begin = torch.ones((*observation.shape[:-1], 1), dtype=torch.bool, device=hidden.device)
        rank = observation.ndim - 1
        state = hidden.unsqueeze(rank), log_weight.unsqueeze(rank), begin
        inputs = (part.unsqueeze(rank) for part in (previous_action, observation, observed))
        out = self(*state, *inputs, ParticleNoise(*(part.unsqueeze(rank) for part in noise)))
        return ParticleOutput(*(part.squeeze(rank) for part in out))

    def features(self, particles: ParticleOutput) -> Tensor:
        """Gather particles into one vector ``(*batch, [time,] hidden)``: a recurrent network."""
        weight = particles.log_weight.softmax(-1).unsqueeze(-1)
        each = torch.cat([particles.hidden, particles.embedding, weight], -1)
        net = self.aggregator
        if isinstance(net, nn.Linear):
            return linear(each.squeeze(-2), net.weight, net.bias)
        flat = each.reshape(-1, *each.shape[-2:])
        start = flat.new_zeros(1, flat.shape[0], self.hidden_dim)
        weights = [net.weight_ih, net.weight_hh, net.bias_ih, net.bias_hh]
        _, last = torch.gru(flat, start, weights, True, 1, 0.0, self.training, False, True)
        return last.reshape(*each.shape[:-2], self.hidden_dim)

    @torch.no_grad()
    def noise(
        self, previous_action: Tensor, observation: Tensor, observed: Tensor, age: Tensor
    ) -> ParticleNoise:
        """Look up the noise of a step: pseudo-random, and the same at every call.

        PPO compares the policy that collected a step with the policy that learns from it, so
        both must see the same particles. The inputs of a step (observation, mask, action, age) are
        hashed; the hash chooses a place in a fixed table of standard normal numbers, drawn from
        ``noise_seed``, and the start of the resampling. So a step has one noise in the collector,
        in GAE and in the loss, and nothing is stored. Numbers are read in float32, so that casting
        data keeps its noise. ``age``, int64 ``(*batch, 1)``, counts steps since the reset.
        """
        # Adding 0 turns -0 into 0.
        numbers = torch.cat([zero_missing(observation, observed), previous_action], -1) + 0.0
        bits = numbers.to(torch.float32).contiguous().view(torch.int32)
        words = torch.cat([bits.to(torch.int64), observed.to(torch.int64), age], -1)
        # Multilinear hashing of 32-bit words modulo 2**64, then a mixing of its bits.
        key = (words * self.noise_multipliers).sum(-1)
        for factor in _MIX:
            key = (key ^ ((key >> 32) & _WORD)) * factor
        key = key ^ ((key >> 32) & _WORD)
        place = key & (_ENTRIES - 1)
        uniform = ((key >> 32) & 0xFFFFFF).to(self.noise_table.dtype) / (1 << 24)
        window = self.num_particles * self.latent_dim
        offset = torch.arange(window, device=key.device)
        proposal = self.noise_table[place.unsqueeze(-1) + offset]
        shape = (*key.shape, self.num_particles, self.latent_dim)
        return ParticleNoise(proposal.reshape(shape), uniform.unsqueeze(-1))


class _Networks(NamedTuple):
    """The filter's networks as a :class:`~torchrl_drbpn.functional.ParticleModel`."""

    parts: ParticleFilter

    def propose(self, hidden: Tensor, inputs: tuple[Tensor, ...]) -> ProposalOutput:
        parts, floor = self.parts, self.parts.latent_min_std**2
        seen, action = _each(inputs, hidden)
        q = parts.proposal(torch.cat([hidden, seen, action], -1)).relu()
        p = parts.transition(torch.cat([hidden, action], -1)).relu()
        proposal = _gaussian(parts.proposal_head(q), floor)
        return ProposalOutput(proposal, _gaussian(parts.transition_head(p), floor))

    def step(self, latent: Tensor, hidden: Tensor, inputs: tuple[Tensor, ...]) -> ParticleStep:
        parts, (seen, action) = self.parts, _each(inputs, hidden)
        embedding = parts.latent_encoder(latent)
        x = parts.emission(torch.cat([hidden, embedding, action], -1)).relu()
        emission = _gaussian(parts.emission_head(parts.decoder(x)), parts.min_std**2)
        rows = torch.cat([embedding, seen, action], -1).flatten(0, -2), hidden.flatten(0, -2)
        return ParticleStep(emission, parts.memory(*rows).view_as(hidden), embedding)


def _each(inputs: tuple[Tensor, ...], hidden: Tensor) -> list[Tensor]:
    """Give every particle what its row shares."""
    return [x.unsqueeze(-2).expand(*hidden.shape[:-1], x.shape[-1]) for x in inputs]


def _gaussian(raw: Tensor, floor: float) -> DiagonalGaussian:
    mean, spread = raw.chunk(2, -1)
    return DiagonalGaussian(mean, softplus(spread) + floor)


def _layers(sizes: Sequence[int], given: dict[str, Any]) -> nn.Sequential:
    """Make linear layers, each with a ReLU behind it."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [nn.Linear(inputs, outputs, **given), nn.ReLU()]
    return nn.Sequential(*layers)
