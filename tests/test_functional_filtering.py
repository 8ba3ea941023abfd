"""Whole sequences: both forms of `functional.filtering` against the slow truth.

Specified here, in float64, for the PyTorch form, the native one, and a Q that depends on the state
(step by step):

- each equals the row-deleting oracle to 1e-10, in values and in the gradient by every input and
  parameter, for state smaller than, equal to and larger than obs, with resets, stored states,
  frames that hold nothing, and diagonal or full noise;
- a sequence equals its steps; a reset inside a sequence equals two sequences; a stored state equals
  a sequence begun from it; batch shape is immaterial;
- nothing observed: the means are the bare transition and the log-likelihood 0, exactly;
- NaN or inf under a False mask, or a NaN belief before a reset, changes nothing and gets a gradient
  of exactly 0;
- every gradient can be differentiated again.
"""

from __future__ import annotations

import math
from dataclasses import replace

import oracles
import pytest
import torch
from filter_problems import FORMS, SIZES, Problem, assert_equal, assert_same
from torch import Tensor

from torchrl_drbpn.functional import filter_sequence, filter_step, filtered_cov

# --- against the oracle -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "events",
    [
        pytest.param({"resets": False}, id="one episode"),
        pytest.param({"resets": True}, id="resets"),
        pytest.param({"resets": True, "stored": True}, id="resets and stored states"),
    ],
)
@pytest.mark.parametrize("full_noise", [False, True], ids=["diagonal R", "full R"])
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_every_form_equals_the_oracle_in_values_and_all_gradients(
    state, obs, form, full_noise, events
):
    problem = Problem(state, obs, full_noise=full_noise, **events)
    assert_same(problem, problem.library(form), problem.oracle())


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
@pytest.mark.parametrize("rate", [0.0, 0.7, 1.0], ids=["complete", "sparse", "empty"])
def test_every_missing_rate_equals_the_oracle(form, rate):
    problem = Problem(3, 5, seed=2)
    g = torch.Generator().manual_seed(2)
    problem.observed = torch.rand(problem.observed.shape, generator=g) >= rate
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


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_gradients_agree_with_finite_differences(state, obs, form):
    problem = Problem(state, obs, batch=2, time=3, stored=True, hidden=(3,))
    names = list(problem.leaves)

    def run(*leaves: Tensor) -> tuple[Tensor, ...]:
        problem.leaves = dict(zip(names, leaves, strict=True))
        return problem.library(form)

    leaves = tuple(problem.leaves.values())
    # One random direction an input: the complete Jacobian is covered by the oracle above.
    assert torch.autograd.gradcheck(run, leaves, fast_mode=True)


def test_a_transition_covariance_that_depends_on_the_state_equals_the_oracle():
    problem = Problem(3, 5, stored=True)
    base = problem.covs()[0]
    model = problem.model()

    def scaled(mean: Tensor, action: Tensor) -> Tensor:
        scale = 1 + mean.square().sum(-1) + action.square().sum(-1)
        return base * scale[..., None, None]

    model = replace(model, transition_cov=scaled)
    out = filter_sequence(model, *problem.arguments(), **problem.stored(), return_cov=True)
    weights, biases = problem.network()
    _, p, r = problem.covs()
    truth = oracles.filter_sequence(
        observation=problem.leaves["observation"],
        observed=problem.observed,
        previous_action=problem.leaves["previous_action"],
        reset=problem.reset,
        start_mean=problem.leaves["start_mean"],
        initial_mean=problem.leaves["initial_mean"],
        initial_cov=p,
        transition=oracles.mean_network(weights, biases, True, "tanh"),
        transition_cov=scaled,
        matrix=problem.leaves["matrix"],
        noise=torch.diag(r),
        action_matrix=problem.leaves["action_matrix"],
        bias=problem.leaves["bias"],
        **problem.stored(),
    )
    assert_same(
        problem,
        (out.mean, out.cov, out.log_likelihood),
        (truth.mean, truth.cov, truth.log_likelihood),
    )


