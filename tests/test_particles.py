"""The mathematics of the particle filter."""

from __future__ import annotations

import pytest
import torch
from particle_tools import sample_noise
from torch import Tensor
from torch.distributions import Normal

from torchrl_drbpn.functional import (
    Belief,
    DiagonalGaussian,
    ParticleStep,
    ProposalOutput,
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

    def propose(self, hidden: Tensor, inputs: tuple[Tensor, ...]) -> ProposalOutput:
        action, x, m = (part.unsqueeze(-2) for part in inputs)
        mean = hidden @ self.A.mT + action @ self.B.mT
        transition = DiagonalGaussian(mean, self.Q.expand_as(mean))
        if not self.exact:
            return ProposalOutput(DiagonalGaussian(mean, 1.5 * transition.variance), transition)
        gain = m * self.Q * self.c / (self.c.square() * self.Q + self.R)
        variance = ((1 - gain * self.c) * self.Q).expand_as(mean)
        return ProposalOutput(
            DiagonalGaussian(mean + gain * (x - self.c * mean), variance), transition
        )

    def step(self, latent: Tensor, hidden: Tensor, inputs: tuple[Tensor, ...]) -> ParticleStep:
        del hidden, inputs
        emission = DiagonalGaussian(self.c * latent, self.R.expand_as(latent))
        return ParticleStep(emission, latent, latent)

    def run(self, data: tuple[Tensor, ...], particles: int, seeds: int) -> Tensor:
        """Log-likelihood of the rows of `data`, (seeds, rows, time)."""
        x, m, action = (part.expand(seeds, *part.shape) for part in data)
        noise = sample_noise(x.shape[:-1], particles, 3, particles)
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
