"""Conditions of an evaluation: what does not arrive or is wrong, written as text."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor
from training.config import GROUPINGS, choice, missingness_kind, missingness_name
from training.errors import UserError

from evaluation.sensor_choice import kept_sensors
from evaluation.trained import TrainedAgent
from torchrl_drbpn.functional import outage_rates

_MECHANISMS = ("none", "mcar", "mar", "nmar")
_SELECTIONS = ("model", "random")


@dataclass(frozen=True)
class Condition:
    """What an agent is evaluated under; what it does not name stays as in training.

    ``name`` reads back to the same condition; ``family`` is its part before the first colon. A
    ``ratio`` of the sensors is taken away for good, by ``selection``: model, random, or empty
    (none).
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


def parse_condition(text: str, settings: DictConfig, *, spike_std: float) -> Condition:
    """Read a condition such as ``mcar:0.5``, see conf/evaluate.yaml.

    What the text does not name stays as in ``settings``, the configuration of the run;
    ``spike_std`` is the deviation of spikes where the text gives none, raw units.
    """
    missing, noise = settings.missingness, settings.noise
    match text.split(":"):
        case ["trained"]:
            return Condition(missingness_name(missing), missingness_kind(missing), missing, noise)
        case ["noise", level] if (sigma := _number(level)) is not None:
            return Condition(f"noise:{sigma:g}", "noise", missing, _with(noise, sigma=sigma))
        case ["spikes", share, *rest] if (p := _number(share, 1.0)) is not None and len(rest) < 2:
            std = _number(rest[0]) if rest else spike_std
            if std is not None:
                spiked = _with(noise, spike_probability=p, spike_std=std)
                return Condition(f"spikes:{p:g}:{std:g}", "spikes", missing, spiked)
        case ["stuck", share, *rest] if (p := _number(share, 1.0)) is not None and len(rest) < 3:
            length, by = _number(rest[0]) if rest else 20.0, rest[1] if rest[1:] else "sensor"
            if length is not None and length >= 1 and by in GROUPINGS:
                stuck = {"stuck_probability": p, "stuck_mean_length": length, "group_by": by}
                frozen = _with(noise, **stuck, id="${env.id}", version="${env.version}")
                return Condition(f"stuck:{p:g}:{length:g}:{by}", "stuck", missing, frozen)
        case ["drift", level, *rest] if (std := _number(level)) is not None and len(rest) < 2:
            rate = _number(rest[0], least=-math.inf) if rest else 0.0
            if rate is not None:
                drifting = _with(noise, drift_std=std, drift_rate=rate)
                return Condition(f"drift:{std:g}:{rate:g}", "drift", missing, drifting)
        case ["delay", level, *rest] if (least := _whole(level)) is not None and len(rest) < 4:
            most, by = _whole(rest[0]) if rest else least, rest[1] if rest[1:] else "sensor"
            if (
                most is not None
                and most >= least
                and by in GROUPINGS
                and rest[2:] in ([], ["in_order"])
            ):
                random = {"max_delay": most, "group_by": by} if rest else {}
                late = choice(
                    "missingness", "delay", delay=least, in_order=bool(rest[2:]), **random
                )
                return Condition(missingness_name(late), "delay", late, noise)
        case ["multi_rate", level, *rest] if (n := _whole(level)) and len(rest) < 3:
            by, phase = rest[0] if rest else "sensor", _whole(rest[1]) if rest[1:] else None
            if by in GROUPINGS and (not rest[1:] or (phase is not None and phase < n)):
                rated = choice("missingness", "multi_rate", period=n, phase=phase, group_by=by)
                return Condition(missingness_name(rated), "multi_rate", rated, noise)
        case ["reduction", share, by] if (r := _number(share, 1.0)) is not None:
            if by in _SELECTIONS:
                nothing = choice("missingness", "none")
                return Condition(f"reduction:{r:g}:{by}", "reduction", nothing, noise, r, by)
        case ["outages", share, length, *rest] if len(rest) < 2:
            eta, mean, by = _number(share, 1.0), _number(length), rest[0] if rest else "sensor"
            if eta is not None and mean is not None and by in GROUPINGS:
                out = choice("missingness", "outages", eta=eta, mean_length=mean, group_by=by)
                try:
                    outage_rates(eta, mean)
                except ValueError as error:
                    raise UserError(f"missingness=outages: {error}") from error
                return Condition(missingness_name(out), "outages", out, noise)
        case [family, share] if family in _MECHANISMS and (eta := _number(share, 1.0)) is not None:
            changed = _mechanism(family, eta, missing)
            return Condition(missingness_name(changed), family, changed, noise)
    raise UserError(
        "`points` must hold trained or mechanism:eta such as mcar:0.5, with one of none, mcar, "
        "mar, nmar and eta in [0, 1], outages:eta:mean_length[:sensor, joint or kind], "
        "delay:steps[:most[:sensor, joint or kind[:in_order]]], "
        "multi_rate:period[:sensor, joint or kind[:phase]], "
        "reduction:ratio:model or random, noise:sigma, spikes:probability[:std], "
        "stuck:probability[:mean_length[:sensor, joint or kind]] or drift:std[:rate]; "
        f"got {text!r}."
    )


