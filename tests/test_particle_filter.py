"""What the particle filter is held to: its laws, the duties of a belief module, PPO's invariants.

Laws: one particle gives the sequential variational bound; on a linear-Gaussian system the mean
weight is unbiased for Kalman's likelihood and its log converges to it; systematic resampling keeps
the right number of offspring; what is missing has no influence; no gradient through the choice of
ancestors. In a pipeline: on fresh data, before any update, PPO's ratio is 1 although particles are
random, and GAE sees the values of the features that the collector stored.
"""

from __future__ import annotations

import functools
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from agents import ACTION as POLE_ACTION
from agents import OBS as POLE_OBS
from agents import Agent, collect, make_agent
from contracts import ACTION, OBS, BeliefModuleContract, StaircaseEnv, with_belief_entries
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.distributions import Normal
from torchrl.envs import Compose, TransformedEnv
from torchrl.envs.utils import step_mdp
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.objectives.value.functional import generalized_advantage_estimate

from torchrl_drbpn import BeliefModelLoss, DRBPNLoss, ParticleFilter, ParticleFilterModule
from torchrl_drbpn.functional import (
    Belief,
    DiagonalGaussian,
    Outcome,
    ParticleNoise,
    ParticleOutput,
    Prospect,
    StateSpace,
    diagonal_log_density,
    effective_sample_size,
    filter_sequence,
    log_likelihood,
    log_mean_weight,
    particle_sequence,
    predict,
    resample,
    systematic_ancestors,
    update,
)

K, HIDDEN, LATENT = 4, 6, 3
OPTIONAL = (("belief", "observation"), ("belief", "latent"), ("belief", "effective_sample_size"))


def make_filter(
    obs: int = OBS, action: int = ACTION, dtype: torch.dtype | None = None, **kwargs: Any
) -> ParticleFilter:
    """A small filter of fixed parameters."""
    sizes = {"num_particles": K, "hidden_dim": HIDDEN, "latent_dim": LATENT}
    sizes |= {"encoder_sizes": (7, 5), "action_width": 3}
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return ParticleFilter(obs, action, dtype=dtype, **(sizes | kwargs))


def make_frames(shape: tuple[int, ...], seed: int = 0) -> TensorDict:
    return BeliefModuleContract().make_frames(shape, torch.float64, seed)


# ---------------------------------------------------------------------------------------- duties
class TestContract(BeliefModuleContract):
    def make_module(self, obs=OBS, action=ACTION, dtype=None, **kwargs):
        return ParticleFilterModule(make_filter(obs, action, dtype), **kwargs)

    def differentiable(self, out: TensorDictBase) -> Tensor:
        return out["features"].square().mean() - out["belief", "log_likelihood"].mean()


# ------------------------------------------------------------------------------- keys of its own
def test_the_keys_are_those_of_the_belief_filter_with_particles_for_the_mean():
    module = ParticleFilterModule(make_filter())
    state = [("recurrent", "particles"), ("recurrent", "log_weight"), ("recurrent", "age")]
    assert module.in_keys == ["observation", "observed", "previous_action", "is_init", *state]
    assert module.out_keys == [
        "features",
        ("belief", "log_likelihood"),
        *(("next", *key) for key in state),
    ]
    assert module.feature_dim == HIDDEN


def test_a_list_of_four_or_seven_in_keys_renames_by_position():
    four = ["a", ("b", "c"), "d", "e"]
    module = ParticleFilterModule(make_filter(), in_keys=four)
    assert module.in_keys[:4] == four
    module = ParticleFilterModule(make_filter(), in_keys=[*four, "f", "g", ("h", "i")])
    assert set(module.make_tensordict_primer().primers.keys(True, True)) == {"f", "g", ("h", "i")}
    assert module.out_keys[-3:] == [("next", "f"), ("next", "g"), ("next", "h", "i")]


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


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"in_keys": ["observation"]}, "`in_keys` must have 4 or 7 entries"),
        ({"in_keys": {"obs": "a"}}, "`in_keys` names"),
        ({"out_keys": [("belief", "mean")]}, "`out_keys` names"),
        ({"out_keys": {"feature": "a"}}, "`out_keys` names"),
    ],
)
def test_a_wrong_key_is_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        ParticleFilterModule(make_filter(), **kwargs)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"num_particles": 0}, "`num_particles` must be an int of at least 1, got 0"),
        ({"latent_dim": 2.0}, "`latent_dim` must be an int of at least 1, got 2.0"),
        ({"encoder_sizes": (4,)}, "`encoder_sizes` must be two sizes"),
        ({"min_std": -1.0}, "`min_std` must be at least 0, got -1.0"),
    ],
)
def test_a_wrong_size_is_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make_filter(**kwargs)


