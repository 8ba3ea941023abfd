"""PPO's terms of two small networks in C: one call forward and one back.

On a minibatch of some hundred frames a policy head, a value head, the clipped gain and the value
error are some fifty operations of PyTorch and as many nodes of its graph, each of which costs more
than its arithmetic. ``heads.c`` computes the same; where the C code cannot be had, PyTorch does.
"""

from __future__ import annotations

import ctypes
import functools
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchrl_drbpn.functional.compiled import load_library, native_error

__all__ = [
    "ClippedTerms",
    "PreparedPolicy",
    "clipped_heads",
    "heads_refusal",
    "policy_refusal",
]

_CPU = torch.device("cpu")
_MAX_LAYERS = 8
_KINDS = ("l2", "l1", "smooth_l1")


class ClippedTerms(NamedTuple):
    """What PPO's loss reports; only the first two have a gradient.

    Attributes:
        objective: minus the mean clipped gain.
        error: mean distance of the value from its target.
        clip_fraction: share of frames whose ratio was clipped.
        kl: mean of minus the log ratio, nats.
        max_ratio: the largest ratio of the policy to the one that collected.
        mean_ratio: their mean.
        sample_size: effective sample size over the first dimension, as a share of it.
    """

    objective: Tensor
    error: Tensor
    clip_fraction: Tensor
    kl: Tensor
    max_ratio: Tensor
    mean_ratio: Tensor
    sample_size: Tensor


def heads_refusal(
    features: Tensor,
    action: Tensor,
    old_log_prob: Tensor,
    advantage: Tensor,
    value_target: Tensor,
    log_scale: Tensor,
    actor: Sequence[Tensor],
    critic: Sequence[Tensor],
) -> str | None:
    """Say why the C code does not take these networks and numbers; see :func:`clipped_heads`.

    Args:
        features: what both networks read.
        action: what was done.
        old_log_prob: of the policy that collected.
        advantage: of the action.
        value_target: of the value.
        log_scale: log sigma.
        actor: weight and bias of every layer of the policy's network.
        critic: the same of the value's.

    Returns:
        None where it takes them, else the reason.

    Example:
        >>> import torch
        >>> layers, x = [torch.zeros(1, 2), torch.zeros(1)], torch.zeros(3, 2)
        >>> heads_refusal(x, x[:, :1], x[:, 0], x[:, 0], x[:, 0], x[0, :1].double(), layers, layers)
        'the dtypes differ'
    """
    batch, actions = features.shape[:-1], log_scale.numel()
    if not features.ndim or log_scale.ndim != 1 or action.shape != (*batch, actions):
        return "shapes do not fit"
    if not (old_log_prob.shape == advantage.shape == value_target.shape == batch and batch):
        return "shapes do not fit"
    given = (features, action, old_log_prob, advantage, value_target, log_scale)
    return _refusal(given, (actor, actions), (critic, 1))


def policy_refusal(layers: Sequence[Tensor], features: Tensor, scale: Tensor) -> str | None:
    """Say why :class:`PreparedPolicy` does not take this network.

    Args:
        layers: weight and bias of every layer.
        features: what it reads, shape ``(rows, features)``.
        scale: sigma, shape ``(action,)``.

    Returns:
        None where it takes it, else the reason.

    Example:
        >>> import torch
        >>> policy_refusal([torch.zeros(1, 2), torch.zeros(1)], torch.zeros(4, 3), torch.ones(1))
        'a layer does not fit what it reads'
    """
    if features.ndim != 2 or scale.ndim != 1:
        return "shapes do not fit"
    return _refusal((features, scale), (layers, scale.numel()))


def _refusal(given: Sequence[Tensor], *networks: tuple[Sequence[Tensor], int]) -> str | None:
    """Say why C may not read this; the first tensor given is what the networks read."""
    if torch.compiler.is_compiling():
        return "torch.compile traces PyTorch's operations"
    if torch._C._are_functorch_transforms_active():
        return "torch.func transforms PyTorch's operations"
    if torch.is_autocast_enabled("cpu"):
        return "autocast computes in another dtype"
    dtype = given[0].dtype
    every = [*given, *(layer for layers, _ in networks for layer in layers)]
    if any(value.device != _CPU for value in every):
        return "it runs on the CPU"
    if any(value.dtype != dtype for value in every):
        return "the dtypes differ"
    if not all(value.is_contiguous() for value in every):
        return "memory is not contiguous"
    for layers, outputs in networks:
        if len(layers) > 2 * _MAX_LAYERS:
            return f"a network has more than {_MAX_LAYERS} layers"
        width = given[0].shape[-1]
        for weight, bias in zip(layers[0::2], layers[1::2], strict=True):
            if weight.ndim != 2 or weight.shape[1] != width or bias.shape != weight.shape[:1]:
                return "a layer does not fit what it reads"
            width = weight.shape[0]
        if width != outputs:
            return "a network has another number of outputs"
    return _error(dtype)


