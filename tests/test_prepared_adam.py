"""Adam's prepared step: the bits and the state of torch.optim's own.

Specified here:

- parameters, moments and counts after some steps, with a changing learning rate, to the last bit;
- other parameters with a gradient: no step is taken, nothing changes;
- the state, written and read back, goes on as if nothing had happened, prepared or not.
"""

from __future__ import annotations

import io

import pytest
import recipe_tools  # noqa: F401  (puts recipes/ on the path)
import torch
from torch import nn

SHAPES = ((5, 3), (5,), (), (2, 5))


def make(seed: int = 0) -> tuple[list[nn.Parameter], torch.optim.Adam]:
    generator = torch.Generator().manual_seed(seed)
    parameters = [nn.Parameter(torch.randn(shape, generator=generator)) for shape in SHAPES]
    return parameters, torch.optim.Adam(parameters, lr=1e-2, eps=1e-5, fused=True)


def set_gradients(parameters: list[nn.Parameter], step: int) -> None:
    generator = torch.Generator().manual_seed(100 + step)
    for parameter in parameters:
        parameter.grad = torch.randn(parameter.shape, generator=generator)


def take(parameters, optimizer, steps, prepared: bool) -> None:
    from algorithms.prepared import PreparedAdam

    fast = None
    for step in steps:
        optimizer.param_groups[0]["lr"] = 1e-2 / (1 + step)
        set_gradients(parameters, step)
        if fast is None or not fast.step(parameters):
            optimizer.step()
            fast = PreparedAdam(optimizer, parameters) if prepared else None


def assert_equal(one, other) -> None:
    for a, b in zip(one[0], other[0], strict=True):
        assert torch.equal(a, b)
        assert set(one[1].state[a]) == set(other[1].state[b])
        for name, value in one[1].state[a].items():
            assert torch.equal(value, other[1].state[b][name]), name


def test_steps_and_state_are_those_of_the_optimiser_to_the_last_bit():
    fast, slow = make(), make()
    take(*fast, range(7), prepared=True)
    take(*slow, range(7), prepared=False)
    assert fast[1].state[fast[0][0]]["step"] == 7
    assert_equal(fast, slow)


@pytest.mark.parametrize("prepared", [True, False], ids=["prepared", "by the optimiser"])
def test_a_state_written_after_prepared_steps_is_taken_up(prepared):
    first, whole = make(), make()
    take(*first, range(3), prepared=True)
    file = io.BytesIO()
    torch.save({"p": [p.detach() for p in first[0]], "o": first[1].state_dict()}, file)
    file.seek(0)
    state = torch.load(file, weights_only=True)
    resumed = make(1)
    with torch.no_grad():
        for parameter, value in zip(resumed[0], state["p"], strict=True):
            parameter.copy_(value)
    resumed[1].load_state_dict(state["o"])
    take(*resumed, range(3, 6), prepared=prepared)
    take(*whole, range(6), prepared=False)
    assert_equal(resumed, whole)


def test_other_parameters_with_a_gradient_are_left_to_the_optimiser():
    from algorithms.prepared import PreparedAdam

    parameters, optimizer = make()
    set_gradients(parameters, 0)
    optimizer.step()
    fast = PreparedAdam(optimizer, parameters)
    before = [parameter.detach().clone() for parameter in parameters]
    assert not fast.step(parameters[1:])
    assert not fast.step([*parameters[1:], parameters[0]])
    for parameter, value in zip(parameters, before, strict=True):
        assert torch.equal(parameter, value)
    assert optimizer.state[parameters[0]]["step"] == 1