# --- one form against another -------------------------------------------------------------------


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


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_stepping_through_time_equals_the_whole_sequence(state, obs, form):
    problem = Problem(state, obs)
    whole = problem.library(form)
    mean, actions, observations, observed, reset = problem.arguments()
    rows = []
    for t in range(reset.shape[1]):
        step = (mean, *(x[:, t] for x in (actions, observations, observed, reset)))
        out = problem.run(form, *step, function=filter_step, return_cov=True)
        mean = out.mean
        rows.append(out)
    stepped = tuple(torch.stack(part, 1) for part in zip(*rows, strict=True))
    assert_same(problem, stepped, whole)


# --- what a reset, a restart and a batch shape mean -----------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_a_reset_inside_a_sequence_equals_two_sequences(form):
    problem = Problem(3, 5, resets=False)
    cut = 3
    problem.reset[:, cut] = True
    whole = problem.run(form, return_cov=True)
    mean, *rest = problem.arguments()
    first = problem.run(form, mean, *(x[:, :cut] for x in rest), return_cov=True)
    # The belief that the second one is handed must not matter: its first step is a reset.
    second = problem.run(form, 50 + mean, *(x[:, cut:] for x in rest), return_cov=True)
    for a, b, c in zip(whole, first, second, strict=True):
        assert_equal(a, torch.cat([b, c], 1))


@pytest.mark.parametrize("form", FORMS)
def test_nothing_before_a_reset_reaches_what_follows_it(form):
    problem = Problem(3, 5, resets=False)
    problem.reset[:, 3] = True
    out = problem.run(form)
    later = out.mean[:, 3:].square().sum() + out.log_likelihood[:, 3:].square().sum()
    start, observation = torch.autograd.grad(
        later, [problem.leaves["start_mean"], problem.leaves["observation"]]
    )
    assert torch.equal(start, torch.zeros_like(start))
    assert torch.equal(observation[:, :3], torch.zeros_like(observation[:, :3]))
    assert observation[:, 3:].abs().sum() > 0


@pytest.mark.parametrize("form", FORMS)
def test_the_initial_belief_learns_from_resets_and_only_from_them(form):
    problem = Problem(3, 5, resets=False)
    for reset in (False, True):
        problem.reset[:, 2] = reset
        gradients = problem.gradients(problem.library(form))
        for name in ("initial_mean", "initial_root"):
            assert bool(gradients[name].abs().sum() > 0) == reset


@pytest.mark.parametrize("form", FORMS)
def test_a_stored_state_equals_a_sequence_begun_from_the_stored_belief(form):
    problem = Problem(3, 5, resets=False, stored=True)
    cut = 3
    problem.use_stored = torch.zeros_like(problem.reset)
    problem.use_stored[:, cut] = True
    stored = problem.leaves["stored_mean"]
    whole = problem.library(form)
    mean, *rest = problem.arguments()
    first = problem.run(form, mean, *(x[:, :cut] for x in rest), return_cov=True)
    second = problem.run(form, stored[:, cut], *(x[:, cut:] for x in rest), return_cov=True)
    for a, b, c in zip(whole, first, second, strict=True):
        assert_equal(a, torch.cat([b, c], 1))


@pytest.mark.parametrize("form", FORMS)
def test_what_is_stored_where_no_stored_state_is_asked_for_does_not_matter(form):
    problem = Problem(3, 5, stored=True)
    clean = problem.library(form)
    stored = problem.leaves["stored_mean"].detach()
    junk = torch.where(problem.use_stored.unsqueeze(-1), stored, torch.full_like(stored, math.nan))
    problem.leaves["stored_mean"] = junk.requires_grad_()
    dirty = problem.library(form)
    for a, b in zip(clean, dirty, strict=True):
        assert torch.equal(a, b)
    gradients = problem.gradients(dirty)
    assert all(torch.isfinite(g).all() for g in gradients.values())
    unused = gradients["stored_mean"][~problem.use_stored]
    assert torch.equal(unused, torch.zeros_like(unused))


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shape", [(), (1,), (6,), (2, 3), (3, 1, 2)], ids=str)
def test_the_batch_shape_does_not_matter(shape, form):
    batch = math.prod(shape)
    problem = Problem(3, 5, batch=batch, time=4)
    flat = problem.run(form, return_cov=True)
    arguments = (x.reshape(*shape, *x.shape[1:]) for x in problem.arguments())
    shaped = problem.run(form, *arguments, return_cov=True)
    assert shaped.mean.shape == (*shape, 4, 3)
    assert shaped.cov.shape == (*shape, 4, 3, 3)
    assert shaped.log_likelihood.shape == (*shape, 4)
    for a, b in zip(shaped, flat, strict=True):
        assert_equal(a, b.reshape(a.shape))