def parse_conditions(
    texts: Sequence[Any], settings: DictConfig, *, spike_std: float
) -> list[Condition]:
    """Read conditions; one that comes twice, under two names perhaps, is one."""
    read = [parse_condition(str(text), settings, spike_std=spike_std) for text in texts]
    return list({condition.name: condition for condition in read}.values())


def default_conditions(
    levels: Mapping[str, Sequence[Any]], *, full: bool, model: bool
) -> list[str]:
    """Return the conditions of an evaluation that names none, as text.

    ``levels`` is ``grid`` of conf/evaluate.yaml (ratio 0, the same in every family, counts once),
    ``full`` whether to go beyond MCAR, MAR and sensor reduction, ``model`` whether the agent has a
    model that can choose sensors.
    """
    ratios = [ratio for ratio in levels["ratios"] if ratio > 0]
    out = ["none:0"] if len(ratios) < len(levels["ratios"]) else []
    out += [f"{f}:{r:g}" for f in ("mcar", "mar", "nmar")[: 3 if full else 2] for r in ratios]
    out += [f"reduction:{r:g}:{by}" for by in _SELECTIONS[0 if model else 1 :] for r in ratios]
    if full:
        out += [
            f"outages:{ratio:g}:{length:g}:{by}"
            for ratio in levels["outage_ratios"]
            for by in levels["outage_groups"]
            for length in levels["outage_lengths"]
            # there is no chain that is off so much of the time and comes back so soon
            if ratio < 1 and length >= max(1.0, ratio / (1 - ratio) - 1e-9)
        ]
        out += [f"noise:{sigma:g}" for sigma in levels["noise_sigmas"]]
        out += [f"spikes:{probability:g}" for probability in levels["spike_probabilities"]]
        out += [f"stuck:{probability:g}" for probability in levels["stuck_probabilities"]]
        out += [f"drift:{std:g}" for std in levels["drift_stds"]]
        out += [f"delay:{steps}" for steps in levels["delays"]]
        out += [f"multi_rate:{period}" for period in levels["periods"]]
    return out


def removed_sensors(
    condition: Condition, trained: TrainedAgent, *, episodes: int, reduction_seed: int
) -> Tensor | None:
    """Return the sensors that a condition takes away for good, ``(episodes, obs)``; None: none.

    At random, every episode lacks sensors of its own: a mean over episodes is one over choices too.
    The order in which an episode loses sensors is drawn from ``reduction_seed`` and its number
    alone, so that every agent of a task meets the same choices, and those of a smaller ratio are
    among those of a larger one. By the agent's model, one choice holds for every episode.
    """
    if not condition.selection:
        return None
    if not isinstance(reduction_seed, int) or reduction_seed < 0:
        raise UserError(f"`reduction_seed` must be a whole number from 0, got {reduction_seed!r}.")
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


def _with(node: DictConfig, **values: Any) -> DictConfig:
    """Return a node of the configuration with other or further values."""
    return OmegaConf.create({str(key): node[key] for key in node} | values)


def _mechanism(family: str, eta: float, trained: DictConfig) -> DictConfig:
    """Return missingness of another family; what both have stays as in training."""
    node = choice("missingness", family, **({} if family == "none" else {"eta": eta}))
    for key in ("always_observed", "mechanism_seed"):
        if key in node and key in trained:
            node[key] = trained[key]
    return node


def _whole(text: str) -> int | None:
    """Read a whole number from 0; None where there is none."""
    return int(text) if text.isdecimal() else None


def _number(text: str, most: float = math.inf, *, least: float = 0.0) -> float | None:
    """Read a number from ``least`` to ``most``; None where there is none."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if least <= value <= most and math.isfinite(value) else None
