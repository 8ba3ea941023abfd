"""Gaussian pieces of `functional.gaussian`: the masked density and the parametrisations."""

from __future__ import annotations

import math

import oracles
import pytest
import torch
from torch import Tensor

from torchrl_drbpn.functional.gaussian import (
    full_cov,
    inverse_softplus,
    masked_cov,
    masked_log_density,
    positive_std,
    tril_to_vector,
    zero_missing,
)

DTYPES = [torch.float32, torch.float64]
# Nothing, one entry, some, all.
MASKS = pytest.mark.parametrize(
    "mask",
    [[False] * 4, [False, False, True, False], [True, False, True, True], [True] * 4],
    ids=["none", "one", "some", "all"],
)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def case(mask: list[bool], batch: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    g = generator()
    residual = torch.randn(batch, 4, generator=g, dtype=torch.float64)
    cov = torch.stack([oracles.spd(4, g) for _ in range(batch)])
    return residual, cov, torch.tensor(mask).expand(batch, 4)


@MASKS
def test_masked_log_density_is_that_of_the_sub_vector(mask):
    residual, cov, observed = case(mask)
    actual = masked_log_density(residual, cov, observed)
    rows = torch.tensor(mask).nonzero().squeeze(-1)
    expected = torch.zeros(3, dtype=torch.float64)
    if len(rows):
        zeros = torch.zeros(len(rows), dtype=torch.float64)
        sub = torch.distributions.MultivariateNormal(zeros, cov[:, rows][:, :, rows])
        expected = sub.log_prob(residual[:, rows])
    torch.testing.assert_close(actual, expected, atol=1e-11, rtol=1e-11)
    # A count of entries held as an integer times a Python float would be float32.
    single = masked_log_density(residual.float(), cov.float(), observed)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), actual, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_the_density_of_nothing_is_exactly_zero_with_finite_gradients(dtype):
    residual, cov, observed = case([False] * 4)
    residual, cov = (x.to(dtype).requires_grad_() for x in (residual, cov))
    value = masked_log_density(residual, cov, observed)
    assert value.dtype == dtype
    assert torch.equal(value, torch.zeros(3, dtype=dtype))
    value.sum().backward()
    assert torch.equal(residual.grad, torch.zeros_like(residual))
    assert torch.equal(cov.grad, torch.zeros_like(cov))


@pytest.mark.parametrize("junk", [math.nan, math.inf, -math.inf])
def test_what_stands_at_missing_entries_does_not_reach_the_density(junk):
    residual, cov, observed = case([True, False, True, False])
    clean = masked_log_density(residual, cov, observed)
    dirty = torch.where(observed, residual, torch.full_like(residual, junk)).requires_grad_()
    value = masked_log_density(dirty, cov, observed)
    assert torch.equal(value, clean)
    value.sum().backward()
    assert torch.equal(dirty.grad[~observed], torch.zeros(6, dtype=torch.float64))
    assert torch.isfinite(dirty.grad).all()


def test_one_covariance_serves_a_whole_batch_of_masks():
    residual, cov, _ = case([True] * 4, batch=16)
    masks = torch.cartesian_prod(*[torch.tensor([False, True])] * 4)
    shared = masked_log_density(residual, cov[0], masks)
    each = masked_log_density(residual, cov[0].expand_as(cov), masks)
    torch.testing.assert_close(shared, each, atol=0, rtol=0)


@MASKS
def test_gradients_of_the_density_agree_with_finite_differences(mask):
    residual, cov, observed = case(mask, batch=1)

    def density(residual: Tensor, root: Tensor) -> Tensor:
        return masked_log_density(residual, root @ root.mT, observed)

    leaves = (residual.requires_grad_(), torch.linalg.cholesky(cov).requires_grad_())
    assert torch.autograd.gradcheck(density, leaves)


@MASKS
def test_the_masked_matrix_has_the_determinant_and_inverse_of_the_sub_matrix(mask):
    _, cov, observed = case(mask, batch=1)
    masked = masked_cov(cov, observed)[0]
    rows = torch.tensor(mask).nonzero().squeeze(-1)
    sub = cov[0][rows][:, rows]
    torch.testing.assert_close(torch.logdet(masked), torch.logdet(sub))
    inverse = torch.linalg.inv(masked)
    torch.testing.assert_close(inverse[rows][:, rows], torch.linalg.inv(sub))
    missing = (~torch.tensor(mask)).nonzero().squeeze(-1)
    assert torch.equal(masked[missing], torch.eye(4, dtype=torch.float64)[missing])


def test_masking_ignores_junk_in_the_rows_of_missing_entries():
    _, cov, observed = case([True, False, True, True], batch=1)
    junk = cov.clone()
    junk[:, 1] = math.nan
    junk[:, :, 1] = math.inf
    assert torch.equal(masked_cov(junk, observed), masked_cov(cov, observed))


