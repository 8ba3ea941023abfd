"""One Kalman step under missing entries: the laws of `functional.kalman`, in float64."""

import math

import pytest
import references
import torch
from filter_problems import assert_equal, outputs

from torchrl_drbpn import functional as F
from torchrl_drbpn.functional import Belief
from torchrl_drbpn.functional.gaussian import inverse_softplus, positive_std

sized = pytest.mark.parametrize(
    ("state", "obs"), [(3, 5), (4, 4), (6, 4)], ids=["state<obs", "state=obs", "state>obs"]
)
FUNCTIONS = ["innovation", "update", "log_likelihood"]


def given(state, obs, *, full_noise=True):
    """The arguments of a step, whose rows observe one entry, all, some and none; a generator."""
    system = references.random_system(state, obs, full_noise=full_noise)
    g = torch.Generator().manual_seed(77)
    mean = torch.randn(5, state, generator=g, dtype=torch.float64)
    cov = torch.stack([references.spd(state, g) for _ in range(5)])
    x = 2 * torch.randn(5, obs, generator=g, dtype=torch.float64)
    offset = torch.randn(5, obs, generator=g, dtype=torch.float64)
    observed = torch.rand(5, obs, generator=g) < 0.6
    observed[0], observed[1], observed[2] = torch.arange(obs) == 0, True, False
    return (Belief(mean, cov), x, observed, system.matrix, system.noise, offset), g


def vector(*values):
    return torch.tensor(values, dtype=torch.float64)


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


def test_predict_forgets_the_covariance_where_the_jacobian_is_none():
    system = references.random_system(3, 4)
    (belief, *_), g = given(3, 4)
    action = torch.randn(5, 2, generator=g, dtype=torch.float64)
    q = system.transition_cov
    plain = F.predict(belief, system.transition, q, action, jacobian=None)
    with pytest.raises(TypeError, match="jacobian"):
        F.predict(belief, system.transition, q, action)
    assert_equal(plain.mean, belief.mean @ system.dynamics.T + action @ system.control.T)
    assert torch.equal(plain.cov.expand_as(belief.cov), q.expand_as(belief.cov))
    # A Q and a Jacobian of each belief's own.
    q = torch.stack([references.spd(3, g) for _ in range(5)])
    j = torch.randn(5, 3, 3, generator=g, dtype=torch.float64)
    assert_equal(
        F.predict(belief, system.transition, q, action, jacobian=j).cov, j @ belief.cov @ j.mT + q
    )


def propagated(system, x, observed, action, belief):
    """Predicted and filtered beliefs and the log-likelihood of each step; the first is given."""
    for t in range(len(x)):
        if t:
            moves = (system.transition, system.transition_cov, action[t])
            belief = F.predict(belief, *moves, jacobian=system.dynamics)
        step = (belief, x[t], observed[t], system.matrix, system.noise, system.offset(action[t]))
        predicted, belief = belief, F.update(*step)
        yield predicted, belief, F.log_likelihood(*step)


def test_it_equals_statsmodels_with_missing_entries_and_the_covariance_propagated():
    system = references.random_system(3, 5, seed=4, full_noise=True)
    data = references.simulate(system, batch=1, time=30, seed=4)
    truth = references.statsmodels(system, data).filter()
    rows = data.observation[0], data.observed[0], data.previous_action[0]
    steps = propagated(system, *rows, Belief(system.initial_mean, system.initial_cov))
    for t, (_, filtered, ll) in enumerate(steps):
        assert_equal(filtered.mean, torch.from_numpy(truth.filtered_state[:, t]), 1e-8)
        assert_equal(filtered.cov, torch.from_numpy(truth.filtered_state_cov[:, :, t]), 1e-8)
        assert_equal(ll, torch.tensor(truth.llf_obs[t], dtype=torch.float64), 1e-8)


def test_exact_sensors_under_a_vast_prior_cost_the_covariance_no_digits():
    """Joseph's form: P - K H P is off by 2 % here, in float64."""
    system = references.random_system(6, 6)
    prior, noise = 1e6 * torch.eye(6).double(), 1e-8 * torch.eye(6).double()
    zeros, seen = torch.zeros(6).double(), torch.ones(6, dtype=torch.bool)
    cov = F.update(Belief(zeros, prior), zeros, seen, system.matrix, noise).cov
    expected = torch.linalg.inv(prior.inverse() + system.matrix.T @ noise.inverse() @ system.matrix)
    torch.testing.assert_close(cov, expected, rtol=1e-9, atol=1e-18)