@pytest.mark.parametrize(
    ("absent", "remedy"),
    [
        ("observation", "in_keys"),
        ("observed", "ObservationMissingness"),
        ("previous_action", "PreviousAction"),
        ("is_init", "InitTracker"),
    ],
)
def test_an_absent_entry_is_named_with_its_remedy(absent, remedy):
    module = ParticleFilterModule(make_filter(dtype=torch.float64))
    with pytest.raises(KeyError, match=f"`{absent}` is not in the tensordict.*{remedy}"):
        module(make_frames((3,)).exclude(absent))


def test_a_sequence_without_a_batch_dimension_is_refused():
    module = ParticleFilterModule(make_filter(dtype=torch.float64))
    with set_recurrent_mode(True), pytest.raises(ValueError, match="no batch dimension"):
        module(make_frames(()))


def test_a_mask_of_numbers_is_refused():
    data = make_frames((3, 4))
    data["observed"] = data["observed"].double()
    module = ParticleFilterModule(make_filter(dtype=torch.float64))
    with set_recurrent_mode(True), pytest.raises((ValueError, RuntimeError), match="bool"):
        module(data)


def test_a_nan_under_a_true_mask_is_refused():
    data = make_frames((3, 4))
    data["observed"][1, 2, 3] = True
    data["observation"][1, 2, 3] = torch.nan
    module = ParticleFilterModule(make_filter(dtype=torch.float64))
    with (
        set_recurrent_mode(True),
        pytest.raises(ValueError, match=r"NaN or inf .* \(components \[3\]\).*ObservedFromNaN"),
    ):
        module(data)


def test_no_tensor_is_made_on_another_device():
    # the device "meta" refuses to be mixed with "cpu", as a GPU does
    module = ParticleFilterModule(
        make_filter(dtype=torch.float64),
        out_keys=["features", ("belief", "log_likelihood"), *OPTIONAL],
    ).to("meta")
    with set_recurrent_mode(True):
        out = module(make_frames((3, 4)).to("meta"))
    assert all(out[key].device.type == "meta" for key in module.out_keys)


# ----------------------------------------------------------------------------- weights, resampling
def test_the_log_density_is_that_of_independent_normals_on_the_observed_entries():
    g = torch.Generator().manual_seed(0)
    x, mean = torch.randn(2, 6, 5, generator=g, dtype=torch.float64)
    variance = torch.rand(6, 5, generator=g, dtype=torch.float64) + 0.1
    seen = torch.rand(6, 5, generator=g) < 0.5
    expected = torch.where(seen, Normal(mean, variance.sqrt()).log_prob(x), 0.0).sum(-1)
    received = diagonal_log_density(x, DiagonalGaussian(mean, variance), seen)
    torch.testing.assert_close(received, expected)
    nothing = diagonal_log_density(x, DiagonalGaussian(mean, variance), torch.zeros_like(seen))
    assert not nothing.any()


def test_the_mean_weight_survives_weights_that_underflow():
    log_weight = torch.tensor([-2000.0, -2000.0], dtype=torch.float64)
    assert log_mean_weight(log_weight).item() == pytest.approx(-2000)
    assert effective_sample_size(log_weight).item() == pytest.approx(2)


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


