"""Observations that follow some steps of a sequence and are no steps of it.

Specified here:

- their log-likelihood is the oracle's for the same sequence cut there and continued by one step, in
  every form, alone and beside the sequence's own outputs, with all gradients;
- they change nothing else; an empty frame among them counts 0 and has no gradient;
- a gradient reaches them where one is asked for; none of them is no special case;
- `BeliefFilter` refuses shapes, dtypes and values that cannot be, and names them.
"""

from __future__ import annotations

import oracles
import pytest
import torch
from agents import make_filter
from filter_problems import FORMS, SIZES, Problem, assert_equal

from torchrl_drbpn.functional import Following, filter_followed, filter_sequence

OBS, ACTION = 5, 2
STEPS = [(0, 2), (0, 2), (1, 5), (2, 0)]  # twice after one step, after the last, after the first


def following_of(problem, count=4, seed=5):
    """What comes after STEPS; the second of them is an empty frame."""
    _, time, obs = problem.leaves["observation"].shape
    g = torch.Generator().manual_seed(seed)
    step = torch.tensor([b * time + t for b, t in STEPS][:count], dtype=torch.int64)
    actions = problem.leaves["previous_action"].shape[-1]
    observed = torch.rand(count, obs, generator=g) < 0.7
    observed[1:2] = False
    return Following(
        step,
        torch.randn(count, actions, generator=g).double(),
        torch.randn(count, obs, generator=g).double(),
        observed,
    )


def filtered(problem, following, form):
    return filter_followed(
        problem.model(), *problem.arguments(), following, **problem.restarts(), form=form
    )


def oracle(problem, following):
    """The likelihood of a last step put behind the sequence cut after the step before it."""
    q, p, r = problem.covs()
    weights, biases = problem.network()
    out = []
    time = problem.reset.shape[1]
    for i, step in enumerate(following.step.tolist()):
        b, t = divmod(step, time)

        def cut(x, last, b=b, t=t):
            return torch.cat([x[b, : t + 1], last.unsqueeze(0)]).unsqueeze(0)

        x, action = problem.leaves["observation"], problem.leaves["previous_action"]
        restart, stored = problem.restart, problem.leaves.get("restart_mean")
        goes_on = torch.zeros((), dtype=torch.bool)
        result = oracles.filter_sequence(
            observation=cut(x, following.observation[i]),
            observed=cut(problem.observed, following.observed[i]),
            previous_action=cut(action, following.previous_action[i]),
            reset=cut(problem.reset, goes_on),
            start_mean=problem.leaves["start_mean"][b : b + 1],
            initial_mean=problem.leaves["initial_mean"],
            initial_cov=p,
            transition=oracles.mean_network(weights, biases, problem.residual, problem.activation),
            transition_cov=q,
            matrix=problem.leaves["matrix"],
            noise=r if problem.full_noise else torch.diag(r),
            action_matrix=problem.leaves["action_matrix"],
            bias=problem.leaves["bias"],
            restart=None if restart is None else cut(restart, goes_on),
            restart_mean=None if stored is None else cut(stored, torch.zeros_like(stored[b, 0])),
        )
        out.append(result.log_likelihood[0, -1])
    return torch.stack(out)


@pytest.mark.parametrize("restarts", [False, True], ids=["", "with restarts"])
@pytest.mark.parametrize(("state", "obs"), SIZES)
@pytest.mark.parametrize(("form", "full_noise"), FORMS)
def test_the_likelihood_and_all_gradients_are_the_oracles(state, obs, form, full_noise, restarts):
    problem = Problem(state, obs, full_noise=full_noise, restarts=restarts)
    following = following_of(problem)
    out = filtered(problem, following, form)
    mean, _, ll = problem.slow()
    after = oracle(problem, following)
    assert after[1] == 0
    assert_equal(out.following_log_likelihood, after)
    assert_equal(out.mean, mean)
    assert_equal(out.log_likelihood, ll)
    for found, truth in (
        ((out.following_log_likelihood,), (after,)),
        ((out.following_log_likelihood, out.mean), (after, mean)),
        ((out.following_log_likelihood, out.log_likelihood), (after, ll)),
        ((out.mean, out.log_likelihood), (mean, ll)),
    ):
        received, expected = problem.gradients(found), problem.gradients(truth)
        for name, value in expected.items():
            scale = max(1.0, float(value.abs().max()))
            assert_equal(received[name] / scale, value / scale)


