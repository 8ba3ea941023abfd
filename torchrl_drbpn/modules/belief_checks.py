"""Tell readings that are no numbers from a model that has diverged."""

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

from torchrl_drbpn.functional import FilterOutput, ParticleOutput
from torchrl_drbpn.functional.gaussian import NotPositiveDefiniteError

_Output = TypeVar("_Output", FilterOutput, ParticleOutput)


class BeliefDivergedError(ValueError):
    """Report that the learned model left the range of its numbers; the input was sound."""


def checked(
    run: Callable[[], _Output],
    validate: bool,
    observation: Tensor,
    observed: Tensor,
    /,
    **others: Tensor | None,
) -> _Output:
    """Filter, and raise if the result is not finite: name the input that caused it."""
    silent = not validate or torch.compiler.is_compiling() or observation.is_meta
    failed: NotPositiveDefiniteError | None = None
    try:
        out = run()
    except NotPositiveDefiniteError as error:  # a covariance network of NaN gives no covariance
        if silent:
            raise
        failed = error
    else:
        if silent:
            return out
        total = out.log_likelihood.detach().sum() + out[0].detach().sum()  # the state is first
        try:
            if bool(total.isfinite()):
                return out
        except RuntimeError:  # under vmap no number reaches the host
            return out
    refuse_readings(observation, observed)
    for name, value in others.items():
        if value is not None and not bool(torch.isfinite(value).all()):
            raise ValueError(
                f"`{name}` holds NaN or inf: the filter cannot start from it. Was it written "
                "by a policy or a filter that had diverged?"
            )
    if failed is not None:
        raise failed
    raise BeliefDivergedError(
        "the belief is no longer finite although every observed entry is: the learned model "
        "diverged. Lower the learning rate, or use residual=False where state > obs."
    )


def refuse_readings(observation: Tensor, observed: Tensor) -> None:
    """Raise ValueError naming the components whose readings that arrived are no usable numbers."""
    largest = torch.finfo(observation.dtype).max ** 0.5
    for bad, what, remedy in (
        (observation.isnan(), "NaN", "mark them missing, for example with ObservedFromNaN"),
        (
            observation.isinf(),
            "infinite readings",
            "a sensor or a division has overflowed; set `observed` to False there "
            "(ObservedFromNaN marks NaN alone)",
        ),
        (
            observation.abs() > largest,
            f"readings over {largest:.1e}, whose squares overflow",
            "standardise them with MaskedObservationNorm, which clips, or mark them missing",
        ),
    ):
        at = (bad & observed).reshape(-1, observation.shape[-1]).any(0).nonzero().flatten().tolist()
        if at:
            raise ValueError(
                f"`observation` holds {what} in entries that `observed` calls arrived "
                f"(components {at}): {remedy}."
            )
