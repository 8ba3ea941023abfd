"""Bring observations with missing entries to zero mean and unit variance, learning on the way."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, cast

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import EnvBase, Transform

from torchrl_drbpn.transforms._carried import flagged_rows
from torchrl_drbpn.transforms._common import (
    Role,
    as_key_list,
    fetch,
    observation_leaf,
    pair_keys,
    read,
    store,
    transform_chain,
    unbounded_like,
)
from torchrl_drbpn.transforms._running import RunningScaleTransform

__all__ = ["MaskedObservationNorm"]


class MaskedObservationNorm(RunningScaleTransform):
    r"""Normalise observations by the running mean and variance of their observed entries.

    With n, mean and var over every entry of a component observed so far (population variance,
    [Chan, Golub, LeVeque 1979]), the entry of this step included:

        normalised = clip((x - mean) / sqrt(var + eps), -clip, clip),  0 where x is missing.

    A component with fewer than two observed entries keeps its own scale. The statistics are kept
    in float64 and learn from every observation once: from `step`, and at a reset from the rows
    that are reset. They pool over all batch dimensions. Missing entries never enter, whatever they
    hold. A complete observation in the tensordict is scaled with the same statistics, which do
    not learn from it.

    One instance belongs around a batched environment; in workers it may only be used frozen. The
    statistics are in `state_dict()`, tensors only. What was filled in by a `FillLastObserved`
    earlier in the chain is scaled like the rest instead of being set to 0, and not learned from.

    Args:
        in_keys: observations, shape `(*batch, obs)`, floating point. Default `"observation"`.
        mask_keys: one mask per observation, bool, shape `(*batch, obs)`, True where observed.
            Default `"observed"` beside each observation. A mask that is not in the tensordict
            means that everything was observed.
        out_keys: where to write. Default in place.

    Keyword Args:
        complete_keys: one complete observation per observation, scaled in place where present.
            Default `"complete_observation"` beside each observation.
        clip: largest magnitude of a normalised entry, in standard deviations; None for no limit.
        eps: added to the variance, squared observation units.

    Raises:
        ValueError: numbers of keys that do not match, `clip` or `eps` not positive, or the
            transform stands before a corrupting one.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> norm = MaskedObservationNorm()
        >>> x = torch.randn(64, 3) * 5 + 100
        >>> seen = torch.rand(64, 3) < 0.7
        >>> x = torch.where(seen, x, torch.nan)
        >>> reset = TensorDict(observation=x, observed=seen, batch_size=64)
        >>> z = norm._reset(reset.empty(), reset)["observation"]
        >>> torch.allclose(z.sum(0) / seen.sum(0), torch.zeros(3), atol=1e-5)
        True
        >>> bool((z[~seen] == 0).all())
        True
    """

    role: ClassVar[Role] = "normalise"

    def __init__(
        self,
        in_keys: NestedKey | Sequence[NestedKey] = "observation",
        mask_keys: NestedKey | Sequence[NestedKey] | None = None,
        out_keys: NestedKey | Sequence[NestedKey] | None = None,
        *,
        complete_keys: NestedKey | Sequence[NestedKey] | None = None,
        clip: float | None = 10.0,
        eps: float = 1e-8,
    ) -> None:
        inputs = as_key_list(in_keys)
        outputs = list(inputs) if out_keys is None else as_key_list(out_keys)
        super().__init__(inputs, outputs, clip=clip, eps=eps)
        self.mask_keys = pair_keys(inputs, mask_keys, name="mask_keys", default="observed")
        self.complete_keys = pair_keys(
            inputs, complete_keys, name="complete_keys", default="complete_observation"
        )
        self._filled: list[bool] | None = None

    # ------------------------------------------------------------------------------- statistics
    @property
    def loc(self) -> Tensor:
        """Running mean of the first in_key, shape `(obs,)`, observation units, float64."""
        return self._running[0].mean

    @property
    def scale(self) -> Tensor:
        """Running sqrt(var + eps) of the first in_key, shape `(obs,)`, observation units."""
        return self._running[0].inverse_scale.reciprocal()

    def denormalize(self, observation: Tensor, key: NestedKey | None = None) -> Tensor:
        """Return normalised values in observation units: x scale + loc, clipping not undone.

        Args:
            observation: normalised values, shape `(*, obs)`.
            key: the in_key they belong to; the first where it is None.

        Returns:
            The same shape and dtype, observation units.

        Raises:
            KeyError: `key` is not an in_key.
        """
        if key is not None and key not in self.in_keys:
            raise KeyError(f"`key` must be one of the in_keys {self.in_keys}, got {key!r}.")
        moments = self._running[0 if key is None else self.in_keys.index(key)]
        if not moments.count.numel():
            raise RuntimeError(
                "MaskedObservationNorm has no statistics yet. Step the environment or load a state."
            )
        value = observation.double() / moments.inverse_scale + moments.mean
        return value.to(observation.dtype)

    # ---------------------------------------------------------------------------- action on data
    def _process(
        self, tensordict: TensorDictBase, flags: TensorDictBase | None, flag: str
    ) -> TensorDictBase:
        """Learn from the rows that `flags` marks (all where None is found) and normalise."""
        learns = flags is not None and not self._frozen
        if self._filled is None:
            self._filled = self._find_filled()
        for index, key in enumerate(self.in_keys):
            value = read(tensordict, key, self)
            moments = self._moments_for(index, value, tensordict.ndim)
            observed = fetch(tensordict, self.mask_keys[index])
            if observed is not None and (
                observed.dtype is not torch.bool or observed.shape != value.shape
            ):
                raise ValueError(
                    f"`{self.mask_keys[index]}` must be bool of shape {tuple(value.shape)}, one "
                    f"entry for every component of {key!r}, got {observed.dtype} of shape "
                    f"{tuple(observed.shape)}. Is it the mask of another observation?"
                )
            if learns:
                rows = flagged_rows(cast(TensorDictBase, flags), flag, key)
                if not moments.learn(value, observed, rows):
                    raise ValueError(
                        f"`{key}` holds NaN or an infinity where {self.mask_keys[index]!r} says "
                        "that it was observed. For sensors that report NaN put ObservedFromNaN "
                        "before MaskedObservationNorm."
                    )
            hidden = None if self._filled[index] else observed
            store(tensordict, self.out_keys[index], moments.scale(value, hidden, clip=self.clip))
            complete = fetch(tensordict, self.complete_keys[index])
            if complete is not None:
                scaled = moments.scale(complete, None, clip=self.clip)
                store(tensordict, self.complete_keys[index], scaled)
        return tensordict

    def _find_filled(self) -> list[bool]:
        filled: set[NestedKey] = set()
        for transform in transform_chain(self):
            if transform is self:
                break
            if getattr(transform, "role", None) == "fill":
                filled.update(transform.out_keys)
        return [key in filled for key in self.in_keys]

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._process(next_tensordict, tensordict, "_step")

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        self._check_collector()
        return self._process(tensordict_reset, tensordict, "_reset")

    def _scale(self, tensordict: TensorDictBase) -> None:
        self._process(tensordict, None, "")

    # ------------------------------------------------------------------------------------- specs
    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Enter the normalised observations as unbounded specs of the same shape.

        Args:
            observation_spec: the spec before the transform.

        Returns:
            The spec after it.
        """
        for index, key in enumerate(self.in_keys):
            leaf = observation_leaf(observation_spec, key, self)
            observation_spec[self.out_keys[index]] = unbounded_like(leaf)
            complete = self.complete_keys[index]
            if complete in observation_spec.keys(True, True):
                observation_spec[complete] = unbounded_like(observation_spec[complete])
        return observation_spec

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attach the transform after checking the order rules.

        Args:
            container: the environment or the `Compose` that takes the transform.

        Raises:
            ValueError: a corrupting transform would come after this one.
        """
        super().set_container(container)
        self._filled = None

    def empty_cache(self) -> None:
        """Forget what was derived from the other transforms."""
        super().empty_cache()
        self._filled = None
