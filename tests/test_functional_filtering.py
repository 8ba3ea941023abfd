"""Whole sequences: every fast form of `functional.filtering` against the slow truth.

Specified here, in float64 unless the test is about float32:

- each form (innovation, native, information, loop) equals the row-deleting oracle to 1e-10, in
  values and in the gradient by every input and parameter, for state smaller than, equal to and
  larger than obs, with resets, restarts, frames that hold nothing, and diagonal or full noise;
- the forms equal each other; a sequence equals its steps; a reset inside a sequence equals two
  sequences; a restart equals a sequence begun from the stored belief; batch shape is immaterial;
- nothing observed: the means are the bare transition and the log-likelihood 0, exactly;
- NaN or inf under a False mask changes nothing and gets a gradient of exactly 0;
- float32 stays near float64, and its covariances positive definite, with the noise at its floor;
- the gradient of a fast form cannot be differentiated again, and says so.
"""

from __future__ import annotations

import math

import oracles
import pytest
import torch
from filter_problems import FAST, FORMS, SIZES, Problem, assert_equal, assert_same
from torch import Tensor

from torchrl_drbpn.functional import (
    choose_form,
    filter_sequence,
    filter_step,
    filtered_cov,
)

# --- against the oracle -------------------------------------------------------------------------


@pytest.mark.parametrize(
    "events",
    [
        pytest.param({"resets": False}, id="one episode"),
        pytest.param({"resets": True}, id="resets"),
        pytest.param({"resets": True, "restarts": True}, id="resets and restarts"),
    ],
)
@pytest.mark.parametrize(("form", "full_noise"), FORMS)
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_every_form_equals_the_oracle_in_values_and_all_gradients(
    state, obs, form, full_noise, events
):
    problem = Problem(state, obs, full_noise=full_noise, **events)
    assert_same(problem, problem.fast(form), problem.slow())


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
@pytest.mark.parametrize("form", FAST)
def test_every_transition_network_equals_the_oracle(form, network):
    problem = Problem(3, 5, seed=1, restarts=True, **network)
    assert_same(problem, problem.fast(form), problem.slow())


@pytest.mark.parametrize("form", FAST)
@pytest.mark.parametrize("rate", [0.0, 0.7, 1.0], ids=["complete", "sparse", "empty"])
def test_every_missing_rate_equals_the_oracle(form, rate):
    problem = Problem(3, 5, seed=2)
    g = torch.Generator().manual_seed(2)
    problem.observed = torch.rand(problem.observed.shape, generator=g) >= rate
    assert_same(problem, problem.fast(form), problem.slow())


@pytest.mark.parametrize("form", FAST)
def test_one_output_alone_has_the_right_gradient(form):
    # PPO alone reads the means, the model loss alone the likelihood: autograd then hands the
    # reverse loop a zero or an absent gradient for the other.
    problem = Problem(3, 5, restarts=True)
    for i in range(3):
        found = problem.gradients((problem.fast(form)[i],))
        truth = problem.gradients((problem.slow()[i],))
        for name in truth:
            assert_equal(found[name], truth[name])


@pytest.mark.parametrize("form", [*FAST, "loop"])
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_gradients_agree_with_finite_differences(state, obs, form):
    problem = Problem(state, obs, batch=2, time=3, restarts=True, hidden=(3,))
    names = list(problem.leaves)

    def run(*leaves: Tensor) -> tuple[Tensor, ...]:
        problem.leaves = dict(zip(names, leaves, strict=True))
        return problem.fast(form)

    leaves = tuple(problem.leaves.values())
    # One random direction an input: the complete Jacobian is covered by the oracle above.
    assert torch.autograd.gradcheck(run, leaves, fast_mode=True)


def test_a_transition_covariance_that_depends_on_the_state_equals_the_oracle():
    problem = Problem(3, 5, restarts=True)
    base = problem.covs()[0]
    model = problem.model()

    def scaled(mean: Tensor, action: Tensor) -> Tensor:
        scale = 1 + mean.square().sum(-1) + action.square().sum(-1)
        return base * scale[..., None, None]

    model = model._replace(transition_cov=scaled)
    out = filter_sequence(model, *problem.arguments(), **problem.restarts(), return_cov=True)
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
        **problem.restarts(),
    )
    assert choose_form(model) == "loop"
    assert_same(
        problem,
        (out.mean, out.cov, out.log_likelihood),
        (truth.mean, truth.cov, truth.log_likelihood),
    )


