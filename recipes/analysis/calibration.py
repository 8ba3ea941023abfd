"""How precise and how well calibrated a trained agent's belief is, episode by episode.

Entries that arrive are compared with the forecast made before; those that do not with what
complete, noiseless sensors would have shown. Both are sorted by the steps since that sensor was
last seen: 1 where it was seen the step before, "never" where it was not seen yet in this episode.
All numbers are in normalised units, one being a running standard deviation of the sensor.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from beliefs import ESTIMATE, ESTIMATE_VARIANCE, FORECAST, FORECAST_COV, NOISE_VARIANCE
from evaluation.conditions import Condition
from evaluation.episodes import run_episodes
from evaluation.trained import TrainedAgent
from tensordict import TensorDictBase
from torch import Tensor
from training.errors import UserError

from torchrl_drbpn.functional import nis, zero_missing

COVERAGE = (0.5, 0.9, 0.95)
LEVELS = tuple(round(0.05 * i, 2) for i in range(1, 20))  # of the reliability curve
FILTERED, PREDICTED, LAST_VALUE, MEAN = "filtered", "predicted", "last value", "running mean"
ARRIVED, MISSING, READING, TRUTH, ALL = "arrived", "missing", "reading", "truth", "all"
_SMALLEST_VARIANCE = 1e-12
_WRITTEN = {
    FILTERED: ESTIMATE,
    "filtered variance": ESTIMATE_VARIANCE,
    PREDICTED: FORECAST,
    "predicted cov": FORECAST_COV,
    "noise variance": NOISE_VARIANCE,
}

Sums = dict[str, Tensor]


class Compared(NamedTuple):
    """What is compared with what."""

    estimate: str  # "filtered" (after this step's observation), "predicted" (before it), ...
    noise: bool | None  # whether its variance holds that of the sensor noise; None: a point
    target: str  # "reading", the noisy one that arrived, or "truth", the noiseless one
    entries: str  # those that "arrived" at this step, or those "missing"


@dataclass
class Tally:
    """Sums over the steps of each episode.

    ``sums`` are, of each pair, ``(episodes, classes)`` unless said otherwise: ``count``,
    ``squared`` error, of Gaussians also scores such as ``crps``, ``nis`` of each class by itself,
    ``nis_joint`` of all entries of a step together, ``(episodes, 1)``, and ``under``, how many lay
    under each of `LEVELS`, ``(episodes, levels)``.
    """

    classes: list[str]  # of steps since last seen; the last is "never"
    lengths: Tensor  # steps of each episode
    observed: Tensor  # entries that arrived in each
    components: int
    sums: dict[Compared, Sums] = field(default_factory=dict)

    @property
    def missing_ratio(self) -> float:
        """Return the share of entries that did not arrive."""
        return 1 - (self.observed.sum() / (self.lengths.sum() * self.components)).item()

    def add(self, rows: slice, steps: Mapping[str, Tensor]) -> None:
        """Add steps of some episodes, each entry ``(episodes of the rows, time, obs[, obs])``."""
        running = steps["running"]
        masks = {ARRIVED: steps["observed"] & running, MISSING: ~steps["observed"] & running}
        for estimate in [e for e in (FILTERED, PREDICTED, LAST_VALUE, MEAN) if e in steps]:
            squared = (steps[estimate] - steps[TRUTH]).square()
            for entries, mask in masks.items():
                part = self._by_class(steps, mask, {"squared": squared})
                self._add(Compared(estimate, None, TRUTH, entries), rows, part)
        for pair, variance in _variances(steps).items():
            self._add(pair, rows, self._scores(steps, pair, variance, masks[pair.entries]))

    def _scores(
        self, steps: Mapping[str, Tensor], pair: Compared, variance: Tensor, mask: Tensor
    ) -> Sums:
        value, mean = steps[pair.target], steps[pair.estimate]
        std = variance.clamp_min(_SMALLEST_VARIANCE).sqrt()
        normal = torch.distributions.Normal(mean, std, validate_args=False)
        # What had the probability to lie lower: uniform if the belief is right.
        error, pit = value - mean, normal.cdf(value)  # type: ignore[no-untyped-call]
        numbers = {
            "squared": error.square(),
            "variance": variance,
            "crps": gaussian_crps(value, mean, std),
            "log_score": -normal.log_prob(value),  # type: ignore[no-untyped-call]
        }
        inside = (2 * pit - 1).abs()
        numbers |= {f"inside_{level:g}": (inside <= level).double() for level in COVERAGE}
        out = self._by_class(steps, mask, numbers)
        under = pit.unsqueeze(-1) <= torch.tensor(LEVELS, dtype=pit.dtype)
        out["under"] = (under & mask.unsqueeze(-1)).sum((1, 2)).double()
        if pair.target == READING:
            cov = steps["predicted cov"]
            out["nis_joint"] = nis(error, cov, mask).sum(-1, keepdim=True)
            out["nis"] = torch.zeros_like(out["count"])
            for index in torch.unique(steps["class"][mask]).tolist():
                # What arrived of one class is a Gaussian vector of its own: rows of the whole one.
                own = mask & (steps["class"] == index)
                out["nis"][:, index] = nis(error, cov, own).sum(-1)
        return out

    def _by_class(
        self, steps: Mapping[str, Tensor], mask: Tensor, numbers: Mapping[str, Tensor]
    ) -> Sums:
        """Sum numbers of shape (episodes, time, obs) by episode and class, and count them."""
        shape = len(mask), len(self.classes)
        cells = (torch.arange(len(mask))[:, None, None] * shape[1] + steps["class"])[mask]
        weights = {"count": None} | {name: value[mask] for name, value in numbers.items()}
        return {
            name: torch.bincount(cells, value, minlength=shape[0] * shape[1]).double().view(shape)
            for name, value in weights.items()
        }

    def _add(self, pair: Compared, rows: slice, part: Sums) -> None:
        sums = self.sums.setdefault(pair, {})
        for name, value in part.items():
            empty = value.new_zeros(len(self.lengths), value.shape[1])
            sums.setdefault(name, empty)[rows] += value


def _variances(steps: Mapping[str, Tensor]) -> dict[Compared, Tensor]:
    """Return the variances of every Gaussian that the steps hold."""
    out: dict[Compared, Tensor] = {}
    if "predicted cov" in steps:
        variance = steps["predicted cov"].diagonal(dim1=-2, dim2=-1)
        kinds = ((READING, ARRIVED), (TRUTH, ARRIVED), (TRUTH, MISSING))
        out |= {Compared(PREDICTED, True, *kind): variance for kind in kinds}
    if "filtered variance" in steps:
        variance = steps["filtered variance"]
        out |= {Compared(FILTERED, False, TRUTH, kind): variance for kind in (ARRIVED, MISSING)}
        if "noise variance" in steps:
            out[Compared(FILTERED, True, TRUTH, MISSING)] = variance + steps["noise variance"]
    return out


def diagnose(
    trained: TrainedAgent,
    condition: Condition,
    removed: Tensor | None = None,
    *,
    episodes: int,
    mode: str,
    seed: int,
    bins: Sequence[int],
) -> Tally:
    """Let a trained agent act and compare its belief with the readings and the truth.

    An agent whose belief has no estimate of the sensors has sums of the last value and the running
    mean. ``bins`` are where the classes of steps since last seen begin.
    """
    obs = trained.obs_dim
    tally = Tally(class_names(bins), torch.zeros(episodes), torch.zeros(episodes), obs)
    edges = torch.tensor(bins)
    seen = torch.zeros(episodes, obs, dtype=torch.bool)
    since = torch.zeros(episodes, obs, dtype=torch.int64)
    last = torch.zeros(episodes, obs, dtype=torch.float64)

    def watch(rows: slice, data: TensorDictBase, running: Tensor) -> None:
        observed = data.get("observed")
        reading = zero_missing(data.get("normalized_observation"), observed).double()
        last[rows] = torch.where(observed, reading, last[rows])
        gap = torch.bucketize(since[rows] + 1, edges, right=True) - 1
        written = {name: data.get(key, None) for name, key in _WRITTEN.items()}
        steps = {
            "running": running.unsqueeze(-1).expand_as(observed),
            "observed": observed,
            "class": torch.where(seen[rows], gap, len(bins)),
            READING: reading,
            TRUTH: data.get("normalized_complete_observation").double(),
            LAST_VALUE: last[rows],
            MEAN: torch.zeros_like(reading),
        }
        steps |= {name: value.double() for name, value in written.items() if value is not None}
        tally.add(rows, {name: value.unsqueeze(1) for name, value in steps.items()})
        tally.lengths[rows] += running
        tally.observed[rows] += observed.sum(-1) * running
        seen[rows] |= observed
        since[rows] = torch.where(observed, 0, since[rows] + 1)

    make_env = trained.environments(condition.missingness, condition.noise, removed, complete=True)
    policy = trained.observing_policy
    run_episodes(policy, make_env, episodes=episodes, mode=mode, seed=seed, watch=watch)
    return tally


def class_names(bins: Sequence[int]) -> list[str]:
    """Name the classes of steps since last seen, such as ``3``, ``6-10``, ``51+``, ``never``."""
    pairs = list(itertools.pairwise(bins))
    if not bins or {*map(type, bins)} != {int} or bins[0] != 1 or any(a >= b for a, b in pairs):
        raise UserError(f"`bins` must be whole numbers that start at 1 and ascend, got {bins}.")
    names = [str(a) if b == a + 1 else f"{a}-{b - 1}" for a, b in pairs]
    return [*names, f"{bins[-1]}+", "never"]


def pool(tallies: Sequence[Tally]) -> Tally:
    """Put the episodes of several tallies, of one task, kind of belief and condition, together."""
    first = tallies[0]
    return Tally(
        first.classes,
        torch.cat([t.lengths for t in tallies]),
        torch.cat([t.observed for t in tallies]),
        first.components,
        {
            pair: {name: torch.cat([t.sums[pair][name] for t in tallies]) for name in sums}
            for pair, sums in first.sums.items()
        },
    )


def gaussian_crps(value: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """Score by the continuous ranked probability score, in units of ``value``; 0 is perfect.

    Eq. (21) of Gneiting and Raftery, *Strictly Proper Scoring Rules, Prediction, and Estimation*,
    JASA 102, 2007, with the sign turned.
    """
    error = value - mean
    z = error / std.clamp_min(torch.finfo(std.dtype).tiny)
    density = torch.exp(-0.5 * z.square()) / math.sqrt(2 * math.pi)
    spread = error * (2 * torch.special.ndtr(z) - 1)  # a std of 0 leaves |error|
    return spread + std * (2 * density - 1 / math.sqrt(math.pi))