@pytest.mark.parametrize("form", FORMS)
def test_memory_layout_does_not_matter(form):
    problem = Problem(3, 5, batch=4, stored=True)
    plain = problem.library(form)
    for name in ("observation", "previous_action", "stored_mean"):
        x = problem.leaves[name].detach()
        problem.leaves[name] = x.transpose(0, 1).contiguous().transpose(0, 1).requires_grad_()
        assert not problem.leaves[name].is_contiguous()
    problem.observed = problem.observed.mT.contiguous().mT
    problem.reset = problem.reset.mT.contiguous().mT
    assert_same(problem, problem.library(form), problem.oracle())
    for a, b in zip(problem.library(form), plain, strict=True):
        assert_equal(a, b)


@pytest.mark.parametrize("form", FORMS)
def test_the_order_of_the_sensors_does_not_matter(form):
    problem, order = Problem(3, 5), torch.tensor([3, 0, 4, 1, 2])
    straight = problem.library(form)
    for name in ("matrix", "noise", "action_matrix", "bias"):
        problem.leaves[name] = problem.leaves[name][order]
    mean, action, x, observed, reset = problem.arguments()
    shuffled = problem.run(
        form, mean, action, x[..., order], observed[..., order], reset, return_cov=True
    )
    for a, b in zip(straight, shuffled, strict=True):
        assert_equal(a, b)


# --- missing entries ----------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_nothing_observed_leaves_the_predicted_belief_and_likelihood_zero(state, obs, form, dtype):
    problem = Problem(state, obs, dtype=dtype, time=5)
    problem.observed = torch.zeros_like(problem.observed)
    mean, cov, ll = problem.library(form)
    assert torch.equal(ll, torch.zeros_like(ll))
    q, p, _ = problem.covs()
    first = problem.reset[..., None, None]
    assert torch.equal(cov, torch.where(first, p, q))
    # The predicted means are the bare transition from the start belief, one step at a time.
    weights, biases = problem.network()
    transition = oracles.mean_network(weights, biases, True, "tanh")
    belief = problem.leaves["start_mean"]
    for t in range(5):
        moved = transition(belief, problem.leaves["previous_action"][:, t])
        belief = torch.where(problem.reset[:, t, None], problem.leaves["initial_mean"], moved)
        assert_equal(mean[:, t], belief, 1e-12 if dtype == torch.float64 else 1e-5)
    gradients = problem.gradients((mean, cov, ll))
    assert all(torch.isfinite(g).all() for g in gradients.values())
    for name in ("observation", "noise", "matrix", "action_matrix", "bias"):
        assert torch.equal(gradients[name], torch.zeros_like(gradients[name])), name


@pytest.mark.parametrize("form", ["pytorch", "step by step"])
def test_an_empty_frame_moves_the_mean_by_nothing_at_all(form):
    # Exactly: step by step the filtered mean IS what the transition returned, to the last bit. (The
    # native form has a transition of its own, in float64.)
    problem = Problem(3, 5, dtype=torch.float32)
    model = problem.model()
    mean, action, x, _, _ = (v[:, 0] if v.ndim > 2 else v for v in problem.arguments())
    nothing = torch.zeros_like(x, dtype=torch.bool)
    for reset in (False, True):
        flag = torch.full(mean.shape[:1], reset)
        step = (mean, action, x, nothing, flag)
        out = problem.run(form, *step, function=filter_step, return_cov=True)
        expected = model.initial_mean.expand_as(mean) if reset else model.transition(mean, action)
        assert torch.equal(out.mean, expected)
        assert torch.equal(
            out.cov, (model.initial_cov if reset else model.transition_cov).expand_as(out.cov)
        )
        assert torch.equal(out.log_likelihood, torch.zeros_like(out.log_likelihood))


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


