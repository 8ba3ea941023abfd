"""The fast forms in C: one call forward and one back, not some hundred operations each.

At the sizes of reinforcement learning (16 sequences of 16 steps, 17 sensors) PyTorch spends its
time between the operations of the filter, not in them. ``native.c`` and the files that it includes
hold the same sums as :class:`~torchrl_drbpn.functional.recurrence.InnovationRecurrence` and
:class:`~torchrl_drbpn.functional.recurrence.InformationRecurrence` and are held to their oracles.
:mod:`.compiled` compiles it; where it cannot, the PyTorch forms run.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchrl_drbpn.functional.compiled import load_library, native_error
from torchrl_drbpn.functional.model import StateSpace, choose_form
from torchrl_drbpn.functional.recurrence import MeanNetwork

__all__ = ["NativeRecurrence", "filter_rows", "native_refusal"]

_CPU = torch.device("cpu")
_MAX_SIZE = 64  # the batched factorisation keeps a group of matrices in cache up to here
_MAX_LAYERS = 15


def native_refusal(model: StateSpace, *tensors: Tensor | None) -> str | None:
    """Say why the C form does not take this model and these inputs.

    Args:
        model: a model that the innovation or the information form takes.
        tensors: the inputs of the filter that hold numbers.

    Returns:
        None where it takes them, else the reason.

    Example:
        >>> import torch
        >>> f = MeanNetwork((torch.zeros(2, 3),), (torch.zeros(2),), True, "relu")
        >>> eye = torch.eye(2)
        >>> model = StateSpace(f, eye, eye, torch.ones(2), torch.zeros(2, 1), torch.zeros(2),
        ...                    torch.zeros(2), eye)
        >>> native_refusal(model, torch.zeros(2).double())
        'the dtypes differ'
    """
    dtype = model.initial_mean.dtype
    obs, state = model.emission_matrix.shape
    assert isinstance(model.transition, MeanNetwork)  # as the innovation form demands
    every = [*model.transition.weights, *model.transition.biases, *model[1:], *tensors]
    given = [x for x in every if isinstance(x, Tensor)]
    if torch.compiler.is_compiling():
        return "torch.compile traces PyTorch's operations"
    if torch._C._are_functorch_transforms_active():
        return "torch.func transforms PyTorch's operations"
    if {x.device for x in given} != {_CPU}:
        return "it runs on the CPU"
    if {x.dtype for x in given} != {dtype}:
        return "the dtypes differ"
    size = state if choose_form(model) == "information" else obs
    if size > _MAX_SIZE:
        return f"{'obs' if size == obs else 'state'} is {size}, more than {_MAX_SIZE}"
    if len(model.transition.weights) > _MAX_LAYERS:
        return f"the transition has more than {_MAX_LAYERS} layers"
    return native_error(dtype)


def _call(function: Any, dims: Any, tensors: list[Tensor | None]) -> None:
    pointers = [None if x is None else x.data_ptr() for x in tensors]
    function(dims, (ctypes.c_void_p * len(pointers))(*pointers))


class NativeRecurrence(torch.autograd.Function):
    """Filter mean and log-likelihood of whole sequences by ``native.c``, batch first.

    Inputs: whether it is the information form, residual, activation, what follows (a
    :class:`.Following` without gradients, or None), observation, observed, previous action, reset,
    restart, stored mean, start, Q, initial covariance, R, H, B, d, initial mean, then the weight
    and the bias of each layer. All contiguous, one dtype, on the CPU. The information form takes
    the inverses of Q and of the initial covariance in their places, in float64, leaves their
    log-determinant out of the likelihood, and takes nothing observed for no special case.

    What follows is a second pass, over sequences of one step: here it shares one node of the graph
    and one sum of the gradients by the model with the first, which is most of what it costs.

    It computes in float64 whatever it is given, and likelihoods come out in float64.
    """

    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return mean (batch, time, state) and log-likelihoods (batch, time), (count,)."""
        information, residual, activation, following, *rest = args
        settings, sequence, model = (information, residual, activation), rest[:7], rest[7:]
        first, mean, ll, tape = _ahead(settings, sequence, model)
        ctx.passes = [first]
        kept = [*sequence[1:5:2], sequence[4], tape]
        of_following = None
        if following is not None:
            start = mean.flatten(0, 1).index_select(0, following.step)
            x, observed, action = (
                value.unsqueeze(1).contiguous()
                for value in (following.observation, following.observed, following.previous_action)
            )
            goes_on = observed.new_zeros(len(start), 1)
            after = (x, observed, action, goes_on, None, None, start)
            second, _, ll_after, tape = _ahead(settings, after, model)
            ctx.passes.append(second)
            kept += [following.step, observed, goes_on, tape]
            of_following = ll_after.squeeze(1)
        ctx.save_for_backward(*kept, *model)
        ctx.set_materialize_grads(False)
        return mean, ll, of_following

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, g_mean: Tensor | None, g_ll: Tensor | None, g_following: Tensor | None = None
    ) -> tuple[Tensor | None, ...]:
        """Return the gradient of every input of ``forward``, in its order."""
        saved, of_following = ctx.saved_tensors, None
        observed, reset, restart, tape = saved[:4]
        model = saved[4:] if len(ctx.passes) == 1 else saved[8:]
        if g_following is not None:
            step, after_observed, goes_on, after_tape = saved[4:8]
            (*_, g_after), of_following = _back(
                ctx.passes[1], (False, False, False, True), None, g_following,
                (after_observed, goes_on, None, after_tape), model,
            )  # fmt: skip
            rows, state = reset.numel(), len(model[6])
            flat = (
                model[6].new_zeros(rows, state) if g_mean is None else g_mean.reshape(rows, state)
            )
            if g_after is not None:  # it was asked for; for the type checker
                g_mean = flat.index_add(0, step, g_after).view(*reset.shape, state)
        wanted = ctx.needs_input_grad
        (g_x, g_action, g_stored, g_start), of_model = _back(
            ctx.passes[0], (wanted[4], wanted[6], wanted[9], wanted[10]), g_mean, g_ll,
            (observed, reset, restart, tape), model,
        )  # fmt: skip
        if of_following is not None:
            torch._foreach_add_(of_model, of_following)
        return (
            None, None, None, None, g_x, None, g_action, None, None, g_stored, g_start, *of_model,
        )  # fmt: skip


