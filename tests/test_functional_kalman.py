"""One Kalman step under missing entries: the laws of `functional.kalman`.

Specified here, in float64 unless the test is about float32:

- masking an entry equals deleting its row, in values and in gradients;
- nothing observed: the filtered belief is the predicted one and the log-likelihood 0, exactly;
- NaN or inf under a False mask changes nothing and gets a gradient of exactly 0;
- the log-likelihood is that of `torch.distributions.MultivariateNormal`;
- a noise variance that grows without bound is a missing entry;
- the order of the entries, the order of assimilation and the batch shape do not matter;
- an update never raises the trace of the covariance, and no eigenvalue of it;
- two steps agree with two steps by hand, and with systems whose answers are known;
- covariances stay symmetric and positive definite in float32, through 10,000 steps too.
"""

from __future__ import annotations

import itertools
import math

import oracles
import pytest
import torch
from kalman_cases import PATTERNS, SEEDS, SIZES, assert_equal, case, pattern, some_masks
from torch import Tensor

from torchrl_drbpn import functional as F
from torchrl_drbpn.functional.gaussian import Belief

# --- missing entries ----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", PATTERNS)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_masking_an_entry_equals_deleting_its_row(state, obs, seed, kind):
    system, belief, x, offset, g = case(state, obs, seed=seed)
    observed = pattern(kind, obs, g)
    h, r = system.matrix, system.noise

    filtered = F.update(belief, x, observed.expand_as(x), h, r, offset)
    ll = F.log_likelihood(belief, x, observed.expand_as(x), h, r, offset)

    for i in range(len(x)):
        arguments = (belief.mean[i], belief.cov[i], x[i], observed, h, r, offset[i])
        mean, cov = oracles.update(*arguments)
        assert_equal(filtered.mean[i], mean)
        assert_equal(filtered.cov[i], cov)
        assert_equal(ll[i], oracles.log_likelihood(*arguments))


@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_gradients_equal_those_of_the_row_deleting_oracle(state, obs):
    system, belief, x, offset, g = case(state, obs)
    observed = some_masks(len(x), obs, g)
    # Covariances enter through a factor, so that the gradient does not depend on which of the
    # two triangles a formula happens to read.
    leaves = [
        t.clone().requires_grad_()
        for t in (
            belief.mean,
            torch.linalg.cholesky(belief.cov),
            x,
            system.matrix,
            torch.linalg.cholesky(system.noise),
            offset,
        )
    ]
    mean, root_p, x, h, root_r, offset = leaves
    cov, r = root_p @ root_p.mT, root_r @ root_r.mT
    weights = torch.randn(2, *cov.shape, generator=g, dtype=torch.float64)

    def objective(mean_: Tensor, cov_: Tensor, ll: Tensor) -> Tensor:
        return (weights[0, ..., 0] * mean_).sum() + (weights[1] * cov_).sum() + ll.square().sum()

    filtered = F.update(Belief(mean, cov), x, observed, h, r, offset)
    ll = F.log_likelihood(Belief(mean, cov), x, observed, h, r, offset)
    actual = torch.autograd.grad(
        objective(filtered.mean, filtered.cov, ll), leaves, retain_graph=True
    )

    rows = [(mean[i], cov[i], x[i], observed[i], h, r, offset[i]) for i in range(len(x))]
    updated = [oracles.update(*row) for row in rows]
    lls = [oracles.log_likelihood(*row) for row in rows]
    expected = torch.autograd.grad(
        objective(
            torch.stack([m for m, _ in updated]),
            torch.stack([c for _, c in updated]),
            torch.stack(lls),
        ),
        leaves,
    )
    for a, e in zip(actual, expected, strict=True):
        assert_equal(a, e)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_nothing_observed_returns_the_predicted_belief_and_likelihood_zero(state, obs, dtype):
    system, belief, x, offset, _ = case(state, obs)
    system = system.to(dtype)
    leaves = [
        t.to(dtype).requires_grad_()
        for t in (belief.mean, belief.cov, x, system.matrix, system.noise, offset)
    ]
    mean, cov, x, h, r, offset = leaves
    nothing = torch.zeros_like(x, dtype=torch.bool)

    filtered = F.update(Belief(mean, cov), x, nothing, h, r, offset)
    ll = F.log_likelihood(Belief(mean, cov), x, nothing, h, r, offset)

    assert torch.equal(filtered.mean, mean)
    assert torch.equal(filtered.cov, cov)
    assert torch.equal(ll, torch.zeros_like(ll))
    (filtered.mean.sum() + filtered.cov.sum() + ll.sum()).backward()
    # x, H, R and the offset took no part, the belief passed through unchanged.
    for leaf in (x, h, r, offset):
        assert leaf.grad is None or torch.equal(leaf.grad, torch.zeros_like(leaf))
    assert torch.equal(mean.grad, torch.ones_like(mean))
    # Through either triangle: the symmetric part of the gradient is that of the identity map.
    assert torch.allclose(cov.grad + cov.grad.mT, 2 * torch.ones_like(cov))