# --- one form against another -------------------------------------------------------------------


@pytest.mark.parametrize(("state", "obs"), [(4, 30), (9, 9), (12, 5)], ids=str)
def test_the_information_form_equals_the_innovation_form(state, obs):
    problem = Problem(
        state, obs, batch=5, time=12, restarts=True, hidden=(16, 16), activation="relu"
    )
    assert_same(problem, problem.fast("information"), problem.fast("innovation"))


@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_a_diagonal_covariance_equals_its_variances(state, obs):
    problem = Problem(state, obs)
    model = problem.model()
    matrix = model._replace(emission_cov=model.emission_cov.diag())
    for form in ("innovation", "loop"):
        a = filter_sequence(model, *problem.arguments(), return_cov=True, form=form)
        b = filter_sequence(matrix, *problem.arguments(), return_cov=True, form=form)
        assert_same(problem, tuple(a), tuple(b))


@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_the_chosen_form_is_the_smaller_factorisation_and_never_changes_the_answer(state, obs):
    problem = Problem(state, obs)
    chosen = choose_form(problem.model())
    assert chosen == ("information" if obs > state else "innovation")
    auto, forced = problem.fast("auto"), problem.fast(chosen)
    for a, b in zip(auto, forced, strict=True):
        assert_equal(a, b)  # "auto" may run the innovation form in C
    full = Problem(state, obs, full_noise=True)
    assert choose_form(full.model()) == "innovation"


@pytest.mark.parametrize("form", [*FAST, "loop"])
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_stepping_through_time_equals_the_whole_sequence(state, obs, form):
    problem = Problem(state, obs)
    whole = problem.fast(form)
    model = problem.model()
    mean, actions, observations, observed, reset = problem.arguments()
    rows = []
    for t in range(reset.shape[1]):
        out = filter_step(
            model,
            mean,
            actions[:, t],
            observations[:, t],
            observed[:, t],
            reset[:, t],
            return_cov=True,
            form=form,
        )
        mean = out.mean
        rows.append(out)
    stepped = tuple(torch.stack(part, 1) for part in zip(*rows, strict=True))
    assert_same(problem, stepped, whole)


# --- what a reset, a restart and a batch shape mean -----------------------------------------------


@pytest.mark.parametrize("form", [*FAST, "loop"])
def test_a_reset_inside_a_sequence_equals_two_sequences(form):
    problem = Problem(3, 5, resets=False)
    cut = 3
    problem.reset[:, cut] = True
    whole = filter_sequence(problem.model(), *problem.arguments(), return_cov=True, form=form)
    mean, *rest = problem.arguments()
    first = filter_sequence(
        problem.model(), mean, *(x[:, :cut] for x in rest), return_cov=True, form=form
    )
    # The belief that the second one is handed must not matter: its first step is a reset.
    second = filter_sequence(
        problem.model(), 50 + mean, *(x[:, cut:] for x in rest), return_cov=True, form=form
    )
    for a, b, c in zip(whole, first, second, strict=True):
        assert_equal(a, torch.cat([b, c], 1))


@pytest.mark.parametrize("form", [*FAST, "loop"])
def test_nothing_before_a_reset_reaches_what_follows_it(form):
    problem = Problem(3, 5, resets=False)
    problem.reset[:, 3] = True
    out = filter_sequence(problem.model(), *problem.arguments(), form=form)
    later = out.mean[:, 3:].square().sum() + out.log_likelihood[:, 3:].square().sum()
    start, observation = torch.autograd.grad(
        later, [problem.leaves["start_mean"], problem.leaves["observation"]]
    )
    assert torch.equal(start, torch.zeros_like(start))
    assert torch.equal(observation[:, :3], torch.zeros_like(observation[:, :3]))
    assert observation[:, 3:].abs().sum() > 0


@pytest.mark.parametrize("form", [*FAST, "loop"])
def test_the_initial_belief_learns_from_resets_and_only_from_them(form):
    problem = Problem(3, 5, resets=False)
    for reset in (False, True):
        problem.reset[:, 2] = reset
        gradients = problem.gradients(problem.fast(form))
        for name in ("initial_mean", "initial_root"):
            assert bool(gradients[name].abs().sum() > 0) == reset


