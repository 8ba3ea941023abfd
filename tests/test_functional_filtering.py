"""Whole sequences: both forms of `functional.filtering` against the slow truth."""

import math
from dataclasses import replace

import pytest
import torch
from filter_problems import FORMS, SIZES, Problem, assert_equal, assert_same
from refusals import refuses

from torchrl_drbpn.functional import TransitionMLP, filter_sequence, filter_step

covariances = pytest.mark.parametrize(
    "propagated", [False, True], ids=["constant covariance", "propagated"]
)


@pytest.mark.parametrize(
    "events",
    [{"resets": False}, {"resets": True}, {"resets": True, "stored": True}],
    ids=["one episode", "resets", "resets and stored states"],
)
@pytest.mark.parametrize("full_noise", [False, True], ids=["diagonal R", "full R"])
@covariances
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_every_form_equals_the_oracle_in_values_and_all_gradients(
    state, obs, form, propagated, full_noise, events
):
    problem = Problem(state, obs, full_noise=full_noise, propagated=propagated, **events)
    if form == "native" and full_noise and propagated:
        with pytest.raises(ValueError, match="diagonal"):
            problem.library(form)
        return
    truth = problem.oracle()
    assert_same(problem, problem.library(form), truth)
    if propagated:  # not asked for, it is there all the same: it is the state, without a gradient
        cov = problem.run(form, **problem.stored()).cov
        assert not cov.requires_grad
        assert_equal(cov, truth[1])


@pytest.mark.parametrize(
    "network",
    [
        pytest.param({"hidden": (), "residual": False}, id="linear"),
        pytest.param({"hidden": (), "residual": True}, id="residual linear"),
        pytest.param({"hidden": (8,), "residual": False, "activation": "tanh"}, id="plain tanh"),
        pytest.param({"hidden": (8, 6), "activation": "relu"}, id="residual relu relu"),
        pytest.param({"hidden": (4, 5, 3), "activation": "tanh"}, id="residual tanh tanh tanh"),
    ],
)
@pytest.mark.parametrize("form", FORMS)
def test_every_transition_network_equals_the_oracle(form, network):
    problem = Problem(3, 5, seed=1, stored=True, **network)
    assert_same(problem, problem.library(form), problem.oracle())


@pytest.mark.parametrize("form", FORMS)
def test_one_output_alone_has_the_right_gradient(form):
    # PPO alone reads the means, the model loss alone the likelihood: autograd then hands the
    # reverse loop a zero or an absent gradient for the other.
    problem = Problem(3, 5, stored=True)
    for i in range(3):
        found = problem.gradients((problem.library(form)[i],))
        truth = problem.gradients((problem.oracle()[i],))
        for name in truth:
            assert_equal(found[name], truth[name])


@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_a_diagonal_covariance_equals_its_variances(state, obs):
    problem = Problem(state, obs)
    model = replace(problem.model(), transition_cov=torch.arange(1.0, state + 1).double())
    names = ("transition_cov", "emission_cov", "initial_cov")
    model = replace(model, initial_cov=model.initial_cov.diagonal())
    full = replace(model, **{name: getattr(model, name).diag() for name in names})
    a = filter_sequence(model, *problem.arguments(), return_cov=True)
    b = filter_sequence(full, *problem.arguments(), return_cov=True)
    assert_same(problem, tuple(a), tuple(b))


@covariances
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_stepping_through_time_equals_the_whole_sequence(state, obs, form, propagated):
    problem = Problem(state, obs, propagated=propagated)
    (mean, *rest), before, rows = problem.arguments(), {}, []
    for t in range(problem.reset.shape[1]):
        step = (mean, *(x[:, t] for x in rest))
        rows.append(problem.run(form, *step, function=filter_step, return_cov=True, **before))
        mean, before = rows[-1].mean, {"cov": rows[-1].cov} if propagated else {}
    stepped = tuple(torch.stack(part, 1) for part in zip(*rows, strict=True))
    assert_same(problem, stepped, problem.library(form))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shape", [(), (1,), (6,), (2, 3), (3, 1, 2)], ids=str)
def test_the_batch_shape_does_not_matter(shape, form):
    problem = Problem(3, 5, batch=math.prod(shape), time=4)
    flat = problem.run(form, return_cov=True)
    arguments = (x.reshape(*shape, *x.shape[1:]) for x in problem.arguments())
    shaped = problem.run(form, *arguments, return_cov=True)
    for a, b in zip(shaped, flat, strict=True):
        assert a.shape == (*shape, *b.shape[1:])
        assert_equal(a, b.reshape(a.shape))