@pytest.mark.parametrize("junk", [math.nan, math.inf, -math.inf, 1e30])
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_what_lies_under_a_false_mask_changes_nothing_and_has_zero_gradient(state, obs, junk):
    system, belief, clean, offset, g = case(state, obs)
    observed = some_masks(len(clean), obs, g)
    dirty = torch.where(observed, clean, torch.full_like(clean, junk))
    results = []
    for x in (clean, dirty):
        leaves = [
            t.clone().requires_grad_()
            for t in (x, belief.mean, belief.cov, system.matrix, system.noise, offset)
        ]
        x, mean, cov, h, r, d = leaves
        predicted = Belief(mean, cov)
        v = F.innovation(predicted, x, observed, h, r, d)
        filtered = F.update(predicted, x, observed, h, r, d)
        ll = F.log_likelihood(predicted, x, observed, h, r, d)
        loss = sum(t.square().sum() for t in (*v, *filtered, ll))
        results.append((*v, *filtered, ll, *torch.autograd.grad(loss, leaves)))

    for a, b in zip(*results, strict=True):
        assert torch.equal(a, b)
    gradient = results[1][5]
    assert torch.equal(gradient[~observed], torch.zeros_like(gradient[~observed]))
    assert (gradient[observed] != 0).all()


@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_an_unbounded_noise_variance_is_a_missing_entry(state, obs):
    system, belief, x, offset, g = case(state, obs, full_noise=False)
    observed = some_masks(len(x), obs, g)
    missing = F.update(belief, x, observed, system.matrix, system.noise, offset)
    errors = []
    for variance in (1e6, 1e8, 1e10):
        noise = system.noise + torch.diag_embed(torch.where(observed, 0.0, variance).double())
        means, covs = [], []
        for i in range(len(x)):
            one = F.update(
                Belief(belief.mean[i], belief.cov[i]),
                x[i],
                torch.ones(obs, dtype=torch.bool),
                system.matrix,
                noise[i],
                offset[i],
            )
            means.append(one.mean)
            covs.append(one.cov)
        errors.append(
            float((torch.stack(means) - missing.mean).abs().max())
            + float((torch.stack(covs) - missing.cov).abs().max())
        )
    # The error of the huge-variance picture falls as 1 / variance.
    assert errors[0] < 1e-3
    assert errors[1] < errors[0] / 50
    assert errors[2] < errors[1] / 50


# --- likelihood and innovation ------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_log_likelihood_is_that_of_the_multivariate_normal(state, obs, seed):
    system, belief, x, offset, _ = case(state, obs, seed=seed)
    everything = torch.ones_like(x, dtype=torch.bool)
    expected = torch.distributions.MultivariateNormal(
        belief.mean @ system.matrix.T + offset,
        system.matrix @ belief.cov @ system.matrix.T + system.noise,
    ).log_prob(x)
    actual = F.log_likelihood(belief, x, everything, system.matrix, system.noise, offset)
    assert actual.shape == x.shape[:-1]
    assert_equal(actual, expected)


