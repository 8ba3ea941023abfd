"""The fast forms in C: one call forward and one back, not some hundred operations each.

At the sizes of reinforcement learning (16 sequences of 16 steps, 17 sensors) PyTorch spends its
time between the operations of the filter, not in them. ``native.c`` and the files that it includes
hold the same sums as :class:`~torchrl_drbpn.functional.recurrence.InnovationRecurrence` and
:class:`~torchrl_drbpn.functional.recurrence.InformationRecurrence` and are held to their oracles.
:mod:`.compiled` compiles it; where it cannot, the PyTorch forms run.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchrl_drbpn.functional.compiled import load_library, native_error
from torchrl_drbpn.functional.model import StateSpace, choose_form
from torchrl_drbpn.functional.recurrence import MeanNetwork

__all__ = ["NativeRecurrence", "native_refusal"]

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

    Inputs: whether it is the information form, residual, activation, observation, observed,
    previous action, reset, restart, stored mean, start, Q, initial covariance, R, H, B, d, initial
    mean, then the weight and the bias of each layer. All contiguous, one dtype, on the CPU. The
    information form takes the inverses of Q and of the initial covariance in their places, in
    float64, leaves their log-determinant out of the likelihood, and takes nothing observed for no
    special case.

    It computes in float64 whatever it is given, and the likelihood comes out in float64.
    """

    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, Tensor]:
        """Return filtered mean ``(batch, time, state)`` and log-likelihood ``(batch, time)``."""
        (information, residual, activation, x, observed, action, reset, restart, stored) = args[:9]
        start, Q, initial_cov, R, H, B, d, initial_mean, *layers = args[9:]
        (batch, time, obs), state = x.shape, start.shape[-1]
        widths = [weight.shape[0] for weight in layers[0::2]]
        numbers = [
            batch, time, obs, state, action.shape[-1], len(widths), residual, activation == "relu",
            R.ndim == 2, start.stride(0), information, *widths,
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
                x, observed, action, reset, restart, stored, start, Q, initial_cov, R, H, B, d,
                initial_mean, mean, ll, tape, scratch, *layers,
            ],
        )  # fmt: skip
        ctx.save_for_backward(observed, reset, restart, Q, initial_cov, R, H, B, d, tape, *layers)
        ctx.dims, ctx.shape, ctx.scratch = dims, (batch, time, obs, state), counts[2]
        ctx.set_materialize_grads(False)
        return mean, ll

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_mean: Tensor | None, g_ll: Tensor | None) -> tuple[Tensor | None, ...]:
        """Return the gradient of every input of ``forward``, in its order."""
        observed, reset, restart, Q, initial_cov, R, H, B, d, tape, *layers = ctx.saved_tensors
        batch, time, obs, state = ctx.shape
        wanted = ctx.needs_input_grad
        g_x = H.new_empty(batch, time, obs) if wanted[3] else None
        g_action = H.new_empty(batch, time, B.shape[-1]) if wanted[5] else None
        g_stored = H.new_empty(batch, time, state) if wanted[8] else None
        g_start = H.new_empty(batch, state) if wanted[9] else None
        of_model = [torch.empty_like(v) for v in (Q, initial_cov, R, H, B, d)]
        g_initial = H.new_empty(state)
        of_layers = [torch.empty_like(v) for v in layers]
        _call(
            load_library(H.dtype).backward,
            ctx.dims,
            [
                None if g_mean is None else g_mean.contiguous(),
                None if g_ll is None else g_ll.contiguous(),
                reset, restart, Q, initial_cov, H, B, tape, tape.new_empty(ctx.scratch),
                g_x, g_action, g_stored, g_start, *of_model, g_initial, observed,
                R, *layers[0::2], *of_layers,
            ],
        )  # fmt: skip
        return (
            None, None, None, g_x, None, g_action, None, None, g_stored, g_start, *of_model,
            g_initial, *of_layers,
        )  # fmt: skip
