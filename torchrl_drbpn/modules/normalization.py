"""Standardise observations with missing entries by statistics that belong to the agent."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor

from torchrl_drbpn.functional.gaussian import check_observed
from torchrl_drbpn.functional.running_moments import (
    RunningMoments,
    masked_moments,
    merge_moments,
    spread,
    winsorize,
)
from torchrl_drbpn.modules.recurrent_belief import as_keys


class MaskedObservationNorm(TensorDictModuleBase):
    r"""Standardise what arrived by its running mean and deviation; the rest reads 0.

    With mean and var those of the entries of a component learned from so far:

    .. math:: z = clip((x - mean) / \sqrt{var + eps}, -clip, clip), \quad 0 \text{ where missing.}

    It is the first module of a policy, ``TensorDictSequential(norm, belief, actor)``: the
    statistics are buffers, so they are saved, exported, compiled and sent to collectors with it.
    ``forward`` never learns. :meth:`update` does; call it after the epochs on a rollout, since
    before them the policy would no longer be the one that acted. Until then it is the identity up
    to ``clip``. Outliers are clipped before they are learned from, see
    :func:`~torchrl_drbpn.functional.running_moments.winsorize`.

    Args:
        obs_dim: components of an observation.
        clip: largest magnitude of a standardised entry, in deviations; None for no limit.
        eps: added to the variance, squared observation units.
        missing: "zero": an entry that did not arrive reads 0. "keep": it is standardised too,
            whatever it holds, as after ``FillLastObserved(fill_value=float("nan"))``; NaN marks
            an entry not yet seen in the episode, which reads 0.
        in_keys: the observation and its mask, bool, True where an entry arrived. The observation
            alone: all of it arrives.
        out_keys: where to write the standardised observation; not in place.
        complete_keys: a complete observation and where to write it, scaled alike where it is
            there and never learned from. None: not read.
        device, dtype: of the statistics, float64 by default; they are computed in it in any case.

    Raises:
        ValueError: for a number out of range, an unknown ``missing``, keys of the wrong number, an
            output in place.

    Example:
        >>> from tensordict import TensorDict
        >>> x, seen = torch.randn(8, 50, 3) * 5 + 100, torch.rand(8, 50, 3) < 0.7
        >>> rollout = TensorDict(observation=x, observed=seen, batch_size=[8, 50])
        >>> norm = MaskedObservationNorm(3)
        >>> norm.update(rollout)
        >>> z = norm(rollout)["normalized_observation"]
        >>> bool(z[seen].mean().abs() < 1e-4), bool((z[~seen] == 0).all())
        (True, True)
    """

    count: Tensor
    mean: Tensor
    var: Tensor

    def __init__(
        self,
        obs_dim: int,
        *,
        clip: float | None = 10.0,
        eps: float = 1e-8,
        missing: Literal["zero", "keep"] = "zero",
        in_keys: Sequence[NestedKey] = ("observation", "observed"),
        out_keys: Sequence[NestedKey] = ("normalized_observation",),
        complete_keys: tuple[NestedKey, NestedKey] | None = None,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        if obs_dim < 1:
            raise ValueError(f"`obs_dim` must be at least 1, got {obs_dim}.")
        if clip is not None and not clip > 0:
            raise ValueError(f"`clip` must be positive, or None for no clipping, got {clip}.")
        if not (eps > 0 and math.isfinite(eps)):
            raise ValueError(f"`eps` must be positive and finite, got {eps}.")
        if missing not in ("zero", "keep"):
            raise ValueError(f"`missing` must be 'zero' or 'keep', got {missing!r}.")
        inputs = as_keys("in_keys", in_keys)
        outputs = as_keys("out_keys", out_keys)
        if len(inputs) not in (1, 2) or len(outputs) != 1 or None in (*inputs, *outputs):
            raise ValueError(
                "`in_keys` must name an observation and its mask, or an observation alone, and "
                f"`out_keys` one entry, got {inputs} and {outputs}."
            )
        self._observation_key, self._out_key = inputs[0], outputs[0]
        self._observed_key = inputs[1] if len(inputs) == 2 else None
        self._complete_keys: tuple[NestedKey, NestedKey] | None = None
        if complete_keys is not None:
            source, target = as_keys("complete_keys", complete_keys)
            self._complete_keys = source, target
            inputs.append(source)
            outputs.append(target)
        if set(inputs) & set(outputs):
            raise ValueError(
                f"`out_keys` must differ from `in_keys`, got {outputs} and {inputs}: what was read "
                "is learned from later and must stay as it is."
            )
        self.in_keys, self.out_keys = inputs, outputs
        self.obs_dim, self.clip, self.eps, self.missing = obs_dim, clip, float(eps), missing
        dtype = torch.float64 if dtype is None else dtype
        for name, kind in (("count", torch.int64), ("mean", dtype), ("var", dtype)):
            self.register_buffer(name, torch.zeros(obs_dim, dtype=kind, device=device))
        self.register_load_state_dict_pre_hook(_refuse_unusable)

    @property
    def std(self) -> Tensor:
        """Scale sqrt(var + eps), 1 where fewer than two readings were seen, shape ``(obs,)``."""
        return spread(RunningMoments(self.count, self.mean, self.var), self.eps)

    def normalize(self, observation: Tensor, observed: Tensor | None = None) -> Tensor:
        """Return clip((x - mean) / std), 0 where nothing arrived, as a new tensor.

        ``observation`` is ``(*batch, obs)``, observation units; its floating dtype is kept.
        ``observed`` is bool of that shape, None: everything arrived. A ValueError for another.
        """
        self._check(observation, observed)
        absent = None
        if observed is not None:
            absent = ~observed if self.missing == "zero" else ~observed & observation.isnan()
        value = observation.double()
        if absent is not None:
            # Filled before any arithmetic: a NaN would reach the gradient even if it is masked.
            value = torch.where(absent, self.mean, value)
        value = (value - self.mean) / self.std
        if self.clip is not None:
            value = value.clamp(-self.clip, self.clip)
        floating = observation.is_floating_point()
        return value.to(observation.dtype if floating else torch.get_default_dtype())

    def denormalize(self, value: Tensor) -> Tensor:
        """Return x std + mean of deviations ``(*batch, obs)``, in units; clips are not undone."""
        return (value.double() * self.std + self.mean).to(value.dtype)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the standardised observation beside what was read; a complete one may be absent."""
        tensordict.set(self._out_key, self.normalize(*self._read(tensordict)))
        if self._complete_keys is not None:
            source, target = self._complete_keys
            complete = tensordict.get(source, None)
            if complete is not None:
                tensordict.set(target, self.normalize(complete))
        return tensordict

    @torch.no_grad()
    def update(self, tensordict: TensorDictBase) -> None:
        """Learn from a rollout ``(*batch, time)``, raw, every reading that arrived once.

        The readings of each step, and the next one where an episode or the row ends. The first
        reading of a row that continues an episode (``is_init`` is there and False) is left out: it
        was counted as the last of the row before. Without "next" the steps alone count. A
        ValueError for a shape that does not fit, and for a reading that is NaN or infinite.
        """
        if not tensordict.ndim:
            raise ValueError("`tensordict` must be a rollout of batch size (*batch, time), got ().")
        value, observed = self._readings(tensordict)
        following = tensordict.get("next", None)
        if following is not None and self._observation_key in following.keys(True):
            is_init, done = tensordict.get("is_init", None), following.get("done", None)
            if is_init is not None:
                observed[..., 0, :] &= is_init.reshape(tensordict.shape)[..., :1]
            last = torch.zeros(tensordict.shape, dtype=torch.bool, device=value.device)
            if done is not None:
                last |= done.reshape(tensordict.shape)
            last[..., -1:] = True
            readings = zip((value, observed), self._readings(following), strict=True)
            value, observed = (torch.cat([x.flatten(0, -2), y[last]]) for x, y in readings)
        else:
            value, observed = value.flatten(0, -2), observed.flatten(0, -2)
        if not bool((value.isfinite() | ~observed).all()):
            raise ValueError(
                f"`{self._observation_key}` holds NaN or an infinity where "
                f"{self._observed_key!r} says that it arrived. For sensors that report NaN put "
                "ObservedFromNaN into the environment."
            )
        learned = RunningMoments(self.count.double(), self.mean.double(), self.var.double())
        value, observed = winsorize(value, observed, learned, self.eps)
        after = merge_moments(learned, masked_moments(value, observed))
        self.count.copy_(after.n)
        for buffer, field in ((self.mean, after.mean), (self.var, after.var)):
            largest = torch.finfo(buffer.dtype).max
            buffer.copy_(field.clamp(-largest, largest))

    def _readings(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        value, observed = self._read(tensordict)
        self._check(value, observed)
        everything = torch.ones_like(value, dtype=torch.bool)
        return value, everything if observed is None else observed.clone()

    def _check(self, value: Tensor, observed: Tensor | None) -> None:
        if value.shape[-1:] != (self.obs_dim,):
            raise ValueError(
                f"`{self._observation_key}` must have {self.obs_dim} components in its last "
                f"dimension, got shape {tuple(value.shape)}. Is it another robot's?"
            )
        if observed is not None:
            check_observed(value, observed, self._observed_key)

    def _read(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor | None]:
        keys = [key for key in (self._observation_key, self._observed_key) if key is not None]
        found = [tensordict.get(key, None) for key in keys]
        for key, value in zip(keys, found, strict=True):
            if value is None:
                raise KeyError(
                    f"`{key}` is not in the tensordict. Name the entries by in_keys; "
                    "in_keys=[observation] alone means that everything arrives."
                )
        return found[0], found[1] if len(found) == 2 else None


def _refuse_unusable(_: Any, state_dict: Mapping[str, Any], prefix: str, *__: Any) -> None:
    """Refuse numbers that are no statistics; torch itself refuses those of another shape."""
    for name, least in (("count", 0), ("mean", -math.inf), ("var", 0)):
        value = state_dict.get(prefix + name, torch.zeros(0))
        bad = value[~(value.isfinite() & (value >= least))]
        if len(bad):
            raise ValueError(
                f"`{prefix}{name}` holds {bad[0].item()}: that is no statistic of readings. Is the "
                "file damaged?"
            )