def clipped_heads(
    features: Tensor,
    action: Tensor,
    old_log_prob: Tensor,
    advantage: Tensor,
    value_target: Tensor,
    log_scale: Tensor,
    actor: Sequence[Tensor],
    critic: Sequence[Tensor],
    *,
    low: float,
    high: float,
    scale_floor: float,
    kind: Literal["l2", "l1", "smooth_l1"],
) -> ClippedTerms | None:
    r"""Run policy and value on features; return the clipped objective and the value's error.

    .. math::
        L = -\frac{1}{n} \sum \min(w A, \mathrm{clip}(w, 1 - \epsilon, 1 + \epsilon) A), \quad
        w = N(a; \mu, \sigma) / N_{old}, \quad E = \frac{1}{n} \sum d(v, V)

    Eq. (7) of [Schulman et al. 2017]; mu and v are networks of tanh layers, sigma is independent
    of the features. Differentiable once, by features, log scale and the networks; both terms are
    one node of the graph.

    Args:
        features: shape ``(*batch, features)``.
        action: shape ``(*batch, action)``.
        old_log_prob: of the policy that collected, shape ``(*batch,)``.
        advantage: shape ``(*batch,)``.
        value_target: shape ``(*batch,)``.
        log_scale: log sigma, shape ``(action,)``.
        actor: weight and bias of every layer of mu, tanh between them.
        critic: the same of v.

    Keyword Args:
        low: log(1 - epsilon).
        high: log(1 + epsilon).
        scale_floor: least sigma; below it the log scale has no gradient.
        kind: the distance d: squared, absolute, or absolute from 1 on and half the square below.

    Returns:
        The terms; None where :func:`heads_refusal` has a reason.

    Example:
        >>> import torch
        >>> actor, critic = ([torch.zeros(n, 3), torch.zeros(n)] for n in (2, 1))
        >>> terms = clipped_heads(
        ...     torch.randn(4, 3), torch.zeros(4, 2), torch.zeros(4), torch.ones(4),
        ...     torch.full((4,), 3.0), torch.zeros(2), actor, critic,
        ...     low=-0.2, high=0.2, scale_floor=1e-4, kind="l1")
        >>> terms is None or float(terms.error)  # None: no C compiler here
        3.0
    """
    given = (features, action, old_log_prob, advantage, value_target, log_scale)
    if heads_refusal(*given, actor, critic) is not None:
        return None
    settings = (low, high, scale_floor, _KINDS.index(kind), len(actor))
    out = _ClippedHeads.apply(  # type: ignore[no-untyped-call]
        settings, *given, *actor, *critic
    )
    objective, error, metrics, sample_size = out
    clip_fraction, kl, max_ratio, mean_ratio = metrics.unbind()
    return ClippedTerms(objective, error, clip_fraction, kl, max_ratio, mean_ratio, sample_size)