@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_log_likelihood_is_the_marginal_of_the_complete_one(state, obs):
    # Deleting rows must be the same as integrating them out: by quadrature over one entry.
    system, belief, x, offset, _ = case(state, obs, batch=1)
    observed = torch.ones_like(x, dtype=torch.bool)
    observed[0, 0] = False
    marginal = F.log_likelihood(belief, x, observed, system.matrix, system.noise, offset)

    grid = torch.linspace(-60, 60, 24001, dtype=torch.float64)
    swept = x.expand(len(grid), obs).clone()
    swept[:, 0] = grid
    complete = F.log_likelihood(
        Belief(belief.mean.expand(len(grid), state), belief.cov.expand(len(grid), state, state)),
        swept,
        torch.ones_like(swept, dtype=torch.bool),
        system.matrix,
        system.noise,
        offset.expand_as(swept),
    )
    integral = torch.trapezoid(complete.exp(), grid).log()
    assert_equal(marginal, integral.reshape(1), 1e-8)


@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_innovation_is_the_residual_with_zeros_and_the_unmasked_covariance(state, obs):
    system, belief, x, offset, g = case(state, obs)
    observed = some_masks(len(x), obs, g)
    residual, cov = F.innovation(belief, x, observed, system.matrix, system.noise, offset)
    complete = x - belief.mean @ system.matrix.T - offset
    assert_equal(residual, torch.where(observed, complete, torch.zeros_like(complete)))
    assert torch.equal(residual[~observed], torch.zeros_like(residual[~observed]))
    assert_equal(cov, system.matrix @ belief.cov @ system.matrix.T + system.noise)


def test_an_offset_of_none_is_an_offset_of_zero():
    system, belief, x, _, g = case(3, 5)
    observed = some_masks(len(x), 5, g)
    arguments = (belief, x, observed, system.matrix, system.noise)
    zero = torch.zeros_like(x)
    for function in (F.innovation, F.update):
        for a, b in zip(function(*arguments), function(*arguments, zero), strict=True):
            assert_equal(a, b)
    assert_equal(F.log_likelihood(*arguments), F.log_likelihood(*arguments, zero))


# --- symmetries ---------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_the_order_of_the_entries_does_not_matter(state, obs, seed):
    system, belief, x, offset, g = case(state, obs, seed=seed)
    observed = some_masks(len(x), obs, g)
    order = torch.randperm(obs, generator=g)
    straight = (belief, x, observed, system.matrix, system.noise, offset)
    permuted = (
        belief,
        x[:, order],
        observed[:, order],
        system.matrix[order],
        system.noise[order][:, order],
        offset[:, order],
    )
    for a, b in zip(F.update(*straight), F.update(*permuted), strict=True):
        assert_equal(a, b)
    assert_equal(F.log_likelihood(*straight), F.log_likelihood(*permuted))
    residual, cov = F.innovation(*straight)
    residual_p, cov_p = F.innovation(*permuted)
    assert_equal(residual[:, order], residual_p)
    assert_equal(cov[:, order][:, :, order], cov_p)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_rotating_the_state_rotates_the_belief(state, obs, seed):
    system, belief, x, offset, g = case(state, obs, seed=seed)
    observed = some_masks(len(x), obs, g)
    rotation = torch.linalg.qr(torch.randn(state, state, generator=g, dtype=torch.float64))[0]
    turned = Belief(belief.mean @ rotation.T, rotation @ belief.cov @ rotation.T)
    matrix = system.matrix @ rotation.T
    plain = F.update(belief, x, observed, system.matrix, system.noise, offset)
    rotated = F.update(turned, x, observed, matrix, system.noise, offset)
    assert_equal(rotated.mean, plain.mean @ rotation.T)
    assert_equal(rotated.cov, rotation @ plain.cov @ rotation.T)
    assert_equal(
        F.log_likelihood(turned, x, observed, matrix, system.noise, offset),
        F.log_likelihood(belief, x, observed, system.matrix, system.noise, offset),
    )


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_assimilating_entries_one_by_one_equals_all_at_once(state, obs, seed):
    # Holds because the noise is diagonal: the entries are independent given the state.
    system, belief, x, offset, g = case(state, obs, seed=seed, full_noise=False)
    observed = some_masks(len(x), obs, g)
    at_once = F.update(belief, x, observed, system.matrix, system.noise, offset)
    at_once_ll = F.log_likelihood(belief, x, observed, system.matrix, system.noise, offset)

    one_by_one = belief
    total = torch.zeros(len(x), dtype=torch.float64)
    for i in torch.randperm(obs, generator=g).tolist():
        only = torch.zeros_like(observed)
        only[:, i] = observed[:, i]
        arguments = (one_by_one, x, only, system.matrix, system.noise, offset)
        total = total + F.log_likelihood(*arguments)
        one_by_one = F.update(*arguments)
    assert_equal(one_by_one.mean, at_once.mean)
    assert_equal(one_by_one.cov, at_once.cov)
    assert_equal(total, at_once_ll)


