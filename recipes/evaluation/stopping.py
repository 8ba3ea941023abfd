"""Decisions of an agent under test: a belief that diverges ends its own episode, no other's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from training.agent import Agent

from evaluation.episodes import only_rows

# Of features. Observations are normalised: a million deviations from all that was ever seen is no
# belief any more, and on its way to infinity.
_FARTHEST = 1e6


class StoppingPolicy(TensorDictModuleBase):
    """Write what ``agent.policy`` writes; where the belief has diverged, zero actions to the end.

    Without its sensors a learned transition runs open loop and need not be stable: the belief may
    leave the range of its numbers. In training that is an error. Under test it is a result: the
    robot gets no more torque, ``diverged`` says so, and the other episodes go on.

    Args:
        agent: whose modules decide.
    """

    def __init__(self, agent: Agent) -> None:
        super().__init__()
        self.belief, self.actor = agent.belief, agent.actor
        self.in_keys = list(agent.policy.in_keys)
        self.out_keys = [*agent.policy.out_keys, "diverged"]
        self._stopped: Tensor | None = None

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write belief, action and ``diverged``, bool of shape ``(episodes, 1)``.

        Args:
            tensordict: root entries of the environment, of batch size ``(episodes,)``.

        Returns:
            The same tensordict.
        """
        with _unchecked(self.belief):
            tensordict = self.belief(tensordict)
        written = {key: tensordict.get(key) for key in self.belief.out_keys}
        numbers = {key: v for key, v in written.items() if v.is_floating_point()}
        finite = torch.stack(
            [v.isfinite().reshape(len(v), -1).all(1) for v in numbers.values()]
        ).all(0)
        near = tensordict.get("features").abs().amax(-1, keepdim=True) < _FARTHEST
        stopped = ~(finite.unsqueeze(-1) & near)  # NaN is not near
        if self._stopped is not None:
            stopped = stopped | (self._stopped & ~tensordict.get("is_init"))
        self._stopped = stopped
        any_stopped = bool(stopped.any())
        if any_stopped:
            # The row starts from zeros again, so that what reads it need not bear NaN.
            for key, value in numbers.items():
                tensordict.set(key, only_rows(~stopped, value))
        tensordict = self.actor(tensordict)
        if any_stopped:
            tensordict.set("action", only_rows(~stopped, tensordict.get("action")))
        return tensordict.set("diverged", stopped)


@contextmanager
def _unchecked(belief: nn.Module) -> Iterator[None]:
    """Let a belief write what is not finite, in the place of an error."""
    checking: list[Any] = [m for m in belief.modules() if getattr(m, "validate", False)]
    for part in checking:
        part.validate = False
    try:
        yield
    finally:
        for part in checking:
            part.validate = True
