"""Entries missing for a reason: the model of the mask, and the belief that learns from it."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from filter_problems import assert_equal, sequences
from tensordict import TensorDict
from torchrl.modules import set_recurrent_mode

from torchrl_drbpn import BeliefFilter, BeliefFilterModule, BeliefModelLoss, PolicyStep
from torchrl_drbpn import functional as F

DOUBLE = {"dtype": torch.float64}


def phi(z):
    return torch.special.ndtr(math.sqrt(math.pi / 8) * z)


@pytest.mark.parametrize("slope", [-3.0, 0.4, 20.0])
@pytest.mark.parametrize("mean", [-2.0, 0.3, 4.0])
def test_one_missing_entry_has_the_moments_and_probability_of_numerical_integration(slope, mean):
    """Over the state in one dimension; the reading's noise is integrated on a second grid."""
    a, P, R, h, o = 0.5, 1.7, 0.4, 1.3, -0.2
    s = torch.linspace(-10, 10, 4001, **DOUBLE) * math.sqrt(P) + mean
    e = torch.linspace(-8, 8, 801, **DOUBLE) * math.sqrt(R)
    prior = torch.exp(-0.5 * (s - mean) ** 2 / P)
    noise = torch.exp(-0.5 * e**2 / R)
    absent = phi(-(a + slope * (h * s[:, None] + o + e))) @ (noise / noise.sum())
    weight = prior / prior.sum() * absent
    Z = weight.sum()
    exact = (weight * s).sum() / Z
    spread = (weight * (s - exact) ** 2).sum() / Z

    vector = lambda x: torch.tensor([x], **DOUBLE)  # noqa: E731
    after, log_mask = F.update_by_mask(
        F.Belief(vector(mean), vector(P)[None]), vector(math.nan), torch.tensor([False]),
        vector(h)[None], vector(R), vector(o), F.MaskModel(vector(a), vector(slope)),
    )  # fmt: skip
    assert_equal(after.mean[0], exact, 1e-6)
    assert_equal(after.cov[0, 0], spread, 1e-6)
    assert_equal(log_mask, Z.log(), 1e-6)


def system(mask_model=None, *, propagated=True):
    """Let s' = .95 s + N(0, .3^2), seen by sensors with a noise of .2."""
    eye = torch.eye(1, **DOUBLE)
    ones = torch.ones(2, 1, **DOUBLE)
    return F.StateSpace(
        lambda m, _: 0.95 * m, 0.09 * eye, ones, 0.04 * ones[:, 0], 0 * ones, 0 * ones[:, 0],
        0 * eye[0], eye, 0.95 * eye if propagated else None, mask_model,
    )  # fmt: skip


def high_readings_are_missing(rows=150, time=40):
    """Return the states and what the filter is given: P(arrives) = 1 / (1 + exp(3 x))."""
    g = torch.Generator().manual_seed(0)
    noise = partial(torch.randn, generator=g, **DOUBLE)
    states = [noise(rows)]
    for _ in range(time - 1):
        states.append(0.95 * states[-1] + 0.3 * noise(rows))
    state = torch.stack(states, 1)
    x = state.unsqueeze(-1) + 0.2 * noise(rows, time, 2)
    observed = torch.rand(x.shape, generator=g, **DOUBLE) < torch.sigmoid(-3 * x)
    reset = torch.zeros(rows, time, dtype=torch.bool)
    reset[:, 0] = True
    zero = torch.zeros(rows, 1, **DOUBLE)
    x = x.where(observed, math.nan)
    return state, (zero, torch.zeros(rows, time, 1, **DOUBLE), x, observed, reset)