@pytest.mark.parametrize("shape", [(), (1,), (7,), (2, 3), (2, 1, 3)], ids=str)
def test_a_batch_equals_a_loop_over_its_members(shape):
    system = oracles.random_system(3, 4, seed=5, full_noise=True)
    g = torch.Generator().manual_seed(5)
    randn = lambda *s: torch.randn(*s, generator=g, dtype=torch.float64)  # noqa: E731
    mean, action = randn(*shape, 3), randn(*shape, 2)
    root = randn(*shape, 3, 3)
    cov = root @ root.mT + torch.eye(3, dtype=torch.float64)
    x, offset = randn(*shape, 4), randn(*shape, 4)
    observed = torch.rand(*shape, 4, generator=g) < 0.5

    predicted = F.predict(
        Belief(mean, cov), system.transition, system.transition_cov, action, jacobian=None
    )
    propagated = F.predict(
        Belief(mean, cov),
        system.transition,
        system.transition_cov,
        action,
        jacobian=system.dynamics,
    )
    arguments = (x, observed, system.matrix, system.noise, offset)
    residual, innovation_cov = F.innovation(propagated, *arguments)
    filtered = F.update(propagated, *arguments)
    ll = F.log_likelihood(propagated, *arguments)

    assert predicted.mean.shape == (*shape, 3)
    assert residual.shape == (*shape, 4)
    assert innovation_cov.shape == (*shape, 4, 4)
    assert filtered.mean.shape == (*shape, 3)
    assert filtered.cov.shape == (*shape, 3, 3)
    assert ll.shape == shape
    for index in itertools.product(*map(range, shape)):
        m, p = oracles.predict(
            mean[index],
            cov[index],
            system.transition,
            system.transition_cov,
            action[index],
            system.dynamics,
        )
        assert_equal(propagated.mean[index], m)
        assert_equal(predicted.mean[index], m)
        assert_equal(propagated.cov[index], p)
        step = (m, p, x[index], observed[index], system.matrix, system.noise, offset[index])
        expected_mean, expected_cov = oracles.update(*step)
        assert_equal(filtered.mean[index], expected_mean)
        assert_equal(filtered.cov[index], expected_cov)
        assert_equal(ll[index], oracles.log_likelihood(*step))


# --- gradients by finite differences ------------------------------------------------------------


@pytest.mark.parametrize("kind", PATTERNS)
def test_gradients_agree_with_finite_differences(kind):
    system, belief, x, offset, g = case(2, 3, batch=1)
    observed = pattern(kind, 3, g).expand_as(x)

    def step(mean, root_p, x, h, root_r, offset):
        # A factor keeps the covariances symmetric while entries of the factor are perturbed.
        predicted = Belief(mean, root_p @ root_p.mT)
        arguments = (predicted, x, observed, h, root_r @ root_r.mT, offset)
        return *F.update(*arguments), F.log_likelihood(*arguments)

    leaves = (
        belief.mean,
        torch.linalg.cholesky(belief.cov),
        x,
        system.matrix,
        torch.linalg.cholesky(system.noise),
        offset,
    )
    assert torch.autograd.gradcheck(step, [t.clone().requires_grad_() for t in leaves])


