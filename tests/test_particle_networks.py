"""The laws of the particle filter's networks and of its noise."""

from __future__ import annotations

from typing import Any

import torch
from particle_tools import HIDDEN, K, make_filter, make_frames, sample_noise
from tensordict import TensorDict
from torch import Tensor
from torch.distributions import Normal

from torchrl_drbpn import ParticleFilter
from torchrl_drbpn.functional import ParticleNoise, ParticleOutput, systematic_ancestors
from torchrl_drbpn.modules import particle_model


def run(
    filter: ParticleFilter, data: TensorDict, begin: Tensor | None = None
) -> tuple[ParticleOutput, ParticleNoise]:
    """Sequences from zeros, with the noise they were given."""
    shape, count = data.shape, filter.num_particles
    noise = sample_noise(shape, count, filter.latent_dim, 1)
    hidden = torch.zeros(*shape, count, filter.hidden_dim, dtype=torch.float64)
    begin = torch.zeros(shape, dtype=torch.bool) if begin is None else begin
    parts = (data["previous_action"], data["observation"], data["observed"])
    return filter(hidden, hidden[..., 0], begin, *parts, noise), noise


def gru_cell(cell: torch.nn.GRUCell, x: Tensor, hidden: Tensor) -> Tensor:
    flat = cell(x.reshape(-1, x.shape[-1]), hidden.reshape(-1, hidden.shape[-1]))
    return flat.reshape(hidden.shape)


def by_hand(
    filter: ParticleFilter, hidden: Tensor, frame: TensorDict, epsilon: Tensor
) -> tuple[Tensor, ...]:
    """One particle, one step, network by network: log q, log p(z), log p(x | z), h, embedding."""
    x, m = frame["observation"], frame["observed"]
    seen = filter.encoder(torch.cat([x, m.double()], -1))
    action = filter.action_encoder(frame["previous_action"])

    def normal(raw: Tensor, floor: float) -> Normal:
        mean, spread = raw.chunk(2, -1)
        return Normal(mean, (torch.nn.functional.softplus(spread) + floor**2).sqrt())

    proposed = filter.proposal(torch.cat([hidden, seen, action], -1)).relu()
    moved = filter.transition(torch.cat([hidden, action], -1)).relu()
    q = normal(filter.proposal_head(proposed), filter.latent_min_std)
    p = normal(filter.transition_head(moved), filter.latent_min_std)
    z = q.loc + q.scale * epsilon
    phi = filter.latent_encoder(z)
    decoded = filter.decoder(filter.emission(torch.cat([hidden, phi, action], -1)).relu())
    sensors = normal(filter.emission_head(decoded), filter.min_std)
    memory = gru_cell(filter.memory, torch.cat([phi, seen, action], -1), hidden)
    seen_density = torch.where(m, sensors.log_prob(x), 0.0).sum(-1)
    return q.log_prob(z).sum(-1), p.log_prob(z).sum(-1), seen_density, memory, phi


def test_one_particle_is_the_sequential_variational_bound():
    filter = make_filter(dtype=torch.float64, num_particles=1)
    data = make_frames((3, 6))
    out, noise = run(filter, data)
    hidden, expected, features = torch.zeros(3, HIDDEN, dtype=torch.float64), [], []
    for t in range(6):
        log_q, log_p, seen, hidden, phi = by_hand(
            filter, hidden, data[:, t], noise.proposal[:, t, 0]
        )
        expected.append(seen + log_p - log_q)
        weight = torch.ones(3, 1, dtype=torch.float64)
        features.append(filter.aggregator(torch.cat([hidden, phi, weight], -1)))
    torch.testing.assert_close(out.log_likelihood, torch.stack(expected, 1))
    torch.testing.assert_close(filter.features(out), torch.stack(features, 1))
    # and so are its gradients
    received = torch.autograd.grad(out.log_likelihood.sum(), filter.encoder.parameters())
    by_steps = torch.autograd.grad(torch.stack(expected).sum(), filter.encoder.parameters())
    torch.testing.assert_close(received, by_steps)


