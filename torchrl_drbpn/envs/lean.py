"""A transformed batch of simulators whose step costs less Python."""

from __future__ import annotations

from tensordict import TensorDictBase
from torchrl.envs import Compose, Transform, TransformedEnv

from torchrl_drbpn.envs.batched import BatchedSimulators
from torchrl_drbpn.envs.stepping import Plan

__all__ = ["LeanTransformedEnv"]


class LeanTransformedEnv(TransformedEnv):
    """Step a transformed batch of simulators as ``TransformedEnv`` does, in less time.

    The same keys, values, order of calls and random numbers: only the Python around the transforms
    is shorter in ``step_and_maybe_reset``, which collectors and ``rollout`` call. What is out of
    the ordinary (another base environment than this package's batches, nested rewards or flags,
    ``"_step"`` masks, hooks after the step, entries that are neither tensors nor TensorDicts)
    goes the way of ``TransformedEnv``.

    Args:
        base_env: the batch of simulators.
        transform: as for ``TransformedEnv``.
        **kwargs: as for ``TransformedEnv``.

    Example:
        >>> import torch
        >>> from torchrl.envs import Compose, InitTracker, StepCounter, TransformedEnv
        >>> from torchrl_drbpn.envs import GymnasiumBatchEnv
        >>> def rollout(cls):
        ...     env = cls(GymnasiumBatchEnv("InvertedPendulum-v5", 3, seed=0),
        ...               Compose(StepCounter(), InitTracker()))
        ...     _ = torch.manual_seed(0)
        ...     return env.rollout(50, break_when_any_done=False)
        >>> bool((rollout(LeanTransformedEnv) == rollout(TransformedEnv)).all())
        True

    See also :class:`torchrl.envs.TransformedEnv`.
    """

    _plan: Plan | None = None

    def empty_cache(self) -> None:
        """Forget what was derived from the specs and the transforms."""
        super().empty_cache()
        self.__dict__["_plan"] = None

    def _step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        # Straight into the dictionaries: nn.Module's attributes cost a microsecond each.
        modules = self.__dict__["_modules"]
        transform: Transform = modules["_transform"]
        whole = type(transform) is Compose
        parts = list(transform.transforms._modules.values()) if whole else [transform]
        plan = self.__dict__.get("_plan")
        if plan is None or plan.parts != parts:
            plan = Plan(self, self.base_env, parts)
            plan.usable &= isinstance(self.base_env, BatchedSimulators)
            self.__dict__["_plan"] = plan
        if plan.usable and plan.takes(tensordict):
            return plan(tensordict)
        return super()._step_and_maybe_reset(tensordict)
