"""What goes missing, in one call of C, held to PyTorch's operations.

Specified here: the same mask and the same filled observation from the same generator state, for
every mechanism, dtype and batch shape, with and without an earlier mask and an action; entries that
always arrive do so; a NaN arrives unless an earlier mask hides it, and then enters no law; what the
C code does not take runs in PyTorch.
"""

from __future__ import annotations

import pytest
import torch

from torchrl_drbpn.functional import arrivals, compiled, draw_mechanism
from torchrl_drbpn.functional.arrivals import sample_arrivals

OBS, ACTION = 7, 3
KINDS = ["mcar", "mar", "nmar"]
pytestmark = pytest.mark.skipif(
    "there is no C compiler" in (compiled.native_error() or ""), reason="no C compiler here"
)


def problem(kind, shape=(64, 5), dtype=torch.float64, mask=True, action=True, actions=ACTION):
    g = torch.Generator().manual_seed(0)
    mechanism = None if kind == "mcar" else draw_mechanism(kind, OBS, actions, generator=g)
    if mechanism is not None:
        mechanism = type(mechanism)(
            mechanism.always_observed, *(part.to(dtype) for part in mechanism[1:])
        )
    x = torch.randn(*shape, OBS, generator=g, dtype=torch.float64).to(dtype)
    observed = torch.rand(*shape, OBS, generator=g) < 0.8 if mask else None
    previous = torch.randn(*shape, actions, generator=g, dtype=torch.float64).to(dtype)
    return mechanism, x, observed, previous if action else None, 0.6


def both(monkeypatch, *given):
    """In C, and then in PyTorch from the same state of the generator."""
    calls = []
    native = arrivals._native
    monkeypatch.setattr(arrivals, "_native", lambda *a: (calls.append(1), native(*a))[1])
    received = sample_arrivals(*given, torch.Generator().manual_seed(1))
    assert calls == [1]
    monkeypatch.setattr(arrivals, "takes_native", lambda *_: False)
    return received, sample_arrivals(*given, torch.Generator().manual_seed(1))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("mask", "action"), [(False, True), (True, True), (True, False)])
@pytest.mark.parametrize("shape", [(), (1,), (64, 5)], ids=str)
def test_mask_and_observation_are_pytorchs(monkeypatch, kind, dtype, mask, action, shape):
    given = problem(kind, shape, dtype, mask, action)
    (filled, arrived), (expected, mask_expected) = both(monkeypatch, *given)
    assert torch.equal(arrived, mask_expected)
    assert torch.equal(filled, expected)
    assert filled.dtype is dtype
    assert arrived.dtype is torch.bool
    if len(shape) == 2:
        assert 0 < arrived.float().mean() < 1


@pytest.mark.parametrize("kind", ["mar", "nmar"])
def test_a_mechanism_without_an_action(monkeypatch, kind):
    given = problem(kind, actions=0)
    received, expected = both(monkeypatch, *given)
    assert torch.equal(received[1], expected[1])


def test_entries_that_always_arrive_do_so():
    mechanism, x, _, action, _ = problem("nmar")
    _, arrived = sample_arrivals(mechanism, x, None, action, 1.0, torch.Generator())
    assert arrived[..., mechanism.always_observed].all()
    assert not arrived.all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_nan_arrives_unless_a_mask_hides_it(monkeypatch, kind):
    mechanism, x, observed, action, eta = problem(kind)
    x[3, 2, 4], x[5, 1, 0] = torch.nan, torch.nan
    observed[3, 2, 4], observed[5, 1] = False, True
    received, expected = both(monkeypatch, mechanism, x, observed, action, eta)
    assert torch.equal(received[1], expected[1])
    assert torch.equal(received[0].nan_to_num(9.0), expected[0].nan_to_num(9.0))
    assert not received[0][3].isnan().any()
    if kind == "nmar":  # every probability of this row is NaN
        assert received[1][5, 1].all()


@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_nothing_and_everything(monkeypatch, eta):
    mechanism, x, _, _, _ = problem("mcar")
    received, expected = both(monkeypatch, mechanism, x, None, None, eta)
    assert torch.equal(received[1], expected[1])
    assert received[1].all() if eta == 0 else not received[1].any()


def test_what_the_c_code_does_not_take_runs_in_pytorch(monkeypatch):
    mechanism, x, observed, action, eta = problem("mar")
    expected = sample_arrivals(mechanism, x, observed, action, eta, torch.Generator())
    monkeypatch.setattr(arrivals, "_native", lambda *_: pytest.fail("the C code ran"))

    def check(mechanism=mechanism, x=x, action=action):
        out = sample_arrivals(mechanism, x, observed, action, eta, torch.Generator())
        torch.testing.assert_close(out[0], expected[0])
        return out[0]

    with pytest.raises(RuntimeError):  # PyTorch's own error
        sample_arrivals(mechanism, x, observed, action[..., :2], eta, torch.Generator())
    with pytest.raises(RuntimeError):
        sample_arrivals(mechanism, x[..., :5], None, action, eta, torch.Generator())
    sample_arrivals(mechanism, x, observed, action[0, 0], eta, torch.Generator())  # broadcast
    sample_arrivals(None, x[0, 0, 0], None, None, eta, torch.Generator())
    check(x=x.transpose(0, 1).contiguous().transpose(0, 1))
    check(action=action.transpose(0, 1).contiguous().transpose(0, 1))
    weight = mechanism.observation_weight
    check(mechanism=mechanism._replace(observation_weight=weight.t().contiguous().t()))
    leaf = x.clone().requires_grad_()
    check(x=leaf).sum().backward()
    assert torch.equal(leaf.grad, expected[1].to(leaf.dtype))