@pytest.mark.parametrize("form", [*FAST, "loop"])
def test_a_restart_equals_a_sequence_begun_from_the_stored_belief(form):
    problem = Problem(3, 5, resets=False, restarts=True)
    cut = 3
    problem.restart = torch.zeros_like(problem.reset)
    problem.restart[:, cut] = True
    model, arguments = problem.model(), problem.arguments()
    stored = problem.leaves["restart_mean"]
    whole = filter_sequence(
        model, *arguments, restart=problem.restart, restart_mean=stored, return_cov=True, form=form
    )
    mean, *rest = arguments
    first = filter_sequence(model, mean, *(x[:, :cut] for x in rest), return_cov=True, form=form)
    second = filter_sequence(
        model, stored[:, cut], *(x[:, cut:] for x in rest), return_cov=True, form=form
    )
    for a, b, c in zip(whole, first, second, strict=True):
        assert_equal(a, torch.cat([b, c], 1))


@pytest.mark.parametrize("form", [*FAST, "loop"])
def test_what_is_stored_where_no_restart_is_asked_for_does_not_matter(form):
    problem = Problem(3, 5, restarts=True)
    clean = problem.fast(form)
    stored = problem.leaves["restart_mean"].detach()
    junk = torch.where(problem.restart.unsqueeze(-1), stored, torch.full_like(stored, math.nan))
    problem.leaves["restart_mean"] = junk.requires_grad_()
    dirty = problem.fast(form)
    for a, b in zip(clean, dirty, strict=True):
        assert torch.equal(a, b)
    gradients = problem.gradients(dirty)
    assert all(torch.isfinite(g).all() for g in gradients.values())
    unused = gradients["restart_mean"][~problem.restart]
    assert torch.equal(unused, torch.zeros_like(unused))


@pytest.mark.parametrize("form", [*FAST, "loop"])
@pytest.mark.parametrize("shape", [(), (1,), (6,), (2, 3), (3, 1, 2)], ids=str)
def test_the_batch_shape_does_not_matter(shape, form):
    batch = math.prod(shape)
    problem = Problem(3, 5, batch=batch, time=4)
    flat = filter_sequence(problem.model(), *problem.arguments(), return_cov=True, form=form)
    shaped = filter_sequence(
        problem.model(),
        *(x.reshape(*shape, *x.shape[1:]) for x in problem.arguments()),
        return_cov=True,
        form=form,
    )
    assert shaped.mean.shape == (*shape, 4, 3)
    assert shaped.cov.shape == (*shape, 4, 3, 3)
    assert shaped.log_likelihood.shape == (*shape, 4)
    for a, b in zip(shaped, flat, strict=True):
        assert_equal(a, b.reshape(a.shape))


@pytest.mark.parametrize("form", [*FAST, "loop"])
def test_memory_layout_does_not_matter(form):
    problem = Problem(3, 5, batch=4, restarts=True)
    plain = problem.fast(form)
    for name in ("observation", "previous_action", "restart_mean"):
        x = problem.leaves[name].detach()
        problem.leaves[name] = x.transpose(0, 1).contiguous().transpose(0, 1).requires_grad_()
        assert not problem.leaves[name].is_contiguous()
    problem.observed = problem.observed.mT.contiguous().mT
    problem.reset = problem.reset.mT.contiguous().mT
    assert_same(problem, problem.fast(form), problem.slow())
    for a, b in zip(problem.fast(form), plain, strict=True):
        assert_equal(a, b)


@pytest.mark.parametrize("form", FAST)
def test_the_order_of_the_sensors_does_not_matter(form):
    problem = Problem(3, 5)
    order = torch.tensor([3, 0, 4, 1, 2])
    model = problem.model()
    permuted = model._replace(
        emission_matrix=model.emission_matrix[order],
        emission_cov=model.emission_cov[order],
        action_matrix=model.action_matrix[order],
        emission_offset=model.emission_offset[order],
    )
    mean, action, x, observed, reset = problem.arguments()
    straight = filter_sequence(model, *problem.arguments(), return_cov=True, form=form)
    shuffled = filter_sequence(
        permuted, mean, action, x[..., order], observed[..., order], reset, return_cov=True,
        form=form,
    )  # fmt: skip
    for a, b in zip(straight, shuffled, strict=True):
        assert_equal(a, b)


