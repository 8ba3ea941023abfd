"""Scores of Gaussian predictions in recipes/analysis: definitions, properness, calibration."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

sys.path.append(str(Path(__file__).parents[1] / "recipes"))

from analysis.scores import gaussian_crps, gaussian_log_score, gaussian_pit


def randn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_the_probability_transform_of_the_right_gaussians_is_uniform():
    mean, std = randn(20_000, seed=1), randn(20_000, seed=2).abs() + 0.1
    pit = gaussian_pit(mean + std * randn(20_000, seed=3), mean, std)
    grid = (torch.arange(20_000) + 0.5) / 20_000
    assert (pit.sort().values - grid).abs().max() < 1.63 / 20_000**0.5  # Kolmogorov and Smirnov


@pytest.mark.parametrize("std", [0.2, 1.0, 3.0])
@pytest.mark.parametrize("value", [-2.5, 0.3, 4.0])
def test_the_crps_equals_the_integral_of_its_definition(value, std):
    mean, total = 0.5, 0.0
    # The integrand jumps at the value: each side by itself, trapezoids on both.
    for low, high, step in ((mean - 12 * std - 10, value, 0.0), (value, mean + 12 * std + 10, 1.0)):
        y = torch.linspace(low, high, 400_001, dtype=torch.float64)
        gap = torch.special.ndtr((y - mean) / std) - step
        total += torch.trapezoid(gap.square(), y).item()
    crps = gaussian_crps(*(torch.tensor(v, dtype=torch.float64) for v in (value, mean, std)))
    assert crps.item() == pytest.approx(total, rel=1e-7)


def test_the_crps_without_a_spread_is_the_absolute_error():
    value, mean = randn(10, seed=1), randn(10, seed=2)
    zero = torch.zeros(10, dtype=torch.float64)
    torch.testing.assert_close(gaussian_crps(value, mean, zero), (value - mean).abs())
    assert (gaussian_crps(value, value, zero) == 0).all()


@pytest.mark.parametrize("score", [gaussian_crps, gaussian_log_score])
def test_no_other_deviation_or_mean_scores_better_than_the_right_one(score):
    value = randn(50_000, seed=7)

    def mean_score(mean: float, std: float) -> float:
        return score(value, torch.tensor(mean), torch.tensor(std)).mean().item()

    others = [(0.0, 0.7), (0.0, 1.4), (0.3, 1.0), (-0.3, 1.0)]
    assert all(mean_score(*other) > mean_score(0.0, 1.0) for other in others)


def test_the_log_score_of_an_entry_is_minus_its_log_density():
    value, mean, std = randn(9, seed=1), randn(9, seed=2), randn(9, seed=3).abs() + 0.1
    expected = -torch.distributions.Normal(mean, std).log_prob(value)
    torch.testing.assert_close(gaussian_log_score(value, mean, std), expected)
