"""A belief module of one's own: every sensor's moving average, and how much stands behind it."""

from __future__ import annotations

import torch
from beliefs import OBSERVATION, Belief
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torchrl.data import Unbounded
from torchrl.envs import TensorDictPrimer
from torchrl.modules.tensordict_module.rnn import recurrent_mode

SUM, WEIGHT = ("recurrent", "sum"), ("recurrent", "weight")


class MovingAverage(TensorDictModuleBase):
    """Average what each sensor delivered; older readings count less, missing ones not at all.

    weight = decay weight + observed, sum = decay sum + observed x, average = sum / (weight + prior)

    Args:
        obs_dim: components of an observation.
        init_decay: what a reading still counts a step later, in (0, 1), at the start; learned.
        prior: readings that the value 0 (the running mean) counts as, positive.
    """

    def __init__(self, obs_dim: int, *, init_decay: float, prior: float) -> None:
        super().__init__()
        if not 0 < init_decay < 1 or not prior > 0:
            raise ValueError(
                "`init_decay` must lie in (0, 1) and `prior` be positive, "
                f"got {init_decay} and {prior}."
            )
        self.raw_decay = torch.nn.Parameter(torch.full((obs_dim,), init_decay).logit())
        self.prior = prior
        self.in_keys = [OBSERVATION, "observed", "is_init", SUM, WEIGHT]
        self.out_keys = ["features", ("next", *SUM), ("next", *WEIGHT)]

    def make_tensordict_primer(self) -> TensorDictPrimer:
        """Say what the memory looks like: zeros at the start of an episode."""
        spec = Unbounded(self.raw_decay.shape)
        return TensorDictPrimer({SUM: spec, WEIGHT: spec.clone()}, expand_specs=True)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write features and memory: one step, or the last batch dimension as time."""
        keys = (OBSERVATION, "observed", "is_init", SUM, WEIGHT)
        x, observed, is_init, total, weight = (tensordict.get(key) for key in keys)
        decay = self.raw_decay.sigmoid()
        seen = observed.to(x.dtype)
        if not recurrent_mode():
            total, weight = self._step(decay, is_init, total, weight, seen * x, seen)
        else:
            # The state stored at the first step is where the row begins, in mid-episode perhaps.
            step, states = (total.select(-2, 0), weight.select(-2, 0)), []
            for t in range(x.shape[-2]):
                now = (v.select(-2, t) for v in (seen * x, seen))
                step = self._step(decay, is_init.select(-2, t), *step, *now)
                states.append(step)
            total, weight = (torch.stack(values, -2) for values in zip(*states, strict=True))
        average = total / (weight + self.prior)
        tensordict.set("features", torch.cat([average, weight], -1))
        return tensordict.set(("next", *SUM), total).set(("next", *WEIGHT), weight)

    def _step(
        self,
        decay: torch.Tensor,
        is_init: torch.Tensor,
        total: torch.Tensor,
        weight: torch.Tensor,
        reading: torch.Tensor,
        seen: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        kept = torch.where(is_init, 0.0, decay)
        return kept * total + reading, kept * weight + seen


def build(*, obs_dim: int, action_dim: int, init_decay: float, prior: float) -> Belief:
    """Build the belief from the sizes of the task and its entry in conf/belief."""
    del action_dim  # it reads no action
    module = MovingAverage(obs_dim, init_decay=init_decay, prior=prior)

    def summary() -> dict[str, float]:
        return {"decay": module.raw_decay.detach().sigmoid().mean().item()}

    return Belief(module, feature_dim=2 * obs_dim, summary=summary)