# --- missing entries ----------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("form", [*FAST, "loop"])
@pytest.mark.parametrize(("state", "obs"), SIZES)
def test_nothing_observed_leaves_the_predicted_belief_and_likelihood_zero(state, obs, form, dtype):
    problem = Problem(state, obs, dtype=dtype, time=5)
    problem.observed = torch.zeros_like(problem.observed)
    mean, cov, ll = problem.fast(form)
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


@pytest.mark.parametrize("form", [*FAST, "loop"])
def test_an_empty_frame_moves_the_mean_by_nothing_at_all(form):
    # Exactly: step by step the filtered mean IS what the transition returned, to the last bit.
    problem = Problem(3, 5, dtype=torch.float32)
    model = problem.model()
    mean, action, x, _, _ = (v[:, 0] if v.ndim > 2 else v for v in problem.arguments())
    nothing = torch.zeros_like(x, dtype=torch.bool)
    for reset in (False, True):
        flag = torch.full(mean.shape[:1], reset)
        out = filter_step(model, mean, action, x, nothing, flag, return_cov=True, form=form)
        expected = model.initial_mean.expand_as(mean) if reset else model.transition(mean, action)
        assert torch.equal(out.mean, expected)
        assert torch.equal(
            out.cov, (model.initial_cov if reset else model.transition_cov).expand_as(out.cov)
        )
        assert torch.equal(out.log_likelihood, torch.zeros_like(out.log_likelihood))


