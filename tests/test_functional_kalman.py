"""One Kalman step under missing entries: the laws of `functional.kalman`, in float64.

Laws over masks, shapes and dimensions drawn at random are in test_functional_properties.py.
"""

from __future__ import annotations

import math

import oracles
import pytest
import torch
from filter_problems import assert_equal
from kalman_cases import PATTERNS, SEEDS, SIZES, case, given, pattern
from torch import Tensor

from torchrl_drbpn import functional as F
from torchrl_drbpn.functional.gaussian import Belief

sized = pytest.mark.parametrize(("state", "obs"), SIZES)
seeded = pytest.mark.parametrize("seed", SEEDS)
FUNCTIONS = ["innovation", "update", "log_likelihood"]


def outputs(*step) -> tuple[Tensor, ...]:
    """Residual and innovation covariance, filtered mean and covariance, log-likelihood."""
    return (*F.innovation(*step), *F.update(*step), F.log_likelihood(*step))


def vector(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


@seeded
@sized
def test_masking_an_entry_equals_deleting_its_row_in_values_and_gradients(state, obs, seed):
    (belief, x, observed, h, r, offset), g = given(state, obs, seed=seed)
    # Covariances enter through a factor: no gradient depends on the triangle that a formula reads.
    roots = torch.linalg.cholesky(belief.cov), torch.linalg.cholesky(r)
    leaves = [t.clone().requires_grad_() for t in (belief.mean, roots[0], x, h, roots[1], offset)]
    mean, root_p, x, h, root_r, offset = leaves
    cov, r = root_p @ root_p.mT, root_r @ root_r.mT
    actual = outputs(Belief(mean, cov), x, observed, h, r, offset)[2:]
    rows = [(mean[i], cov[i], x[i], observed[i], h, r, offset[i]) for i in range(len(x))]
    each = [(*oracles.update(*row), oracles.log_likelihood(*row)) for row in rows]
    expected = [torch.stack(part) for part in zip(*each, strict=True)]
    weights = [torch.randn(e.shape, generator=g, dtype=torch.float64) for e in expected]
    totals = [
        sum((w * (t + t.square())).sum() for w, t in zip(weights, out, strict=True))
        for out in (actual, expected)
    ]
    gradients = [torch.autograd.grad(total, leaves, retain_graph=True) for total in totals]
    for a, e in zip((*actual, *gradients[0]), (*expected, *gradients[1]), strict=True):
        assert_equal(a, e)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
@sized
def test_readings_one_after_the_other_lead_where_all_at_once_do(state, obs, dtype, tolerance):
    (belief, x, observed, h, r, offset), _ = given(state, obs, full_noise=False)
    expected = F.update(belief, x, observed, h, r, offset)
    parts = [t.to(dtype) for t in (*belief, torch.where(observed, x, torch.nan), h, r, offset)]
    mean, cov, x, h, r, offset = parts
    actual = F.sequential_update(Belief(mean, cov), x, observed, h, r.diagonal(), offset)
    assert actual.mean.dtype == actual.cov.dtype == dtype
    for a, e in zip(actual, expected, strict=True):
        assert_equal(a.double(), e, tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@sized
def test_nothing_observed_returns_the_predicted_belief_and_likelihood_zero(state, obs, dtype):
    (belief, x, _, h, r, offset), _ = given(state, obs)
    leaves = [t.to(dtype).requires_grad_() for t in (*belief, x, h, r, offset)]
    mean, cov, *rest = leaves
    rest.insert(1, torch.zeros_like(x, dtype=torch.bool))
    *_, filtered_mean, filtered_cov, ll = outputs(Belief(mean, cov), *rest)
    assert torch.equal(filtered_mean, mean)
    assert torch.equal(filtered_cov, cov)
    assert torch.equal(ll, torch.zeros_like(ll))
    (filtered_mean.sum() + filtered_cov.sum() + ll.sum()).backward()
    # x, H, R and the offset took no part, the belief passed through unchanged.
    assert all(leaf.grad is None or not leaf.grad.any() for leaf in leaves[2:])
    assert torch.equal(mean.grad, torch.ones_like(mean))
    # Through either triangle: the symmetric part of the gradient is that of the identity map.
    assert torch.allclose(cov.grad + cov.grad.mT, 2 * torch.ones_like(cov))


@sized
def test_an_unbounded_noise_variance_is_a_missing_entry(state, obs):
    (belief, x, observed, h, r, offset), _ = given(state, obs, full_noise=False)
    missing = F.update(belief, x, observed, h, r, offset)
    errors = []
    for variance in (1e6, 1e8, 1e10):
        noise = r + torch.diag_embed(torch.where(observed, 0.0, variance).double())
        for i in range(len(x)):
            row = Belief(belief.mean[i], belief.cov[i]), x[i], torch.ones(obs, dtype=torch.bool)
            one = F.update(*row, h, noise[i], offset[i])
            errors.append(max((a - b[i]).abs().max() for a, b in zip(one, missing, strict=True)))
    worst = torch.stack(errors).reshape(3, -1).amax(1)
    assert worst[0] < 1e-3
    assert (worst[1:] < worst[:-1] / 50).all()  # it falls as 1 / variance


@seeded
@sized
def test_log_likelihood_is_that_of_the_multivariate_normal(state, obs, seed):
    (belief, x, observed, h, r, offset), _ = given(state, obs, seed=seed)
    mean, cov = belief.mean @ h.T + offset, h @ belief.cov @ h.T + r
    whole = torch.distributions.MultivariateNormal(mean, cov).log_prob(x)
    assert_equal(F.log_likelihood(belief, x, torch.ones_like(observed), h, r, offset), whole)
    # Deleting an entry is integrating it out: by quadrature over the first one.
    grid = torch.linspace(-60, 60, 24001, dtype=torch.float64)
    swept = x[0].expand(len(grid), obs).clone()
    swept[:, 0] = grid
    first = Belief(belief.mean[0].expand(len(grid), -1), belief.cov[0].expand(len(grid), -1, -1))
    complete = F.log_likelihood(
        first, swept, torch.ones_like(swept).bool(), h, r, offset[0].expand_as(swept)
    )
    without = torch.arange(obs).expand_as(x) > 0
    marginal = F.log_likelihood(belief, x, without, h, r, offset)[0]
    assert_equal(marginal, torch.trapezoid(complete.exp(), grid).log(), 1e-8)


@sized
def test_innovation_is_the_residual_with_zeros_and_the_unmasked_covariance(state, obs):
    (belief, x, observed, h, r, offset), _ = given(state, obs)
    residual, cov = F.innovation(belief, x, observed, h, r, offset)
    assert_equal(residual, torch.where(observed, x - belief.mean @ h.T - offset, 0.0))
    assert not residual[~observed].any()
    assert_equal(cov, h @ belief.cov @ h.T + r)
    without = outputs(belief, x, observed, h, r)
    for a, b in zip(without, outputs(belief, x, observed, h, r, 0 * x), strict=True):
        assert_equal(a, b)


@pytest.mark.parametrize("kind", PATTERNS)
def test_gradients_agree_with_finite_differences(kind):
    system, belief, x, offset, g = case(2, 3, batch=1)
    observed = pattern(kind, 3, g).expand_as(x)

    def step(mean, root_p, x, h, root_r, offset):
        # A factor keeps the covariances symmetric while entries of the factor are perturbed.
        predicted = Belief(mean, root_p @ root_p.mT)
        return outputs(predicted, x, observed, h, root_r @ root_r.mT, offset)[2:]

    roots = torch.linalg.cholesky(belief.cov), torch.linalg.cholesky(system.noise)
    leaves = (belief.mean, roots[0], x, system.matrix, roots[1], offset)
    assert torch.autograd.gradcheck(step, [t.clone().requires_grad_() for t in leaves])


def test_two_steps_by_hand():
    # Scalar, s' = s + a, x = 2 s + 1 + noise, Q = 1, R = 4, the paper's rule P = Q.
    # Step 1: a = 1, mean 0 -> 1, P = 1; S = 2 * 1 * 2 + 4 = 8, K = 2 / 8 = 1/4;
    #         x = 7, v = 7 - 2 - 1 = 4, mean = 1 + 1 = 2, cov = 1 - 1/4 * 2 * 1 = 1/2;
    #         ll = -1/2 (16 / 8 + log(2 pi 8)).
    # Step 2: a = -1, mean 2 -> 1, P = 1 (it forgets 1/2); x = 3, v = 0: mean 1, cov 1/2;
    #         ll = -1/2 log(2 pi 8).
    one, half_log = torch.ones(1, 1, dtype=torch.float64), 0.5 * math.log(2 * math.pi * 8)
    belief = Belief(vector(0.0), one)
    for action, x, mean, ll in [(1.0, 7.0, 2.0, -1 - half_log), (-1.0, 3.0, 1.0, -half_log)]:
        predicted = F.predict(belief, lambda m, a: m + a, one, vector(action), jacobian=None)
        step = (predicted, vector(x), torch.ones(1).bool(), 2 * one, 4 * one, vector(1.0))
        belief = F.update(*step)
        for a, e in zip((*belief, F.log_likelihood(*step)), (mean, 0.5, ll), strict=True):
            assert_equal(a, vector(e).reshape(a.shape))


def test_two_steps_by_hand_with_the_covariance_propagated():
    # Scalar, s' = s / 2, x = s + noise, Q = R = 1, start N(0, 4).
    # Step 1: P = 4/4 + 1 = 2, K = 2/3, x = 3: mean = 2, cov = 2/3.
    # Step 2: P = 1/6 + 1 = 7/6, K = 7/13, x = 14 / 1: predicted 1, v = 13: mean = 8, cov = 7/13.
    one = torch.ones(1, 1, dtype=torch.float64)
    belief = Belief(vector(0.0), 4 * one)
    for x, mean, cov in [(3.0, 2.0, 2 / 3), (14.0, 8.0, 7 / 13)]:
        predicted = F.predict(belief, lambda m, _: m / 2, one, vector(0.0), jacobian=one / 2)
        belief = F.update(predicted, vector(x), torch.ones(1).bool(), one, one)
        assert_equal(belief.mean, vector(mean))
        assert_equal(belief.cov, cov * one)


def test_predict_forgets_the_covariance_where_the_jacobian_is_none():
    system, belief, _, _, g = case(3, 4)
    action = torch.randn(5, 2, generator=g, dtype=torch.float64)
    q = system.transition_cov
    plain = F.predict(belief, system.transition, q, action, jacobian=None)
    with pytest.raises(TypeError, match="jacobian"):
        F.predict(belief, system.transition, q, action)
    assert_equal(plain.mean, belief.mean @ system.dynamics.T + action @ system.control.T)
    assert torch.equal(plain.cov.expand_as(belief.cov), q.expand_as(belief.cov))
    # A Q and a Jacobian of each belief's own.
    q = torch.stack([oracles.spd(3, g) for _ in range(5)])
    j = torch.randn(5, 3, 3, generator=g, dtype=torch.float64)
    assert_equal(
        F.predict(belief, system.transition, q, action, jacobian=j).cov, j @ belief.cov @ j.mT + q
    )


def test_independent_sensors_average_by_precision_and_independent_coordinates_stay_apart():
    # Of one state: mean = (m / P + sum x_i / r_i) / (1 / P + sum 1 / r_i), cov = one over that sum.
    x, r, observed = vector(1, -2, 4), vector(0.5, 2, 1), torch.tensor([True, False, True])
    p, m = 3.0, 0.7
    precision = 1 / p + (observed / r).sum()
    h = torch.ones(3, 1, dtype=torch.float64)
    filtered = F.update(Belief(vector(m), vector(p)[None]), x, observed, h, r.diag())
    assert_equal(filtered.mean, ((m / p + (observed * x / r).sum()) / precision).reshape(1))
    assert_equal(filtered.cov, (1 / precision).reshape(1, 1))
    # H = I, P and R diagonal: entry i moves coordinate i alone, with gain p_i / (p_i + r_i).
    p, m, eye = vector(0.3, 1, 2), vector(1, 2, 3), torch.eye(3, dtype=torch.float64)
    filtered = F.update(Belief(m, p.diag()), x, observed, eye, r.diag())
    gain = torch.where(observed, p / (p + r), 0.0)
    assert_equal(filtered.mean, m + gain * (x - m))
    assert_equal(filtered.cov, torch.diag(p * (1 - gain)))


def propagated(system, x, observed, action, belief):
    """Predicted and filtered beliefs and the log-likelihood of each step; the first is given."""
    for t in range(len(x)):
        if t:
            moves = (system.transition, system.transition_cov, action[t])
            belief = F.predict(belief, *moves, jacobian=system.dynamics)
        step = (belief, x[t], observed[t], system.matrix, system.noise, system.offset(action[t]))
        predicted, belief = belief, F.update(*step)
        yield predicted, belief, F.log_likelihood(*step)


def test_the_scalar_random_walk_settles_on_the_golden_ratio():
    system, zeros = oracles.scalar_random_walk(), torch.zeros(60, 1, dtype=torch.float64)
    start = Belief(system.initial_mean, 50 * system.initial_cov)
    *_, (predicted, filtered, _) = propagated(system, zeros, zeros == 0, zeros, start)
    assert_equal(predicted.cov, torch.full_like(predicted.cov, oracles.GOLDEN_RATIO))
    assert_equal(filtered.cov, torch.full_like(filtered.cov, oracles.GOLDEN_RATIO - 1))


@seeded
@sized
def test_step_likelihoods_sum_to_one_joint_gaussian_when_the_covariance_is_propagated(
    state, obs, seed
):
    system = oracles.random_system(state, obs, seed=seed, full_noise=True)
    data = oracles.simulate(system, batch=1, time=6, seed=seed)
    rows = data.observation[0], data.observed[0], data.previous_action[0]
    steps = propagated(system, *rows, Belief(system.initial_mean, system.initial_cov))
    assert_equal(sum(ll for *_, ll in steps), oracles.joint_log_likelihood(system, data, row=0))


def test_it_equals_statsmodels_with_missing_entries_and_the_covariance_propagated():
    system = oracles.random_system(3, 5, seed=4, full_noise=True)
    data = oracles.simulate(system, batch=1, time=30, seed=4)
    truth = oracles.statsmodels(system, data).filter()
    rows = data.observation[0], data.observed[0], data.previous_action[0]
    steps = propagated(system, *rows, Belief(system.initial_mean, system.initial_cov))
    for t, (_, filtered, ll) in enumerate(steps):
        assert_equal(filtered.mean, torch.from_numpy(truth.filtered_state[:, t]), 1e-8)
        assert_equal(filtered.cov, torch.from_numpy(truth.filtered_state_cov[:, :, t]), 1e-8)
        assert_equal(ll, torch.tensor(truth.llf_obs[t], dtype=torch.float64), 1e-8)


def test_inputs_are_left_as_they_were():
    (belief, x, observed, *model), _ = given(3, 5)
    inputs = (*belief, torch.where(observed, x, math.nan), observed, *model)
    before = [t.clone() for t in inputs]
    outputs(belief, *inputs[2:])
    F.predict(belief, lambda m, _: m, torch.eye(3).double(), torch.zeros(5, 2), jacobian=None)
    for a, b in zip(inputs, before, strict=True):
        assert torch.equal(a.nan_to_num(7.0), b.nan_to_num(7.0))


def test_variances_are_a_diagonal_covariance_and_never_a_row():
    belief, x = Belief(torch.zeros(2), torch.ones(2)), torch.tensor([1.0, 2.0])
    seen, eye, r = torch.ones(2, dtype=torch.bool), torch.eye(2), torch.tensor([0.1, 0.2])
    full, short = Belief(belief.mean, eye), (belief, x, seen, eye, r)
    assert_equal(F.update(*short).mean, torch.tensor([1 / 1.1, 2 / 1.2]), 1e-6)
    for a, b in zip(outputs(*short), outputs(full, x, seen, eye, r.diag()), strict=True):
        assert torch.equal(a, b)
    for jacobian in (None, 2 * eye):
        a = F.predict(belief, lambda m, _: m, r, x, jacobian=jacobian)
        b = F.predict(full, lambda m, _: m, r.diag(), x, jacobian=jacobian)
        assert torch.equal(a.cov, b.cov)


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (0, Belief(torch.zeros(3), torch.ones(2)), r"`belief.cov` must be .* \(3,\).* got \(2,\)"),
        (2, torch.ones(5), r"`observed` must be"),
        (2, torch.ones(1).bool(), r"`observed` must be"),
        (3, torch.ones(5, 2), r"`emission_matrix` must have shape \(obs, state\) = \(5, 3\)"),
        (4, torch.ones(5, 1), r"`emission_cov` must be a covariance .* got \(5, 1\)"),
        (4, torch.ones(1), r"`emission_cov` must be a covariance .* got \(1,\)"),
        (5, torch.ones(1), r"`offset` must have shape"),
    ],
)
def test_a_wrong_size_or_dtype_is_one_clear_line(function, place, value, message):
    seen = torch.ones(5, dtype=torch.bool)
    step = [Belief(torch.zeros(3), torch.eye(3)), torch.ones(5), seen, torch.ones(5, 3)]
    step += [torch.ones(5), torch.zeros(5)]
    step[place] = value
    with pytest.raises(ValueError, match=message):
        getattr(F, function)(*step)


@pytest.mark.parametrize("function", FUNCTIONS[1:])
def test_two_exact_sensors_of_one_quantity_are_one_clear_line(function):
    belief, seen = Belief(torch.zeros(1), torch.eye(1)), torch.ones(2, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"not positive definite.*without noise \(R = 0\)"):
        getattr(F, function)(belief, torch.ones(2), seen, torch.ones(2, 1), torch.zeros(2))
