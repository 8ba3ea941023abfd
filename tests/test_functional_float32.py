"""What float32 may cost: with R at its floor the chosen form keeps its digits.

Every figure is held to the same model in float64.
"""

from __future__ import annotations

import pytest
import torch
from filter_problems import FORMS, SIZES, Problem
from torch import Tensor

from torchrl_drbpn.functional import filter_step


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_float32_is_near_float64(state, obs, form):
    double = Problem(state, obs, stored=True)
    single = Problem(state, obs, stored=True, dtype=torch.float32)
    outputs, truth = single.library(form), double.library(form)
    for a, e in zip(outputs, truth, strict=True):
        assert a.dtype == torch.float32
        torch.testing.assert_close(a.double(), e, atol=1e-4, rtol=1e-4)
    gradients, true_gradients = single.gradients(outputs), double.gradients(truth)
    for name, gradient in gradients.items():
        scale = max(1.0, float(true_gradients[name].abs().max()))
        assert gradient.dtype == torch.float32
        assert float((gradient.double() - true_gradients[name]).abs().max()) < 1e-4 * scale, name


def at_the_noise_floor(
    state: int, obs: int, *, full_noise: bool = False, rank: int | None = None, spread: float = 0.3
) -> tuple[Problem, Problem]:
    """Return one problem in float32 and the same numbers in float64: R std 1e-2, Q std .3.

    H is random, of full rank where none is given; `spread` is the Q std. Masks are of every
    density from empty to complete, and the data come from the model itself, so that innovations
    have the size the model claims.
    """
    batch, time, std = 4, 60, 1e-2
    options = {"batch": batch, "time": time, "hidden": (32,), "residual": False}
    double = Problem(state, obs, full_noise=full_noise, **options)
    leaves, g = double.leaves, torch.Generator().manual_seed(0)

    def randn(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

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


@pytest.mark.parametrize("full_noise", [False, True], ids=["diagonal R", "full R"])
@pytest.mark.parametrize(("state", "obs"), [(8, 27), (17, 17), (16, 105)], ids=str)
def test_a_float32_step_keeps_its_digits_at_the_noise_floor(state, obs, full_noise):
    single, double = at_the_noise_floor(state, obs, full_noise=full_noise)
    outputs = []
    for problem in (single, double):
        mean, action, x, observed, reset = problem.arguments()
        # Every step of the sequence at once, each from the same belief.
        mean = mean.unsqueeze(1).expand(*reset.shape, state)
        outputs.append(
            filter_step(problem.model(), mean, action, x, observed, reset, return_cov=True)
        )
    mean, cov, ll = (a.detach().double() - b.detach() for a, b in zip(*outputs, strict=True))
    assert float(mean.abs().max()) < 1e-3
    assert float(cov.abs().max()) < 1e-5
    relative = ll.abs() / outputs[1].log_likelihood.detach().abs().clamp(min=10)
    assert float(relative.max()) < 1e-3
