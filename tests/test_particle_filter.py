"""The particle filter as a belief module, its networks, its noise and its mathematics."""

import pytest
import torch
from particle_tools import HIDDEN, LATENT, OPTIONAL, K, make_filter, make_frames, sample_noise
from refusals import refuses
from suites import ACTION, OBS, BeliefModuleSuite
from torch.distributions import Normal
from torchrl.modules import set_recurrent_mode

from torchrl_drbpn import ParticleFilterModule
from torchrl_drbpn.functional.particles import systematic_ancestors
from torchrl_drbpn.modules import particle_model


def run(filter, data):
    """Sequences from zeros, with the noise they were given."""
    shape, count = data.shape, filter.num_particles
    noise = sample_noise(shape, count, filter.latent_dim, 1)
    hidden = torch.zeros(*shape, count, filter.hidden_dim, dtype=torch.float64)
    begin = torch.zeros(shape, dtype=torch.bool)
    parts = (data["previous_action"], data["observation"], data["observed"])
    return filter(hidden, hidden[..., 0], begin, *parts, noise), noise


def gru_cell(cell, x, hidden):
    flat = cell(x.reshape(-1, x.shape[-1]), hidden.reshape(-1, hidden.shape[-1]))
    return flat.reshape(hidden.shape)


def by_hand(filter, hidden, frame, epsilon):
    """One particle, one step, network by network: log q, log p(z), log p(x | z), h, embedding."""
    x, m = frame["observation"], frame["observed"]
    seen = filter.encoder(torch.cat([x, m.double()], -1))
    action = filter.action_encoder(frame["previous_action"])

    def normal(raw, floor):
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


def test_many_particles_are_each_by_hand_over_a_resampled_memory():
    filter = make_filter(dtype=torch.float64)
    data = make_frames((2, 4))
    out, noise = run(filter, data)
    hidden = torch.zeros(2, K, HIDDEN, dtype=torch.float64)
    log_weight = torch.zeros(2, K, dtype=torch.float64)
    died, total = 0, torch.zeros((), dtype=torch.float64)
    for t in range(4):
        frame = data[:, t].unsqueeze(-1).expand(2, K)
        ancestors = systematic_ancestors(log_weight, noise.resampling[:, t])
        died += (ancestors != torch.arange(K)).sum().item()
        hidden = torch.stack([hidden[b, ancestors[b]] for b in range(2)])
        log_q, log_p, seen, hidden, phi = by_hand(filter, hidden, frame, noise.proposal[:, t])
        log_weight = seen + log_p - log_q
        torch.testing.assert_close(out.hidden[:, t], hidden)
        torch.testing.assert_close(out.log_weight[:, t], log_weight)
        likelihood = log_weight.exp().mean(-1).log()
        torch.testing.assert_close(out.log_likelihood[:, t], likelihood)
        total = total + likelihood.sum()
        each = torch.cat([hidden, phi, log_weight.softmax(-1).unsqueeze(-1)], -1)
        features = torch.zeros(2, HIDDEN, dtype=torch.float64)
        for k in range(K):
            features = gru_cell(filter.aggregator, each[:, k], features)
        torch.testing.assert_close(filter.features(out)[:, t], features)
    assert died  # resampling did something
    for network in (filter.encoder, filter.transition, filter.memory):
        parameters = list(network.parameters())
        received = torch.autograd.grad(out.log_likelihood.sum(), parameters, retain_graph=True)
        by_steps = torch.autograd.grad(total, parameters, retain_graph=True)
        torch.testing.assert_close(received, by_steps)


@pytest.mark.parametrize("name", ["previous_action", "observation"])
def test_what_is_no_number_is_named(name):
    filter, data = make_filter(dtype=torch.float64), make_frames((3, 5))
    data["observed"][:] = True
    data[name][1, 2] = torch.nan
    with pytest.raises(ValueError, match=f"`{name}` holds NaN"):
        run(filter, data)


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


def noise_of(data, age=0, **kwargs):
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


class TestSuite(BeliefModuleSuite):
    all_outputs = ("features", ("belief", "log_likelihood"), *OPTIONAL)

    def make_module(self, obs=OBS, action=ACTION, dtype=None, **kwargs):
        return ParticleFilterModule(make_filter(obs, action, dtype), **kwargs)

    def differentiable(self, out):
        return out["features"].square().mean() - out["belief", "log_likelihood"].mean()


def test_keys_are_those_of_the_belief_filter_with_particles_for_the_mean():
    module = ParticleFilterModule(make_filter())
    state = [("recurrent", "particles"), ("recurrent", "log_weight"), ("recurrent", "age")]
    assert module.in_keys == ["observation", "observed", "previous_action", "is_init", *state]
    next_state = [("next", *key) for key in state]
    assert module.out_keys == ["features", ("belief", "log_likelihood"), *next_state]
    assert module.feature_dim == HIDDEN


@pytest.mark.parametrize("over_time", [False, True])
def test_optional_entries_are_written_where_asked_for(over_time):
    data = make_frames((3, 4))
    data["is_init"][:] = not over_time
    filter = make_filter(dtype=torch.float64)
    module = ParticleFilterModule(filter, out_keys=["features", *OPTIONAL])
    with set_recurrent_mode(over_time), torch.no_grad():
        state = {k: s.expand(3, 4, *s.shape).zero() for k, s in
                 module.make_tensordict_primer().primers.items(True, True)}  # fmt: skip
        out = module(data.update(state))
    assert ("belief", "log_likelihood") not in out.keys(True)
    assert out["belief", "observation"].shape == (3, 4, OBS)
    assert out["belief", "latent"].shape == (3, 4, K, LATENT)
    share = out["belief", "effective_sample_size"]
    assert share.shape == (3, 4)
    assert (share >= 1 - 1e-9).all()
    assert (share <= K + 1e-9).all()


test_a_wrong_size_is_refused = refuses(
    ({"num_particles": 0}, "`num_particles` must be an int of at least 1, got 0"),
    ({"latent_dim": 2.0}, "`latent_dim` must be an int of at least 1, got 2.0"),
    ({"encoder_sizes": (4,)}, "`encoder_sizes` must be two sizes"),
    ({"min_std": -1.0}, "`min_std` must be at least 0, got -1.0"),
    make=make_filter,
)


def test_systematic_resampling_gives_each_particle_its_share_rounded_and_on_average_exactly():
    g = torch.Generator().manual_seed(0)
    log_weight = torch.randn(7, generator=g, dtype=torch.float64)
    uniform = (torch.arange(2000, dtype=torch.float64) + 0.5).unsqueeze(-1) / 2000
    ancestors = systematic_ancestors(log_weight.expand(2000, 7), uniform)
    share = 7 * log_weight.softmax(-1)
    offspring = torch.nn.functional.one_hot(ancestors, 7).sum(-2).double()
    assert (offspring >= share.floor()).all()
    assert (offspring <= share.ceil()).all()
    torch.testing.assert_close(offspring.mean(0), share, rtol=0, atol=2e-3)


def test_equal_weights_keep_every_particle_and_a_zero_weight_none():
    uniform = torch.tensor([[0.01], [0.5], [0.99]])
    assert systematic_ancestors(torch.zeros(3, 8), uniform).eq(torch.arange(8)).all()
    log_weight = torch.zeros(3, 4)
    log_weight[:, [0, 3]] = -torch.inf
    assert systematic_ancestors(log_weight, uniform).tolist() == [[1, 1, 2, 2]] * 3