def filter_rows(
    settings: tuple[bool, bool, str], sequence: Sequence[Any], model: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """Return mean and log-likelihood without a graph: a decision needs none.

    Args:
        settings: the first three inputs of :class:`NativeRecurrence`.
        sequence: its inputs from the observation to the start.
        model: its inputs from Q on.

    Returns:
        Shapes ``(batch, time, state)`` and ``(batch, time)``.
    """
    _, mean, ll, _ = _ahead(settings, sequence, model)
    return mean, ll


class _Pass(NamedTuple):
    """Hold the sizes of a pass as native_memory.h reads them, and how much its reverse needs."""

    dims: ctypes.Array[ctypes.c_int64]
    shape: tuple[int, int, int, int, int]
    scratch: int


def _ahead(
    settings: tuple[bool, bool, str], sequence: Sequence[Any], model: Sequence[Tensor]
) -> tuple[_Pass, Tensor, Tensor, Tensor]:
    """Filter sequences; return mean, log-likelihood and tape."""
    information, residual, activation = settings
    x, observed, action, reset, restart, stored, start = sequence
    (batch, time, obs), state = x.shape, start.shape[-1]
    widths = [weight.shape[0] for weight in model[7::2]]
    numbers = [
        batch, time, obs, state, action.shape[-1], len(widths), residual, activation == "relu",
        model[2].ndim == 2, start.stride(0), information, *widths,
    ]  # fmt: skip
    dims = (ctypes.c_int64 * len(numbers))(*numbers)
    library = load_library(x.dtype)
    counts = (ctypes.c_int64 * 3)()
    library.sizes(dims, counts)
    tape, scratch = (x.new_empty(count, dtype=torch.float64) for count in counts[:2])
    ll = x.new_empty(batch, time, dtype=torch.float64)
    mean = x.new_empty(batch, time, state)
    _call(
        library.forward,
        dims,
        [
            x, observed, action, reset, restart, stored, start, *model[:7], mean, ll, tape, scratch,
            *model[7:],
        ],
    )  # fmt: skip
    shape = (batch, time, obs, state, action.shape[-1])
    return _Pass(dims, shape, counts[2]), mean, ll, tape


def _back(
    of: _Pass,
    wanted: Sequence[bool],
    g_mean: Tensor | None,
    g_ll: Tensor | None,
    kept: Sequence[Any],
    model: Sequence[Tensor],
) -> tuple[tuple[Tensor | None, ...], list[Tensor]]:
    """Return the gradients by observation, action, stored mean and start, and by the model."""
    observed, reset, restart, tape = kept
    Q, initial_cov, R, H, B, _, _, *layers = model
    batch, time, obs, state, actions = of.shape
    shapes = ((batch, time, obs), (batch, time, actions), (batch, time, state), (batch, state))
    by_inputs = tuple(
        H.new_empty(shape) if asked else None for shape, asked in zip(shapes, wanted, strict=True)
    )
    by_model = [torch.empty_like(value) for value in model]
    _call(
        load_library(H.dtype).backward,
        of.dims,
        [
            None if g_mean is None else g_mean.contiguous(),
            None if g_ll is None else g_ll.contiguous(),
            reset, restart, Q, initial_cov, H, B, tape, tape.new_empty(of.scratch), *by_inputs,
            *by_model[:7], observed, R, *layers[0::2], *by_model[7:],
        ],
    )  # fmt: skip
    return by_inputs, by_model