def test_variances_are_a_diagonal_covariance_and_never_a_row():
    belief, x = Belief(torch.zeros(2), torch.ones(2)), torch.tensor([1.0, 2.0])
    seen, eye, r = torch.ones(2, dtype=torch.bool), torch.eye(2), torch.tensor([0.1, 0.2])
    full, short = Belief(belief.mean, eye), (belief, x, seen, eye, r)
    assert_equal(F.update(*short).mean, torch.tensor([1 / 1.1, 2 / 1.2]), 1e-6)
    for a, b in zip(outputs(*short), outputs(full, x, seen, eye, r.diag()), strict=True):
        assert torch.equal(a, b)
    S, v = torch.tensor([0.5, 3.0]).double(), x.double()
    for function in (
        lambda cov: F.masked_cov(cov, seen),
        lambda cov: F.masked_log_density(v, cov, seen),
        lambda cov: F.nis(v, cov, seen),
        lambda cov: F.nees(v, cov),
        lambda cov: F.innovation_weights(v, cov, r, seen, "huber", 4.0),
    ):
        assert torch.equal(function(S), function(S.diag()))
        with pytest.raises(ValueError, match=r"or the variances \(2,\) of a diagonal one, got"):
            function(S[:1])
    expected = F.update(full, x, seen, eye, r)
    for a, b in zip(F.sequential_update(*short), expected, strict=True):
        assert_equal(a, b, 1e-6)
    with pytest.raises(ValueError, match=r"must be the variances \(obs,\) of a diagonal R, got"):
        F.sequential_update(belief, x, seen, eye, r.diag())
    with pytest.raises(ValueError, match="`emission_matrix` must have shape"):
        F.sequential_update(belief, x, seen, eye[:1], r)
    with pytest.raises(ValueError, match="`noise` must be the variances"):
        F.innovation_weights(v, S, r.diag(), seen[:2], "huber", 4.0)
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


# Nothing, one entry, some, all.
MASKS = pytest.mark.parametrize(
    "mask",
    [[False] * 4, [False, False, True, False], [True, False, True, True], [True] * 4],
    ids=["none", "one", "some", "all"],
)


@MASKS
def test_masked_log_density_is_that_of_the_sub_vector_and_reads_nothing_else(mask):
    g = torch.Generator().manual_seed(0)
    residual = torch.randn(3, 4, generator=g, dtype=torch.float64)
    cov = torch.stack([references.spd(4, g) for _ in range(3)])
    rows = torch.tensor(mask).nonzero().squeeze(-1)
    expected = torch.zeros(3, dtype=torch.float64)
    if len(rows):
        zeros = torch.zeros(len(rows), dtype=torch.float64)
        sub = torch.distributions.MultivariateNormal(zeros, cov[:, rows][:, :, rows])
        expected = sub.log_prob(residual[:, rows])
    observed = torch.tensor(mask).expand(3, 4)
    both = observed.unsqueeze(-1) & observed.unsqueeze(-2)
    for junk in (math.nan, math.inf, -math.inf):
        dirty = torch.where(observed, residual, junk).requires_grad_()
        actual = F.masked_log_density(dirty, torch.where(both, cov, junk), observed)
        torch.testing.assert_close(actual, expected, atol=1e-11, rtol=1e-11)
        (gradient,) = torch.autograd.grad(actual.sum(), dirty)
        assert not gradient[~observed].any()
        assert gradient.isfinite().all()
    # A count of entries held as an integer times a Python float would be float32.
    single = F.masked_log_density(residual.float(), cov.float(), observed)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), actual, atol=1e-4, rtol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_inverse_softplus_undoes_softplus(dtype):
    value = torch.logspace(-6, 3, 40, dtype=dtype)
    raw = inverse_softplus(value)
    assert torch.isfinite(raw).all()
    torch.testing.assert_close(torch.nn.functional.softplus(raw), value, atol=0, rtol=1e-5)
    torch.testing.assert_close(positive_std(raw, 1e-2), value + 1e-2)


def test_float32_full_covariances_can_be_factorised_for_extreme_parameters():
    raw = torch.stack([torch.full((6, 6), value) for value in (-1e4, -10.0, 0.0, 3.0)])
    factor, info = torch.linalg.cholesky_ex(F.full_cov(raw, 1e-2))
    assert torch.equal(info, torch.zeros_like(info))
    assert torch.isfinite(factor).all()


def test_every_full_covariance_above_the_floor_can_be_reached_by_a_lower_triangle():
    target = references.spd(4, torch.Generator().manual_seed(1)) + 0.02 * torch.eye(
        4, dtype=torch.float64
    )
    root = torch.linalg.cholesky(target - 0.01 * torch.eye(4, dtype=torch.float64))
    raw = root.tril(-1) + torch.diag(inverse_softplus(root.diagonal()))
    torch.testing.assert_close(F.full_cov(raw, 0.1), target)
    spoilt = raw + torch.triu(torch.full((4, 4), 7.0), 1)  # the upper one is not read
    assert torch.equal(F.full_cov(raw, 0.1), F.full_cov(spoilt, 0.1))