# --- covariances --------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS)
def test_covariances_are_computed_only_where_asked_for(form):
    problem = Problem(3, 5)
    out = problem.run(form)
    assert out.cov is None
    asked = problem.run(form, return_cov=True)
    assert torch.equal(asked.mean, out.mean)
    assert_equal(asked.cov, filtered_cov(problem.model(), problem.observed, problem.reset))


def test_with_a_constant_transition_covariance_only_masks_and_resets_matter_for_covariances():
    problem = Problem(3, 5, resets=False)
    problem.observed = problem.observed[:, :1].expand_as(problem.observed)
    cov = problem.library("pytorch")[1]
    assert_equal(cov, cov[:, :1].expand_as(cov))
    problem.reset[:, 2] = True
    changed = problem.library("pytorch")[1]
    assert_equal(changed[:, 3:], cov[:, 3:])
    some = problem.observed[:, 2].any(-1)
    assert ((changed[:, 2] - cov[:, 2])[some].abs().amax((-1, -2)) > 1e-6).all()


@pytest.mark.parametrize("given", ["use_stored_state", "stored_mean"])
def test_use_stored_state_and_stored_mean_come_together(given):
    problem = Problem(3, 5)
    one = {"use_stored_state": problem.reset, "stored_mean": torch.zeros(3, 6, 3).double()}[given]
    with pytest.raises(ValueError, match="`use_stored_state` and `stored_mean` come together"):
        problem.run("auto", **{given: one})


@pytest.mark.parametrize("form", FORMS)
def test_a_nan_belief_before_a_reset_leaves_every_gradient_finite(form):
    problem = Problem(3, 5, stored=True)
    problem.reset[:, 0] = problem.reset[:, 2] = True
    problem.use_stored[:, 2] = True
    clean = problem.gradients(problem.library(form))
    with torch.no_grad():
        problem.leaves["start_mean"].fill_(math.nan)
        problem.leaves["stored_mean"][:, 2] = math.nan
    spoilt = problem.library(form)
    for name, gradient in problem.gradients(spoilt).items():
        assert torch.equal(gradient, clean[name]), name


@pytest.mark.parametrize("form", ["auto", "pytorch", "step by step"])
def test_no_step_at_all_returns_nothing(form):
    problem = Problem(3, 5)
    mean, *rest = problem.arguments()
    out = problem.run(form, mean, *(x[:, :0] for x in rest), return_cov=True)
    assert [tuple(x.shape) for x in out] == [(3, 0, 3), (3, 0, 3, 3), (3, 0)]


# --- autograd manners -----------------------------------------------------------------------------


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
    together = problem.gradients(problem.library(form))
    for name in list(problem.leaves):
        for other, leaf in problem.leaves.items():
            leaf.requires_grad_(other == name)
        outputs = tuple(out for out in problem.library(form) if out.requires_grad)
        # The same weights for the same outputs as in `gradients`.
        g = torch.Generator().manual_seed(3)
        loss = torch.zeros((), dtype=torch.float64)
        for out in problem.library(form):
            weight = torch.randn(out.shape, generator=g, dtype=torch.float64)
            loss = loss + (weight * out).sum() + 0.1 * (weight * out.square()).sum()
        assert outputs, name
        (alone,) = torch.autograd.grad(loss, [problem.leaves[name]])
        assert_equal(alone, together[name])


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("obs", [2, 4], ids=["innovation", "information"])
def test_every_form_can_be_differentiated_twice(obs, form):
    problem = Problem(3, obs, batch=1, time=3, hidden=(3,), stored=True)
    names = ("bias0", "noise", "matrix", "observation", "stored_mean", "initial_mean")

    def run(*leaves: Tensor) -> Tensor:
        problem.leaves |= dict(zip(names, leaves, strict=True))
        mean, _, ll = problem.library(form)
        return mean.square().sum() + ll.sum()

    leaves = tuple(problem.leaves[name] for name in names)
    assert torch.autograd.gradgradcheck(run, leaves, fast_mode=True)


