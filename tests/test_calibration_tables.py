"""Tables of a diagnosis on data with known errors, and the scores of Gaussian predictions."""

import itertools
import math

import pytest
import torch
from analysis.calibration import Compared, Tally, class_names, gaussian_crps
from analysis.calibration_tables import (
    Resampling,
    calibration_rows,
    precision_rows,
    reliability_rows,
)

BINS = [1, 2, 3, 6]
READINGS = Compared("predicted", True, "reading", "arrived")


def steps_with(observed, **more):
    """Steps (episodes, time, obs) of zeros beside a mask, classes by a plain loop."""
    episodes, time, obs = observed.shape
    classes = torch.zeros(observed.shape, dtype=torch.int64)
    for e, i in itertools.product(range(episodes), range(obs)):
        seen = observed[e, :, i].tolist()
        latest = None
        for t in range(time):
            if latest is None:
                classes[e, t, i] = len(BINS)
            else:
                classes[e, t, i] = max(k for k, b in enumerate(BINS) if b <= t - latest)
            latest = t if seen[t] else latest
    zeros = torch.zeros(observed.shape, dtype=torch.float64)
    steps = dict.fromkeys(("reading", "truth", "last value", "running mean"), zeros)
    steps |= {"observed": observed, "running": torch.ones_like(observed), "class": classes}
    return steps | more


def test_errors_are_sorted_by_arrival_and_by_steps_since_last_seen():
    observed = torch.tensor([1, 0, 0, 0, 1, 0], dtype=torch.bool).reshape(1, 6, 1)
    error = torch.tensor([9, 1, 2, 3, 8, 5], dtype=torch.float64).reshape(1, 6, 1)
    tally = Tally(class_names(BINS), torch.tensor([6.0]), torch.tensor([2.0]), 1)
    tally.add(slice(None), steps_with(observed, filtered=error))
    rows = {
        (row["estimate"], row["entries"], row["steps_since_seen"]): row
        for row in precision_rows(tally, resamples=2, seed=0)
    }
    missing = {k[2]: v["rmse"] for k, v in rows.items() if k[:2] == ("filtered", "missing")}
    assert missing == pytest.approx(
        {"1": math.sqrt((1 + 25) / 2), "2": 2, "3-5": 3, "all": math.sqrt(39 / 4)}
    )
    assert rows["filtered", "arrived", "0"]["rmse"] == pytest.approx(math.sqrt((81 + 64) / 2))
    assert rows["running mean", "missing", "all"]["rmse"] == 0


def known_forecasts(std):
    """Readings around forecasts with a deviation of 1, where `std` is claimed."""
    g = torch.Generator().manual_seed(0)
    shape = (40, 100, 3)
    observed = torch.rand(shape, generator=g) < 0.6
    root = torch.tensor([[1.0, 0, 0], [0.6, 0.8, 0], [0, 0.6, 0.8]], dtype=torch.float64)
    reading = torch.randn(shape, generator=g, dtype=torch.float64) @ root.T
    cov = std**2 * (root @ root.T).expand(*shape[:2], 3, 3)
    steps = steps_with(observed, truth=reading, reading=torch.where(observed, reading, torch.nan))
    zeros = torch.zeros(shape, dtype=torch.float64)
    steps |= {"predicted": zeros, "predicted cov": cov, "filtered": zeros}
    steps["filtered variance"] = cov.diagonal(dim1=-2, dim2=-1)
    total = observed.sum((1, 2)).double()
    tally = Tally(class_names(BINS), torch.full((40,), 100.0), total, 3)
    for start in range(0, 100, 30):  # chunks of different length
        tally.add(slice(None), {k: v[:, start : start + 30] for k, v in steps.items()})
    return tally


