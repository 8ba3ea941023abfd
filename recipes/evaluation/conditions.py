"""Conditions of an evaluation: what does not arrive or is wrong, written as text."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from training.config import build, choice
from training.errors import UserError

from evaluation.points import (
    FAULTS,
    FIELDS,
    condition_name,
    missingness_kind,
    missingness_name,
    read_fields,
)
from evaluation.sensor_choice import kept_sensors
from evaluation.trained import TrainedAgent

_MECHANISMS = ("none", "mcar", "mar", "nmar")


@dataclass(frozen=True)
class Condition:
    """What an agent is evaluated under; ``name`` reads back to the same condition.

    A ``ratio`` of the sensors is taken away for good, by ``selection``: model, random, or "".
    """

    name: str
    family: str
    missingness: DictConfig
    noise: DictConfig
    ratio: float = 0.0
    selection: str = ""

    def columns(self) -> dict[str, Any]:
        """Return the columns of a table that describe it; None where one does not apply."""
        missing, noise = self.missingness, self.noise
        kind, std = missingness_kind(missing), noise.get("spike_std")
        return {
            "point": self.name,
            "family": self.family,
            "mechanism": kind,
            "eta": missing.get("eta"),
            "mechanism_seed": missing.get("mechanism_seed"),
            "mean_length": missing.get("mean_length"),
            "group_by": missing.get("group_by"),
            "removed_ratio": self.ratio if self.selection else None,
            "removed_by": self.selection or None,
            "noise_sigma": noise.sigma,
            "spike_probability": noise.get("spike_probability", 0.0),
            "spike_std": std if noise.get("spike_probability") else None,
        }


def parse_condition(text: str, settings: DictConfig) -> Condition:
    """Read a condition such as ``mcar:0.5``, see conf/evaluate.yaml.

    What the text does not name stays as in ``settings``, the configuration of the run.
    """
    missing, noise = settings.missingness, settings.noise
    if text == "trained":
        return Condition(missingness_name(missing), missingness_kind(missing), missing, noise)
    family, *words = text.split(":")
    values = read_fields(family, words)
    if values is None:
        raise UserError(
            f"`points` must hold trained, or one of {', '.join(FIELDS)} with its numbers, such as "
            f"mcar:0.5 (conf/evaluate.yaml shows each), got {text!r}."
        )
    if family in ("noise", *FAULTS):
        name = condition_name(family, values)
        task = {"id": "${env.id}", "version": "${env.version}"} if "group_by" in values else {}
        noise = OmegaConf.create({str(key): noise[key] for key in noise} | values | task)
    elif family == "reduction":
        name, missing = condition_name(family, values), choice("missingness", "none")
    else:
        trained = {} if family not in _MECHANISMS else missing
        missing = choice("missingness", family, **({} if family == "none" else values))
        for key in {"always_observed", "mechanism_seed"} & {*missing} & {*trained}:
            missing[key] = trained[key]
        name = missingness_name(missing)
    changed = settings.copy()
    changed.missingness, changed.noise = missing, noise
    try:  # the transforms say what they refuse before any episode
        for group in ("missingness", "noise"):
            build(group, changed[group])
    except UserError as error:
        raise UserError(f"`points` must hold other numbers than {text!r}: {error}") from error
    taken = values if family == "reduction" else {}
    return Condition(name, family, missing, noise, **taken)


def parse_conditions(points: str | Sequence[Any], settings: DictConfig) -> list[Condition]:
    """Read one condition or several; one that comes twice, under two names perhaps, is one."""
    texts = [points] if isinstance(points, str) else points
    if not texts:
        raise UserError("`points` must hold at least one, such as trained or mcar:0.5.")
    read = [parse_condition(str(text), settings) for text in texts]
    return list({condition.name: condition for condition in read}.values())


def default_conditions(
    levels: Mapping[str, Sequence[Any]], *, full: bool, model: bool
) -> list[str]:
    """Return the conditions of an evaluation that names none, as text.

    ``levels`` is ``grid`` of conf/evaluate.yaml; ``model``: whether the agent has a model that can
    choose sensors.
    """
    ratios = [ratio for ratio in levels["ratios"] if ratio > 0]
    out = ["none:0"] if len(ratios) < len(levels["ratios"]) else []  # the same in every family
    mechanisms = ("mcar", "mar", "nmar") if full else ("mcar", "mar")
    out += [f"{mechanism}:{ratio:g}" for mechanism in mechanisms for ratio in ratios]
    selections = ("model", "random") if model else ("random",)
    out += [f"reduction:{ratio:g}:{by}" for by in selections for ratio in ratios]
    if full:
        out += [
            f"outages:{ratio:g}:{length:g}:{by}"
            for ratio in levels["outage_ratios"]
            for by in levels["outage_groups"]
            for length in levels["outage_lengths"]
            # there is no chain that is off so much of the time and comes back so soon
            if ratio < 1 and length >= max(1.0, ratio / (1 - ratio) - 1e-9)
        ]
        rest = {"noise": "noise_sigmas", "spikes": "spike_probabilities", "drift": "drift_stds"}
        rest |= {"stuck": "stuck_probabilities", "delay": "delays", "multi_rate": "periods"}
        out += [f"{family}:{level:g}" for family, key in rest.items() for level in levels[key]]
    return out


def removed_sensors(
    condition: Condition, trained: TrainedAgent, *, episodes: int, reduction_seed: int
) -> Tensor | None:
    """Return the sensors that a condition takes away for good, ``(episodes, obs)``; None: none.

    At random, every episode lacks sensors of its own. The order in which an episode loses sensors
    is drawn from ``reduction_seed`` and its number alone, so that every agent of a task meets the
    same choices, and those of a smaller ratio are among those of a larger one.
    """
    if not condition.selection:
        return None
    count = round(condition.ratio * trained.obs_dim)
    removed = torch.zeros(episodes, trained.obs_dim, dtype=torch.bool)
    if condition.selection == "model":
        removed[:, kept_sensors(trained, trained.obs_dim)[trained.obs_dim - count :]] = True
        return removed
    for episode, row in enumerate(removed):
        # NumPy's generator takes both numbers as its seed; torch's takes one.
        order = np.random.default_rng((reduction_seed, episode)).permutation(trained.obs_dim)
        row[torch.from_numpy(order[:count])] = True
    return removed