@pytest.mark.parametrize("form", FORMS)
def test_memory_layout_does_not_matter(form):
    problem = Problem(3, 5, batch=4, stored=True)
    for name in ("observation", "previous_action", "stored_mean"):
        x = problem.leaves[name].detach()
        problem.leaves[name] = x.transpose(0, 1).contiguous().transpose(0, 1).requires_grad_()
        assert not problem.leaves[name].is_contiguous()
    problem.observed = problem.observed.mT.contiguous().mT
    problem.reset = problem.reset.mT.contiguous().mT
    assert_same(problem, problem.library(form), problem.oracle())


@pytest.mark.parametrize("junk", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("form", FORMS)
def test_what_lies_under_a_false_mask_changes_nothing_and_has_zero_gradient(form, junk):
    problem = Problem(3, 5, stored=True)
    clean = problem.library(form)
    clean_gradients = problem.gradients(clean)
    x = problem.leaves["observation"].detach()
    dirty = torch.where(problem.observed, x, torch.full_like(x, junk))
    problem.leaves["observation"] = dirty.requires_grad_()
    spoilt = problem.library(form)
    for a, b in zip(clean, spoilt, strict=True):
        assert torch.equal(a, b)
    gradients = problem.gradients(spoilt)
    for name, gradient in gradients.items():
        assert torch.equal(gradient, clean_gradients[name]), name
    unseen = gradients["observation"][~problem.observed]
    assert torch.equal(unseen, torch.zeros_like(unseen))


@covariances
@pytest.mark.parametrize("form", FORMS)
def test_a_nan_before_a_reset_and_what_is_not_asked_for_change_nothing(form, propagated):
    problem = Problem(3, 5, stored=True, propagated=propagated)
    problem.reset[:, 0] = problem.reset[:, 2] = True
    problem.use_stored[:, 2] = True
    clean = problem.library(form)
    gradients = problem.gradients(clean)
    unused = (~problem.use_stored | problem.reset).unsqueeze(-1)
    with torch.no_grad():
        problem.leaves["start_mean"].fill_(math.nan)
        problem.leaves["stored_mean"].masked_fill_(unused, math.nan)
    if propagated:
        problem.start_cov = problem.start_cov * math.nan
        problem.stored_cov = problem.stored_cov.masked_fill(unused.unsqueeze(-1), math.nan)
    spoilt = problem.library(form)
    assert all(map(torch.equal, spoilt, clean))
    for name, gradient in problem.gradients(spoilt).items():
        assert torch.equal(gradient, gradients[name]), name


@pytest.mark.parametrize("form", ["auto", "pytorch", "step by step"])
def test_no_step_at_all_returns_nothing(form):
    problem = Problem(3, 5)
    mean, *rest = problem.arguments()
    out = problem.run(form, mean, *(x[:, :0] for x in rest), return_cov=True)
    assert [tuple(x.shape) for x in out] == [(3, 0, 3), (3, 0, 3, 3), (3, 0)]


@pytest.mark.parametrize("form", FORMS)
def test_without_gradients_the_values_are_the_same_and_carry_no_graph(form):
    problem = Problem(3, 5, stored=True)
    graph = problem.library(form)
    with torch.no_grad():
        bare = problem.library(form)
    for a, b in zip(graph, bare, strict=True):
        assert torch.equal(a, b)
        assert a.requires_grad
        assert not b.requires_grad


@pytest.mark.parametrize("form", FORMS)
def test_each_leaf_alone_gets_the_gradient_it_gets_among_all(form):
    problem = Problem(3, 5, stored=True)
    leaves, together = problem.leaves, problem.gradients(problem.library(form))
    for name, leaf in leaves.items():
        problem.leaves = {other: x.detach() for other, x in leaves.items()} | {name: leaf}
        outputs = problem.library(form)
        problem.leaves = {name: leaf}
        assert_equal(problem.gradients(outputs)[name], together[name])


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("obs", [2, 4], ids=["innovation", "information"])
def test_every_form_can_be_differentiated_twice(obs, form):
    problem = Problem(3, obs, batch=1, time=3, hidden=(3,), stored=True)
    names = ("bias0", "noise", "matrix", "observation", "stored_mean", "initial_mean")

    def run(*leaves):
        problem.leaves |= dict(zip(names, leaves, strict=True))
        mean, _, ll = problem.library(form)
        return mean.square().sum() + ll.sum()

    leaves = tuple(problem.leaves[name] for name in names)
    assert torch.autograd.gradgradcheck(run, leaves, fast_mode=True)


@pytest.mark.parametrize("form", FORMS)
def test_layers_that_share_their_weights_have_one_gradient_once_and_twice(form):
    problem = Problem(3, 4, hidden=(5, 5))
    weight = problem.leaves["weight1"] = problem.leaves["weight0"]
    mean, _, ll = problem.library(form)
    loss = mean.square().sum() + ll.sum()
    once, again = (
        torch.autograd.grad(loss, weight, retain_graph=True, create_graph=x)[0]
        for x in (False, True)
    )
    assert_equal(again, once)


@pytest.mark.parametrize("form", FORMS)
def test_inputs_are_left_as_they_were(form):
    problem = Problem(3, 5, stored=True)
    given = [*problem.leaves.values(), problem.observed, problem.reset, problem.use_stored]
    before = [x.detach().clone() for x in given]
    problem.gradients(problem.library(form))
    assert all(map(torch.equal, given, before))


@pytest.mark.parametrize("propagated", [False, True])
@pytest.mark.parametrize("full_noise", [False, True])
@pytest.mark.parametrize("form", ["auto", "step by step"])
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_a_weight_is_a_variance_in_values_and_all_gradients(
    state, obs, form, full_noise, propagated
):
    options = {"full_noise": full_noise, "propagated": propagated}
    problem = Problem(state, obs, stored=True, weighted=True, **options)
    assert_same(problem, problem.library(form), problem.oracle())


def filter_with_a_narrow_network():
    problem = Problem(3, 5)
    problem.leaves["weight0"] = problem.leaves["weight0"][:, 1:]
    problem.model()


def run_with_a_weight_of(value):
    problem = Problem(4, 4)
    problem.run("auto", weight=torch.full(problem.observed.shape, value).double())


def cov_of_a_state_dependent_model():
    problem = Problem(3, 5)
    model = replace(problem.model(), transition_cov=lambda mean, action: mean)
    model.constant_cov()


def run_with_functions(**functions):
    problem = Problem(3, 5)
    model = replace(problem.model(), **functions)
    filter_sequence(model, *problem.arguments())


test_wrong_use_is_one_clear_line = refuses(
    (
        lambda: run_with_functions(transition=lambda mean, action: mean[..., :1]),
        "`transition` must return means like its own",
    ),
    (
        lambda: run_with_functions(transition_cov=lambda mean, action: mean.square()),
        r"`transition_cov` must return \(\*batch, state, state\)",
    ),
    (lambda: Problem(3, 5).run("fast"), "`form` must be 'auto', 'pytorch' or 'native', got 'f"),
    (lambda: Problem(3, 5).run("auto", use_stored_state=torch.zeros(3, 6).bool()), "together"),
    (lambda: Problem(3, 5).run("auto", stored_mean=torch.zeros(3, 6, 3)), "come together"),
    (cov_of_a_state_dependent_model, "`transition_cov` depends on the state"),
    (filter_with_a_narrow_network, r"`transition.weights\[0\]` must have shape \(5, 5\)"),
    (lambda: run_with_a_weight_of(-0.1), r"`weight` must lie in \[0, 1\], got"),
    (lambda: run_with_a_weight_of(1.5), r"`weight` must lie in \[0, 1\], got"),
)


ONES = torch.ones(2, 3, 3).double()
test_a_state_space_with_a_wrong_field_is_one_clear_line = refuses(
    ({"emission_cov": ONES[0, 0, :2]}, r"`emission_cov` must have shape \(5, 5\) or \(5,\)"),
    ({"initial_cov": ONES[0, :, :2]}, r"`initial_cov` must have shape \(3, 3\) or \(3,\)"),
    ({"transition_cov": ONES}, "`transition_cov` must have shape"),
    ({"initial_mean": ONES[0, 0, :2]}, "`initial_mean` must have shape"),
    ({"emission_offset": torch.zeros(5).float()}, "`emission_offset` is torch.float32"),
    ({"action_matrix": ONES[0, 0]}, r"`action_matrix` of shape \(obs, action\)"),
    ({"emission_matrix": torch.zeros(5, 3).long()}, "must be floating point"),
    ({"transition_cov": 0.3}, "`transition_cov` must be a tensor, got float"),
    ({"initial_mean": None}, "`initial_mean` must be a tensor, got NoneType"),
    ({"transition": ONES}, r"`transition` must be a function of \(mean, action\)"),
    ({"transition": TransitionMLP((), (), False, "relu")}, "must have at least one layer"),
    ({"transition": TransitionMLP((ONES,), (ONES,), False, "gelu")}, "must be 'relu' or 'tanh', g"),
    make=lambda **wrong: replace(Problem(3, 5).model(), **wrong),
)