def test_a_right_belief_is_found_consistent_and_covers_what_it_claims():
    tally = known_forecasts(1.0)
    rows = list(calibration_rows(tally, resamples=200, seed=0))
    for row in rows:
        if row["count"] < 500:
            continue
        assert row["coverage_90"] == pytest.approx(0.9, abs=0.04)
        assert row["coverage_50"] == pytest.approx(0.5, abs=0.07)
        # The CRPS of a right standard normal forecast is 1 / sqrt(pi).
        assert row["crps"] == pytest.approx(1 / math.sqrt(math.pi), abs=0.05)
        if row["held_against"] == "reading":
            assert row["nis_per_dof"] == pytest.approx(1, abs=0.15)
            assert row["consistent_low"] < 1 < row["consistent_high"]
    (together,) = [
        r for r in rows if r["held_against"] == "reading" and r["steps_since_seen"] == "all"
    ]
    assert together["nis_per_dof_low"] < 1 < together["nis_per_dof_high"]
    (curve,) = [r for r in reliability_rows(tally) if r["held_against"] == "reading"]
    assert all(curve[f"under_{p}"] == pytest.approx(p / 100, abs=0.02) for p in (5, 50, 95))


def test_a_belief_that_is_too_sure_is_found_so_by_every_statistic():
    right, sure = known_forecasts(1.0), known_forecasts(0.5)
    first, second = (
        {tuple(r.values())[:5]: r for r in calibration_rows(t, resamples=20, seed=0)}
        for t in (right, sure)
    )
    key = ("predicted", "in", "reading", "arrived", "all")
    assert second[key]["nis_per_dof"] == pytest.approx(4 * first[key]["nis_per_dof"])
    assert second[key]["nis_per_dof"] > second[key]["consistent_high"]
    # A central 95 % interval of half the width holds 2 Phi(1.96 / 2) - 1 = .673.
    assert second[key]["coverage_95"] == pytest.approx(0.673, abs=0.03)
    assert second[key]["crps"] > first[key]["crps"]
    assert second[key]["log_score"] > first[key]["log_score"]


def test_nis_by_class_are_those_of_the_rows_of_a_class_alone():
    observed = torch.ones(1, 2, 2, dtype=torch.bool)
    observed[0, 0, 1] = False  # at step 1 one sensor was seen the step before, one never
    cov = torch.tensor([[2.0, 1.0], [1.0, 2.0]], dtype=torch.float64).expand(1, 2, 2, 2)
    reading = torch.tensor([[[0.0, 0.0], [2.0, 4.0]]], dtype=torch.float64)
    tally = Tally(class_names(BINS), torch.tensor([2.0]), torch.tensor([3.0]), 2)
    zeros = torch.zeros_like(reading)
    more = {"reading": reading, "predicted": zeros, "predicted cov": cov}
    tally.add(slice(None), steps_with(observed) | more)
    sums = tally.sums[READINGS]
    assert sums["nis"][0].tolist() == pytest.approx([4 / 2, 0, 0, 0, 16 / 2])
    # Together: (2, 4) C^-1 (2, 4)' with C^-1 = [[2, -1], [-1, 2]] / 3.
    assert sums["nis_joint"].item() == pytest.approx((2 * 4 + 2 * 16 - 2 * 8) / 3)


def test_an_interval_over_few_episodes_holds_the_mean_as_often_as_it_claims():
    """Plain percentiles hold it in .91 of the cases; .007 is a standard error of 1000 trials."""
    generator = torch.Generator().manual_seed(0)
    ones, held = torch.ones(10, dtype=torch.float64), 0
    for seed in range(1000):
        values = torch.randn(10, generator=generator, dtype=torch.float64)
        row = Resampling(10, 1000, seed).ratio("x", values, ones)
        held += row["x_low"] < 0 < row["x_high"]
    assert 0.93 <= held / 1000 <= 0.97


def test_nothing_to_count_is_an_empty_cell_and_one_episode_has_no_interval():
    resampling = Resampling(3, 50, seed=0)
    one = torch.tensor([0.0, 4.0, 0.0], dtype=torch.float64)
    for numerator, denominator in ((torch.zeros(3), torch.zeros(3)), (None, one)):
        assert set(resampling.ratio("x", numerator, denominator).values()) == {None}
    assert resampling.ratio("x", 2 * one, one) == {"x": 2.0, "x_low": None, "x_high": None}


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
    value, mean = torch.randn(2, 10, dtype=torch.float64)
    zero = torch.zeros(10, dtype=torch.float64)
    torch.testing.assert_close(gaussian_crps(value, mean, zero), (value - mean).abs())
    assert (gaussian_crps(value, value, zero) == 0).all()
