"""Running statistics that a transform owns: shared by the observation and the return scaling."""

from __future__ import annotations

import copy
import math
from typing import Any, Self, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import EnvBase, Transform

from torchrl_drbpn.functional.running import learn_native, scale_native, takes_native
from torchrl_drbpn.functional.statistics import Moments, masked_moments, variance
from torchrl_drbpn.transforms._common import OrderedTransform

__all__ = ["RunningMoments", "RunningScaleTransform"]

# Under two samples `variance` gives 1.
_ENOUGH = 2.0


class RunningMoments(nn.Module):
    """Keep count, mean and squared deviations per component, and the scale they give.

    The buffers have shape `(0,)` until the first use or the first loaded state fixes the shape.
    They are replaced, not written in place, so that a state_dict taken earlier stays what it was.

    Args:
        eps: added to the variance before its root is taken, squared units.
    """

    count: Tensor
    mean: Tensor
    m2: Tensor
    inverse_scale: Tensor

    def __init__(self, eps: float) -> None:
        super().__init__()
        self.eps = eps
        # Once every component has been seen twice its variance needs no special case any more.
        self._settled = False
        for name in ("count", "mean", "m2"):
            self.register_buffer(name, torch.zeros(0, dtype=torch.float64))
        # Derived, hence not saved: what the hot path multiplies with.
        self.register_buffer("inverse_scale", torch.zeros(0, dtype=torch.float64), persistent=False)

    def initialise(self, event_shape: torch.Size, device: torch.device | None = None) -> None:
        """Fix the shape, with nothing seen; do nothing where it is fixed already.

        Args:
            event_shape: shape of one sample.
            device: where the statistics live.

        Raises:
            ValueError: statistics of another shape are present.
        """
        if self.count.shape != event_shape:
            if self.count.numel():
                raise ValueError(
                    f"the running statistics are those of entries of shape "
                    f"{tuple(self.count.shape)}, got {tuple(event_shape)}. Do they belong to "
                    "another environment? Use a new transform."
                )
            zero = torch.zeros(event_shape, dtype=torch.float64, device=device)
            self._store(Moments(zero, zero.clone(), zero.clone()))

    def learn(self, value: Tensor, observed: Tensor | None, rows: Tensor | None = None) -> bool:
        """Merge the observed entries of a batch into the statistics.

        Args:
            value: shape `(*batch, *event)`, floating point.
            observed: shape `(*batch, *event)`, bool; None counts every entry.
            rows: shape `(*batch,)`, bool; None counts every row.

        Returns:
            False where an observed entry is NaN or infinite; nothing was learned then.
        """
        buffers = self._buffers
        count = cast(Tensor, buffers["count"])
        # A differentiable environment must not be remembered for ever.
        value = value.detach()
        if self._takes_native(value, observed) and (
            rows is None or (rows.dtype is torch.bool and rows.is_contiguous())
        ):
            before = Moments(count, cast(Tensor, buffers["mean"]), cast(Tensor, buffers["m2"]))
            after = learn_native(before, value, observed, rows, self.eps)
            if after is None:
                return False
            buffers["count"], buffers["mean"], buffers["m2"] = after.moments
            buffers["inverse_scale"] = after.inverse_scale
            return True
        if rows is not None:
            spread = rows.reshape(*rows.shape, *(1,) * count.ndim).expand_as(value)
            observed = spread if observed is None else observed & spread
        if value.ndim != count.ndim + 1:
            shape = (-1, *count.shape)
            value = value.reshape(shape)
            observed = None if observed is None else observed.reshape(shape)
        if observed is None:
            batch = masked_moments(value)
        else:
            # masked_moments, operation by operation, without its checks and with fewer copies: at
            # every step of every environment the number of operations is what is paid for.
            weight = observed.double()
            n = weight.sum(0)
            filled = value.double().masked_fill(observed.logical_not(), 0.0)
            mean = filled.sum(0).div_(n.clamp_min(1.0))
            deviation = filled.sub_(mean).mul_(weight)
            batch = Moments(n, mean, torch.linalg.vecdot(deviation, deviation, dim=0))
        # One scalar leaves the device. It is worth it: a single NaN would spoil the mean for good.
        if not math.isfinite(batch.m2.sum().item()):
            return False
        # merge_moments likewise; the batch's own tensors are written over.
        total = count + batch.n
        delta = batch.mean.sub_(cast(Tensor, buffers["mean"]))
        share = batch.n.div_(total if self._settled else total.clamp_min(1.0))
        shift = share.mul_(delta)
        m2 = batch.m2.add_(cast(Tensor, buffers["m2"])).addcmul_(delta.mul_(count), shift)
        self._store(Moments(total, shift.add_(cast(Tensor, buffers["mean"])), m2))
        return True

    def scale(
        self,
        value: Tensor,
        observed: Tensor | None,
        *,
        clip: float | None,
        centred: bool = True,
    ) -> Tensor:
        """Return clip((value - mean) / sqrt(var + eps), -clip, clip).

        Args:
            value: shape `(*batch, *event)`, floating point.
            observed: shape `(*batch, *event)`, bool: 0 where it is False; None: no such entry.
            clip: largest magnitude; None for no limit.
            centred: whether the mean is subtracted.

        Returns:
            Shape and dtype of `value`.
        """
        mean = cast(Tensor, self._buffers["mean"])
        inverse_scale = cast(Tensor, self._buffers["inverse_scale"])
        if self._takes_native(value, observed):
            return scale_native(value, observed, mean if centred else None, inverse_scale, clip)
        scaled = (value.double() - mean if centred else value.double()) * inverse_scale
        if clip is not None:
            scaled = scaled.clamp_(-clip, clip)
        if observed is not None:
            scaled = scaled.masked_fill_(observed.logical_not(), 0.0)
        return scaled.to(value.dtype)

    def _takes_native(self, value: Tensor, observed: Tensor | None) -> bool:
        # C reads addresses: what a cast or a move of the module may have changed is looked at.
        scale = cast(Tensor, self._buffers["inverse_scale"])
        return (
            scale.dtype is torch.float64
            and scale.device == value.device
            and value.shape[value.ndim - scale.ndim :] == scale.shape
            and takes_native(value, observed)
        )

    def _store(self, moments: Moments) -> None:
        # Straight into the dictionary: nn.Module's own __setattr__ costs as much as the arithmetic.
        buffers = self._buffers
        buffers["count"], buffers["mean"], buffers["m2"] = moments
        if self._settled:
            scale = moments.m2 / moments.n
        else:
            scale = variance(moments)
            self._settled = moments.n.numel() > 0 and bool(moments.n.amin() >= _ENOUGH)
        buffers["inverse_scale"] = scale.add_(self.eps).rsqrt_()

    def _load_from_state_dict(
        self, state_dict: dict[str, Any], prefix: str, *args: Any, **kwargs: Any
    ) -> None:
        # A fresh transform takes the saved shape; an empty saved state clears a shaped one.
        saved = state_dict.get(prefix + "count")
        if saved is not None:
            # New tensors, so that a state_dict taken earlier is not written over.
            self._settled = False
            shape = self.count.shape if self.count.numel() else saved.shape
            self._store(Moments(*self.count.new_zeros(3, *shape)))
            if not saved.numel():
                state_dict = dict(state_dict)
                for name in ("count", "mean", "m2"):
                    state_dict[prefix + name] = getattr(self, name)
        super()._load_from_state_dict(state_dict, prefix, *args, **kwargs)
        self._store(Moments(self.count, self.mean, self.m2))