def test_the_gradient_goes_to_the_ancestors_and_not_through_their_choice():
    values = torch.arange(3.0).unsqueeze(-1).requires_grad_()
    log_weight = torch.tensor([0.0, -torch.inf, 0.0], requires_grad=True)
    ancestors = systematic_ancestors(log_weight, torch.tensor([0.5]))
    resample(values, ancestors).sum().backward()
    assert values.grad.flatten().tolist() == ancestors.bincount(minlength=3).tolist()
    assert log_weight.grad is None


# ---------------------------------------------------------------- a linear-Gaussian system
class LinearGaussian:
    """z = A h + B a + N(0, Q), x = c z + N(0, R), all diagonal but A; h is z itself.

    `exact` proposes from p(z | h, x, a), for which every particle of an ancestor weighs the same;
    otherwise the proposal is the transition widened.
    """

    def __init__(self, exact: bool = True, forgets: bool = False) -> None:
        g = torch.Generator().manual_seed(3)
        self.A = 0.5 * torch.randn(3, 3, generator=g, dtype=torch.float64) * (not forgets)
        self.B = torch.randn(3, 2, generator=g, dtype=torch.float64)
        self.Q, self.R, self.c = 0.2 + torch.rand(3, 3, generator=g, dtype=torch.float64)
        self.exact = exact

    def prospect(self, hidden: Tensor, inputs: tuple[Tensor, ...]) -> Prospect:
        action, x, m = (part.unsqueeze(-2) for part in inputs)
        mean = hidden @ self.A.mT + action @ self.B.mT
        transition = DiagonalGaussian(mean, self.Q.expand_as(mean))
        if not self.exact:
            return Prospect(DiagonalGaussian(mean, 1.5 * transition.variance), transition)
        gain = m * self.Q * self.c / (self.c.square() * self.Q + self.R)
        variance = ((1 - gain * self.c) * self.Q).expand_as(mean)
        return Prospect(DiagonalGaussian(mean + gain * (x - self.c * mean), variance), transition)

    def outcome(
        self, latent: Tensor, hidden: Tensor, context: Any, inputs: tuple[Tensor, ...]
    ) -> Outcome:
        emission = DiagonalGaussian(self.c * latent, self.R.expand_as(latent))
        return Outcome(emission, latent, latent)

    def run(self, data: tuple[Tensor, ...], particles: int, seeds: int) -> Tensor:
        """Log-likelihood of the rows of `data`, (seeds, rows, time)."""
        x, m, action = (part.expand(seeds, *part.shape) for part in data)
        noise = ParticleNoise.sample(
            x.shape[:-1], particles, 3, torch.Generator().manual_seed(particles), torch.float64
        )
        hidden = x.new_zeros(*x.shape[:-1], particles, 3)
        begin = torch.zeros(x.shape[:-1], dtype=torch.bool)
        inputs = (action, x, m.double())
        return particle_sequence(
            self, hidden, hidden[..., 0], begin, inputs, x, m, noise
        ).log_likelihood

    def kalman(self, data: tuple[Tensor, ...]) -> Tensor:
        """The same from the Kalman filter that carries the covariance along, (rows, time)."""
        x, m, action = data
        belief = Belief(x.new_zeros(x.shape[0], 3), x.new_zeros(x.shape[0], 3, 3))
        out = []
        for t in range(x.shape[1]):
            belief = predict(
                belief, lambda s, a: s @ self.A.mT + a @ self.B.mT, self.Q.diag(), action[:, t],
                jacobian=self.A,
            )  # fmt: skip
            step = (belief, x[:, t], m[:, t], self.c.diag(), self.R.diag())
            out.append(log_likelihood(*step))
            belief = update(*step)
        return torch.stack(out, 1)


def linear_data(rows: int, time: int) -> tuple[Tensor, ...]:
    g = torch.Generator().manual_seed(5)
    m = torch.rand(rows, time, 3, generator=g) < 0.7
    x, action = torch.randn(2, rows, time, 3, generator=g, dtype=torch.float64)
    return torch.where(m, x, 0.0), m, action[..., :2]