@pytest.mark.parametrize("dtype", [*DTYPES, torch.float16], ids=str)
def test_zero_missing_keeps_what_arrived_and_its_dtype(dtype):
    values = torch.tensor([1.0, math.nan, -3.0, math.inf], dtype=dtype)
    observed = torch.tensor([True, False, True, False])
    filled = zero_missing(values, observed)
    assert filled.dtype == dtype
    assert filled.tolist() == [1.0, 0.0, -3.0, 0.0]


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_inverse_softplus_undoes_softplus(dtype):
    value = torch.logspace(-6, 3, 40, dtype=dtype)
    raw = inverse_softplus(value)
    assert torch.isfinite(raw).all()
    torch.testing.assert_close(torch.nn.functional.softplus(raw), value, atol=0, rtol=1e-5)
    torch.testing.assert_close(positive_std(raw, 1e-2), value + 1e-2)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_standard_deviations_never_fall_under_their_floor(dtype):
    raw = torch.tensor([-1e30, -1e3, -20.0, 0.0, 5.0, 1e3], dtype=dtype, requires_grad=True)
    std = positive_std(raw, 1e-2)
    assert (std >= 1e-2).all()
    assert (std.diff() >= 0).all()
    assert torch.isfinite(std).all()
    (gradient,) = torch.autograd.grad(std.sum(), raw)
    assert torch.isfinite(gradient).all()
    # Away from the floor the parameter is felt, so that learning can leave it.
    assert (gradient[2:] > 0).all()


@pytest.mark.parametrize("shape", [(), (3,), (2, 3)], ids=str)
@pytest.mark.parametrize("scale", [0.0, 1.0, 5.0])
def test_full_covariances_are_symmetric_with_a_floor_in_every_direction(shape, scale):
    raw = scale * torch.randn(*shape, 5, 5, generator=generator(), dtype=torch.float64)
    cov = full_cov(raw, 0.1)
    assert cov.shape == (*shape, 5, 5)
    assert torch.equal(cov, cov.mT)
    assert torch.linalg.eigvalsh(cov).min() >= 0.01 - 1e-9 * scale**2


def test_the_floor_of_a_full_covariance_is_one_of_directions_not_of_components():
    # A covariance whose components all have variance 2 + floor, and a direction with almost none.
    raw = torch.zeros(2, 2, dtype=torch.float64)
    raw[0, 0] = inverse_softplus(torch.tensor(2.0**0.5, dtype=torch.float64))
    raw[1, 0], raw[1, 1] = 2.0**0.5, -1e3
    cov = full_cov(raw, 0.1)
    torch.testing.assert_close(
        torch.linalg.eigvalsh(cov), torch.tensor([0.01, 4.01], dtype=torch.float64)
    )


def test_float32_full_covariances_can_be_factorised_for_extreme_parameters():
    raw = torch.stack([torch.full((6, 6), value) for value in (-1e4, -10.0, 0.0, 3.0)])
    factor, info = torch.linalg.cholesky_ex(full_cov(raw, 1e-2))
    assert torch.equal(info, torch.zeros_like(info))
    assert torch.isfinite(factor).all()


def test_every_full_covariance_above_the_floor_can_be_reached_by_a_lower_triangle():
    target = oracles.spd(4, generator(1)) + 0.02 * torch.eye(4, dtype=torch.float64)
    root = torch.linalg.cholesky(target - 0.01 * torch.eye(4, dtype=torch.float64))
    raw = root.tril(-1) + torch.diag(inverse_softplus(root.diagonal()))
    torch.testing.assert_close(full_cov(raw, 0.1), target)
    spoilt = raw + torch.triu(torch.full((4, 4), 7.0), 1)  # the upper one is not read
    assert torch.equal(full_cov(raw, 0.1), full_cov(spoilt, 0.1))


def test_gradients_of_the_parametrisations_agree_with_finite_differences():
    raw = torch.randn(2, 3, 3, generator=generator(), dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda r: full_cov(r, 0.1), (raw,))
    assert torch.autograd.gradcheck(lambda r: positive_std(r, 0.1), (raw,))
    positive = (raw.detach().abs() + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(inverse_softplus, (positive,))


@pytest.mark.parametrize("shape", [(), (2,), (2, 3)], ids=str)
def test_the_lower_triangle_holds_a_whole_symmetric_matrix(shape):
    g = generator()
    root = torch.randn(*shape, 4, 4, generator=g, dtype=torch.float64)
    cov = root @ root.mT
    vector = tril_to_vector(cov)
    assert vector.shape == (*shape, 10)
    rebuilt = torch.zeros_like(cov)
    row, column = torch.tril_indices(4, 4)
    rebuilt[..., row, column] = vector
    rebuilt[..., column, row] = vector
    torch.testing.assert_close(rebuilt, cov)
