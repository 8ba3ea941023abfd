"""The propagated covariance, P = F cov F' + Q: its digits, its Jacobian, its key."""

from dataclasses import replace

import pytest
import references
import torch
from filter_problems import TOLERANCE, Problem, assert_equal, by_hand, sequences, space
from tensordict import TensorDict
from torch import nn

from torchrl_drbpn import BeliefFilter, GaussianTransition
from torchrl_drbpn.functional import (
    Belief,
    TransitionMLP,
    filter_sequence,
    filter_step,
)


@pytest.mark.parametrize("form", ["auto", "pytorch"])
@pytest.mark.parametrize("expands", [0.9, 1.05])
@pytest.mark.parametrize("obs", [3, 6], ids=["innovation", "information"])
def test_float32_stays_positive_definite_over_ten_thousand_steps(obs, expands, form):
    g = torch.Generator().manual_seed(0)
    system = references.random_system(4, obs).to(torch.float32)
    weight = torch.cat([system.dynamics, system.control], 1)
    model = replace(
        space(system),
        transition=TransitionMLP((weight,), (torch.zeros(4),), False, "relu"),
        transition_jacobian=expands * system.dynamics / 0.9,
        transition_cov=torch.full((4,), 1e-6),  # the floor of a GaussianTransition
        emission_cov=torch.full((obs,), 1e-4),
    )
    seen = torch.rand(1, 10_000, obs, generator=g) < 0.5
    seen[:, 3000:6000] = False
    seen[:, :, 0] = False
    none = torch.zeros(1, 10_000, 2)
    first = torch.zeros(1, 10_000, dtype=torch.bool)
    start = torch.zeros(1, 4), torch.eye(4).unsqueeze(0)
    given = (none, torch.zeros(seen.shape), seen, first)
    out = filter_sequence(model, start[0], *given, cov=start[1], form=form)
    assert torch.equal(out.cov, out.cov.mT)
    assert torch.linalg.cholesky_ex(out.cov).info.eq(0).all()
    assert out.mean.isfinite().all()
    # The same step by step, where each step begins from what float32 holds.
    step, cov = (start[0], none[:, 0], torch.zeros(1, obs)), start[1]
    for t in range(0, 10_000, 25):
        cov = filter_step(model, *step, seen[:, t], first[:, t], cov=cov).cov
        assert not torch.linalg.cholesky_ex(cov).info.any()


def test_what_a_propagated_covariance_needs_is_named():
    problem = Problem(3, 5, stored=True, propagated=True)
    with pytest.raises(ValueError, match="`cov` is None, but this model propagates"):
        problem.run("auto", cov=None)
    missing = {**problem.stored(), "stored_cov": None}
    with pytest.raises(ValueError, match="`stored_cov` is None, but this model propagates"):
        problem.run("auto", **missing)
    with pytest.raises(ValueError, match=r"`cov` must be float64 of shape .*= \(3, 3, 3\)"):
        problem.run("auto", cov=problem.start_cov[:2])
    problem.jacobian = torch.eye(2).double()
    with pytest.raises(ValueError, match=r"`transition_jacobian` must have shape \(3, 3\)"):
        problem.model()


class Own(nn.Module):
    """A transition that is no GaussianTransition: s + .1 tanh(A s) a_1, with a constant Q."""

    def __init__(self, state):
        super().__init__()
        self.matrix = nn.Parameter(torch.randn(state, state))

    def forward(self, mean, action):
        moved = mean + 0.1 * (mean @ self.matrix.mT).tanh() * action[..., :1]
        return Belief(moved, 0.1 * torch.eye(mean.shape[-1]).to(mean).expand(*mean.shape, -1))


@pytest.mark.parametrize("residual", [False, True])
@pytest.mark.parametrize("activation", ["relu", "tanh"])
@pytest.mark.parametrize("hidden", [(), (7,), (7, 5), (7, 5, 6)], ids=len)
def test_the_closed_form_jacobian_is_that_of_autograd(hidden, activation, residual):
    transition = GaussianTransition(
        3, 2, hidden_sizes=hidden, activation=activation, residual=residual, dtype=torch.float64
    )
    f = transition.mean_network()
    mean, action = torch.randn(4, 6, 3).double(), torch.randn(4, 6, 2).double()
    rows = torch.func.vmap(torch.func.vmap(torch.func.jacrev(f)))(mean, action)
    assert_equal(f.jacobian(mean, action), rows, 1e-12)
    assert_equal(f.jacobian(mean, action, average=True), rows.mean((0, 1)), 1e-12)


def test_the_jacobian_starts_at_the_initial_mean_and_is_state_like_any_other():
    new, used = (BeliefFilter(5, 2, 3, covariance="propagated").double() for _ in range(2))
    first = {name: value.clone() for name, value in new.state_dict().items()}
    mean, action = torch.randn(9, 3).double(), torch.randn(9, 2).double()

    def derivative(filter, *at):
        return filter.transition.mean_network().jacobian(*at)

    at_start = 0 * mean[0], 0 * action[0]
    torch.testing.assert_close(new.mean_jacobian, derivative(new, *at_start))
    used.refresh_jacobian(mean, action)
    torch.testing.assert_close(used.mean_jacobian, derivative(used, mean, action).mean(0))
    # what a collector does with the learner's weights, and a call of the filter after it
    weights = TensorDict.from_module(new).data.update_(TensorDict.from_module(used).data)
    inputs = sequences(3, (4,))
    data = inputs._replace(cov=torch.eye(3).double().expand(4, 3, 3))
    filtered = [filter(*data).mean for filter in (new, used)]
    assert torch.equal(weights["mean_jacobian"], used.mean_jacobian)
    assert torch.equal(*filtered)
    used.load_state_dict(first)
    assert torch.equal(used.mean_jacobian, first["mean_jacobian"])
    used.reset_parameters()
    torch.testing.assert_close(used.mean_jacobian, derivative(used, *at_start))
    with pytest.raises(ValueError, match="covariance='propagated'"):
        BeliefFilter(5, 2).refresh_jacobian(mean, action)


@pytest.mark.parametrize("own", [False, True], ids=["ours", "another"])
@pytest.mark.parametrize("jacobian", ["mean", "row"])
def test_a_filter_propagates_by_the_jacobian_of_its_transition(jacobian, own):
    options = {"covariance": "propagated", "jacobian": jacobian}
    filter = BeliefFilter(5, 2, 3, transition=Own(3) if own else None, **options).double()
    f = lambda m, a: filter.transition(m, a)[0]  # noqa: E731
    data = sequences(3, (4,))[2:]
    mean, action = torch.randn(9, 3).double(), torch.randn(9, 2).double()
    filter.refresh_jacobian(mean, action)
    rows = torch.func.vmap(torch.func.jacrev(f))
    F = rows(mean, action).mean(0) if jacobian == "mean" else torch.func.jacrev(f)
    start = mean[:4], torch.eye(3).double().expand(4, 3, 3)
    truth = by_hand(filter, *start, *data, jacobian=F)
    out = filter(*start, *data, return_cov=True)
    for a, b in zip(out, (truth.mean, truth.cov, truth.log_likelihood), strict=True):
        assert_equal(a, b, TOLERANCE)
