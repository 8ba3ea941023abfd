"""Laws of `functional` over masks, shapes, dtypes and dimensions drawn at random."""

import functools
import itertools
import math

import references
import torch
from filter_problems import Problem, outputs
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_drbpn import functional as F
from torchrl_drbpn.functional.gaussian import Belief

often = settings(max_examples=40, deadline=None, derandomize=True, database=None)
DIMS = {"state": st.integers(1, 6), "obs": st.integers(1, 6), "seed": st.integers(0, 999)}
CASES = DIMS | {
    "batch": st.lists(st.integers(1, 3), max_size=3).map(tuple),
    "share": st.sampled_from([0.0, 0.3, 0.7, 1.0]),
    "full_noise": st.booleans(),
    "dtype": st.sampled_from([torch.float32, torch.float64]),
}


def draw(state, obs, seed, batch, share, full_noise, dtype):
    """A predicted belief, readings, mask, H, R and offsets, as `update` takes them."""
    g = torch.Generator().manual_seed(seed)
    system = references.random_system(state, obs, seed=seed, full_noise=full_noise).to(dtype)
    randn = functools.partial(torch.randn, *batch, generator=g, dtype=torch.float64)
    mean, root, x, offset = randn(state), randn(state, state), 2 * randn(obs), randn(obs)
    cov = root @ root.mT / state + 0.3 * torch.eye(state)
    observed = torch.rand(*batch, obs, generator=g) < share
    belief = Belief(mean.to(dtype), ((cov + cov.mT) / 2).to(dtype))
    return [belief, x.to(dtype), observed, system.matrix, system.noise, offset.to(dtype)], g


def assert_near(actual, expected, dtype=torch.float64):
    limit = 1e-10 if dtype == torch.float64 else 1e-3
    for a, e in zip(actual, expected, strict=True):
        torch.testing.assert_close(a, e.to(a.dtype), rtol=limit, atol=limit)


@often
@given(**CASES)
def test_every_member_of_a_batch_is_the_row_deleting_oracle(**case):
    ((mean, cov), x, observed, h, r, offset), g = draw(**case)
    state, obs, batch, dtype = (case[name] for name in ("state", "obs", "batch", "dtype"))
    system = references.random_system(state, obs, seed=case["seed"]).to(dtype)
    action = torch.randn(*batch, 2, generator=g, dtype=dtype)
    moves = system.transition, system.transition_cov
    predicted = F.predict(Belief(mean, cov), *moves, action, jacobian=system.dynamics)
    found = outputs(predicted, x, observed, h, r, offset)
    assert {t.dtype for t in found[2:]} == {dtype}
    shapes = [(obs,), (obs, obs), (state,), (state, state), ()]
    assert [t.shape for t in found] == [(*batch, *shape) for shape in shapes]
    wide = [t.double() for t in (mean, cov, action, x, offset)]
    system = system.to(torch.float64)
    moves = system.transition, system.transition_cov
    for i in itertools.product(*map(range, batch)):
        m, p, a, reading, d = (t[i] for t in wide)
        belief = references.predict(m, p, *moves, a, system.dynamics)
        step = (*belief, reading, observed[i], h.double(), r.double(), d)
        expected = (*belief, *references.update(*step), references.log_likelihood(*step))
        assert_near([t[i] for t in (*predicted, *found[2:])], expected, dtype)


@often
@given(**CASES, junk=st.sampled_from([math.nan, math.inf, -math.inf, 1e30]))
def test_what_is_missing_is_not_read_and_where_nothing_arrived_nothing_changes(junk, **case):
    (belief, x, observed, *model), _ = draw(**case)
    results = []
    for given_x in (x, torch.where(observed, x, junk)):
        leaves = [t.clone().requires_grad_() for t in (given_x, *belief, *model)]
        leaf, mean, cov, *rest = leaves
        out = outputs(Belief(mean, cov), leaf, observed, *rest)
        results.append((*out, *torch.autograd.grad(sum(t.square().sum() for t in out), leaves)))
    assert all(map(torch.equal, *results))
    *_, m, p, ll = results[1][:5]
    assert not results[1][5][~observed].any()  # the gradient by x
    nothing = ~observed.any(-1)
    assert torch.equal(m[nothing], belief.mean[nothing])
    assert torch.equal(p[nothing], belief.cov[nothing])
    assert not ll[nothing].any()


@often
@given(**CASES)
def test_the_order_of_the_entries_and_the_basis_of_the_state_do_not_matter(**case):
    case["dtype"] = torch.float64
    (belief, x, observed, h, r, offset), g = draw(**case)
    residual, innovation_cov, mean, cov, ll = outputs(belief, x, observed, h, r, offset)
    order = torch.randperm(case["obs"], generator=g)
    square = torch.randn(case["state"], case["state"], generator=g, dtype=torch.float64)
    turn = torch.linalg.qr(square)[0]
    turned = Belief(belief.mean @ turn.T, turn @ belief.cov @ turn.T)
    rows = x[..., order], observed[..., order], (h @ turn.T)[order], r[order][:, order]
    found = outputs(turned, *rows, offset[..., order])
    expected = (residual[..., order], innovation_cov[..., order, :][..., order])
    assert_near(found, (*expected, mean @ turn.T, turn @ cov @ turn.T, ll))


@often
@given(**CASES)
def test_more_readings_only_shrink_the_covariance_and_one_by_one_equals_all_at_once(**case):
    # One by one holds because the noise is diagonal: entries are independent given the state.
    case |= {"dtype": torch.float64, "full_noise": False}
    (belief, x, observed, *model), g = draw(**case)
    *_, mean, cov, ll = outputs(belief, x, observed, *model)
    shrinkage = torch.linalg.eigvalsh(belief.cov - cov)  # in the Loewner order
    assert shrinkage.min() > -1e-10
    rank = observed.sum(-1).clamp(max=case["state"])
    assert ((shrinkage > 1e-9).sum(-1) <= rank).all()
    total = torch.zeros_like(ll)
    for i in torch.randperm(case["obs"], generator=g).tolist():
        step = (belief, x, observed & (torch.arange(case["obs"]) == i), *model)
        total, before, belief = total + F.log_likelihood(*step), belief, F.update(*step)
        assert torch.linalg.eigvalsh(before.cov - belief.cov).min() > -1e-10
    assert_near((*belief, total), (mean, cov, ll))


@often
@given(
    **DIMS,
    batch=st.integers(1, 3),
    time=st.integers(3, 6),
    stored=st.booleans(),
    full_noise=st.booleans(),
    share=st.sampled_from([0.0, 0.5, 1.0]),
    hidden=st.lists(st.integers(1, 5), max_size=2).map(tuple),
)
def test_every_form_of_a_sequence_is_the_oracle(state, obs, share, seed, **options):
    problem = Problem(state, obs, seed=seed, **options)
    g = torch.Generator().manual_seed(seed)
    problem.observed = torch.rand(problem.observed.shape, generator=g) < share
    expected = problem.oracle()
    for form in ("pytorch", "step by step", *(["native"] if F.native_status() is None else [])):
        found = problem.library(form)
        assert_near(found, expected)
        assert not found.log_likelihood[~problem.observed.any(-1)].any()  # exactly 0
