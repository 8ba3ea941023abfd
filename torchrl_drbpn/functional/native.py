"""The native form of the filter: one operator on the CPU, forward and back.

At the sizes of reinforcement learning (16 sequences of 16 steps, 17 sensors) PyTorch spends its
time between the operations of the filter, not in them. ``csrc/filter.h`` holds the same sums; the
package is built with it. ``torch.ops.torchrl_drbpn.filter_rows`` and its gradient check every
tensor before they hand over a pointer; FakeTensors, tracing and vmap meet an ordinary operator.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
import warnings
from collections.abc import Callable, Sequence
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchrl_drbpn.functional.state_space import StateSpace, TransitionMLP

__all__ = [
    "filter_rows",
    "native_status",
    "operator_arguments",
    "register_gradient",
    "unsupported_reason",
]

_KINDS = {torch.float32: "float", torch.float64: "double"}
_WIDTHS = {"AVX512": "avx512", "AVX2": "avx2"}
_MAX_SIZE = 64  # the batched factorisation keeps a group of matrices in cache up to here
_MAX_LAYERS = 15
_LANES = 8  # doubles in a vector; memory.h pads every row to whole ones


@functools.cache
def _library() -> ctypes.CDLL | str:
    """Load what the build made for this processor; the reason where there is nothing."""
    width = _WIDTHS.get(torch.backends.cpu.get_cpu_capability(), "baseline")
    folder = Path(__file__).parents[1]
    for name, suffix in itertools.product((width, "baseline"), EXTENSION_SUFFIXES):
        path = folder / f"_native_{name}{suffix}"
        if path.is_file():
            try:
                return ctypes.CDLL(str(path))
            except OSError as error:
                return f"{path.name} cannot be loaded: {error}"
    return (
        "the package was built without it: install a C compiler, then the package again "
        "(in a checkout: python setup.py build_ext --inplace)"
    )


def native_status() -> str | None:
    """Say why the native form of the filter cannot run on this machine.

    Returns:
        None where it can, else the reason: the PyTorch form runs instead.

    Example:
        >>> type(native_status()) in (type(None), str)
        True
    """
    library = _library()
    return library if isinstance(library, str) else None


@functools.cache
def _warn_once(reason: str) -> None:
    warnings.warn(f"the filter runs in PyTorch, several times slower: {reason}.", stacklevel=2)


def unsupported_reason(model: StateSpace, *tensors: Tensor | None) -> str | None:
    """Say why the native form does not take this model and these inputs.

    Args:
        model: the state-space model.
        tensors: the inputs of the filter that hold numbers.

    Returns:
        None where it takes them, else the reason.

    Example:
        >>> import torch
        >>> f = TransitionMLP((torch.zeros(2, 3),), (torch.zeros(2),), True, "relu")
        >>> eye = torch.eye(2)
        >>> model = StateSpace(f, eye, eye, torch.ones(2), torch.zeros(2, 1), torch.zeros(2),
        ...                    torch.zeros(2), eye)
        >>> unsupported_reason(model, torch.zeros(2).double())
        'the dtypes differ'
    """
    f, Q = model.transition, model.transition_cov
    if not isinstance(f, TransitionMLP) or not isinstance(Q, Tensor):
        return "it takes a TransitionMLP with a constant transition_cov"
    own = (Q, *list(vars(model).values())[2:], *f.weights, *f.biases)
    given = [x for x in (*own, *tensors) if x is not None]
    if torch.compiler.is_compiling():
        return "torch.compile and torch.export trace PyTorch's operations"
    # functorch has no public word for "a transformation is running", and a tensor under one looks
    # like any other.
    if torch._C._are_functorch_transforms_active():
        return "torch.func transforms PyTorch's operations"
    # A new object comes back inside a forward-mode level, where tensors may carry tangents.
    dual = forward_ad.unpack_dual(given[0])  # type: ignore[no-untyped-call]
    if dual.primal is not given[0]:
        return "it has no forward-mode derivative"
    for x in given:
        if type(x) is not Tensor and type(x) is not torch.nn.Parameter:
            return f"{type(x).__name__} is a class of its own"
        if not x.is_cpu:
            return "it runs on the CPU"
        if x.dtype != given[0].dtype:
            return "the dtypes differ"
    if given[0].dtype not in _KINDS:
        return f"there is none for {given[0].dtype}"
    size, name = (model.state_dim, "state") if model.information_form else (model.obs_dim, "obs")
    if size > _MAX_SIZE:
        return f"{name} is {size}, more than {_MAX_SIZE}"
    if len(f.weights) > _MAX_LAYERS:
        return f"the transition has more than {_MAX_LAYERS} layers"
    if any(x.numel() == 0 for x in given):
        return "there is nothing to filter"
    reason = native_status()
    if reason is not None:
        _warn_once(reason)
    return reason


def filter_rows(model: StateSpace, sequence: Sequence[Tensor | None]) -> tuple[Tensor, Tensor]:
    """Filter rows of sequences by the operator.

    Args:
        model: a model that :func:`unsupported_reason` has nothing against.
        sequence: observation, observed, previous action, reset, use_stored_state, stored_mean (both
            may be None), each ``(batch, time, ...)``, and the mean ``(batch, state)`` before.

    Returns:
        Filtered means ``(batch, time, state)`` and log-likelihoods ``(batch, time)``.

    Example:
        >>> import torch
        >>> f = TransitionMLP((torch.zeros(2, 3),), (torch.zeros(2),), True, "relu")
        >>> eye = torch.eye(2)
        >>> model = StateSpace(f, eye, eye, torch.ones(2), torch.zeros(2, 1), torch.zeros(2),
        ...                    torch.zeros(2), eye)
        >>> no = torch.zeros(4, 3, dtype=torch.bool)
        >>> rows = (torch.zeros(4, 3, 2), no.unsqueeze(-1).expand(4, 3, 2), torch.zeros(4, 3, 1),
        ...         no, None, None, torch.ones(4, 2))
        >>> native_status() is not None or bool((filter_rows(model, rows)[0] == 1).all())
        True
    """
    mean, log_likelihood, _ = torch.ops.torchrl_drbpn.filter_rows(
        *sequence, *operator_arguments(model)
    )
    return mean, log_likelihood


def operator_arguments(model: StateSpace) -> tuple[Any, ...]:
    """Return a model as the operator takes it: Q, P_0, R, H, B, d, m_0, the network in one piece.

    Args:
        model: a model that :func:`unsupported_reason` has nothing against.

    Returns:
        Eight tensors, the widths of the network's layers, whether it is residual, and whether it
        has tanh between its layers. One tensor, as autograd is slow on lists of them.
    """
    f = model.transition
    assert isinstance(f, TransitionMLP)  # the rule saw to it; for the type checker
    layers = itertools.chain.from_iterable(zip(f.weights, f.biases, strict=True))
    return (
        model.constant_cov(), model.full_initial_cov(), model.emission_cov, model.emission_matrix,
        model.action_matrix, model.emission_offset, model.initial_mean,
        torch.cat([x.reshape(-1) for x in layers]), [len(bias) for bias in f.biases],
        f.residual, f.activation == "tanh",
    )  # fmt: skip


# ------------------------------------------------------------------ the operator
_ARGUMENTS = (
    "Tensor observation, Tensor observed, Tensor action, Tensor reset, Tensor? use_stored, "
    "Tensor? stored, Tensor start, Tensor Q, Tensor P0, Tensor R, Tensor H, Tensor B, Tensor d, "
    "Tensor m0, Tensor network, int[] widths, bool residual, bool tanh"
)
_LIBRARY: Any = torch.library.Library("torchrl_drbpn", "DEF")  # type: ignore[no-untyped-call]
# The second is the first without its derivative. (torch.library.register_autograd would make the
# first alone do, at several times the cost of a call: it reads the schema in Python every time.)
for _name in ("filter_rows", "filter_rows_forward"):
    _LIBRARY.define(f"{_name}({_ARGUMENTS}) -> (Tensor, Tensor, Tensor)")
_LIBRARY.define(
    "filter_rows_backward(Tensor? by_mean, Tensor? by_log_likelihood, Tensor tape, "
    f"{_ARGUMENTS}) -> Tensor[]"
)


class _Sizes:
    """Check the tensors of a call, and hold its sizes as memory.h reads them."""

    def __init__(self, *arguments: Any) -> None:
        observation, _, action, _, use_stored, stored, start, *model = arguments[:15]
        layers, residual, tanh = arguments[15:]
        if observation.ndim != 3 or action.ndim != 3 or start.ndim != 2:
            raise ValueError(
                "`observation` and `action` must be (batch, time, n), `start` (batch, n)."
            )
        batch, time, obs = observation.shape
        state, self.actions = start.shape[1], action.shape[2]
        R = model[2]
        widths = [state + self.actions, *layers]
        self.information = R.ndim == 1 and obs > state
        shapes: list[tuple[int, ...]] = [
            (batch, time, obs), (batch, time, obs), (batch, time, self.actions), (batch, time),
            (batch, time), (batch, time, state), (batch, state), (state, state), (state, state),
            (obs,) * min(2, max(1, R.ndim)), (obs, state), (obs, self.actions), (obs,), (state,),
            (sum(n * (m + 1) for m, n in itertools.pairwise(widths)),),
        ]  # fmt: skip
        self.dtype = observation.dtype
        for i, (x, shape) in enumerate(zip(arguments[:15], shapes, strict=True)):
            dtype = torch.bool if i in (1, 3, 4) else self.dtype
            if x is not None and (x.shape != shape or x.dtype != dtype or x.device != start.device):
                raise ValueError(
                    f"tensor {i} must be {dtype} of shape {shape} on {start.device}, got {x.dtype} "
                    f"{tuple(x.shape)} on {x.device}."
                )
        size = state if self.information else obs
        if (
            self.dtype not in _KINDS
            or not layers
            or widths[-1] != state
            or (use_stored is None) != (stored is None)
        ):
            raise ValueError("float32 or float64, last width state, `use_stored` beside `stored`.")
        smallest = min(*widths, *(n for shape in shapes for n in shape))
        if size > _MAX_SIZE or len(layers) > _MAX_LAYERS or smallest < 1:
            raise ValueError(f"no size may be 0, none factorised over {_MAX_SIZE}; got {shapes}.")
        self.batch, self.time, self.obs, self.state = batch, time, obs, state
        self.numbers = [
            batch, time, obs, state, self.actions, len(layers), residual, not tanh,
            R.ndim == 2, state, self.information, *layers,
        ]  # fmt: skip
        N, S, J, *W = map(_padded, (obs, state, *widths))
        entries = state * (state + 1) // 2 if self.information else obs * obs
        beside = batch * time * S if self.information else 2 * (state * N + obs * S)
        rows = batch * time
        self.widths = widths
        self.tape = rows * (2 * J + N + sum(W[:-1])) + _padded(rows) * entries + beside

    def layers(self, network: Tensor) -> list[int]:
        """Return the addresses of weight, bias, weight, ... in a network."""
        at, found = network.data_ptr(), []
        for fan_in, fan_out in itertools.pairwise(self.widths):
            found += [at, at + fan_out * fan_in * network.itemsize]
            at = found[-1] + fan_out * network.itemsize
        return found

    def call(self, name: str, pointers: Sequence[Tensor | int | None], scratch_at: int) -> None:
        """Call a function of the library; a scratch of the size it asks for goes in between."""
        library = _library()
        if isinstance(library, str):
            raise RuntimeError(f"the native filter cannot run: {library}.")
        kind = _KINDS[self.dtype]
        dims = (ctypes.c_int64 * len(self.numbers))(*self.numbers)
        counts = (ctypes.c_int64 * 3)()
        getattr(library, f"sizes_{kind}")(dims, counts)
        scratch = torch.empty(counts[1 + (name == "backward")], dtype=torch.float64)
        every = [*pointers[:scratch_at], scratch, *pointers[scratch_at:]]
        found = (ctypes.c_void_p * len(every))(
            *(x.data_ptr() if isinstance(x, Tensor) else x for x in every)
        )
        getattr(library, f"{name}_{kind}")(dims, found)


def _padded(n: int) -> int:
    return (n + _LANES - 1) // _LANES * _LANES


def _dense(arguments: Sequence[Any]) -> list[Any]:
    return [x.contiguous() if isinstance(x, Tensor) else x for x in arguments]


def _inverses(sizes: _Sizes, model: Sequence[Tensor]) -> tuple[list[Tensor], Tensor | None]:
    """Return what C takes for Q and P_0, and log|Q|, log|P_0| in the information form."""
    if not sizes.information:
        return list(model[:2]), None
    factor, _ = torch.linalg.cholesky_ex(torch.stack(list(model[:2])).double())
    inverse = torch.cholesky_inverse(factor)
    return list(inverse), 2.0 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)


def _forward(*given: Any) -> tuple[Tensor, Tensor, Tensor]:
    sizes, arguments = _Sizes(*given), _dense(given)
    x, observed, reset, model = arguments[0], arguments[1], arguments[3], arguments[7:15]
    mean = x.new_empty(sizes.batch, sizes.time, sizes.state)
    ll = x.new_empty(sizes.batch, sizes.time, dtype=torch.float64)
    tape = x.new_empty(sizes.tape, dtype=torch.float64)
    priors, log_det = _inverses(sizes, model)
    layers = sizes.layers(model[7])
    sizes.call("forward", [*arguments[:7], *priors, *model[2:7], mean, ll, tape, *layers], 17)
    if log_det is not None:
        ll = ll - 0.5 * torch.where(reset, log_det[1], log_det[0])
        ll = torch.where(observed.any(-1), ll, 0.0)
    return mean, ll.to(x.dtype), tape


def _backward(by_mean: Tensor | None, by_ll: Tensor | None, *rest: Any) -> list[Tensor]:
    """Return the gradients by observation, action, stored mean, start and the model's tensors."""
    tape, *given = rest
    sizes, arguments = _Sizes(*given), _dense(given)
    x, observed, action, reset, use_stored, stored, start, *model = arguments[:15]
    if tape.shape != (sizes.tape,) or tape.dtype != torch.float64 or not tape.is_contiguous():
        raise ValueError("`tape` must be what filter_rows returned for the same inputs.")
    for by, shape in ((by_mean, (*reset.shape, sizes.state)), (by_ll, reset.shape)):
        if by is not None and (by.shape != shape or by.dtype != x.dtype):
            raise ValueError("`by_mean` and `by_log_likelihood` must be like the outputs.")
    by_mean = None if by_mean is None else by_mean.contiguous()
    by_ll = None if by_ll is None else by_ll.double().contiguous()
    priors, log_det = _inverses(sizes, model)
    if log_det is not None and by_ll is not None:
        by_ll = torch.where(observed.any(-1), by_ll, 0.0)
    by_inputs = [torch.empty_like(v) for v in (x, action, stored, start) if v is not None]
    by_stored = None if stored is None else by_inputs[2]
    by_model = [torch.empty_like(v) for v in (*priors, *model[2:])]
    _, _, R, H, B, _, _, network = model
    sizes.call(
        "backward",
        [
            by_mean, by_ll, reset, use_stored, *priors, H, B, tape, *by_inputs[:2], by_stored,
            by_inputs[-1], *by_model[:7], observed, R, *sizes.layers(network)[::2],
            *sizes.layers(by_model[7]),
        ],
        9,
    )  # fmt: skip
    if log_det is not None:
        for k, (prior, chosen) in enumerate(zip(priors, (~reset, reset), strict=True)):
            by = -prior @ by_model[k] @ prior
            if by_ll is not None:
                by -= 0.5 * torch.where(chosen, by_ll, 0.0).sum() * prior
            by_model[k] = by.to(x.dtype)
    return [*by_inputs, *by_model]


