"""One step in float32: covariances stay symmetric positive definite and keep their digits."""

from __future__ import annotations

import pytest
import torch
from kalman_cases import SEEDS, SIZES, case, some_masks
from torch import Tensor

from torchrl_drbpn import functional as F
from torchrl_drbpn.functional.gaussian import Belief

FLOOR_STD, TRANSITION_STD = 1e-2, 0.3


def assert_spd(cov: Tensor, context: str) -> None:
    assert torch.isfinite(cov).all(), f"not finite {context}"
    assert torch.equal(cov, cov.mT), f"not symmetric {context}"
    smallest = torch.linalg.eigvalsh(cov.double()).min()
    assert smallest > 0, f"not positive definite {context}: smallest eigenvalue {smallest:.1e}"


def float32_case(state: int, obs: int, batch: int, seed: int, *, full_noise: bool):
    g = torch.Generator().manual_seed(seed)
    h = torch.randn(obs, state, generator=g)
    q = TRANSITION_STD**2 * torch.eye(state)
    r = FLOOR_STD**2 * torch.eye(obs)
    if full_noise:
        rotation = torch.linalg.qr(torch.randn(obs, obs, generator=g))[0]
        spread = torch.linspace(1, 100, obs)
        r = FLOOR_STD**2 * (rotation * spread) @ rotation.T
        r = (r + r.T) / 2
    belief = Belief(torch.zeros(batch, state), q.expand(batch, state, state))
    return h, q, r, belief, g


@pytest.mark.parametrize("full_noise", [False, True], ids=["diagonal R", "full R"])
@pytest.mark.parametrize(
    ("state", "obs"), [(4, 17), (17, 17), (32, 17), (1, 1), (16, 105), (32, 8)], ids=str
)
def test_float32_covariances_are_symmetric_positive_definite_at_the_noise_floor(
    state, obs, full_noise
):
    batch = 64
    for seed in SEEDS:
        h, _, r, belief, g = float32_case(state, obs, batch, seed, full_noise=full_noise)
        rate = torch.linspace(0, 1, batch)[:, None]
        observed = torch.rand(batch, obs, generator=g) < rate
        x = torch.randn(batch, obs, generator=g)
        filtered = F.update(belief, x, observed, h, r)
        ll = F.log_likelihood(belief, x, observed, h, r)
        assert filtered.cov.dtype == torch.float32
        assert_spd(filtered.cov, f"seed {seed}")
        assert torch.isfinite(filtered.mean).all()
        assert torch.isfinite(ll).all()


@pytest.mark.parametrize("predicts", [True, False], ids=["predict+update", "update"])
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_float32_covariances_survive_10000_iterations(state, obs, predicts):
    batch, seen_masks = 4, 50
    h, q, r, belief, g = float32_case(state, obs, batch, 0, full_noise=False)
    masks = torch.rand(seen_masks, batch, obs, generator=g) < 0.5
    x = torch.randn(seen_masks, batch, obs, generator=g)
    jacobian = 0.99 * torch.linalg.qr(torch.randn(state, state, generator=g))[0]
    action = torch.zeros(batch, 1)
    history = []
    with torch.no_grad():
        for i in range(10_000):
            if predicts:
                belief = F.predict(
                    belief, lambda m, _: m @ jacobian.T, q, action, jacobian=jacobian
                )
            belief = F.update(belief, x[i % seen_masks], masks[i % seen_masks], h, r)
            history.append(belief.cov)
    assert torch.isfinite(belief.mean).all()
    covs = torch.stack(history)
    assert torch.equal(covs, covs.mT)
    assert torch.isfinite(covs).all()
    smallest = torch.linalg.eigvalsh(covs.double())[..., 0].amin(-1)
    bad = (smallest <= 0).nonzero()
    assert not len(bad), (
        f"indefinite in {len(bad)} of 10,000 iterations, first at {int(bad[0])}, "
        f"smallest eigenvalue {float(smallest.min()):.1e}"
    )


@pytest.mark.parametrize("dead", [False, True], ids=["random masks", "a sensor dead for good"])
@pytest.mark.parametrize(("state", "obs"), [(17, 17), (32, 8)], ids=str)
def test_float32_updates_of_a_correlated_belief_stay_positive_definite(state, obs, dead):
    g = torch.Generator().manual_seed(0)
    root = torch.randn(state, state, generator=g)
    cov = root @ root.T / state + 0.01 * torch.eye(state)
    belief = Belief(torch.zeros(state), cov)
    h = torch.randn(obs, state, generator=g) / state**0.5
    r = 1e-4 * torch.eye(obs)
    observed = torch.ones(obs, dtype=torch.bool)
    observed[0] = False
    smallest = []
    for _ in range(1500):
        if not dead:
            observed = torch.rand(obs, generator=g) < 0.5
        belief = F.update(belief, torch.randn(obs, generator=g), observed, h, r)
        smallest.append(torch.linalg.eigvalsh(belief.cov.double())[0])
    assert float(torch.stack(smallest).min()) > 0


@pytest.mark.parametrize("std", [0.3, 3.0])
def test_a_float32_covariance_is_not_inflated(std):
    # A large prior beside a small R: the safeguard against rounding must not show.
    g = torch.Generator().manual_seed(0)
    h = 5.0 * torch.linalg.qr(torch.randn(17, 17, generator=g))[0]
    belief = Belief(torch.zeros(17), std**2 * torch.eye(17))
    seen = torch.ones(17, dtype=torch.bool)
    single = F.update(belief, torch.zeros(17), seen, h, 1e-4 * torch.eye(17)).cov
    wide = Belief(belief.mean.double(), belief.cov.double())
    zeros = torch.zeros(17, dtype=torch.float64)
    r = (1e-4 * torch.eye(17)).double()
    double = F.update(wide, zeros, seen, h.double(), r).cov
    torch.testing.assert_close(single.diagonal().double(), double.diagonal(), rtol=1e-5, atol=0)


@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_float32_is_near_float64(state, obs):
    system, belief, x, offset, g = case(state, obs)
    observed = some_masks(len(x), obs, g)
    single = system.to(torch.float32)
    truth = (belief, x, observed, system.matrix, system.noise, offset)
    near = (
        Belief(belief.mean.float(), belief.cov.float()),
        x.float(),
        observed,
        single.matrix,
        single.noise,
        offset.float(),
    )
    for a, b in zip(F.update(*near), F.update(*truth), strict=True):
        assert a.dtype == torch.float32
        torch.testing.assert_close(a.double(), b, atol=2e-5, rtol=2e-5)
    torch.testing.assert_close(
        F.log_likelihood(*near).double(), F.log_likelihood(*truth), atol=2e-4, rtol=2e-5
    )
