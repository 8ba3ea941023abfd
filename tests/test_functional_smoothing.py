"""The smoother and the forecast, held to one joint Gaussian of all states and readings."""

import math

import pytest
import references
import torch
from filter_problems import Problem, assert_equal, sequences, space

from torchrl_drbpn import BeliefFilter
from torchrl_drbpn.functional import Belief, forecast, smooth_sequence


def linear(time=7, *, batch=3, reset_rate=0.3, seed=0):
    system = references.random_system(3, 4, seed=seed, full_noise=True)
    data = references.simulate(system, batch, time, seed=seed, reset_rate=reset_rate)
    data.reset[:, 0] = True
    return system, data


def inputs(data, rows=slice(None), steps=slice(None)):
    sequence = (data.previous_action, data.observation, data.observed, data.reset)
    return [data.start_mean[rows], None, *(x[rows, steps] for x in sequence)]


def joint_posterior(system, data, row):
    """All states of a row given all its readings, by conditioning one joint Gaussian."""
    time, s = data.reset.shape[1], system.state_dim
    mean, prior, H, R, x = references.joint_gaussian(system, data, row)
    gain = torch.linalg.solve(H @ prior @ H.mT + R, H @ prior).mT
    mean = mean + gain @ (x - H @ mean)
    cov = (prior - gain @ H @ prior).reshape(time, s, time, s)
    return Belief(mean.reshape(time, s), torch.stack([cov[t, :, t] for t in range(time)]))


def test_it_is_the_joint_gaussian_conditioned_on_all_readings_with_its_gradients():
    system, data = linear()
    leaves = {
        "dynamics": system.dynamics, "matrix": system.matrix, "bias": system.bias,
        "control": system.control, "initial_mean": system.initial_mean,
        "noise": torch.linalg.cholesky(system.noise),
        "transition_cov": torch.linalg.cholesky(system.transition_cov),
        "initial_cov": torch.linalg.cholesky(system.initial_cov),
    }  # fmt: skip
    leaves = {name: value.clone().requires_grad_() for name, value in leaves.items()}
    roots = ("noise", "transition_cov", "initial_cov")
    fields = {n: v @ v.mT if n in roots else v for n, v in leaves.items()}
    system = references.replace(system, **fields)
    found = smooth_sequence(space(system), *inputs(data))
    truth = [joint_posterior(system, data, row) for row in range(3)]
    truth = Belief(*(torch.stack(part) for part in zip(*truth, strict=True)))
    weight = torch.randn(truth.cov.shape, dtype=torch.float64)
    gradients = []
    for belief in (found, truth):
        total = (belief.cov * weight).sum() + belief.mean.square().sum()
        gradients.append(torch.autograd.grad(total, list(leaves.values()), retain_graph=True))
    for a, b in zip(found, truth, strict=True):
        assert_equal(a, b)
    for name, a, b in zip(leaves, *gradients, strict=True):
        assert_equal(a, b, 1e-8, name)


def textbook(problem, row, jacobian):
    """§9.1 [Särkkä 2013] for one row, step by step; F from torch.autograd unless given."""
    q, p, r = problem.covs()
    leaf, model = problem.leaves, problem.model()
    weights, biases = problem.network()
    f = references.mean_network(weights, biases, problem.residual, problem.activation)
    noise = r if problem.full_noise else torch.diag(r)
    m, P, steps = leaf["start_mean"][row], torch.zeros_like(q), []
    for t in range(problem.reset.shape[1]):
        a = leaf["previous_action"][row, t]
        F = jacobian
        if F is None:
            F = torch.autograd.functional.jacobian(lambda s, a=a: f(s, a), m, create_graph=True)
        first = bool(problem.reset[row, t])
        mp, Pp = (leaf["initial_mean"], p) if first else (f(m, a), F @ P @ F.mT + q)
        m, P = references.update(
            mp, Pp, leaf["observation"][row, t], problem.observed[row, t], leaf["matrix"], noise,
            model.offset(a),
        )  # fmt: skip
        steps.append((m, P, mp, Pp, F, first))
    out = [(m, P)]
    for t in range(len(steps) - 2, -1, -1):
        m, P = steps[t][:2]
        _, _, mp, Pp, F, first = steps[t + 1]
        if not first:
            G = P @ F.mT @ torch.linalg.inv(Pp)
            m, P = m + G @ (out[-1][0] - mp), P + G @ (out[-1][1] - Pp) @ G.mT
        out.append((m, P))
    return out[::-1]


@pytest.mark.parametrize("given", ["row-wise", "the model's", "another"])
def test_a_network_is_smoothed_as_the_textbook_extends_it(given):
    problem = Problem(3, 4, batch=2, time=6, propagated=given != "row-wise")
    jacobian = 0.5 * torch.eye(3, dtype=torch.float64) if given == "another" else None
    start, action, x, observed, reset = problem.arguments()
    found = smooth_sequence(
        problem.model(), start, None, action, x, observed, reset, jacobian=jacobian
    )
    F = problem.jacobian if jacobian is None else jacobian
    rows = [textbook(problem, row, F) for row in range(2)]
    mean = torch.stack([torch.stack([m for m, _ in row]) for row in rows])
    cov = torch.stack([torch.stack([P for _, P in row]) for row in rows])
    assert_equal(found.mean, mean)
    assert_equal(found.cov, cov)
    mine, theirs = (problem.gradients(out) for out in (tuple(found), (mean, cov)))
    for name, value in theirs.items():
        assert_equal(mine[name], value, 1e-8, name)


