"""What float32 may cost: with R at its floor the chosen form keeps the digits of float64."""

from functools import partial

import pytest
import torch
from filter_problems import FORMS, Problem

from torchrl_drbpn import functional as F
from torchrl_drbpn.functional import Belief


def at_the_noise_floor(state, obs, *, full_noise=False, rank=None, spread=0.3):
    """Return one problem in float32 and the same numbers in float64: R std 1e-2, Q std .3.

    H is random, of full rank where none is given; `spread` is the Q std. Masks are of every
    density from empty to complete, and the data come from the model itself, so that innovations
    have the size the model claims.
    """
    batch, time, std = 4, 60, 1e-2
    options = {"batch": batch, "time": time, "hidden": (32,), "residual": False}
    double = Problem(state, obs, full_noise=full_noise, **options)
    leaves, g = double.leaves, torch.Generator().manual_seed(0)
    randn = partial(torch.randn, generator=g, dtype=torch.float64)
    density = torch.linspace(0, 1, time).view(1, time, 1)
    double.observed = torch.rand(batch, time, obs, generator=g) < density
    with torch.no_grad():
        leaves["transition_root"].copy_(spread * torch.eye(state))
        leaves["initial_root"].copy_(torch.eye(state))
        leaves["noise"].copy_(std * torch.eye(obs) if full_noise else torch.full((obs,), std**2))
        matrix = randn(obs, state)
        if rank is not None:
            matrix = randn(obs, rank) @ randn(rank, state) / rank**0.5
        leaves["matrix"].copy_(matrix)
        model, truth = double.model(), leaves["start_mean"]
        for t in range(time):
            action = leaves["previous_action"][:, t]
            moved = model.transition(truth, action) + spread * randn(batch, state)
            fresh = leaves["initial_mean"] + randn(batch, state)
            truth = torch.where(double.reset[:, t, None], fresh, moved)
            noise = std * randn(batch, obs)
            leaves["observation"][:, t] = truth @ leaves["matrix"].T + model.offset(action) + noise
    single = Problem(state, obs, full_noise=full_noise, **options)
    single.observed, single.reset = double.observed, double.reset
    single.leaves = {k: v.detach().float().requires_grad_() for k, v in leaves.items()}
    double.leaves = {k: v.detach().double().requires_grad_() for k, v in single.leaves.items()}
    return single, double


def assert_gradients_near(differentiate, outputs, differentiate_truth, truth, tolerance):
    """By every leaf, of mean and likelihood; relative to the norm of the right one."""
    found = differentiate((outputs[0], outputs[2]))
    expected = differentiate_truth((truth[0], truth[2]))
    for name, gradient in found.items():
        error = (gradient.double() - expected[name]).norm() / expected[name].norm()
        assert float(error) < tolerance, name


@pytest.mark.parametrize("full_noise", [False, True], ids=["diagonal R", "full R"])
@pytest.mark.parametrize("form", FORMS[:2])
@pytest.mark.parametrize(("state", "obs"), [(8, 9), (8, 27), (17, 17), (32, 11), (16, 64)], ids=str)
def test_float32_keeps_its_digits_at_the_noise_floor(state, obs, form, full_noise):
    single, double = at_the_noise_floor(state, obs, full_noise=full_noise)
    outputs, truth = single.library(form), double.library(form)
    mean, cov, ll = (a.detach().double() - b.detach() for a, b in zip(outputs, truth, strict=True))
    assert float(mean.abs().max()) < 1e-3
    assert torch.linalg.eigvalsh(outputs[1].detach().double()).min() > 0
    assert float(cov.abs().max()) < 1e-5
    assert float(ll.abs().max()) < 1e-2
    assert_gradients_near(single.gradients, outputs, double.gradients, truth, 1e-3)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("spread", [0.3, 3.0])
@pytest.mark.parametrize(("state", "obs", "rank"), [(17, 17, 4), (32, 32, 8)], ids=str)
def test_float32_keeps_its_digits_where_sensors_are_redundant(state, obs, rank, spread, form):
    """H of low rank: S = H Q H' + R is as ill-conditioned as Q / R, 1e5 to 1e7 here."""
    single, double = at_the_noise_floor(state, obs, rank=rank, spread=spread)
    outputs, truth = single.library(form), double.library(form)
    for a, e, scale in zip(outputs, truth, (1, max(1, spread**2), obs), strict=True):
        assert float((a.detach().double() - e.detach()).abs().max()) < 2e-5 * scale
    assert_gradients_near(single.gradients, outputs, double.gradients, truth, 1e-3)


@pytest.mark.parametrize("form", FORMS)
def test_a_single_sensor_has_its_gradient_by_r(form):
    """R at its floor, half of the sensors missing, nearly as many states as sensors."""
    single, double = at_the_noise_floor(8, 9)
    found = single.gradients((single.library(form)[2],))["noise"].double()
    expected = double.gradients((double.library("step by step")[2],))["noise"]
    assert float(((found - expected) / expected).abs().max()) < 1e-3


def smallest_eigenvalues(cov):
    assert torch.isfinite(cov).all()
    assert torch.equal(cov, cov.mT)
    return torch.linalg.eigvalsh(cov.double())[..., 0]


@pytest.mark.parametrize("dead", [False, True], ids=["random masks", "a sensor dead for good"])
@pytest.mark.parametrize(("state", "obs"), [(17, 17), (32, 8)], ids=str)
def test_float32_updates_of_a_correlated_belief_stay_positive_definite(state, obs, dead):
    g = torch.Generator().manual_seed(0)
    root = torch.randn(state, state, generator=g)
    belief = Belief(torch.zeros(state), root @ root.T / state + 0.01 * torch.eye(state))
    h, r = torch.randn(obs, state, generator=g) / state**0.5, 1e-4 * torch.eye(obs)
    observed = torch.arange(obs) > 0
    covs = []
    for _ in range(1500):
        if not dead:
            observed = torch.rand(obs, generator=g) < 0.5
        belief = F.update(belief, torch.randn(obs, generator=g), observed, h, r)
        covs.append(belief.cov)
    assert smallest_eigenvalues(torch.stack(covs)).min() > 0


@pytest.mark.parametrize("std", [0.3, 3.0])
def test_a_float32_covariance_is_not_inflated(std):
    # A large prior beside a small R: the safeguard against rounding must not show.
    h = 5 * torch.linalg.qr(torch.randn(17, 17, generator=torch.Generator().manual_seed(0)))[0]
    seen, variances = torch.ones(17, dtype=torch.bool), []
    for dtype in (torch.float32, torch.float64):
        zeros, eye = torch.zeros(17, dtype=dtype), torch.eye(17, dtype=dtype)
        r = (1e-4 * torch.eye(17)).to(dtype)
        cov = F.update(Belief(zeros, std**2 * eye), zeros, seen, h.to(dtype), r).cov
        variances.append(cov.diagonal().double())
    torch.testing.assert_close(*variances, rtol=1e-5, atol=0)