# --- what an update may do to a covariance ------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_an_update_never_raises_the_trace_nor_any_eigenvalue(state, obs, seed):
    system, belief, x, offset, g = case(state, obs, seed=seed, batch=40)
    observed = some_masks(len(x), obs, g)
    filtered = F.update(belief, x, observed, system.matrix, system.noise, offset)
    trace = lambda cov: cov.diagonal(dim1=-2, dim2=-1).sum(-1)  # noqa: E731
    assert (trace(filtered.cov) <= trace(belief.cov)).all()
    # P - filtered cov is positive semidefinite (the Loewner order), of rank the number observed.
    shrinkage = torch.linalg.eigvalsh(belief.cov - filtered.cov)
    assert shrinkage.min() > -1e-12
    rank = (shrinkage > 1e-9).sum(-1)
    assert torch.equal(rank, observed.sum(-1).clamp(max=state))


@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_observing_one_more_entry_never_raises_the_trace(state, obs):
    system, belief, x, offset, g = case(state, obs, batch=30)
    more = torch.rand(30, obs, generator=g) < 0.6
    less = more & (torch.rand(30, obs, generator=g) < 0.5)
    arguments = (system.matrix, system.noise, offset)
    cov_more = F.update(belief, x, more, *arguments).cov
    cov_less = F.update(belief, x, less, *arguments).cov
    assert torch.linalg.eigvalsh(cov_less - cov_more).min() > -1e-12


# --- known answers ------------------------------------------------------------------------------


def test_two_steps_by_hand():
    # Scalar, s' = s + a, x = 2 s + 1 + noise, Q = 1, R = 4, the paper's rule P = Q.
    # Step 1: a = 1, mean 0 -> 1, P = 1; S = 2 * 1 * 2 + 4 = 8, K = 2 / 8 = 1/4;
    #         x = 7, v = 7 - 2 - 1 = 4, mean = 1 + 1 = 2, cov = 1 - 1/4 * 2 * 1 = 1/2;
    #         ll = -1/2 (16 / 8 + log(2 pi 8)).
    # Step 2: a = -1, mean 2 -> 1, P = 1 (it forgets 1/2); x = 3, v = 0: mean 1, cov 1/2;
    #         ll = -1/2 log(2 pi 8).
    one = torch.ones(1, 1, dtype=torch.float64)
    d = torch.ones(1, dtype=torch.float64)
    seen = torch.ones(1, dtype=torch.bool)
    vector = lambda value: torch.tensor([value], dtype=torch.float64)  # noqa: E731
    half_log = 0.5 * math.log(2 * math.pi * 8)
    belief = Belief(vector(0.0), one)
    for action, x, mean, ll in [(1.0, 7.0, 2.0, -1 - half_log), (-1.0, 3.0, 1.0, -half_log)]:
        predicted = F.predict(belief, lambda m, a: m + a, one, vector(action), jacobian=None)
        arguments = (predicted, vector(x), seen, 2 * one, 4 * one, d)
        actual_ll = F.log_likelihood(*arguments)
        belief = F.update(*arguments)
        assert_equal(belief.mean, vector(mean))
        assert_equal(belief.cov, one / 2)
        assert_equal(actual_ll, torch.tensor(ll, dtype=torch.float64))