@pytest.mark.parametrize("exact", [True, False])
def test_the_likelihood_is_unbiased_on_a_linear_gaussian_system(exact):
    data = linear_data(rows=3, time=4)
    system = LinearGaussian(exact)
    seeds = 4000
    ratio = (system.run(data, 5, seeds).sum(-1) - system.kalman(data).sum(-1)).exp()
    error = ratio.std(0) / seeds**0.5
    assert (error < 0.05).all()  # or the next line would allow anything
    assert ((ratio.mean(0) - 1).abs() < 3 * error).all()


def test_its_log_converges_to_kalman_from_below_as_particles_grow():
    data = linear_data(rows=3, time=8)
    system = LinearGaussian()
    truth = system.kalman(data).sum(-1)
    gaps = [(truth - system.run(data, k, 64).sum(-1)).mean().item() for k in (2, 16, 128)]
    assert gaps[0] > 4 * gaps[1] > 0
    assert gaps[1] > 4 * abs(gaps[2])
    each = system.run(data, 4096, 2)[0] - system.kalman(data)
    assert each.abs().max() < 0.05


def test_where_the_state_is_forgotten_one_particle_gives_the_belief_filter_exactly():
    # The exact proposal has one weight for all particles; `filter_sequence` (P = Q) is exact here.
    data = linear_data(rows=3, time=6)
    system = LinearGaussian(forgets=True)
    x, m, action = data
    zeros = x.new_zeros(3)
    model = StateSpace(
        lambda s, a: a @ system.B.mT, system.Q.diag(), system.c.diag(), system.R,
        x.new_zeros(3, 2), zeros, zeros, system.Q.diag(),
    )  # fmt: skip
    reset = torch.zeros(3, 6, dtype=torch.bool)
    expected = filter_sequence(model, x.new_zeros(3, 3), action, x, m, reset).log_likelihood
    torch.testing.assert_close(system.run(data, 1, 1)[0], expected)


# -------------------------------------------------------------------------- laws of the networks
def run(
    filter: ParticleFilter, data: TensorDict, begin: Tensor | None = None
) -> tuple[ParticleOutput, ParticleNoise]:
    """Sequences from zeros, with the noise they were given."""
    shape, count = data.shape, filter.num_particles
    noise = ParticleNoise.sample(
        shape, count, filter.latent_dim, torch.Generator().manual_seed(1), torch.float64
    )
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

    q = normal(
        filter.proposal_head(filter.proposal(torch.cat([hidden, seen, action], -1)).relu()),
        filter.latent_min_std,
    )
    p = normal(
        filter.transition_head(filter.transition(torch.cat([hidden, action], -1)).relu()),
        filter.latent_min_std,
    )
    z = q.loc + q.scale * epsilon
    phi = filter.latent_encoder(z)
    decoded = filter.decoder(filter.emission(torch.cat([hidden, phi, action], -1)).relu())
    sensors = normal(filter.emission_head(decoded), filter.min_std)
    return (
        q.log_prob(z).sum(-1),
        p.log_prob(z).sum(-1),
        torch.where(m, sensors.log_prob(x), 0.0).sum(-1),
        gru_cell(filter.memory, torch.cat([phi, seen, action], -1), hidden),
        phi,
    )


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


def test_nothing_observed_leaves_the_ratio_of_transition_and_proposal():
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


def test_what_a_missing_entry_holds_changes_neither_particles_nor_gradient():
    grads = []
    for junk in (0.0, 7.0, float("nan"), float("inf")):
        module = ParticleFilterModule(make_filter(dtype=torch.float64))
        data = make_frames((3, 5))
        data["observation"] = torch.where(data["observed"], data["observation"], junk)
        with set_recurrent_mode(True):
            out = module(data)
        (out["features"].sum() + out["belief", "log_likelihood"].sum()).backward()
        grads.append(torch.cat([p.grad.flatten() for p in module.parameters()]))
    for grad in grads[1:]:
        assert torch.equal(grad, grads[0])