@pytest.mark.parametrize("junk", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("form", [*FAST, "loop"])
def test_what_lies_under_a_false_mask_changes_nothing_and_has_zero_gradient(form, junk):
    problem = Problem(3, 5, restarts=True)
    clean = problem.fast(form)
    clean_gradients = problem.gradients(clean)
    x = problem.leaves["observation"].detach()
    dirty = torch.where(problem.observed, x, torch.full_like(x, junk))
    problem.leaves["observation"] = dirty.requires_grad_()
    spoilt = problem.fast(form)
    for a, b in zip(clean, spoilt, strict=True):
        assert torch.equal(a, b)
    gradients = problem.gradients(spoilt)
    for name, gradient in gradients.items():
        assert torch.equal(gradient, clean_gradients[name]), name
    unseen = gradients["observation"][~problem.observed]
    assert torch.equal(unseen, torch.zeros_like(unseen))


# --- covariances --------------------------------------------------------------------------------


@pytest.mark.parametrize("form", [*FAST, "loop"])
def test_covariances_are_computed_only_where_asked_for(form):
    problem = Problem(3, 5)
    out = filter_sequence(problem.model(), *problem.arguments(), form=form)
    assert out.cov is None
    asked = filter_sequence(problem.model(), *problem.arguments(), return_cov=True, form=form)
    assert torch.equal(asked.mean, out.mean)
    assert_equal(asked.cov, filtered_cov(problem.model(), problem.observed, problem.reset))


def test_with_a_constant_transition_covariance_only_masks_and_resets_matter_for_covariances():
    problem = Problem(3, 5, resets=False)
    problem.observed = problem.observed[:, :1].expand_as(problem.observed)
    cov = problem.fast("innovation")[1]
    assert_equal(cov, cov[:, :1].expand_as(cov))
    problem.reset[:, 2] = True
    changed = problem.fast("innovation")[1]
    assert_equal(changed[:, 3:], cov[:, 3:])
    some = problem.observed[:, 2].any(-1)
    assert ((changed[:, 2] - cov[:, 2])[some].abs().amax((-1, -2)) > 1e-6).all()


@pytest.mark.parametrize("form", [*FAST, "loop"])
@pytest.mark.parametrize("given", ["restart", "restart_mean"])
def test_restart_and_restart_mean_come_together(form, given):
    problem = Problem(3, 5)
    mean, action, x, observed, reset = problem.arguments()
    one = {"restart": reset, "restart_mean": torch.zeros(*reset.shape, 3).to(x)}[given]
    with pytest.raises(ValueError, match="`restart` and `restart_mean` come together"):
        filter_sequence(
            problem.model(), mean, action, x, observed, reset, form=form, **{given: one}
        )


# --- autograd manners -----------------------------------------------------------------------------


@pytest.mark.parametrize("form", [*FAST, "loop"])
def test_without_gradients_the_values_are_the_same_and_carry_no_graph(form):
    problem = Problem(3, 5, restarts=True)
    graph = problem.fast(form)
    with torch.no_grad():
        bare = problem.fast(form)
    for a, b in zip(graph, bare, strict=True):
        assert torch.equal(a, b)
        assert a.requires_grad
        assert not b.requires_grad


@pytest.mark.parametrize("form", FAST)
def test_each_leaf_alone_gets_the_gradient_it_gets_among_all(form):
    problem = Problem(3, 5, restarts=True)
    together = problem.gradients(problem.fast(form))
    for name in list(problem.leaves):
        for other, leaf in problem.leaves.items():
            leaf.requires_grad_(other == name)
        outputs = tuple(out for out in problem.fast(form) if out.requires_grad)
        # The same weights for the same outputs as in `gradients`.
        g = torch.Generator().manual_seed(3)
        loss = torch.zeros((), dtype=torch.float64)
        for out in problem.fast(form):
            weight = torch.randn(out.shape, generator=g, dtype=torch.float64)
            loss = loss + (weight * out).sum() + 0.1 * (weight * out.square()).sum()
        assert outputs, name
        (alone,) = torch.autograd.grad(loss, [problem.leaves[name]])
        assert_equal(alone, together[name])


@pytest.mark.parametrize("form", FAST)
def test_differentiating_a_fast_form_twice_is_refused(form):
    problem = Problem(3, 5)
    mean, _, ll = problem.fast(form)
    leaf = problem.leaves["bias0"]
    (gradient,) = torch.autograd.grad(mean.square().sum() + ll.sum(), leaf, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.square().sum().backward()


def test_the_loop_can_be_differentiated_twice():
    problem = Problem(2, 3, batch=1, time=2, hidden=(3,))
    leaf = problem.leaves["bias0"]

    def run(bias: Tensor) -> Tensor:
        problem.leaves["bias0"] = bias
        mean, _, ll = problem.fast("loop")
        return mean.square().sum() + ll.sum()

    assert torch.autograd.gradgradcheck(run, (leaf,))


@pytest.mark.parametrize("form", [*FAST, "loop"])
def test_inputs_are_left_as_they_were(form):
    problem = Problem(3, 5, restarts=True)
    before = {k: v.detach().clone() for k, v in problem.leaves.items()}
    masks = (problem.observed.clone(), problem.reset.clone(), problem.restart.clone())
    problem.gradients(problem.fast(form))
    for name, leaf in problem.leaves.items():
        assert torch.equal(leaf, before[name]), name
    for a, b in zip(masks, (problem.observed, problem.reset, problem.restart), strict=True):
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
        problem.fast("auto")
    arguments = [x if x.ndim < 2 or i == 0 else x[:, 0] for i, x in enumerate(problem.arguments())]
    with pytest.raises(ValueError, match=r"`observed` must be"):
        filter_step(problem.model(), *arguments)


def test_an_unknown_form_is_refused():
    problem = Problem(3, 5)
    with pytest.raises(ValueError, match="`form` must be 'auto', 'innovation', 'information'"):
        problem.fast("fast")


def test_the_information_form_of_a_full_noise_covariance_is_refused():
    problem = Problem(3, 5, full_noise=True)
    with pytest.raises(ValueError, match="`form` 'information' needs a diagonal emission"):
        problem.fast("information")


@pytest.mark.parametrize("form", FAST)
def test_a_fast_form_of_an_arbitrary_transition_is_refused(form):
    problem = Problem(3, 5)
    model = problem.model()
    for other in (
        model._replace(transition=lambda mean, action: mean),
        model._replace(transition_cov=lambda mean, action: torch.eye(3, dtype=torch.float64)),
    ):
        with pytest.raises(ValueError, match="needs a MeanNetwork transition with a constant"):
            filter_sequence(other, *problem.arguments(), form=form)


def test_the_covariance_of_a_state_dependent_model_cannot_be_had_from_the_masks_alone():
    problem = Problem(3, 5)
    model = problem.model()._replace(transition_cov=lambda mean, action: mean)
    with pytest.raises(ValueError, match="`transition_cov` depends on the state"):
        filtered_cov(model, problem.observed, problem.reset)
