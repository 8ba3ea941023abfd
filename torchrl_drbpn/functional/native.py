"""The native form of the filter: one operator on the CPU, forward and back.

At the sizes of reinforcement learning PyTorch spends its time between the operations of the filter,
not in them. ``torch.ops.torchrl_drbpn.filter_rows`` and its gradient check every tensor before they
hand over a pointer to ``csrc/filter.h``.
"""

import ctypes
import functools
import itertools
import zlib
from collections.abc import Sequence
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any, Self, cast

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.fx.experimental.symbolic_shapes import guard_or_true

from torchrl_drbpn.functional.pytorch_form import Filtered, run_in_pytorch
from torchrl_drbpn.functional.state_space import FilterInputs, StateSpace, TransitionMLP

_ABI = 1  # of csrc/filter.h
_KINDS = {torch.float32: "float", torch.float64: "double"}
_WIDTHS = {"AVX512": "avx512", "AVX2": "avx2"}
_MAX_SIZE = 64  # the batched factorisation keeps a group of matrices in cache up to here
_MAX_LAYERS = 15
_GROUP = 8  # rows that C factorises side by side, at most
_TENSORS = 17  # arguments of the operator before the network's layers


@functools.cache
def _library() -> ctypes.CDLL | str:
    """Load what the build made for this processor; the reason where there is nothing."""
    width = _WIDTHS.get(torch.backends.cpu.get_cpu_capability(), "baseline")
    for name, suffix in itertools.product((width, "baseline"), EXTENSION_SUFFIXES):
        path = Path(__file__).parents[1] / f"_native_{name}{suffix}"
        if path.is_file():
            return load(path)
    return (
        "the package was built without it: install a C compiler, then the package again "
        "(in a checkout: python setup.py build_ext --inplace)"
    )


def load(path: Path) -> ctypes.CDLL | str:
    """Load a compiled library; the reason where it is none, or takes other arguments."""
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        return f"{path.name} cannot be loaded: {error}"
    if getattr(library, "abi_float", int)() != _ABI:  # one without the number has none
        return f"{path.name} is of another version than the Python beside it: run pip install -e ."
    library.build = zlib.crc32(path.read_bytes())  # type: ignore[attr-defined]
    return library


@torch.compiler.assume_constant_result
def native_status() -> str | None:
    """Say why the native form of the filter cannot run on this machine; None where it can.

    Example:
        >>> type(native_status()) in (type(None), str)
        True
    """
    library = _library()
    return library if isinstance(library, str) else None


@torch.compiler.assume_constant_result
def _build() -> int:
    """Return a number of the library: what torch.compile keeps on disk holds its tape's length."""
    return getattr(_library(), "build", 0)


def unsupported_reason(
    model: StateSpace, *tensors: Tensor | None, weight: Tensor | None = None
) -> str | None:
    """Say why the native form does not take this model and these inputs; None where it does."""
    f, Q = model.transition, model.transition_cov
    if not isinstance(f, TransitionMLP) or not isinstance(Q, Tensor):
        return "it takes a TransitionMLP with a constant transition_cov"
    if model.mask_model is not None:
        return "its belief learns from the mask"
    F = model.transition_jacobian
    if callable(F) or (F is not None and model.emission_cov.ndim == 2):
        return "it propagates a covariance by one Jacobian, with a diagonal emission_cov"
    own = (Q, *list(vars(model).values())[2:], *f.weights, *f.biases)
    given = [x for x in (*own, *tensors) if x is not None]
    if torch.compiler.is_exporting():
        return "an exported program runs where this package is not"
    # functorch has no public word for "a transformation is running", and a tensor under one looks
    # like any other; inside one an autograd.Function below the dispatcher has no kernel, wrapped
    # inputs (torch.func.debug_unwrap) or not.
    if torch._C._are_functorch_transforms_active():
        return "torch.func transforms PyTorch's operations"
    # Nor is there one for an open level of forward mode, in which tensors may carry tangents; in a
    # traced function no tensor tells.
    if forward_ad._current_level >= 0:
        return "it has no forward-mode derivative"
    for x in given:
        if type(x) not in (Tensor, torch.nn.Parameter, torch.nn.Buffer):
            return f"{type(x).__name__} is a class of its own"
        if not x.is_cpu:
            return "it runs on the CPU"
        if x.dtype != given[0].dtype:
            return "the dtypes differ"
    if given[0].dtype not in _KINDS:
        return f"there is none for {given[0].dtype}"
    by_state = model.information_form or F is not None
    size, name = (model.state_dim, "state") if by_state else (model.obs_dim, "obs")
    if size > _MAX_SIZE:
        return f"{name} is {size}, more than {_MAX_SIZE}"
    if len(f.weights) > _MAX_LAYERS:
        return f"the transition has more than {_MAX_LAYERS} layers"
    if any(guard_or_true(x.numel() == 0) for x in given):  # or a number that only the data know
        return "there is nothing to filter"
    return native_status() if weight is None else "it takes no weights"