def test_the_mask_is_read_too():
    # a zero that arrived is not a zero that did not
    filter = make_filter(dtype=torch.float64)
    data = make_frames((1, 1))
    data["observation"][..., 0] = 0.0
    data["observed"][..., 0] = True
    seen, _ = run(filter, data)
    data["observed"][..., 0] = False
    missing, _ = run(filter, data)
    assert not torch.allclose(seen.hidden, missing.hidden)


def test_variances_never_fall_under_their_floor():
    filter = make_filter(dtype=torch.float64, min_std=0.5, latent_min_std=0.1)
    with torch.no_grad():
        for head in (filter.emission_head, filter.proposal_head, filter.transition_head):
            head.bias[head.out_features // 2 :] = -1e3
    networks = filter._networks()
    data = make_frames((2,))
    seen = filter.encoder(torch.cat([data["observation"], data["observed"].double()], -1))
    action = filter.action_encoder(data["previous_action"])
    inputs = networks.share(torch.cat([seen, action], -1), action)
    hidden = torch.zeros(2, K, HIDDEN, dtype=torch.float64)
    prospect = networks.prospect(hidden, inputs)
    outcome = networks.outcome(prospect.proposal.mean, hidden, prospect.context, inputs)
    for gaussian, floor in (
        (prospect.proposal, 0.1),
        (prospect.transition, 0.1),
        (outcome.emission, 0.5),
    ):
        torch.testing.assert_close(gaussian.variance, torch.full_like(gaussian.mean, floor**2))


# ------------------------------------------------------------------------------------- the noise
def noise_of(data: TensorDict, age: int = 0, **kwargs: Any) -> ParticleNoise:
    filter = make_filter(dtype=torch.float64, **kwargs)
    ages = torch.full((*data.shape, 1), age)
    return filter.noise(data["previous_action"], data["observation"], data["observed"], ages)


def test_a_step_has_one_noise_and_another_step_another():
    data = make_frames((50,))
    noise = noise_of(data)
    assert all(map(torch.equal, noise, noise_of(data)))
    other = data.clone()
    other["observation"][other["observed"]] += 1e-3
    changed = [noise_of(other), noise_of(data, age=1), noise_of(data, noise_seed=1)]
    other = data.clone()
    other["previous_action"] += 1e-3
    changed.append(noise_of(other))
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


def test_the_global_generator_is_untouched():
    module = ParticleFilterModule(make_filter(dtype=torch.float64))
    torch.manual_seed(0)
    state = torch.get_rng_state()
    with set_recurrent_mode(True):
        module(make_frames((3, 4)))
    assert torch.equal(torch.get_rng_state(), state)


def test_float32_data_cast_to_float64_keep_their_noise():
    data = make_frames((5,))
    narrow = data.clone()
    for key in ("observation", "previous_action"):
        narrow[key] = data[key].float()
        data[key] = narrow[key].double()
    one, other = noise_of(narrow), noise_of(data)
    assert all(map(torch.equal, one, other))


# ------------------------------------------------------------------------------ in a pipeline
@functools.cache
def agent_and_rollout() -> tuple[Agent, TensorDictBase]:
    filter = make_filter(POLE_OBS, POLE_ACTION)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        agent = make_agent(ParticleFilterModule(filter), HIDDEN, dtype=torch.float32)
    return agent, collect(agent, dtype=torch.float32)


def make_gae(agent: Agent) -> GAE:
    return GAE(
        gamma=0.99, lmbda=0.95, value_network=agent.value, shifted=False, deactivate_vmap=True
    )


@pytest.mark.parametrize("loss", ["ClipPPOLoss", "DRBPNLoss"])
def test_on_fresh_data_the_ratio_and_the_effective_sample_size_are_one(loss):
    agent, data = agent_and_rollout()
    data = data.clone()
    assert data["is_init"][:, 1:].any()
    assert not data["is_init"][:, 0].all()
    with set_recurrent_mode(True), torch.no_grad():
        make_gae(agent)(data)
    if loss == "ClipPPOLoss":
        out = ClipPPOLoss(agent.policy, agent.value)(data)
    else:
        ppo = ClipPPOLoss(agent.actor, agent.critic)
        out = DRBPNLoss(agent.belief, ppo, BeliefModelLoss())(data)
        assert out["loss_model"].isfinite()
    torch.testing.assert_close(out["ESS"], torch.ones_like(out["ESS"]), rtol=1e-4, atol=0)
    assert out["max_ratio"].item() == pytest.approx(1, abs=1e-4)
    assert out["mean_ratio"].item() == pytest.approx(1, abs=1e-4)
    assert out["kl_approx"].item() == pytest.approx(0, abs=1e-4)


def test_sequences_cut_from_a_rollout_replay_its_particles():
    agent, data = agent_and_rollout()
    pieces = data.reshape(-1, 6)
    with set_recurrent_mode(True), torch.no_grad():
        again = agent.belief(pieces.select(*agent.belief.in_keys))
    for key in ("features", ("belief", "log_likelihood"), ("next", "recurrent", "particles")):
        torch.testing.assert_close(again[key], pieces[key], rtol=1e-4, atol=1e-4)


def test_gae_sees_the_values_of_stored_and_next_features():
    agent, data = agent_and_rollout()
    through = data.clone()
    with set_recurrent_mode(True), torch.no_grad():
        make_gae(agent)(through)
    with torch.no_grad():
        value = agent.critic.module(data["features"])
        following = step_mdp(data, keep_other=False).select(*agent.belief.in_keys)
        with set_recurrent_mode(False):
            next_value = agent.critic.module(agent.belief(following)["features"])
    going_on = ~data["next", "done"][:, :-1]
    torch.testing.assert_close(
        next_value[:, :-1][going_on], value[:, 1:][going_on], rtol=1e-4, atol=1e-4
    )
    advantage, _ = generalized_advantage_estimate(
        0.99,
        0.95,
        value,
        next_value,
        data["next", "reward"],
        data["next", "done"],
        data["next", "terminated"],
    )
    torch.testing.assert_close(through["advantage"], advantage, rtol=1e-4, atol=1e-4)


def test_the_model_is_learned_by_the_loss_that_learns_the_belief_filter():
    # a staircase observed through a mask: the bound rises
    with torch.random.fork_rng():
        torch.manual_seed(0)
        module = ParticleFilterModule(make_filter(num_particles=3))
        env = with_belief_entries(
            TransformedEnv(StaircaseEnv(horizon=20), Compose()), module.make_tensordict_primer()
        )
        data = env.rollout(16, break_when_any_done=False)
        data["observation"] *= 0.01
        data["next", "observation"] *= 0.01
        loss, optimizer = BeliefModelLoss(), torch.optim.Adam(module.parameters(), lr=1e-2)
        history = []
        for _ in range(40):
            with set_recurrent_mode(True):
                value = loss(module(data.select(*module.in_keys, "observed")))["loss_model"]
            optimizer.zero_grad()
            value.backward()
            optimizer.step()
            history.append(value.item())
    assert history[-1] < history[0] - 0.5


# ------------------------------------------------------------------------------ the recipe's seam
def test_the_recipe_builds_it_with_the_settings_of_conf():
    pytest.importorskip("hydra")
    from omegaconf import OmegaConf

    root = Path(__file__).parents[1]
    sys.path.insert(0, str(root / "recipes"))
    from assembly.beliefs import build_belief

    settings = OmegaConf.to_container(OmegaConf.load(root / "conf" / "belief" / "dvrl.yaml"))
    belief = build_belief(settings, obs_dim=11, action_dim=3, normalize="entry")
    filter = belief.module.filter
    # conf/default.yaml and conf/mountainHike.yaml of the authors' code
    assert (filter.num_particles, filter.hidden_dim, filter.latent_dim) == (10, 128, 256)
    assert belief.feature_dim == 128
    assert belief.model_loss is not None


@pytest.mark.parametrize("given", [["a", "a", "b", "c"], ["a", "b", "c", "a"]])
def test_two_entries_under_one_key_are_refused(given):
    with pytest.raises(ValueError, match="a key of its own"):
        ParticleFilterModule(ParticleFilter(OBS, ACTION), in_keys=given)