def test_learning_why_readings_are_missing_removes_most_of_the_bias():
    state, given = high_readings_are_missing()
    cov = torch.zeros(len(state), 1, 1, **DOUBLE)
    parameters = torch.zeros(2, 2, **DOUBLE, requires_grad=True)
    optimizer = torch.optim.LBFGS([parameters], max_iter=8, line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        out = F.filter_sequence(system(F.MaskModel(*parameters)), *given, cov=cov)
        value = -out.log_likelihood.mean()
        value.backward()
        return value

    optimizer.step(loss)
    learned = F.MaskModel(*parameters.detach())
    assert bool((learned.slope < -1.5).all())
    gone = ~given[3].any(-1)
    bias, squared = {}, {}
    for name, mask_model in (("ignored", None), ("learned", learned)):
        out = F.filter_sequence(system(mask_model), *given, cov=cov, return_cov=True)
        error = out.mean[..., 0] - state
        bias[name], squared[name] = error[gone].mean().abs(), error.square().mean()
        nees = (error.square() / out.cov[..., 0, 0]).mean()
        if name == "learned":
            assert nees == pytest.approx(1.0, abs=0.15)
    assert bias["ignored"] > 0.3
    assert bias["learned"] < 0.5 * bias["ignored"]
    assert squared["learned"] < 0.7 * squared["ignored"]
    smoothed = F.smooth_sequence(system(learned), given[0], None, *given[1:])
    assert (smoothed.mean[..., 0] - state)[gone].mean().abs() < 0.5 * bias["ignored"]


def test_a_mask_without_a_reason_changes_no_belief_and_adds_its_own_probability():
    _, given = high_readings_are_missing(4, 10)
    cov = torch.zeros(4, 1, 1, **DOUBLE)
    a = torch.tensor([0.7, -1.0], **DOUBLE)
    plain = F.filter_sequence(system(), *given, cov=cov)
    told = F.filter_sequence(system(F.MaskModel(a, 0 * a)), *given, cov=cov)
    assert_equal(told.mean, plain.mean)
    assert_equal(told.cov, plain.cov)
    expected = torch.where(given[3], phi(a).log(), phi(-a).log()).sum(-1)
    assert_equal(told.log_likelihood - plain.log_likelihood, expected)
    with pytest.raises(ValueError, match="'native' cannot run here"):
        F.filter_sequence(system(F.MaskModel(a, a)), *given, cov=cov, form="native")
    with pytest.raises(ValueError, match=r"`mask_model.slope` must have shape \(2,\)"):
        system(F.MaskModel(a, a[:1]))


def test_gradients_agree_with_finite_differences_at_a_slope_of_zero_too():
    """With the constant covariance: a propagated one is a constant of autograd by design."""
    _, given = high_readings_are_missing(2, 4)

    def likelihood(parameters, noise):
        model = system(F.MaskModel(*parameters), propagated=False)
        return F.filter_sequence(replace(model, emission_cov=noise), *given).log_likelihood

    noise = torch.tensor([0.04, 0.3], **DOUBLE, requires_grad=True)
    for slope in (-2.0, 1e-3):
        start = torch.tensor([[0.3, 0.1], [slope, 2 * slope]], **DOUBLE, requires_grad=True)
        assert torch.autograd.gradcheck(likelihood, (start, noise))
    start = torch.zeros(2, 2, **DOUBLE, requires_grad=True)
    (gradient,) = torch.autograd.grad(likelihood(start, noise).sum(), start)
    assert bool(gradient.isfinite().all())
    assert bool((gradient != 0).any())


@pytest.mark.parametrize("covariance", ["constant", "propagated"])
def test_the_module_learns_it_by_the_model_loss_and_steps_are_the_sequence(covariance):
    belief_filter = BeliefFilter(3, 2, mask_model=True, covariance=covariance, dtype=torch.float64)
    with torch.no_grad():
        belief_filter.mask_model.copy_(torch.randn(2, 3))
    mean, _, action, x, observed, reset = sequences(3, (4,), 5, obs=3)
    mean, cov, action = 0 * mean, torch.zeros(4, 3, 3, **DOUBLE), 0 * action
    reset[:, 0] = True
    whole = belief_filter(mean, cov, action, x, observed, reset, return_cov=True)
    for t in range(5):
        steps = (action[:, t], x[:, t], observed[:, t], reset[:, t])
        mean, cov, ll = belief_filter.step(mean, cov, *steps, return_cov=True)
        assert_equal(mean, whole.mean[:, t])
        assert_equal(ll, whole.log_likelihood[:, t])
    module = BeliefFilterModule(belief_filter)
    data = TensorDict(
        observation=x, observed=observed, previous_action=action, is_init=reset.unsqueeze(-1),
        batch_size=[4, 5],
    )  # fmt: skip
    with set_recurrent_mode(True), pytest.warns(UserWarning, match="initial belief"):
        module(data)
    assert_equal(data["belief", "log_likelihood"], whole.log_likelihood)
    BeliefModelLoss()(data)["loss_model"].backward()
    assert bool((belief_filter.mask_model.grad != 0).all())
    with pytest.raises(ValueError, match="`mask_model`, which PolicyStep does not read"):
        PolicyStep(module, torch.nn.Linear(3, 2))
    with pytest.raises(ValueError, match="its belief learns from the mask"):
        F.filter_sequence(
            belief_filter.state_space(), torch.zeros(4, 3, **DOUBLE), action, x, observed, reset,
            cov=torch.zeros(4, 3, 3, **DOUBLE), form="native",
        )  # fmt: skip
    belief_filter.reset_parameters()
    assert not belief_filter.mask_model.any()


def test_a_robust_update_beside_a_mask_model_is_refused():
    """Its weights would be those of another belief in a sequence than one step at a time."""
    with pytest.raises(ValueError, match="`robust` must be None with a `mask_model`"):
        BeliefFilter(3, 2, mask_model=True, robust="huber")
    belief_filter, x = BeliefFilter(3, 2, mask_model=True), torch.zeros(4, 3)
    belief_filter.robust = "imq"
    with pytest.raises(ValueError, match="`robust` must be None with a `mask_model`"):
        belief_filter.step(x, None, torch.zeros(4, 2), x, x == 0, torch.zeros(4, dtype=torch.bool))