def test_two_steps_by_hand_with_the_covariance_propagated():
    # Scalar, s' = s / 2, x = s + noise, Q = R = 1, start N(0, 4).
    # Step 1: P = 4/4 + 1 = 2, K = 2/3, x = 3: mean = 2, cov = 2/3.
    # Step 2: P = 1/6 + 1 = 7/6, K = 7/13, x = 14 / 1: predicted 1, v = 13: mean = 8, cov = 7/13.
    one = torch.ones(1, 1, dtype=torch.float64)
    seen = torch.ones(1, dtype=torch.bool)
    vector = lambda value: torch.tensor([value], dtype=torch.float64)  # noqa: E731
    belief = Belief(vector(0.0), 4 * one)
    for x, mean, cov in [(3.0, 2.0, 2 / 3), (14.0, 8.0, 7 / 13)]:
        predicted = F.predict(belief, lambda m, _: m / 2, one, vector(0.0), jacobian=one / 2)
        belief = F.update(predicted, vector(x), seen, one, one)
        assert_equal(belief.mean, vector(mean))
        assert_equal(belief.cov, cov * one)


def test_predict_forgets_the_covariance_where_the_jacobian_is_none():
    system, belief, _, _, g = case(3, 4)
    action = torch.randn(5, 2, generator=g, dtype=torch.float64)
    q = system.transition_cov
    plain = F.predict(belief, system.transition, q, action, jacobian=None)
    wide = Belief(belief.mean, 9 * belief.cov)
    wider = F.predict(wide, system.transition, q, action, jacobian=None)
    with pytest.raises(TypeError, match="jacobian"):
        F.predict(belief, system.transition, q, action)
    moved = F.predict(belief, system.transition, q, action, jacobian=system.dynamics)
    assert_equal(plain.mean, belief.mean @ system.dynamics.T + action @ system.control.T)
    assert torch.equal(plain.cov.expand_as(belief.cov), q.expand_as(belief.cov))
    assert torch.equal(plain.cov, wider.cov)
    assert_equal(moved.mean, plain.mean)
    assert_equal(moved.cov, system.dynamics @ belief.cov @ system.dynamics.T + q)


def test_predict_takes_a_transition_covariance_and_a_jacobian_for_each_belief():
    system, belief, _, _, g = case(3, 4)
    action = torch.randn(5, 2, generator=g, dtype=torch.float64)
    q = torch.stack([oracles.spd(3, g) for _ in range(5)])
    j = torch.randn(5, 3, 3, generator=g, dtype=torch.float64)
    predicted = F.predict(belief, system.transition, q, action, jacobian=j)
    for i in range(5):
        _, cov = oracles.predict(
            belief.mean[i], belief.cov[i], system.transition, q[i], action[i], j[i]
        )
        assert_equal(predicted.cov[i], cov)


def test_independent_sensors_of_one_state_average_by_precision():
    # mean = (m / P + sum x_i / r_i) / (1 / P + sum 1 / r_i), cov = 1 / (1 / P + sum 1 / r_i).
    x = torch.tensor([1.0, -2.0, 4.0], dtype=torch.float64)
    r = torch.tensor([0.5, 2.0, 1.0], dtype=torch.float64)
    observed = torch.tensor([True, False, True])
    p, m = 3.0, 0.7
    precision = 1 / p + (observed / r).sum()
    filtered = F.update(
        Belief(torch.tensor([m]).double(), torch.tensor([[p]]).double()),
        x,
        observed,
        torch.ones(3, 1, dtype=torch.float64),
        torch.diag(r),
    )
    expected = (torch.tensor(m).double() / p + (observed * x / r).sum()) / precision
    assert_equal(filtered.mean, expected.reshape(1))
    assert_equal(filtered.cov, (1 / precision).reshape(1, 1))


def test_independent_coordinates_do_not_hear_of_each_other():
    # H = I, P and R diagonal: entry i moves coordinate i alone, with gain p_i / (p_i + r_i).
    g = torch.Generator().manual_seed(0)
    p, r = torch.rand(2, 4, generator=g, dtype=torch.float64) + 0.1
    m, x = torch.randn(2, 4, generator=g, dtype=torch.float64)
    observed = torch.tensor([True, False, True, False])
    filtered = F.update(
        Belief(m, torch.diag(p)), x, observed, torch.eye(4, dtype=torch.float64), torch.diag(r)
    )
    gain = torch.where(observed, p / (p + r), 0.0)
    assert_equal(filtered.mean, m + gain * (x - m))
    assert_equal(filtered.cov, torch.diag(p * (1 - gain)))