class _ClippedHeads(torch.autograd.Function):
    """Call ``heads.c``; inputs as of :func:`clipped_heads`, all contiguous, of one dtype."""

    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return objective, error, four metrics, and effective sample sizes."""
        (low, high, floor, kind, of_actor), *given = args
        features, old_log_prob, layers = given[0], given[2], given[6:]
        widths = [weight.shape[0] for weight in layers[0::2]]
        rows, columns = old_log_prob.numel(), old_log_prob[:1].numel()
        numbers = [
            rows, columns, given[1].shape[-1], kind, features.shape[-1], of_actor // 2,
            (len(layers) - of_actor) // 2, *widths,
        ]  # fmt: skip
        dims = (ctypes.c_int64 * len(numbers))(*numbers)
        native = _load(features.dtype)
        counts = (ctypes.c_int64 * 2)()
        native.sizes(dims, counts)
        tape, scratch = (features.new_empty(count) for count in counts)
        objective, error = features.new_empty(()), features.new_empty(())
        metrics, sample_size = features.new_empty(4), features.new_empty(old_log_prob.shape[1:])
        native.forward(
            dims,
            (ctypes.c_double * 3)(low, high, floor),
            _pointers(*given[:6], objective, error, metrics, sample_size, tape, scratch, *layers),
        )
        ctx.save_for_backward(tape, *layers)
        ctx.dims, ctx.scratch, ctx.shapes = dims, counts[1], (features.shape, given[5].shape)
        ctx.of_actor = of_actor
        ctx.mark_non_differentiable(metrics, sample_size)
        ctx.set_materialize_grads(False)
        return objective, error, metrics, sample_size

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, by_objective: Tensor | None, by_error: Tensor | None, *_: Any
    ) -> tuple[Tensor | None, ...]:
        """Return the gradients by features, log scale and layers."""
        tape, *layers = ctx.saved_tensors
        of_features = tape.new_empty(ctx.shapes[0]) if ctx.needs_input_grad[1] else None
        of_scale: Tensor | None = tape.new_empty(ctx.shapes[1])
        of_layers = [torch.empty_like(value) for value in layers]
        scratch = tape.new_empty(ctx.scratch)
        _load(tape.dtype).backward(
            ctx.dims,
            _pointers(
                by_objective, by_error, tape, scratch, of_features, of_scale, *layers, *of_layers
            ),
        )
        actor: list[Tensor | None] = [*of_layers[: ctx.of_actor]]
        critic: list[Tensor | None] = [*of_layers[ctx.of_actor :]]
        if by_objective is None:  # nothing was written into these
            of_scale, actor = None, [None] * len(actor)
        if by_error is None:
            critic = [None] * len(critic)
        return (None, of_features, None, None, None, None, of_scale, *actor, *critic)


class PreparedPolicy:
    r"""Decide for one batch after the other with the same parameters, without gradients.

    .. math:: a = \mu + \sigma \epsilon, \qquad \log \pi(a) = \log N(a; \mu, \sigma)

    mu is a network of tanh layers, sigma a number for each action. What does not change is laid out
    once: a decision is one call of C. The memory is one for all calls: not for several threads.

    Args:
        layers: weight and bias of every layer of mu. A change in place is seen by the next
            decision; other tensors in their place, as after ``module.to()``, are not.
        scale: sigma, shape ``(action,)``.
        rows: how many decisions a call takes.

    Raises:
        ValueError: where :func:`policy_refusal` has a reason.

    Example:
        >>> import torch
        >>> layers, scale = [torch.zeros(2, 3), torch.zeros(2)], torch.ones(2)
        >>> if policy_refusal(layers, torch.zeros(4, 3), scale) is None:
        ...     loc, action, log_prob = PreparedPolicy(layers, scale, 4)(
        ...         torch.randn(4, 3), torch.zeros(4, 2))
        ...     assert torch.equal(loc, action) and log_prob.shape == (4,)
    """

    def __init__(self, layers: Sequence[Tensor], scale: Tensor, rows: int) -> None:
        widths = [weight.shape[0] for weight in layers[0::2]]
        self._shapes = (rows, layers[0].shape[1]), (rows, scale.shape[0])
        self._dtype = scale.dtype
        refusal = policy_refusal(layers, scale.new_empty(self._shapes[0]), scale)
        if refusal is not None:
            raise ValueError(f"the C code does not take this network: {refusal}. Run PyTorch's.")
        numbers = [rows, 1, scale.shape[0], 0, layers[0].shape[1], len(widths), 0, *widths]
        self._dims = (ctypes.c_int64 * len(numbers))(*numbers)
        native = _load(scale.dtype)
        counts = (ctypes.c_int64 * 2)()
        native.sizes(self._dims, counts)
        tape, scratch = (scale.new_empty(count) for count in counts)
        # Tensors of its own over the same numbers: what C reads stays, whatever a module does.
        self._kept = (tape, scratch, scale, *(layer.detach() for layer in layers))
        self._at = _pointers(None, None, scale, None, None, None, tape, scratch, *layers)
        self._act = native.act

    def takes(self, features: Tensor) -> bool:
        """Tell whether these features are of the number, the width and the dtype laid out.

        Args:
            features: what is to be decided on.

        Returns:
            False also on another device or where memory is not contiguous.
        """
        return (
            features.shape == self._shapes[0]
            and features.dtype is self._dtype
            and features.device == _CPU
            and features.is_contiguous()
        )

    @torch.no_grad()
    def __call__(self, features: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return location, action and log-probability.

        Args:
            features: shape ``(rows, features)``; :meth:`takes` is true of it.
            noise: epsilon, shape ``(rows, action)``, likewise.

        Returns:
            Shapes ``(rows, action)`` twice and ``(rows,)``.

        Raises:
            ValueError: for other shapes, dtypes or layouts.
        """
        sound = noise.shape == self._shapes[1] and noise.dtype is self._dtype
        if not (sound and noise.is_contiguous() and self.takes(features)):
            raise ValueError(
                f"`features` and `noise` must be {self._dtype}, contiguous, on the CPU, of shapes "
                f"{self._shapes[0]} and {self._shapes[1]}, got {features.dtype} "
                f"{tuple(features.shape)} and {noise.dtype} {tuple(noise.shape)}."
            )
        loc, action = torch.empty_like(noise), torch.empty_like(noise)
        log_prob = noise.new_empty(self._shapes[0][0])
        at = self._at
        at[0], at[1] = features.data_ptr(), noise.data_ptr()
        at[3], at[4], at[5] = loc.data_ptr(), action.data_ptr(), log_prob.data_ptr()
        self._act(self._dims, at)
        return loc, action, log_prob


def _pointers(*tensors: Tensor | None) -> ctypes.Array[ctypes.c_void_p]:
    at = [None if tensor is None else tensor.data_ptr() for tensor in tensors]
    return (ctypes.c_void_p * len(at))(*at)


class _Functions(NamedTuple):
    sizes: ctypes._NamedFuncPointer
    forward: ctypes._NamedFuncPointer
    backward: ctypes._NamedFuncPointer
    act: ctypes._NamedFuncPointer


@functools.cache
def _error(dtype: torch.dtype) -> str | None:
    return native_error(dtype, "heads")


@functools.cache
def _load(dtype: torch.dtype) -> _Functions:
    library = load_library(dtype, "heads")
    out = _Functions(
        library.heads_sizes, library.heads_forward, library.heads_backward, library.heads_act
    )
    for function in out:
        function.restype = None
    return out