def filter_rows(model: StateSpace, rows: FilterInputs) -> Filtered:
    """Filter what :func:`unsupported_reason` has nothing against, as ``run_in_pytorch`` does."""
    mean, ll, _, cov = torch.ops.torchrl_drbpn.filter_rows(*rows[:9], *operator_arguments(model))
    return mean, None if model.transition_jacobian is None else cov, ll


def operator_arguments(model: StateSpace) -> tuple[Any, ...]:
    """Return a model as the operator takes it, the network as weight, bias, weight, ..."""
    f = cast(TransitionMLP, model.transition)  # the rule saw to it
    layers = itertools.chain.from_iterable(zip(f.weights, f.biases, strict=True))
    return (
        model.constant_cov(), model.full_initial_cov(), model.emission_cov, model.emission_matrix,
        model.action_matrix, model.emission_offset, model.initial_mean, model.transition_jacobian,
        list(layers), f.residual, f.activation == "tanh", _build(),
    )  # fmt: skip


def _count(kind: str, numbers: Sequence[int]) -> tuple[Any, list[int]]:
    """Return sizes as C takes them, and its count of tape, scratch and scratch of backward."""
    sizes, counts = (ctypes.c_int64 * len(numbers))(*numbers), (ctypes.c_int64 * 3)()
    getattr(_library(), f"sizes_{kind}")(sizes, counts)
    return sizes, list(counts)


@functools.cache
def _tape_of_a_group(kind: str, *rest: int) -> tuple[int, int]:
    """Return the length of the tape of one group of rows, and what each further one adds."""
    one, two = (_count(kind, (groups * _GROUP, 1, *rest))[1][0] for groups in (1, 2))
    return one, two - one