@pytest.mark.parametrize("form", FORMS)
def test_inputs_are_left_as_they_were(form):
    problem = Problem(3, 5, stored=True)
    before = {k: v.detach().clone() for k, v in problem.leaves.items()}
    masks = (problem.observed.clone(), problem.reset.clone(), problem.use_stored.clone())
    problem.gradients(problem.library(form))
    for name, leaf in problem.leaves.items():
        assert torch.equal(leaf, before[name]), name
    for a, b in zip(masks, (problem.observed, problem.reset, problem.use_stored), strict=True):
        assert torch.equal(a, b)


# --- errors -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(lambda mask: mask.float(), id="dtype"),
        pytest.param(lambda mask: mask[..., :1], id="shape"),
    ],
)
def test_a_mask_of_wrong_dtype_or_shape_is_refused(spoil):
    # A mask of shape (*batch, 1) would broadcast, and count one entry where there are many.
    problem = Problem(3, 5)
    problem.observed = spoil(problem.observed)
    with pytest.raises(ValueError, match=r"`observed` must be"):
        problem.library("auto")


def test_an_unknown_form_is_refused():
    with pytest.raises(
        ValueError, match="`form` must be 'auto', 'pytorch' or 'native', got 'fast'"
    ):
        Problem(3, 5).run("fast")


@pytest.mark.parametrize("name", ["mean", "previous_action", "observation"])
@pytest.mark.parametrize("form", FORMS)
def test_an_input_of_wrong_size_is_one_clear_line(form, name):
    problem = Problem(3, 5)
    names = ("mean", "previous_action", "observation", "observed", "reset")
    arguments = dict(zip(names, problem.arguments(), strict=True))
    arguments[name] = arguments[name][..., :-1]
    with pytest.raises(ValueError, match=f"`{name}` must be float64 of shape"):
        problem.run(form, *arguments.values())


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("emission_cov", torch.ones(4), r"`emission_cov` must have shape \(5, 5\) or \(5,\)"),
        ("initial_cov", torch.ones(3, 2), r"`initial_cov` must have shape \(3, 3\) or \(3,\)"),
        ("transition_cov", torch.ones(2, 3, 3), "`transition_cov` must have shape"),
        ("initial_mean", torch.zeros(4), "`initial_mean` must have shape"),
        ("emission_offset", torch.zeros(5).float(), "`emission_offset` is torch.float32"),
        ("action_matrix", torch.zeros(5), r"`action_matrix` of shape \(obs, action\)"),
        ("emission_matrix", torch.zeros(5, 3).long(), "must be floating point"),
    ],
)
def test_a_state_space_with_a_wrong_field_is_one_clear_line(field, value, message):
    model = Problem(3, 5).model()
    if value.dtype == torch.float32 and field != "emission_offset":
        value = value.double()
    with pytest.raises(ValueError, match=message):
        replace(model, **{field: value})


def test_a_transition_of_wrong_width_is_one_clear_line():
    problem = Problem(3, 5)
    problem.leaves["weight0"] = problem.leaves["weight0"][:, 1:]
    with pytest.raises(ValueError, match=r"`transition.weights\[0\]` must have shape \(5, 5\)"):
        problem.model()


def test_the_covariance_of_a_state_dependent_model_cannot_be_had_from_the_masks_alone():
    problem = Problem(3, 5)
    model = replace(problem.model(), transition_cov=lambda mean, action: mean)
    with pytest.raises(ValueError, match="`transition_cov` depends on the state"):
        filtered_cov(model, problem.observed, problem.reset)