@pytest.mark.parametrize(("form", "full_noise"), FORMS)
def test_they_change_nothing_else(form, full_noise):
    problem = Problem(3, 7, full_noise=full_noise)
    alone = filter_sequence(problem.model(), *problem.arguments(), form=form)
    beside = filtered(problem, following_of(problem), form)
    assert torch.equal(alone.mean, beside.mean)
    assert torch.equal(alone.log_likelihood, beside.log_likelihood)


@pytest.mark.parametrize("form", ["auto", "native", "innovation"])
def test_a_gradient_reaches_them(form):
    problem = Problem(4, 4)
    following = following_of(problem)
    leaves = [value.requires_grad_() for value in following[1:3]]
    received = filtered(problem, following, form).following_log_likelihood
    expected = filtered(problem, following, "loop").following_log_likelihood
    assert_equal(received, expected)
    pairs = (torch.autograd.grad(value.sum(), leaves) for value in (received, expected))
    for a, b in zip(*pairs, strict=True):
        assert a.abs().sum() > 0
        assert_equal(a, b)


@pytest.mark.parametrize(("form", "full_noise"), FORMS)
def test_none_of_them_is_no_special_case(form, full_noise):
    problem = Problem(4, 4, full_noise=full_noise)
    out = filtered(problem, following_of(problem, 0), form)
    assert out.following_log_likelihood.shape == (0,)
    (out.mean.sum() + out.following_log_likelihood.sum()).backward()
    assert problem.leaves["matrix"].grad.isfinite().all()


# ----------------------------------------------------------------------------- BeliefFilter
def call(**changes):
    g = torch.Generator().manual_seed(0)
    following = Following(
        torch.tensor([3, 7]),
        torch.randn(2, ACTION, generator=g),
        torch.randn(2, OBS, generator=g),
        torch.ones(2, OBS, dtype=torch.bool),
    )._replace(**changes)
    belief = make_filter(OBS, ACTION)
    return belief, belief(
        torch.zeros(2, belief.state_dim), None, torch.zeros(2, 4, ACTION), torch.zeros(2, 4, OBS),
        torch.ones(2, 4, OBS, dtype=torch.bool), torch.zeros(2, 4, dtype=torch.bool),
        following=following,
    )  # fmt: skip


def test_the_filter_gives_what_one_more_step_gives():
    belief, out = call()
    g = torch.Generator().manual_seed(0)
    action, x = torch.randn(2, ACTION, generator=g), torch.randn(2, OBS, generator=g)
    step = belief.step(
        out.mean.flatten(0, 1)[[3, 7]], None, action, x, torch.ones(2, OBS, dtype=torch.bool),
        torch.zeros(2, dtype=torch.bool),
    )  # fmt: skip
    torch.testing.assert_close(out.following_log_likelihood, step.log_likelihood)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"step": torch.tensor([3.0, 7.0])}, "following.step` must be int64"),
        ({"step": torch.tensor([[3, 7]])}, r"following.step` must be int64 of shape \(count,\)"),
        ({"previous_action": torch.zeros(2, 9)}, "following.previous_action` must be float32"),
        ({"observation": torch.zeros(2, OBS).double()}, "following.observation` must be float32"),
        ({"observed": torch.ones(3, OBS, dtype=torch.bool)}, "following.observed` must be bool"),
        ({"observed": torch.ones(2, OBS)}, "following.observed` must be bool"),
        ({"observation": torch.full((2, OBS), torch.nan)}, "`observation` holds NaN or inf"),
        ({"previous_action": torch.full((2, ACTION), torch.inf)}, "`previous_action` holds NaN"),
    ],
    ids=lambda value: None if isinstance(value, dict) else value[:30],
)
def test_what_cannot_be_is_refused_by_name(changes, message):
    with pytest.raises(ValueError, match=message):
        call(**changes)
