"""Belief modules: each file builds one, each conf/belief entry names one of these builders.

A builder takes the sizes of the task and its own settings, and returns a :class:`Belief`. A new
belief module is a new file here and a new entry in conf/belief; nothing else changes. Both may lie
elsewhere too: docs/new_belief.md.

A belief that has something to say about the sensors offers it by `Belief.observing`: a module with
the same weights that writes, beside everything else, whichever of these it has. All of it is in
normalised units.

- `ESTIMATE`: every sensor without its noise, after this step's observation, shape ``(*, obs)``
- `ESTIMATE_VARIANCE`: how far off it may be, ``(*, obs)``
- `FORECAST`: every sensor's reading before this step's observation, ``(*, obs)``
- `FORECAST_COV`: its covariance, sensor noise included, ``(*, obs, obs)``
- `NOISE_VARIANCE`: of the sensor noise that the belief assumes, ``(*, obs)``
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torchrl.envs import Transform
from torchrl.objectives import LossModule
from training.errors import UserError

ESTIMATE: NestedKey = ("belief", "observation")
ESTIMATE_VARIANCE: NestedKey = ("belief", "observation_variance")
FORECAST: NestedKey = ("belief", "predicted_observation")
FORECAST_COV: NestedKey = ("belief", "innovation_cov")
NOISE_VARIANCE: NestedKey = ("belief", "noise_variance")


@dataclass(frozen=True)
class Belief:
    """What the rest of a recipe has to know about a belief module.

    Attributes:
        module: reads observations, writes ``features``; recurrent ones work one step at a time
            by default and over time under ``set_recurrent_mode(True)``.
        feature_dim: components of ``features``.
        model_loss: the loss of the belief's own model, or None where it has none.
        transforms: makes further environment transforms, right after normalisation.
        summary: numbers worth a column in metrics.csv, asked for once a rollout.
        observing: makes a module with the weights of ``module`` that also writes what the belief
            knows of the sensors (see the top of this file); None where it knows nothing.
    """

    module: TensorDictModuleBase
    feature_dim: int
    model_loss: LossModule | None = None
    transforms: Callable[[], Sequence[Transform]] = tuple
    summary: Callable[[], Mapping[str, float]] = dict
    observing: Callable[[], TensorDictModuleBase] | None = None


def build_belief(
    settings: Mapping[str, Any], *, obs_dim: int, action_dim: int, normalize: str
) -> Belief:
    """Call the builder that a conf/belief entry names.

    Args:
        settings: the entry: ``_target_`` (module and function), ``name``, and what else the
            builder takes.
        obs_dim: components of an observation.
        action_dim: components of an action.
        normalize: what a model likelihood is divided by, ``entry`` or ``step``.

    Returns:
        The belief.

    Raises:
        UserError: if there is no such builder, or its settings are refused.
    """
    path, _, function = str(settings.get("_target_", "")).rpartition(".")
    try:
        builder = getattr(importlib.import_module(path), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise UserError(
            f"`belief._target_` must name a builder such as beliefs.drbpn.build, "
            f"got {settings.get('_target_')!r}."
        ) from error
    own = {k: v for k, v in settings.items() if k not in ("_target_", "name")}
    try:
        return builder(obs_dim=obs_dim, action_dim=action_dim, normalize=normalize, **own)
    except (TypeError, ValueError) as error:
        raise UserError(f"`belief={settings.get('name')}`: {error}") from error