class RunningScaleTransform(OrderedTransform):
    """Own one set of running moments for every in_key; freeze them, copy them, guard them.

    Copies go their own way from the present statistics: `clone()` learns on, `frozen_copy()` does
    not. Wrapping a `TransformedEnv` in another makes TorchRL clone the transforms, so read the
    statistics from the environment's own transform then.
    """

    moments: nn.ModuleList
    # The same objects as in `moments`, in a plain list, which is quicker to index at every step.
    _running: list[RunningMoments]

    def __init__(self, in_keys: Any, out_keys: Any, *, clip: float | None, eps: float) -> None:
        super().__init__(in_keys=in_keys, out_keys=out_keys)
        name = type(self).__name__
        if len(self.in_keys) != len(self.out_keys) or not self.in_keys:
            raise ValueError(
                f"`out_keys` of {name} must name one key for every one of the {len(self.in_keys)} "
                f"in_keys, at least one, got {len(self.out_keys)}."
            )
        if clip is not None and not clip > 0:
            raise ValueError(f"`clip` must be positive, or None for no clipping, got {clip}.")
        if not (eps > 0 and math.isfinite(eps)):
            raise ValueError(f"`eps` must be positive and finite, got {eps}.")
        self.clip = clip
        self.eps = eps
        self._frozen = False
        self._collector_checked = False
        self._running = [RunningMoments(eps) for _ in self.in_keys]
        self.moments = nn.ModuleList(self._running)

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attach the transform after checking the order rules.

        Args:
            container: the environment or the `Compose` that takes the transform.
        """
        super().set_container(container)
        self._collector_checked = False

    @property
    def frozen(self) -> bool:
        """Tell whether the statistics are kept as they are."""
        return self._frozen

    def freeze(self) -> Self:
        """Stop learning: scale with the present statistics from now on.

        Returns:
            The transform itself.
        """
        self._frozen = True
        return self

    def unfreeze(self) -> Self:
        """Learn again.

        Returns:
            The transform itself.
        """
        self._frozen = False
        return self

    def frozen_copy(self) -> Self:
        """Copy the transform with its present statistics, frozen, for another environment.

        Returns:
            A transform without a parent that shares no state with this one.
        """
        return self.clone().freeze()

    def clone(self) -> Self:
        """Copy the transform with its present statistics, without a parent.

        Returns:
            A transform that shares no state with this one.
        """
        twin: Self = super().clone()
        twin._running = copy.deepcopy(self._running)
        twin.moments = nn.ModuleList(twin._running)
        return twin

    def _check_batched_worker_compat(self) -> None:
        if not self._frozen:
            raise RuntimeError(
                f"{type(self).__name__} cannot learn inside a SerialEnv or ParallelEnv: every "
                "worker would keep statistics of its own and they would drift apart. Put one "
                "instance around the batched environment, TransformedEnv(ParallelEnv(...), "
                f"{type(self).__name__}(...)), or put a frozen_copy() into the workers."
            )

    def _check_collector(self) -> None:
        # A collector in a worker process knows its index; one in the main process has None.
        if self._frozen or self._collector_checked:
            return
        collector = getattr(self.container, "collector", None)
        # Looking it up goes through every wrapper of the environment: once a container is enough.
        self._collector_checked = collector is not None
        if getattr(collector, "worker_idx", None) is not None:
            raise RuntimeError(
                f"{type(self).__name__} cannot learn in the worker processes of a multi-process "
                "collector: every process would keep statistics of its own and the agent would be "
                "saved without them. Collect with one torchrl.collectors.Collector over a batched "
                "environment, or give the workers a frozen_copy()."
            )

    def _moments_for(self, index: int, value: Tensor, batch_dims: int) -> RunningMoments:
        """Return the moments of an in_key, shaped after the entries that it turns out to have."""
        moments = self._running[index]
        event_shape = value.shape[batch_dims:]
        if moments.count.shape != event_shape:
            if self._frozen and not moments.count.numel():
                raise RuntimeError(
                    f"{type(self).__name__} is frozen but has no statistics: it would leave "
                    f"`{self.in_keys[index]}` as it is. Freeze it after it has learned, or load a "
                    "state. A Collector may hold a copy of the environment that it was given: the "
                    "statistics are then those of `collector.env`."
                )
            moments.initialise(event_shape, value.device)
        return moments

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Scale stored data with frozen statistics; refuse where they are not frozen.

        Args:
            tensordict: data in its raw units; the in_keys found in it and under `"next"` are
                scaled.

        Returns:
            The tensordict with the out_keys written.

        Raises:
            NotImplementedError: the transform is not frozen. Samples are drawn from a buffer many
                times over, so learning from them would count each many times.
        """
        if not self._frozen:
            raise NotImplementedError(
                f"{type(self).__name__} learns while an environment steps and would count stored "
                "samples many times over. For stored raw data use its frozen_copy(); data that was "
                "collected through the transform is scaled already."
            )
        following = tensordict.get("next", None)
        for part in (tensordict,) if following is None else (tensordict, following):
            self._scale(part)
        return tensordict

    def _scale(self, tensordict: TensorDictBase) -> None:
        """Write the out_keys with the present statistics."""
        raise NotImplementedError