def _forward_fake(*arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
    x, sizes = arguments[0], _Sizes(*arguments)
    mean = x.new_empty(sizes.batch, sizes.time, sizes.state)
    return mean, x.new_empty(mean.shape[:2]), x.new_empty(sizes.tape, dtype=torch.float64)


def _backward_fake(*arguments: Any) -> list[Tensor]:
    x, _, action, _, _, stored, start, *model = arguments[3:18]
    return [torch.empty_like(v) for v in (x, action, stored, start, *model) if v is not None]


def register_gradient(pytorch_form: Callable[..., tuple[Tensor, Tensor]]) -> None:
    """Register the operator's derivative; one that is differentiated again runs in PyTorch.

    Args:
        pytorch_form: of a :class:`StateSpace` and the seven tensors of a sequence, returns the
            filtered means and the log-likelihoods.

    Example:
        >>> from torchrl_drbpn.functional import filtering  # registers its own
        >>> hasattr(torch.ops.torchrl_drbpn, "filter_rows")
        True
    """

    class Filter(torch.autograd.Function):
        @staticmethod
        def forward(*arguments: Any) -> tuple[Tensor, Tensor, Tensor]:
            return torch.ops.torchrl_drbpn.filter_rows_forward(*arguments)

        @staticmethod
        def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
            ctx.rest = inputs[15:]
            ctx.save_for_backward(output[2], *inputs[:15])
            ctx.mark_non_differentiable(output[2])
            ctx.set_materialize_grads(False)

        @staticmethod
        def backward(ctx: Any, *by_outputs: Tensor | None) -> tuple[Any, ...]:
            return gradient(ctx, *by_outputs)

    def gradient(ctx: Any, *by_outputs: Tensor | None) -> tuple[Any, ...]:
        tape, *saved = ctx.saved_tensors
        by_mean, by_ll, _ = by_outputs
        if not torch.is_grad_enabled():
            x, action, *stored, start, Q, P0, R, H, B, d, m0, network = (
                torch.ops.torchrl_drbpn.filter_rows_backward(
                    by_mean, by_ll, tape, *saved, *ctx.rest
                )
            )
            of_stored = stored[0] if stored else None
            sequence = (x, None, action, None, None, of_stored, start)
            return (*sequence, Q, P0, R, H, B, d, m0, network, None, None, None)
        Q, P0, R, H, B, d, m0, network = saved[7:]
        outputs = pytorch_form(
            StateSpace(_unpacked(network, Q, B, *ctx.rest), Q, H, R, B, d, m0, P0), *saved[:7]
        )
        wanted = [x for x in saved if x is not None and x.requires_grad]
        pairs = [(o, g) for o, g in zip(outputs, by_outputs[:2], strict=True) if g is not None]
        found = torch.autograd.grad(
            [o for o, _ in pairs],
            wanted,
            [g for _, g in pairs],
            create_graph=True,
            allow_unused=True,
        )
        known = {id(x): g for x, g in zip(wanted, found, strict=True)}
        return *(known.get(id(x)) for x in saved), None, None, None

    _LIBRARY.impl("filter_rows", Filter.apply, "Autograd")


def _unpacked(
    network: Tensor, Q: Tensor, B: Tensor, widths: list[int], residual: bool, tanh: bool
) -> TransitionMLP:
    """Return the network that :func:`operator_arguments` put into one piece."""
    pairs = list(itertools.pairwise([len(Q) + B.shape[1], *widths]))
    parts = torch.split(network, [size for m, n in pairs for size in (n * m, n)])
    weights = tuple(part.view(n, m) for part, (m, n) in zip(parts[::2], pairs, strict=True))
    return TransitionMLP(weights, tuple(parts[1::2]), residual, "tanh" if tanh else "relu")


def _vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> tuple[tuple[Tensor, ...], Any]:
    """Run the operator for one member of the batch after the other."""

    def member(value: Any, dim: Any, i: int) -> Any:
        return value.select(dim, i) if isinstance(dim, int) else value

    runs = [
        torch.ops.torchrl_drbpn.filter_rows(
            *(member(value, dim, i) for value, dim in zip(args, in_dims, strict=True))
        )
        for i in range(info.batch_size)
    ]
    return tuple(torch.stack(parts) for parts in zip(*runs, strict=True)), (0, 0, 0)


for _name in ("filter_rows", "filter_rows_forward"):
    _LIBRARY.impl(_name, _forward, "CPU")
    torch.library.register_fake(f"torchrl_drbpn::{_name}", _forward_fake, lib=_LIBRARY)
_LIBRARY.impl("filter_rows_backward", _backward, "CPU")
torch.library.register_fake("torchrl_drbpn::filter_rows_backward", _backward_fake, lib=_LIBRARY)
torch.library.register_vmap("torchrl_drbpn::filter_rows", _vmap, lib=_LIBRARY)
