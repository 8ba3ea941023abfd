"""Properties of the filter over shapes, masks, dtypes and dimensions, drawn at random."""

from __future__ import annotations

import itertools
from functools import partial

import oracles
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_agents import make_filter
from tensordict import TensorDict
from torchrl.modules import set_recurrent_mode

from torchrl_drbpn import BeliefFilterModule, functional
from torchrl_drbpn.functional import Belief

CASES = {
    "obs": st.integers(1, 6),
    "state": st.integers(1, 6),
    "action": st.integers(1, 3),
    "batch": st.lists(st.integers(1, 3), max_size=2).map(tuple),
    "time": st.integers(1, 5),
    "share": st.sampled_from([0.0, 0.3, 1.0]),
    "dtype": st.sampled_from([torch.float32, torch.float64]),
    "seed": st.integers(0, 999),
}


def draw(obs, state, action, batch, time, share, dtype, seed):
    """A module, and trajectories that begin in mid-episode with resets inside."""
    g = torch.Generator().manual_seed(seed)
    module = BeliefFilterModule(make_filter(obs, action, dtype, state))
    shape = (*batch, time)
    is_init = torch.rand(*shape, 1, generator=g) < 0.2
    data = TensorDict(
        {
            "observation": torch.randn(*shape, obs, generator=g, dtype=dtype),
            "observed": torch.rand(*shape, obs, generator=g) < share,
            "previous_action": torch.randn(*shape, action, generator=g, dtype=dtype),
            "is_init": is_init,
            "recurrent": {
                "mean": torch.randn(*shape, state, generator=g, dtype=dtype),
                "age": torch.where(is_init, 0, 3),
            },
        },
        shape,
    )
    return module, data


@settings(max_examples=25, deadline=None, derandomize=True, database=None)
@given(**CASES)
def test_a_trajectory_is_its_steps_one_after_the_other(**case):
    module, data = draw(**case)
    with set_recurrent_mode(True), torch.no_grad():
        whole = module(data.clone())
    mean = data["recurrent", "mean"][..., 0, :]
    limit = 1e-10 if case["dtype"] == torch.float64 else 1e-4
    for t in range(case["time"]):
        step = data[..., t].clone().set(("recurrent", "mean"), mean)
        with torch.no_grad():
            module(step)
        mean = step["next", "recurrent", "mean"]
        for key in module.out_keys[:3]:
            expected = whole[key].select(len(case["batch"]), t)
            torch.testing.assert_close(step[key], expected, rtol=limit, atol=10 * limit)
            assert step[key].dtype == case["dtype"]


@settings(max_examples=25, deadline=None, derandomize=True, database=None)
@given(**CASES, junk=st.sampled_from([float("nan"), float("inf"), 1e30]))
def test_what_did_not_arrive_is_not_read_and_nothing_costs_nothing(junk, **case):
    module, data = draw(**case)
    spoilt = data.clone()
    spoilt["observation"] = torch.where(data["observed"], data["observation"], junk)
    with set_recurrent_mode(True), torch.no_grad():
        expected, received = module(data), module(spoilt)
    for key in module.out_keys:
        assert torch.equal(received[key], expected[key])
    nothing = ~data["observed"].any(-1)
    assert not received["belief", "log_likelihood"][nothing].any()


@settings(max_examples=40, deadline=None, derandomize=True, database=None)
@given(
    obs=st.integers(1, 7),
    state=st.integers(1, 7),
    batch=st.lists(st.integers(1, 3), max_size=3).map(tuple),
    share=st.sampled_from([0.0, 0.4, 1.0]),
    full=st.booleans(),
    dtype=st.sampled_from([torch.float32, torch.float64]),
    seed=st.integers(0, 999),
)
def test_an_update_is_the_textbooks_on_the_rows_that_arrived(
    obs, state, batch, share, full, dtype, seed
):
    g = torch.Generator().manual_seed(seed)
    draw = partial(torch.randn, generator=g, dtype=torch.float64)
    square, spread = draw(*batch, state, state), draw(obs, obs)
    P, R = square @ square.mT + torch.eye(state), 0.1 * (spread @ spread.T) + 0.1 * torch.eye(obs)
    R = R if full else R.diagonal()
    mean, H, x, offset = draw(*batch, state), draw(obs, state), draw(*batch, obs), draw(*batch, obs)
    seen = torch.rand(*batch, obs, generator=g) < share
    m, P, x, H, R, offset = (value.to(dtype) for value in (mean, P, x, H, R, offset))
    spoilt = torch.where(seen, x, torch.nan)
    filtered = functional.update(Belief(m, P), spoilt, seen, H, R, offset)
    score = functional.log_likelihood(Belief(m, P), spoilt, seen, H, R, offset)
    assert filtered.mean.dtype == filtered.cov.dtype == score.dtype == dtype
    assert (filtered.mean.shape, score.shape) == (m.shape, tuple(batch))
    noise = R.double() if full else torch.diag(R.double())
    limit = 1e-9 if dtype == torch.float64 else 2e-4
    close = partial(torch.testing.assert_close, rtol=limit, atol=10 * limit, check_dtype=False)
    for i in itertools.product(*map(range, batch)):
        row = (m[i], P[i], x[i], seen[i], H, noise, offset[i])
        row = [value if value.dtype == torch.bool else value.double() for value in row]
        expected_mean, expected_cov = oracles.update(*row)
        close(filtered.mean[i], expected_mean)
        close(filtered.cov[i], expected_cov)
        close(score[i], oracles.log_likelihood(*row))
