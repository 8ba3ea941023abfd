"""The filter inside torch.autocast."""

from __future__ import annotations

import functools
from collections.abc import Callable
from contextlib import ExitStack
from typing import ParamSpec, TypeVar

import torch

__all__ = ["outside_autocast"]

_DEVICES = ("cpu", "cuda")
_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def outside_autocast(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Run a function in the dtypes of its tensors, inside torch.autocast too.

    A filter in half precision would lose every digit, and its fast forms would mix their dtypes.

    Args:
        function: any.

    Returns:
        The same function.

    Example:
        >>> import torch
        >>> @outside_autocast
        ... def square(x):
        ...     return x @ x
        >>> with torch.autocast("cpu", dtype=torch.bfloat16):
        ...     square(torch.eye(2)).dtype
        torch.float32
    """

    @functools.wraps(function)
    def run(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        casting = [device for device in _DEVICES if torch.is_autocast_enabled(device)]
        if not casting:
            return function(*args, **kwargs)
        with ExitStack() as stack:
            for device in casting:
                stack.enter_context(torch.autocast(device, enabled=False))
            return function(*args, **kwargs)

    return run