class _Call:
    """One call with the operator's arguments, checked: its sizes, and how much memory it needs."""

    def __init__(self, arguments: Sequence[Any]) -> None:
        observation, _, action, _, use_stored, stored, start, stored_cov, cov, *_ = arguments
        R, (F, layers, residual, tanh, _) = arguments[11], arguments[_TENSORS - 1 :]
        if observation.ndim != 3 or action.ndim != 3 or start.ndim != 2:
            raise ValueError(
                "`observation` and `action` must be (batch, time, n), `start` (batch, n)."
            )
        batch, time, obs = observation.shape
        state, actions = start.shape[1], action.shape[2]
        widths = [state + actions, *(bias.numel() for bias in layers[1::2])]
        self.propagated = F is not None
        self.information = R.ndim == 1 and (obs > state or self.propagated)
        shapes: tuple[tuple[int, ...], ...] = (
            (batch, time, obs), (batch, time, obs), (batch, time, actions), (batch, time),
            (batch, time), (batch, time, state), (batch, state), (batch, time, state, state),
            (batch, state, state), (state, state), (state, state), (obs,) * min(2, max(1, R.ndim)),
            (obs, state), (obs, actions), (obs,), (state,), (state, state),
            *(shape for m, n in itertools.pairwise(widths) for shape in ((n, m), (n,))),
        )  # fmt: skip
        own = observation.dtype
        for i, (x, shape) in enumerate(zip((*arguments[:_TENSORS], *layers), shapes, strict=False)):
            dtype = torch.bool if i in (1, 3, 4) else own
            if x is not None and (x.shape != shape or x.dtype != dtype or x.device != start.device):
                raise ValueError(
                    f"tensor {i} must be {dtype} of shape {shape} on {start.device}, got {x.dtype} "
                    f"{tuple(x.shape)} on {x.device}."
                )
        whole = (len(layers), widths[-1]) == (2 * len(widths) - 2, state)
        if own not in _KINDS or not whole or (use_stored is None) != (stored is None):
            raise ValueError("float32 or float64, last width state, `use_stored` beside `stored`.")
        needed = [cov is not None, stored_cov is not None or use_stored is None, R.ndim == 1]
        if self.propagated and not all(needed):
            raise ValueError("`F` must come with `cov`, `stored_cov` beside `stored`, R diagonal.")
        size = state if self.information else obs
        empty = any(n < 1 for n in (batch, time, obs, state, actions, *widths))
        if size > _MAX_SIZE or len(widths) > _MAX_LAYERS + 1 or empty:
            raise ValueError(f"no size may be 0, none factorised over {_MAX_SIZE}; got {shapes}.")
        if (reason := native_status()) is not None:
            raise RuntimeError(f"the native filter cannot run: {reason}.")
        numbers = [
            batch, time, obs, state, actions, len(widths) - 1, residual, not tanh, R.ndim == 2,
            state, self.information, self.propagated, *widths[1:],
        ]  # fmt: skip
        self.kind, self.mean_shape = _KINDS[own], (batch, time, state)
        self.cov_shape = (batch, time, state, state) if self.propagated else (0,)
        # By a formula: a trace serves every number of rows, batch and time being symbols there.
        one, more = _tape_of_a_group(self.kind, *map(int, numbers[2:]))
        self.numbers, self.tape = numbers, one + more * ((batch * time - 1) // _GROUP)

    def measure(self) -> Self:
        """Have C count its memory, where the sizes are numbers."""
        self.sizes, (least, self.scratch, self.scratch_back) = _count(self.kind, self.numbers)
        if least > self.tape:
            raise RuntimeError(f"the tape must hold {least} numbers, got {self.tape}.")
        return self

    def run(self, name: str, *pointers: Tensor | None) -> None:
        """Call a function of the library."""
        found = (ctypes.c_void_p * len(pointers))(
            *[None if x is None else x.data_ptr() for x in pointers]
        )
        getattr(_library(), f"{name}_{self.kind}")(self.sizes, found)


def _doubles(count: int) -> Tensor:
    return torch.empty(count, dtype=torch.float64)


def _dense(arguments: Sequence[Any]) -> list[Any]:
    """Return the tensors without gaps, the network's after the others."""
    tensors = (*arguments[:_TENSORS], *arguments[_TENSORS])
    return [None if x is None else x.contiguous() for x in tensors]


def _inverses(call: _Call, covs: Sequence[Tensor]) -> tuple[list[Tensor], Tensor | None]:
    """Return what C takes for Q and P_0: the inverses where there are two, and their log|.|."""
    if not call.information:
        return list(covs), None
    if call.propagated:
        return [cov.double() for cov in covs], None
    factor, _ = torch.linalg.cholesky_ex(torch.stack(list(covs)).double())
    inverse = torch.cholesky_inverse(factor)
    return list(inverse), 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def _forward(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    call, dense = _Call(arguments).measure(), _dense(arguments)
    x, observed, reset, F = dense[0], dense[1], dense[3], dense[16]
    mean, ll = x.new_empty(call.mean_shape), x.new_empty(reset.shape, dtype=torch.float64)
    cov = x.new_empty(call.cov_shape)
    tape, scratch = _doubles(call.tape), _doubles(call.scratch)
    priors, log_det = _inverses(call, dense[9:11])
    call.run(
        "forward", *dense[:7], *priors, *dense[11:16], mean, ll, tape, scratch, F, dense[8],
        dense[7], cov, *dense[_TENSORS:],
    )  # fmt: skip
    if log_det is not None:
        ll = ll - 0.5 * torch.where(reset, log_det[1], log_det[0])
    if call.information:
        ll = torch.where(observed.any(-1), ll, 0.0)
    return mean, ll.to(x.dtype), tape, cov


def _backward(
    by_mean: Tensor | None, by_ll: Tensor | None, tape: Tensor, *arguments: Any
) -> list[Tensor]:
    """Return the gradients by observation, action, stored mean, start and the model's tensors."""
    call, dense = _Call(arguments).measure(), _dense(arguments)
    x, observed, action, reset, use_stored, stored, start, _, _, *model = dense
    R, H, B, layers = *model[2:5], model[8:]
    if tape.shape != (call.tape,) or tape.dtype != torch.float64 or not tape.is_contiguous():
        raise ValueError("`tape` must be what filter_rows returned for the same inputs.")
    for by, shape in ((by_mean, call.mean_shape), (by_ll, reset.shape)):
        if by is not None and (by.shape != shape or by.dtype != x.dtype):
            raise ValueError("`by_mean` and `by_log_likelihood` must be like the outputs.")
    by_mean = None if by_mean is None else by_mean.contiguous()
    by_ll = None if by_ll is None else by_ll.double().contiguous()
    priors, log_det = _inverses(call, model[:2])
    if call.information and by_ll is not None:
        by_ll = torch.where(observed.any(-1), by_ll, 0.0)
    by_inputs = [None if v is None else torch.empty_like(v) for v in (x, action, stored, start)]
    by_model = [torch.empty_like(v) for v in (*priors, *model[2:7], *layers)]
    call.run(
        "backward", by_mean, by_ll, reset, use_stored, *priors, H, B, tape,
        _doubles(call.scratch_back), *by_inputs, *by_model[:7], observed, R, *layers[::2],
        *by_model[7:],
    )  # fmt: skip
    if log_det is not None:
        for k, (prior, chosen) in enumerate(zip(priors, (~reset, reset), strict=True)):
            by = -prior @ by_model[k] @ prior
            if by_ll is not None:
                by -= 0.5 * torch.where(chosen, by_ll, 0.0).sum() * prior
            by_model[k] = by
    by_model[:2] = [by.to(x.dtype) for by in by_model[:2]]
    return [v for v in by_inputs if v is not None] + by_model


def _forward_fake(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    x, call = arguments[0], _Call(arguments)
    mean, tape = x.new_empty(call.mean_shape), x.new_empty(call.tape, dtype=torch.float64)
    return mean, x.new_empty(mean.shape[:2]), tape, x.new_empty(call.cov_shape)


def _backward_fake(*arguments: Any) -> list[Tensor]:
    x, _, action, _, _, stored, start, _, _, *model, _ = arguments[3 : 3 + _TENSORS]
    wanted = (x, action, stored, start, *model, *arguments[3 + _TENSORS])
    return [v.new_empty(v.shape) for v in wanted if v is not None]  # dense, whatever v is


class _Filter(torch.autograd.Function):
    """The derivative; one that is differentiated again runs in PyTorch."""

    @staticmethod
    def forward(
        ctx: Any, residual: bool, tanh: bool, build: int, *tensors: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        layers, ctx.flags = list(tensors[_TENSORS:]), (residual, tanh, build)
        output = torch.ops.torchrl_drbpn.filter_rows_forward(
            *tensors[:_TENSORS], layers, *ctx.flags
        )
        ctx.save_for_backward(output[2], *tensors)
        ctx.mark_non_differentiable(*output[2:])
        ctx.set_materialize_grads(False)
        return output

    @staticmethod
    def backward(ctx: Any, *by_outputs: Tensor | None) -> tuple[Any, ...]:
        tape, *saved = ctx.saved_tensors
        if not torch.is_grad_enabled():
            x, action, *by = torch.ops.torchrl_drbpn.filter_rows_backward(
                *by_outputs[:2], tape, *saved[:_TENSORS], saved[_TENSORS:], *ctx.flags
            )
            stored = None if saved[5] is None else by.pop(0)
            sequence = (x, None, action, None, None, stored, by[0], None, None)
            return None, None, None, *sequence, *by[1:8], None, *by[8:]
        # A tensor may be there twice: each place has a gradient of its own.
        saved = [None if x is None else x.view_as(x) for x in saved]
        (Q, P0, R, H, B, d, m0, F), layers = saved[9:_TENSORS], saved[_TENSORS:]
        residual, tanh, _ = ctx.flags
        f = TransitionMLP(
            tuple(layers[::2]), tuple(layers[1::2]), residual, "tanh" if tanh else "relu"
        )
        model = StateSpace(f, Q, H, R, B, d, m0, P0, F)
        outputs = run_in_pytorch(model, FilterInputs(*saved[:9]))[::2]
        pairs = [(o, g) for o, g in zip(outputs, by_outputs[:2], strict=True) if g is not None]
        values, weights = zip(*pairs, strict=True)
        wanted = [x for x in saved if x is not None and x.requires_grad]
        gradients = torch.autograd.grad(
            values, wanted, weights, create_graph=True, allow_unused=True
        )
        found = {id(x): g for x, g in zip(wanted, gradients, strict=True)}
        return None, None, None, *(found.get(id(x)) for x in saved)


def _differentiable(*arguments: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Run the operator; acting asks for no gradient, and keeping one costs as much as a step."""
    if torch.is_grad_enabled():
        flags, tensors = arguments[_TENSORS + 1 :], arguments[:_TENSORS]
        return _Filter.apply(*flags, *tensors, *arguments[_TENSORS])  # type: ignore[no-untyped-call]
    return torch.ops.torchrl_drbpn.filter_rows_forward(*arguments)


def _vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[tuple[Tensor, ...], Any]:
    """Run the operator for one member of the batch after the other."""

    def member(value: Any, dim: Any, i: int) -> Any:
        if isinstance(value, list):
            return [member(*pair, i) for pair in zip(value, dim, strict=True)]
        return value.select(dim, i) if isinstance(dim, int) else value

    runs = [
        torch.ops.torchrl_drbpn.filter_rows(
            *(member(*pair, i) for pair in zip(args, in_dims, strict=True))
        )
        for i in range(info.batch_size)
    ]
    return tuple(torch.stack(parts) for parts in zip(*runs, strict=True)), (0, 0, 0, 0)


_ARGUMENTS = (
    "Tensor observation, Tensor observed, Tensor action, Tensor reset, Tensor? use_stored, "
    "Tensor? stored, Tensor start, Tensor? stored_cov, Tensor? cov, Tensor Q, Tensor P0, Tensor R, "
    "Tensor H, Tensor B, Tensor d, Tensor m0, Tensor? F, Tensor[] layers, bool residual, "
    "bool tanh, int build"
)
_LIBRARY: Any = torch.library.Library("torchrl_drbpn", "DEF")  # type: ignore[no-untyped-call]
# The second is the first without its derivative. (torch.library.register_autograd would make the
# first alone do, at several times the cost of a call: it reads the schema in Python every time.)
for _name, _more, _out, _run, _fake in (
    ("filter_rows", "", "(Tensor, Tensor, Tensor, Tensor)", _forward, _forward_fake),
    ("filter_rows_forward", "", "(Tensor, Tensor, Tensor, Tensor)", _forward, _forward_fake),
    (
        "filter_rows_backward", "Tensor? by_mean, Tensor? by_log_likelihood, Tensor tape, ",
        "Tensor[]", _backward, _backward_fake,
    ),
):  # fmt: skip
    _LIBRARY.define(f"{_name}({_more}{_ARGUMENTS}) -> {_out}")
    _LIBRARY.impl(_name, _run, "CPU")
    torch.library.register_fake(f"torchrl_drbpn::{_name}", _fake, lib=_LIBRARY)
_LIBRARY.impl("filter_rows", _differentiable, "Autograd")
torch.library.register_vmap("torchrl_drbpn::filter_rows", _vmap, lib=_LIBRARY)
