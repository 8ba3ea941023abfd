"""Running statistics in two calls of ``moments.c``: one that learns, one that scales.

For the observations of sixteen robots they are some thirty operations on a few hundred numbers, and
what is paid for is their number. Both forms compute in float64; sums are rounded in another order.
Where the C code cannot be had, PyTorch's operations run.
"""

from __future__ import annotations

import ctypes
import functools
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_drbpn.functional.compiled import load_library, native_error
from torchrl_drbpn.functional.statistics import Moments

__all__ = ["RunningNumbers", "learn_native", "scale_native", "takes_native"]

_CPU = torch.device("cpu")
_INFINITY = float("inf")


class RunningNumbers(NamedTuple):
    """Hold the statistics after a batch, all float64 of shape ``(*event)``.

    Attributes:
        moments: count, mean and squared deviations.
        inverse_scale: 1 / sqrt(var + eps), the inverse of the values' units.
    """

    moments: Moments
    inverse_scale: Tensor


def takes_native(value: Tensor, observed: Tensor | None = None, source: str = "moments") -> bool:
    """Tell whether the C code takes these values.

    Args:
        value: shape ``(*batch, *event)``.
        observed: bool mask of the same shape, or None.
        source: which C code, see :func:`.native_error`.

    Returns:
        False on another device or dtype, where memory is not contiguous, where a gradient is
        wanted, under ``torch.compile``, and where the C code cannot be had.

    Example:
        >>> import torch
        >>> takes_native(torch.zeros(3, 2).half())
        False
    """
    return (
        value.device == _CPU
        and value.is_contiguous()
        and not (value.requires_grad and torch.is_grad_enabled())
        and (
            observed is None
            or (
                observed.dtype is torch.bool
                and observed.shape == value.shape
                and observed.is_contiguous()
            )
        )
        and not torch.compiler.is_compiling()
        and not torch._C._are_functorch_transforms_active()
        and _available(value.dtype, source)
    )


def learn_native(
    before: Moments,
    value: Tensor,
    observed: Tensor | None,
    rows: Tensor | None,
    eps: float,
) -> RunningNumbers | None:
    """Merge the observed entries of the flagged rows of a batch into running statistics.

    The same as ``masked_moments``, ``merge_moments`` and ``variance``, but for the order of sums.

    Args:
        before: the statistics so far, shape ``(*event)``, contiguous.
        value: shape ``(*batch, *event)``; :func:`takes_native` is true of it.
        observed: bool, shape ``(*batch, *event)``, contiguous; None: every entry.
        rows: bool, shape ``(*batch,)``, contiguous; None: every row.
        eps: added to the variance, squared units.

    Returns:
        New statistics; None where an entry that counts is NaN or infinite.

    Example:
        >>> import torch
        >>> x, nothing = torch.randn(64, 2), Moments(*torch.zeros(3, 2).double())
        >>> out = learn_native(nothing, x, None, None, 0.0) if takes_native(x) else None
        >>> out is None or torch.allclose(out.inverse_scale, 1 / x.double().std(0, correction=0))
        True
    """
    native = _load(value.dtype)
    n = before.n.numel()
    count, mean, m2, inverse_scale = (torch.empty_like(before.n) for _ in range(4))
    if not native.learn(
        value.numel() // n if n else 0,
        n,
        eps,
        value.data_ptr(),
        None if observed is None else observed.data_ptr(),
        None if rows is None else rows.data_ptr(),
        before.n.data_ptr(),
        before.mean.data_ptr(),
        before.m2.data_ptr(),
        count.data_ptr(),
        mean.data_ptr(),
        m2.data_ptr(),
        inverse_scale.data_ptr(),
    ):
        return None
    return RunningNumbers(Moments(count, mean, m2), inverse_scale)


def scale_native(
    value: Tensor,
    observed: Tensor | None,
    mean: Tensor | None,
    inverse_scale: Tensor,
    clip: float | None,
) -> Tensor:
    """Return clip((value - mean) inverse_scale, -clip, clip), 0 where nothing was observed.

    Computed in float64, bit for bit what PyTorch's operations give.

    Args:
        value: shape ``(*batch, *event)``; :func:`takes_native` is true of it.
        observed: bool, shape ``(*batch, *event)``, contiguous; None: every entry.
        mean: float64, shape ``(*event)``, contiguous; None: 0.
        inverse_scale: float64, shape ``(*event)``, contiguous.
        clip: largest magnitude; None for no limit.

    Returns:
        Shape and dtype of ``value``.

    Example:
        >>> import torch
        >>> x, one = torch.tensor([[1.0, -9.0]]), torch.ones(2).double()
        >>> scale_native(x, None, one, one, 2.0).tolist() if takes_native(x) else [[0.0, -2.0]]
        [[0.0, -2.0]]
    """
    native = _load(value.dtype)
    out = torch.empty_like(value)
    n = inverse_scale.numel()
    native.scale(
        value.numel() // n if n else 0,
        n,
        _INFINITY if clip is None else clip,
        value.data_ptr(),
        None if observed is None else observed.data_ptr(),
        None if mean is None else mean.data_ptr(),
        inverse_scale.data_ptr(),
        out.data_ptr(),
    )
    return out


# ------------------------------------------------------------------------------------- the C code
class _Functions(NamedTuple):
    learn: ctypes._NamedFuncPointer
    scale: ctypes._NamedFuncPointer


@functools.cache
def _available(dtype: torch.dtype, source: str) -> bool:
    return native_error(dtype, source) is None


@functools.cache
def _load(dtype: torch.dtype) -> _Functions:
    """Return the functions for values of a dtype, with the types of their arguments."""
    library = load_library(dtype, "moments")
    whole, real, at = ctypes.c_long, ctypes.c_double, ctypes.c_void_p
    out = _Functions(library.moments_learn, library.moments_scale)
    out.learn.argtypes = [whole, whole, real, *[at] * 10]
    out.scale.argtypes = [whole, whole, real, *[at] * 5]
    out.scale.restype = None
    return out
