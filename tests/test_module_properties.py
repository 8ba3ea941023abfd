"""Laws of `BeliefFilterModule` over shapes, masks, dtypes and dimensions drawn at random."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from small_agents import make_filter
from tensordict import TensorDict
from torchrl.modules import set_recurrent_mode

from torchrl_drbpn import BeliefFilterModule

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
