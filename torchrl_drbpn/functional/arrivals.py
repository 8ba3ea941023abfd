"""Which entries of an observation arrive, and the rest set to 0: eight small operations in one.

For sixteen robots between two steps of their simulators each operation of PyTorch costs several
microseconds, whatever it computes. ``arrivals.c`` computes the same in one call; where the C code
cannot be had, PyTorch's operations run.
"""

from __future__ import annotations

import ctypes
import functools

import torch
from torch import Tensor

from torchrl_drbpn.functional.compiled import load_library
from torchrl_drbpn.functional.corruption import (
    MissingnessMechanism,
    missing_probability,
    sample_observed,
)
from torchrl_drbpn.functional.gaussian import zero_missing
from torchrl_drbpn.functional.running import takes_native

__all__ = ["sample_arrivals"]


def sample_arrivals(
    mechanism: MissingnessMechanism | None,
    observation: Tensor,
    observed: Tensor | None,
    previous_action: Tensor | None,
    eta: float,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Draw which entries arrive, and set the others to 0.

    The law is that of :func:`.missing_probability` and :func:`.sample_observed`. In C its sums are
    rounded in another order: for the same generator state one entry in some millions may differ.

    Args:
        mechanism: parameters, on the device and in the dtype of `observation`; None: MCAR.
        observation: shape ``(*batch, obs)``.
        observed: bool of that shape, what an earlier transform left; None: everything. What it
            hides enters no law and does not arrive.
        previous_action: shape ``(*batch, action)``, in the observation's dtype; None counts as 0.
        eta: missing rate (MCAR), or the upper bound of the probability.
        generator: source of randomness, on the observation's device.

    Returns:
        The observation with zeros where it is missing, and the mask, bool, True = arrived.

    Example:
        >>> import torch
        >>> x, g = torch.ones(3, 5), torch.Generator().manual_seed(0)
        >>> filled, arrived = sample_arrivals(None, x, None, None, 0.5, g)
        >>> torch.equal(filled, arrived.float())
        True
    """
    uniform = torch.rand(observation.shape, generator=generator, device=observation.device)
    if (
        observation.ndim > 0
        and takes_native(observation, observed, "arrivals")
        and uniform.dtype is torch.float32
        and (mechanism is None or _takes(mechanism, observation, previous_action))
    ):
        return _native(mechanism, observation, observed, previous_action, eta, uniform)
    probability: Tensor | float = eta
    if mechanism is not None:
        read = observation if observed is None else zero_missing(observation, observed)
        probability = missing_probability(mechanism, read, previous_action, eta)
    arrived = sample_observed(probability, observation, generator, uniform)
    if observed is not None:
        arrived = arrived.logical_and_(observed)
    return torch.where(arrived, observation, 0.0), arrived


def _takes(mechanism: MissingnessMechanism, observation: Tensor, action: Tensor | None) -> bool:
    """Tell whether C may read these addresses."""
    given = [*mechanism[1:], *(() if action is None else (action,))]
    n, actions = observation.shape[-1], mechanism.action_weight.shape[-1]
    return (
        mechanism.observation_weight.shape == (n, n)
        and mechanism.bias.shape == (n,)
        and mechanism.action_weight.shape == (n, actions)
        and (action is None or action.shape == (*observation.shape[:-1], actions))
    ) and all(
        value.dtype is observation.dtype
        and value.device == observation.device
        and value.is_contiguous()
        and not value.requires_grad
        for value in given
    )


def _native(
    mechanism: MissingnessMechanism | None,
    observation: Tensor,
    observed: Tensor | None,
    action: Tensor | None,
    eta: float,
    uniform: Tensor,
) -> tuple[Tensor, Tensor]:
    arrived = torch.empty_like(observation, dtype=torch.bool)
    filled = torch.empty_like(observation)
    n = observation.shape[-1]
    weight = bias = by_action = None
    actions = 0
    if mechanism is not None:
        weight, bias = mechanism.observation_weight, mechanism.bias
        by_action, actions = mechanism.action_weight, mechanism.action_weight.shape[-1]
    _load(observation.dtype)(
        observation.numel() // n if n else 0,
        n,
        actions,
        eta,
        observation.data_ptr(),
        None if observed is None else observed.data_ptr(),
        None if action is None else action.data_ptr(),
        None if weight is None else weight.data_ptr(),
        None if bias is None else bias.data_ptr(),
        None if by_action is None else by_action.data_ptr(),
        uniform.data_ptr(),
        arrived.data_ptr(),
        filled.data_ptr(),
    )
    return filled, arrived


@functools.cache
def _load(dtype: torch.dtype) -> ctypes._NamedFuncPointer:
    """Return the function for observations of a dtype, with the types of its arguments."""
    draw = load_library(dtype, "arrivals").arrivals_draw
    draw.argtypes = [*[ctypes.c_long] * 3, ctypes.c_double, *[ctypes.c_void_p] * 9]
    draw.restype = None
    return draw