def test_a_reading_of_huge_noise_is_a_missing_one_and_r_per_step_is_r():
    system, data = linear()
    model, everywhere = space(system), torch.ones_like(data.observed)
    R = system.noise.expand(*data.reset.shape, 4, 4).clone()
    same = smooth_sequence(model, *inputs(data), emission_cov=R)
    masked = smooth_sequence(model, *inputs(data))
    assert torch.equal(same.mean, masked.mean)
    data.observed[1, 2] = False
    expected = smooth_sequence(model, *inputs(data))
    data.observed[1, 2] = everywhere[1, 2]
    R[1, 2] = 1e12 * torch.eye(4)
    found = smooth_sequence(model, *inputs(data), emission_cov=R)
    assert_equal(found.mean, expected.mean, 1e-9)
    assert_equal(found.cov, expected.cov, 1e-9)


def test_a_nan_under_a_false_mask_or_before_an_episode_start_changes_nothing():
    problem, found = Problem(3, 4), []
    problem.reset[:, 0] = True
    x, start = problem.leaves["observation"].detach(), problem.leaves["start_mean"].detach()
    for junk in (0.0, math.nan):
        problem.leaves["observation"] = x.where(problem.observed, junk).requires_grad_()
        problem.leaves["start_mean"] = torch.full_like(start, junk).requires_grad_()
        mean, *rest = problem.arguments()
        belief = smooth_sequence(problem.model(), mean, torch.full((3, 3, 3), junk).double(), *rest)
        found.append([*belief, *problem.gradients(tuple(belief)).values()])
    for clean, spoilt in zip(*found, strict=True):
        assert torch.equal(clean, spoilt)


@pytest.mark.parametrize("expands", [0.9, 1.5])
def test_float32_covariances_stay_positive_definite_at_the_noise_floor(expands):
    system, data = linear(120, batch=1, reset_rate=0.0)
    data.observed[:, 2:-3] &= expands < 1  # where it expands, it is lost until the last three
    system = references.replace(
        system, noise=1e-4 * torch.eye(4), transition_cov=1e-6 * torch.eye(3),
        dynamics=expands / 0.9 * system.dynamics,
    ).to(torch.float32)  # fmt: skip
    single = [x.float() if x is not None and x.is_floating_point() else x for x in inputs(data)]
    cov = smooth_sequence(space(system), *single).cov
    assert cov.dtype == torch.float32
    assert torch.equal(cov, cov.mT)
    assert bool((torch.linalg.cholesky_ex(cov)[1] == 0).all())


def test_a_forecast_is_what_the_smoother_says_of_steps_without_readings():
    problem = Problem(3, 4, batch=2, time=6, resets=False)
    start, action, x, observed, reset = problem.arguments()
    cov = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    ahead = forecast(problem.model(), start, cov, action)
    nothing = torch.zeros_like(observed)
    smoothed = smooth_sequence(problem.model(), start, cov, action, x, nothing, reset)
    for a, b in zip(ahead.state, smoothed, strict=True):
        assert_equal(a, b)
    H, R = problem.model().emission_matrix, problem.model().full_emission_cov()
    assert_equal(ahead.observation.mean, smoothed.mean @ H.mT + problem.model().offset(action))
    assert_equal(ahead.observation.cov, H @ smoothed.cov @ H.mT + R)


@pytest.mark.parametrize("jacobian", [None, "mean", "row"])
def test_a_filter_ends_in_its_smoothed_belief_and_forecasts_what_it_predicts(jacobian):
    options = {"covariance": "propagated", "jacobian": jacobian} if jacobian else {}
    module = BeliefFilter(5, 2, 3, dtype=torch.float64, **options)
    cov = torch.eye(3, dtype=torch.float64).expand(4, 3, 3)  # read where it is propagated
    mean, _, action, x, observed, reset = sequences(3, (4,))
    sequence = mean, cov, action, x, observed, torch.zeros_like(reset)
    sequence[-1][:, -1] = jacobian is None  # where it starts afresh, a constant covariance is exact
    filtered, smoothed = module(*sequence, return_cov=True), module.smooth(*sequence)
    assert_equal(smoothed.mean[:, -1], filtered.mean[:, -1])
    assert_equal(smoothed.cov[:, -1], filtered.cov[:, -1])
    ahead = module.forecast(*sequence[:3])
    nothing = torch.zeros_like(observed), torch.zeros_like(reset)
    unseen = module(*sequence[:4], *nothing, return_cov=True)
    steps = 6 if jacobian else 1
    assert_equal(ahead.state.mean[:, :steps], unseen.mean[:, :steps])
    assert_equal(ahead.state.cov[:, :steps], unseen.cov[:, :steps])
    x[0, 0, observed[0, 0].nonzero()[0]] = math.nan
    with pytest.raises(ValueError, match="`observation` holds NaN"):
        module.smooth(*sequence)


def test_bad_input_is_named_and_no_step_is_no_error():
    system, data = linear()
    model = space(system)
    with pytest.raises(ValueError, match="`observed` must be bool"):
        smooth_sequence(model, *inputs(data)[:4], data.observed.float(), data.reset)
    with pytest.raises(ValueError, match="`mean` and `cov` must have shapes"):
        smooth_sequence(model, data.start_mean, torch.eye(3), *inputs(data)[2:])
    with pytest.raises(ValueError, match=r"`emission_cov` must be .* got \(4, 4\)"):
        smooth_sequence(model, *inputs(data), emission_cov=torch.eye(4).double())
    with pytest.raises(ValueError, match="`action` must have shape"):
        forecast(model, data.start_mean, None, data.previous_action[..., :1])
    empty = smooth_sequence(model, *inputs(data, steps=slice(0)))
    assert empty.mean.shape == (3, 0, 3)
    assert forecast(model, data.start_mean, None, data.previous_action[:, :0]).state.cov.shape == (
        3, 0, 3, 3,
    )  # fmt: skip