def test_the_scalar_random_walk_settles_on_the_golden_ratio():
    system = oracles.scalar_random_walk()
    zero = torch.zeros(1, dtype=torch.float64)
    seen = torch.ones(1, dtype=torch.bool)
    filtered = Belief(system.initial_mean, 50 * system.initial_cov)
    for _ in range(60):
        predicted = F.predict(
            filtered, system.transition, system.transition_cov, zero, jacobian=system.dynamics
        )
        filtered = F.update(predicted, zero, seen, system.matrix, system.noise)
    assert_equal(predicted.cov, torch.full_like(predicted.cov, oracles.GOLDEN_RATIO))
    assert_equal(filtered.cov, torch.full_like(filtered.cov, oracles.GOLDEN_RATIO - 1))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_step_likelihoods_sum_to_one_joint_gaussian_when_the_covariance_is_propagated(
    state, obs, seed
):
    system = oracles.random_system(state, obs, seed=seed, full_noise=True)
    data = oracles.simulate(system, batch=1, time=6, seed=seed)
    filtered = Belief(system.initial_mean, system.initial_cov)
    total = torch.zeros((), dtype=torch.float64)
    for t in range(6):
        action = data.previous_action[0, t]
        predicted = filtered
        if t > 0:
            predicted = F.predict(
                filtered,
                system.transition,
                system.transition_cov,
                action,
                jacobian=system.dynamics,
            )
        arguments = (
            predicted,
            data.observation[0, t],
            data.observed[0, t],
            system.matrix,
            system.noise,
            system.offset(action),
        )
        total = total + F.log_likelihood(*arguments)
        filtered = F.update(*arguments)
    assert_equal(total, oracles.joint_log_likelihood(system, data, row=0))


def test_it_equals_statsmodels_with_missing_entries_and_the_covariance_propagated():
    statespace = pytest.importorskip("statsmodels.tsa.statespace.kalman_filter")
    system = oracles.random_system(3, 5, seed=4, full_noise=True)
    data = oracles.simulate(system, batch=1, time=30, seed=4)
    x, observed = data.observation[0], data.observed[0]
    offsets = system.offset(data.previous_action[0])
    theirs = statespace.KalmanFilter(k_endog=5, k_states=3)
    theirs.bind(torch.where(observed, x, torch.nan).numpy())
    theirs["design"], theirs["obs_cov"] = system.matrix.numpy(), system.noise.numpy()
    theirs["obs_intercept"] = offsets.T.numpy()
    theirs["transition"], theirs["selection"] = system.dynamics.numpy(), torch.eye(3).numpy()
    moves = data.previous_action[0, 1:] @ system.control.T  # theirs lead from a step to the next
    theirs["state_intercept"] = torch.cat([moves, torch.zeros(1, 3)]).double().T.numpy()
    theirs["state_cov"] = system.transition_cov.numpy()
    theirs.initialize_known(system.initial_mean.numpy(), system.initial_cov.numpy())
    truth = theirs.filter()

    predicted = Belief(system.initial_mean, system.initial_cov)
    for t in range(30):
        step = (predicted, x[t], observed[t], system.matrix, system.noise, offsets[t])
        ll, filtered = F.log_likelihood(*step), F.update(*step)
        assert_equal(filtered.mean, torch.from_numpy(truth.filtered_state[:, t]), 1e-8)
        assert_equal(filtered.cov, torch.from_numpy(truth.filtered_state_cov[:, :, t]), 1e-8)
        assert_equal(ll, torch.tensor(truth.llf_obs[t], dtype=torch.float64), 1e-8)
        if t < 29:
            predicted = F.predict(
                filtered, system.transition, system.transition_cov, data.previous_action[0, t + 1],
                jacobian=system.dynamics,
            )  # fmt: skip


