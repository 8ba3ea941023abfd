"""Adam's step without what torch.optim does around it at every call."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn


class PreparedAdam:
    """Take the steps of an optimiser that has taken one, to the last bit as it would.

    ``torch.optim`` collects its lists, sorts them by device and dtype and calls its hooks at every
    step, which costs more than the step of some thousand parameters. Here the lists are made once;
    the state is the optimiser's own, so that its ``state_dict`` is what it always was.

    Args:
        optimizer: a fused Adam with one group, which has stepped with these parameters. Nothing
            else may step it, and no setting but its learning rate may change, while this is used.
        parameters: those that have a gradient; of one device and dtype.
    """

    def __init__(self, optimizer: torch.optim.Adam, parameters: Sequence[nn.Parameter]) -> None:
        states = [optimizer.state[parameter] for parameter in parameters]
        self._group = optimizer.param_groups[0]
        self._parameters: list[torch.Tensor] = list(parameters)
        self._means = [state["exp_avg"] for state in states]
        self._squares = [state["exp_avg_sq"] for state in states]
        # One number of steps for each parameter, in one tensor: one addition counts them all.
        self._count = torch.stack([state["step"] for state in states])
        self._counts = list(self._count.unbind())
        for state, count in zip(states, self._counts, strict=True):
            state["step"] = count

    def step(self, parameters: Sequence[nn.Parameter]) -> bool:
        """Take one step.

        Args:
            parameters: those that have a gradient now, in the same order.

        Returns:
            Whether it was taken: not where other parameters have a gradient than before.
        """
        if len(parameters) != len(self._parameters) or any(
            a is not b for a, b in zip(parameters, self._parameters, strict=True)
        ):
            return False
        group = self._group
        beta1, beta2 = group["betas"]
        self._count += 1
        with torch.no_grad():
            torch._fused_adam_(
                self._parameters,
                [parameter.grad for parameter in parameters if parameter.grad is not None],
                self._means,
                self._squares,
                [],
                self._counts,
                amsgrad=False,
                lr=group["lr"],
                beta1=beta1,
                beta2=beta2,
                weight_decay=group["weight_decay"],
                eps=group["eps"],
                maximize=False,
            )
        return True
