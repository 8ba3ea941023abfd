"""Calibration: normalised squares, whose distribution tells a wrong covariance from a right one."""

import sys
from pathlib import Path

import pytest
import torch
from references import spd
from refusals import refuses
from scipy.stats import chi2

from torchrl_drbpn.functional import Belief, innovation, nees, nis

sys.path.append(str(Path(__file__).parents[1] / "docs/calibration"))

import constant_covariance


def randn(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_nis_is_chi_square_distributed_for_the_claimed_covariance_and_no_other():
    cov = spd(4, torch.Generator().manual_seed(3))
    error = randn(10_000, 4) @ torch.linalg.cholesky(cov).mT
    seen = randn(10_000, 4, seed=1) < torch.linspace(-1, 2, 10_000)[:, None]  # some see nothing
    lower, upper = chi2.ppf([0.0005, 0.9995], seen.sum().item())
    exact, too_small, too_large = (
        nis(error, claimed * cov, seen).sum() for claimed in (1.0, 0.8, 1.25)
    )
    assert lower < exact < upper < too_small
    assert too_large < lower


def test_a_constant_covariance_is_too_small_in_outages_though_its_average_nis_is_right():
    """The figures of docs/calibration.md, on fewer and shorter sequences."""
    model = constant_covariance.system()
    case = (0.5, 20.0, False)
    _, observation, observed = constant_covariance.simulate(model, case, 60, 80, seed=0)
    cov = constant_covariance.trained_cov(model, observation, observed, iterations=60)
    exact_cov = model.transition_cov
    assert isinstance(exact_cov, torch.Tensor)
    data = constant_covariance.simulate(model, case, 60, 80, seed=1)
    judged = {
        "constant": constant_covariance.judge(model, cov, *data, propagated=False),
        "exact": constant_covariance.judge(model, exact_cov, *data, propagated=True),
        "mistaken": constant_covariance.judge(model, cov, *data, propagated=True),
    }
    scores = {"nees": "entries", "nis": "dof", "se": "entries"}
    found = {
        name: {key: (sums[key].sum() / sums[per].sum()).item() for key, per in scores.items()}
        for name, sums in judged.items()
    }
    assert found["exact"]["nees"] == pytest.approx(1, abs=0.1)
    assert found["constant"]["nees"] > 1.4
    assert found["constant"]["se"] > 1.05 * found["exact"]["se"]
    assert found["constant"]["nis"] == pytest.approx(1, abs=0.15)
    # What was trained as the whole covariance is no Q: propagated, it is too modest.
    assert found["mistaken"]["nees"] < 0.85
    assert found["mistaken"]["nis"] < 0.85


@pytest.mark.parametrize("seed", range(3))
def test_masking_an_entry_equals_deleting_its_row(seed):
    g = torch.Generator().manual_seed(seed)
    cov, error = spd(5, g), randn(5, seed=seed)
    seen = torch.tensor([True, False, True, True, False])
    rows = seen.nonzero().squeeze(-1)
    small, e = cov[rows][:, rows], error[rows]
    hidden = torch.where(seen, error, torch.nan)
    torch.testing.assert_close(nis(hidden, cov, seen), e @ torch.linalg.solve(small, e))
    torch.testing.assert_close(nees(e, small), e @ torch.linalg.solve(small, e))


def test_nothing_observed_is_zero():
    nothing = torch.zeros(2, 3, dtype=torch.bool)
    assert (nis(torch.full((2, 3), torch.nan), torch.eye(3), nothing) == 0).all()


@pytest.mark.parametrize(("obs", "state", "spread"), [(17, 4, 3.0), (27, 8, 1.0), (105, 16, 1.0)])
def test_a_float32_belief_at_the_noise_floor_has_the_nis_of_float64(obs, state, spread):
    """H of low rank, R std .01: in float32 the innovation covariance has no Cholesky factor."""
    matrix, predicted = randn(obs, state), spread * randn(20, state, seed=1)
    cov, noise = spread**2 * torch.eye(state), 1e-4 * torch.eye(obs)
    truth = predicted + spread * randn(20, state, seed=2)
    x = truth @ matrix.T + 0.01 * randn(20, obs, seed=3)
    seen = randn(20, obs, seed=4) > -0.5
    doubles = [v.float().double() for v in (predicted, cov, x, matrix, noise)]
    scores = []
    for m, P, reading, H, R in ([v.float() for v in doubles], doubles):
        error, S = innovation(Belief(m, P.expand(20, -1, -1)), reading, seen, H, R)
        scores.append(nis(error, S, seen))
    torch.testing.assert_close(scores[0], scores[1], rtol=1e-9, atol=1e-9)
    # What comes in float32 is computed in float64 too: the same as of the rounded numbers.
    error, S = 3 * randn(20, obs, seed=5), spd(obs, torch.Generator().manual_seed(6))
    rounded = error.float(), S.float(), seen
    widened = error.float().double(), S.float().double(), seen
    assert torch.equal(nis(*rounded), nis(*widened))
    assert 0.8 < float(scores[1].sum() / seen.sum()) < 1.2


test_a_mask_of_numbers_is_refused = refuses(
    (
        lambda: nis(torch.ones(2, 3), torch.eye(3), torch.ones(2, 3)),
        "`observed` must be bool of the observation's sha",
    ),
)