# --- manners ------------------------------------------------------------------------------------


def test_inputs_are_left_as_they_were():
    system, belief, x, offset, g = case(3, 5)
    observed = some_masks(len(x), 5, g)
    x = torch.where(observed, x, torch.full_like(x, math.nan))
    inputs = (belief.mean, belief.cov, x, observed, system.matrix, system.noise, offset)
    before = [t.clone() for t in inputs]
    F.update(belief, *inputs[2:])
    F.log_likelihood(belief, *inputs[2:])
    F.innovation(belief, *inputs[2:])
    F.predict(
        belief, system.transition, system.transition_cov, torch.zeros(5, 2).double(), jacobian=None
    )
    for a, b in zip(inputs, before, strict=True):
        assert torch.equal(a.nan_to_num(7.0), b.nan_to_num(7.0))


@pytest.mark.parametrize("function", ["innovation", "update", "log_likelihood"])
@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(lambda mask: mask.float(), id="dtype"),
        pytest.param(lambda mask: mask[..., :1], id="shape"),
    ],
)
def test_a_mask_of_wrong_dtype_or_shape_is_refused(function, spoil):
    system, belief, x, offset, g = case(3, 5)
    observed = spoil(some_masks(len(x), 5, g))
    with pytest.raises(ValueError, match=r"`observed` must be"):
        getattr(F, function)(belief, x, observed, system.matrix, system.noise, offset)


def test_variances_are_a_diagonal_covariance_and_never_a_row():
    belief, x = Belief(torch.zeros(2), torch.ones(2)), torch.tensor([1.0, 2.0])
    seen, eye, r = torch.ones(2, dtype=torch.bool), torch.eye(2), torch.tensor([0.1, 0.2])
    full = (Belief(belief.mean, eye), x, seen, eye, r.diag())
    short = (belief, x, seen, eye, r)
    assert_equal(F.update(*short).mean, torch.tensor([1 / 1.1, 2 / 1.2]), 1e-6)
    for function in (F.update, F.innovation):
        for a, b in zip(function(*short), function(*full), strict=True):
            assert torch.equal(a, b)
    assert torch.equal(F.log_likelihood(*short), F.log_likelihood(*full))
    for jacobian in (None, 2 * eye):
        a = F.predict(belief, lambda m, _: m, r, x, jacobian=jacobian)
        b = F.predict(full[0], lambda m, _: m, r.diag(), x, jacobian=jacobian)
        assert torch.equal(a.cov, b.cov)


@pytest.mark.parametrize("function", ["innovation", "update", "log_likelihood"])
@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (0, Belief(torch.zeros(3), torch.ones(2)), r"`belief.cov` must be .* \(3,\).* got \(2,\)"),
        (3, torch.ones(5, 2), r"`emission_matrix` must have shape \(obs, state\) = \(5, 3\)"),
        (4, torch.ones(5, 1), r"`emission_cov` must be a covariance .* got \(5, 1\)"),
        (4, torch.ones(1), r"`emission_cov` must be a covariance .* got \(1,\)"),
        (5, torch.ones(1), r"`offset` must have shape"),
    ],
)
def test_a_wrong_size_is_one_clear_line(function, place, value, message):
    seen = torch.ones(5, dtype=torch.bool)
    step = [Belief(torch.zeros(3), torch.eye(3)), torch.ones(5), seen, torch.ones(5, 3)]
    step += [torch.ones(5), torch.zeros(5)]
    step[place] = value
    with pytest.raises(ValueError, match=message):
        getattr(F, function)(*step)


@pytest.mark.parametrize("function", ["update", "log_likelihood"])
def test_two_exact_sensors_of_one_quantity_are_one_clear_line(function):
    belief, seen = Belief(torch.zeros(1), torch.eye(1)), torch.ones(2, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"not positive definite.*without noise \(R = 0\)"):
        getattr(F, function)(belief, torch.ones(2), seen, torch.ones(2, 1), torch.zeros(2))