def test_many_particles_are_each_by_hand_over_a_resampled_memory():
    filter = make_filter(dtype=torch.float64)
    data = make_frames((2, 4))
    out, noise = run(filter, data)
    hidden = torch.zeros(2, K, HIDDEN, dtype=torch.float64)
    log_weight = torch.zeros(2, K, dtype=torch.float64)
    died = 0
    for t in range(4):
        frame = data[:, t].unsqueeze(-1).expand(2, K)
        ancestors = systematic_ancestors(log_weight, noise.resampling[:, t])
        died += (ancestors != torch.arange(K)).sum().item()
        hidden = torch.stack([hidden[b, ancestors[b]] for b in range(2)])
        log_q, log_p, seen, hidden, phi = by_hand(filter, hidden, frame, noise.proposal[:, t])
        log_weight = seen + log_p - log_q
        torch.testing.assert_close(out.hidden[:, t], hidden)
        torch.testing.assert_close(out.log_weight[:, t], log_weight)
        torch.testing.assert_close(out.log_likelihood[:, t], log_weight.exp().mean(-1).log())
        each = torch.cat([hidden, phi, log_weight.softmax(-1).unsqueeze(-1)], -1)
        features = torch.zeros(2, HIDDEN, dtype=torch.float64)
        for k in range(K):
            features = gru_cell(filter.aggregator, each[:, k], features)
        torch.testing.assert_close(filter.features(out)[:, t], features)
    assert died  # resampling did something


def test_nothing_observed_leaves_the_ratio_of_transition_and_proposal_and_the_mask_is_read():
    filter = make_filter(dtype=torch.float64, num_particles=1)
    data = make_frames((3, 5))
    data["observed"][:] = False
    data["observation"][:] = torch.nan
    out, noise = run(filter, data)
    assert all(part.isfinite().all() for part in out)
    data["observation"][:] = 0.0
    hidden = torch.zeros(3, HIDDEN, dtype=torch.float64)
    for t in range(5):
        log_q, log_p, seen, hidden, _ = by_hand(filter, hidden, data[:, t], noise.proposal[:, t, 0])
        assert not seen.any()
        torch.testing.assert_close(out.log_likelihood[:, t], log_p - log_q)
    # a zero that arrived is not a zero that did not
    data["observed"][..., 0] = True
    assert not torch.allclose(run(filter, data)[0].hidden, out.hidden)


def test_variances_never_fall_under_their_floor():
    filter = make_filter(dtype=torch.float64, min_std=0.5, latent_min_std=0.1)
    with torch.no_grad():
        for head in (filter.emission_head, filter.proposal_head, filter.transition_head):
            head.bias[head.out_features // 2 :] = -1e3
    shared = (torch.randn(2, 5).double(), torch.randn(2, 3).double())
    networks = particle_model._Networks(filter)
    hidden = torch.zeros(2, K, HIDDEN, dtype=torch.float64)
    proposed = networks.propose(hidden, shared)
    outcome = networks.step(proposed.proposal.mean, hidden, shared)
    for gaussian, floor in (
        (proposed.proposal, 0.1),
        (proposed.transition, 0.1),
        (outcome.emission, 0.5),
    ):
        torch.testing.assert_close(gaussian.variance, torch.full_like(gaussian.mean, floor**2))


def noise_of(data: TensorDict, age: int = 0, **kwargs: Any) -> ParticleNoise:
    filter = make_filter(dtype=torch.float64, **kwargs)
    ages = torch.full((*data.shape, 1), age)
    return filter.noise(data["previous_action"], data["observation"], data["observed"], ages)


def test_a_step_has_one_noise_in_either_dtype_and_another_step_another():
    data, state = make_frames((50,)), torch.get_rng_state()
    for key in ("observation", "previous_action"):
        data[key] = data[key].float()
    noise = noise_of(data)
    assert torch.equal(torch.get_rng_state(), state)
    assert all(map(torch.equal, noise, noise_of(data.double().set("observed", data["observed"]))))
    changed = [noise_of(data, age=1), noise_of(data, noise_seed=1)]
    for key in ("observation", "previous_action"):
        other = data.clone()
        other[key] += 1e-3
        changed.append(noise_of(other.set("observed", torch.ones_like(data["observed"]))))
    for one in changed:
        for new, old in zip(one, noise, strict=True):
            assert not (new == old).flatten(1).all(1).any()


def test_the_noise_is_normal_uniform_and_uncorrelated():
    noise = noise_of(make_frames((4000,)), num_particles=2, latent_dim=2)
    z = noise.proposal.flatten(1)
    assert z.mean(0).abs().max() < 4 / 4000**0.5
    assert (z.std(0) - 1).abs().max() < 4 / 8000**0.5
    both = torch.cat([z, noise.resampling], -1)
    assert (torch.corrcoef(both.mT) - torch.eye(5)).abs().max() < 4.5 / 4000**0.5
    rows = torch.stack([z[:-1, 0], z[1:, 0]])
    assert torch.corrcoef(rows)[0, 1].abs() < 4 / 4000**0.5
    ordered = noise.resampling.flatten().sort().values
    grid = (torch.arange(4000) + 0.5) / 4000
    assert (ordered - grid).abs().max() < 2 / 4000**0.5  # Kolmogorov and Smirnov
    assert ordered[0] >= 0
    assert ordered[-1] < 1
