"""Watch a trained agent and add up how precise and how honest its belief is, episode by episode.

Two clocks run for every sensor. An entry that arrives is held against the forecast made before it
arrived; an entry that does not is held against what complete, noiseless sensors would have shown.
Both are sorted by the steps since that sensor was last seen before this step: 1 where it was seen
the step before, 2 after one step without, and so on; "never" where it was not seen yet in this
episode. All numbers are in normalised units, one being a running standard deviation of the sensor.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from beliefs import (
    ESTIMATE,
    ESTIMATE_VARIANCE,
    FORECAST,
    FORECAST_COV,
    NOISE_VARIANCE,
)
from evaluation.episodes import leave_standing, make_evaluation_environment
from evaluation.trained import TrainedAgent
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type
from training.config import MissingnessSettings, NoiseSettings
from training.envs import copy_statistics
from training.errors import UserError

from analysis.scores import gaussian_crps, gaussian_log_score, gaussian_pit
from torchrl_drbpn import seed_env
from torchrl_drbpn.functional import nis, zero_missing

COVERAGE = (0.5, 0.9, 0.95)
LEVELS = tuple(round(0.05 * i, 2) for i in range(1, 20))  # of the reliability curve
FILTERED, PREDICTED, LAST_VALUE, MEAN = "filtered", "predicted", "last value", "running mean"
ARRIVED, MISSING = "arrived", "missing"
READING, TRUTH = "reading", "truth"
_KINDS = {"sampled": ExplorationType.RANDOM, "mean": ExplorationType.DETERMINISTIC}
_CHUNK_NUMBERS = 2**24  # at most so many numbers of covariances are held at a time
_SMALLEST_VARIANCE = 1e-12


class Forecast(NamedTuple):
    """Name a Gaussian that is held against what was the case.

    Attributes:
        estimate: ``filtered`` (after this step's observation) or ``predicted`` (before it).
        noise: whether its variance holds that of the sensor noise.
        target: ``reading``, the noisy one that arrived, or ``truth``, the noiseless one.
        entries: those that ``arrived`` at this step, or those ``missing``.
    """

    estimate: str
    noise: bool
    target: str
    entries: str


@dataclass
class Tally:
    """Sums over the steps of each episode.

    Attributes:
        classes: names of the classes of steps since last seen; the last is ``never``.
        lengths: steps of each episode, shape ``(episodes,)``.
        observed: entries that arrived, shape ``(episodes,)``.
        components: sensors.
        precision: for each estimate and kind of entries, ``count`` and ``squared`` error.
        honesty: for each forecast, sums such as ``crps``; ``nis`` holds those of each class by
            itself, ``nis_joint`` of all entries of a step together.
        reliability: for each forecast, how many values came under each of `LEVELS`, shape
            ``(episodes, levels)``.

        Every sum but those whose shape is given has the shape ``(episodes, classes)``.
    """

    classes: list[str]
    lengths: Tensor
    observed: Tensor
    components: int
    precision: dict[tuple[str, str], dict[str, Tensor]] = field(default_factory=dict)
    honesty: dict[Forecast, dict[str, Tensor]] = field(default_factory=dict)
    reliability: dict[Forecast, Tensor] = field(default_factory=dict)

    @property
    def missing_ratio(self) -> float:
        """Return the share of entries that did not arrive."""
        return 1 - (self.observed.sum() / (self.lengths.sum() * self.components)).item()


def diagnose(
    trained: TrainedAgent,
    missingness: MissingnessSettings,
    *,
    episodes: int,
    mode: str,
    seed: int,
    bins: Sequence[int],
    noise: NoiseSettings | None = None,
    removed: Tensor | None = None,
) -> Tally:
    """Let a trained agent act and hold its belief against what was the case.

    Args:
        trained: the agent.
        missingness: what does not arrive.
        episodes: how many; the first of each environment of a batch.
        mode: ``sampled`` actions or ``mean`` actions.
        seed: of episodes, corruption and sampled actions. The global generator is left alone.
        bins: where the classes of steps since last seen begin; the first is 1.
        noise: what is added to what arrives; None: as in training.
        removed: components that never arrive, bool of shape ``(episodes, obs)``; None: there are
            none.

    Returns:
        The sums. An agent whose belief knows nothing of the sensors has those of the last value
        and the running mean.

    Raises:
        UserError: if the number of episodes or the classes make no sense.
    """
    if episodes < 1:
        raise UserError(f"`episodes` must be positive, got {episodes}.")
    classes = class_names(bins)
    make = trained.belief.observing
    policy = TensorDictSequential(
        trained.agent.belief if make is None else make(), trained.agent.actor
    )
    env = make_evaluation_environment(
        trained.settings,
        trained.belief,
        trained.agent,
        episodes=episodes,
        missingness=missingness,
        noise=noise,
        complete=True,
        removed=removed,
    )
    copy_statistics(trained.statistics, env)
    components = env.observation_spec["observation"].shape[-1]
    tally = Tally(classes, torch.zeros(episodes), torch.zeros(episodes), components)
    running = torch.ones(episodes, dtype=torch.bool)
    seen = torch.zeros(episodes, components, dtype=torch.bool)
    since = torch.zeros(episodes, components, dtype=torch.int64)
    last = torch.zeros(episodes, components, dtype=torch.float64)
    edges = torch.tensor(bins)
    chunk = max(1, min(64, _CHUNK_NUMBERS // (episodes * components**2)))
    held: list[dict[str, Tensor]] = []
    with torch.random.fork_rng(devices=[]), torch.no_grad(), set_exploration_type(_KINDS[mode]):
        torch.manual_seed(seed)
        seed_env(env, seed)
        data = env.reset()
        while running.any():
            data = policy(data)
            observed = data.get("observed")
            reading = zero_missing(data.get("observation"), observed).double()
            gap = torch.bucketize(since + 1, edges, right=True) - 1
            last = torch.where(observed, reading, last)
            held.append(
                {
                    "running": running.unsqueeze(-1).expand_as(observed),
                    "observed": observed,
                    "class": torch.where(seen, gap, len(bins)),
                    READING: reading,
                    TRUTH: data.get("complete_observation").double(),
                    LAST_VALUE: last,
                    MEAN: torch.zeros_like(last),
                }
                | _beliefs(data)
            )
            tally.lengths += running
            tally.observed += observed.sum(-1) * running
            seen, since = seen | observed, torch.where(observed, 0, since + 1)
            # An episode that is over costs no simulation.
            stepped = env.step(data.set("_step", running.unsqueeze(-1)))
            running = running & ~stepped.get(("next", "done")).squeeze(-1)
            data = leave_standing(env.step_mdp(stepped), running.unsqueeze(-1))
            if len(held) == chunk or not running.any():
                steps = {key: torch.stack([row[key] for row in held], 1) for key in held[0]}
                _add(tally, steps)
                held = []
    env.close()
    return tally


def class_names(bins: Sequence[int]) -> list[str]:
    """Name the classes of steps since last seen.

    Args:
        bins: where they begin.

    Returns:
        Names such as ``3``, ``6-10``, ``51+``, and ``never``.

    Raises:
        UserError: if they do not start at 1 and ascend.
    """
    ascending = all(a < b for a, b in itertools.pairwise(bins))
    whole = all(isinstance(b, int) and not isinstance(b, bool) for b in bins)
    if not (bins and whole and bins[0] == 1 and ascending):
        raise UserError(f"`bins` must be whole numbers that start at 1 and ascend, got {bins}.")
    names = [
        str(low) if high == low + 1 else f"{low}-{high - 1}"
        for low, high in itertools.pairwise(bins)
    ]
    return [*names, f"{bins[-1]}+", "never"]


def pool(tallies: Sequence[Tally]) -> Tally:
    """Put the episodes of several tallies side by side.

    Args:
        tallies: of one task, kind of belief and point.

    Returns:
        One tally of all their episodes.
    """
    first = tallies[0]
    return Tally(
        first.classes,
        torch.cat([t.lengths for t in tallies]),
        torch.cat([t.observed for t in tallies]),
        first.components,
        {key: _joined([t.precision[key] for t in tallies]) for key in first.precision},
        {key: _joined([t.honesty[key] for t in tallies]) for key in first.honesty},
        {key: torch.cat([t.reliability[key] for t in tallies]) for key in first.reliability},
    )


def _joined(parts: Sequence[Mapping[str, Tensor]]) -> dict[str, Tensor]:
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def _beliefs(data: TensorDictBase) -> dict[str, Tensor]:
    """Return what the belief has written of the sensors, by names of our own."""
    names = {
        FILTERED: ESTIMATE,
        "filtered variance": ESTIMATE_VARIANCE,
        PREDICTED: FORECAST,
        "predicted cov": FORECAST_COV,
        "noise variance": NOISE_VARIANCE,
    }
    found = {name: data.get(key, None) for name, key in names.items()}
    return {name: value.double() for name, value in found.items() if value is not None}


def _add(tally: Tally, steps: Mapping[str, Tensor]) -> None:
    """Add steps, each tensor (episodes, time, obs[, obs]), to the sums."""
    masks = {
        ARRIVED: steps["observed"] & steps["running"],
        MISSING: ~steps["observed"] & steps["running"],
    }
    for estimate in (FILTERED, PREDICTED, LAST_VALUE, MEAN):
        if estimate not in steps:
            continue
        squared = (steps[estimate] - steps[TRUTH]).square()
        for entries, mask in masks.items():
            sums = tally.precision.setdefault((estimate, entries), {})
            _accumulate(sums, _by_class(tally, {"squared": squared}, mask, steps["class"]))
    for forecast, variance in _forecasts(steps).items():
        _add_forecast(tally, steps, forecast, variance, masks[forecast.entries])


def _forecasts(steps: Mapping[str, Tensor]) -> dict[Forecast, Tensor]:
    """Return the variances of every Gaussian that the steps hold."""
    out: dict[Forecast, Tensor] = {}
    if "predicted cov" in steps:
        variance = steps["predicted cov"].diagonal(dim1=-2, dim2=-1)
        out[Forecast(PREDICTED, True, READING, ARRIVED)] = variance
        out[Forecast(PREDICTED, True, TRUTH, ARRIVED)] = variance
        out[Forecast(PREDICTED, True, TRUTH, MISSING)] = variance
    if "filtered variance" in steps:
        variance = steps["filtered variance"]
        out[Forecast(FILTERED, False, TRUTH, ARRIVED)] = variance
        out[Forecast(FILTERED, False, TRUTH, MISSING)] = variance
        if "noise variance" in steps:
            noisy = variance + steps["noise variance"]
            out[Forecast(FILTERED, True, TRUTH, MISSING)] = noisy
    return out


def _add_forecast(
    tally: Tally, steps: Mapping[str, Tensor], forecast: Forecast, variance: Tensor, mask: Tensor
) -> None:
    """Add what one Gaussian was worth."""
    mean, value = steps[forecast.estimate], steps[forecast.target]
    std = variance.clamp_min(_SMALLEST_VARIANCE).sqrt()
    pit = gaussian_pit(value, mean, std)
    off_centre = (2 * pit - 1).abs()
    numbers = {
        "squared": (value - mean).square(),
        "variance": variance,
        "crps": gaussian_crps(value, mean, std),
        "log_score": gaussian_log_score(value, mean, std),
    }
    numbers |= {f"inside_{level:g}": (off_centre <= level).double() for level in COVERAGE}
    sums = tally.honesty.setdefault(forecast, {})
    part = _by_class(tally, numbers, mask, steps["class"])
    if forecast.target == READING:
        error, cov = value - mean, steps["predicted cov"]
        part["nis_joint"] = nis(error, cov, mask).sum(-1, keepdim=True)
        part["nis"] = torch.zeros_like(part["count"])
        present = torch.unique(steps["class"][mask])
        for index in present.tolist():
            # What arrived of one class is a Gaussian vector of its own: rows of the whole one.
            chosen = mask & (steps["class"] == index)
            part["nis"][:, index] = nis(error, cov, chosen).sum(-1)
    _accumulate(sums, part)
    under = pit.unsqueeze(-1) <= torch.tensor(LEVELS, dtype=pit.dtype)
    counts = (under & mask.unsqueeze(-1)).sum((1, 2)).double()
    tally.reliability[forecast] = tally.reliability.get(forecast, torch.zeros(())) + counts


def _by_class(
    tally: Tally, numbers: Mapping[str, Tensor], mask: Tensor, index: Tensor
) -> dict[str, Tensor]:
    """Sum numbers of shape (episodes, time, obs) by episode and class, and count them."""
    episodes, count = mask.shape[0], len(tally.classes)
    rows = torch.arange(episodes)[:, None, None] * count + index
    chosen = rows[mask]

    def total(values: Tensor | None) -> Tensor:
        sums = torch.bincount(chosen, values, minlength=episodes * count)
        return sums.reshape(episodes, count).double()

    return {"count": total(None)} | {n: total(v[mask]) for n, v in numbers.items()}


def _accumulate(sums: dict[str, Tensor], part: Mapping[str, Tensor]) -> None:
    for name, value in part.items():
        sums[name] = sums[name] + value if name in sums else value
