"""Tables of a diagnosis: one row a class of entries, with 95 % intervals over episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from statistics import NormalDist
from typing import Any

import torch
from torch import Tensor

from analysis.calibration import ARRIVED, COVERAGE, LEVELS, Tally
from torchrl_drbpn.functional import chi_square_quantile

ALL = "all"
_INTERVAL = (0.025, 0.975)


def _same(ratio: Tensor) -> Tensor:
    return ratio


class Resampling:
    r"""Draw episodes with replacement, to say how far a number would be off with others.

    Entries of one episode hang together, those of two do not: whole episodes are drawn (the
    bootstrap over clusters), and a number is a ratio of sums over the drawn ones. Of few episodes
    the 95 % percentiles are too narrow (91 % of ten); the interval takes those that a Student
    interval of a mean would reach: :math:`\Phi(\mp t_{n-1} \sqrt{n / (n - 1)})`, the expanded
    percentile interval of Hesterberg, *What Teachers Should Know About the Bootstrap*, 2015.

    Args:
        episodes: how many there are.
        resamples: how often to draw as many.
        seed: of the draws.
    """

    def __init__(self, episodes: int, resamples: int, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.randint(episodes, (resamples, episodes), generator=generator)
        self.weights = torch.zeros(resamples, episodes, dtype=torch.float64)
        self.weights.scatter_add_(1, drawn, torch.ones(drawn.shape, dtype=torch.float64))

    def ratio(
        self,
        numerator: Tensor,
        denominator: Tensor,
        then: Callable[[Tensor], Tensor] = lambda ratio: ratio,
    ) -> tuple[float | None, float | None, float | None]:
        """Return a ratio of sums and its 95 % interval.

        Args:
            numerator: sums of each episode, shape ``(episodes,)``.
            denominator: the same shape.
            then: monotonous, applied to the ratio.

        Returns:
            The number, None where there is nothing to divide by, and the ends of its interval,
            None where fewer than two episodes have anything to say.
        """
        if not denominator.sum() > 0:
            return None, None, None
        value = then(numerator.sum() / denominator.sum()).item()
        if (denominator > 0).sum() < 2:
            return value, None, None
        ratios = then((self.weights @ numerator) / (self.weights @ denominator))
        low, high = torch.nanquantile(ratios, _levels(int((denominator > 0).sum()))).tolist()
        return value, low, high


def _levels(count: int) -> Tensor:
    """Return the percentiles whose interval holds a mean of `count` episodes in 95 of 100 cases."""
    normal, free = NormalDist(), count - 1
    z = normal.inv_cdf(_INTERVAL[1])
    # Student's quantile by its expansion in 1 / free, 26.7.5 of Abramowitz and Stegun.
    student = (
        z
        + (z**3 + z) / (4 * free)
        + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * free**2)
        + (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * free**3)
    )
    tail = normal.cdf(-student * math.sqrt(count / free))
    return torch.tensor([tail, 1 - tail], dtype=torch.float64)


def precision_rows(tally: Tally, *, resamples: int, seed: int) -> Iterator[dict[str, Any]]:
    """Make the rows of precision.csv: how far estimates are from the noiseless truth.

    Args:
        tally: of an agent at a point.
        resamples: for the intervals.
        seed: of them.

    Yields:
        Columns and values. Steps since last seen are 0 for entries that arrived.
    """
    resampling = Resampling(len(tally.lengths), resamples, seed)
    for (estimate, entries), sums in tally.precision.items():
        for name, index in _classes(tally, sums):
            if entries == ARRIVED and name != ALL:
                continue
            squared, count = _taken(sums["squared"], index), _taken(sums["count"], index)
            rmse = resampling.ratio(squared, count, Tensor.sqrt)
            yield {
                "estimate": estimate,
                "entries": entries,
                "steps_since_seen": "0" if entries == ARRIVED else name,
                "count": int(count.sum()),
                "rmse": rmse[0],
                "rmse_low": rmse[1],
                "rmse_high": rmse[2],
            }


def calibration_rows(tally: Tally, *, resamples: int, seed: int) -> Iterator[dict[str, Any]]:
    """Make the rows of calibration.csv: how honest the claimed deviations are.

    Args:
        tally: of an agent at a point.
        resamples: for the intervals.
        seed: of them.

    Yields:
        Columns and values.
    """
    resampling = Resampling(len(tally.lengths), resamples, seed)
    for forecast, sums in tally.honesty.items():
        for name, index in _classes(tally, sums):
            count = _taken(sums["count"], index)
            row: dict[str, Any] = {
                "estimate": forecast.estimate,
                "sensor_noise": "in" if forecast.noise else "out",
                "held_against": forecast.target,
                "entries": forecast.entries,
                "steps_since_seen": name,
                "count": int(count.sum()),
                "rmse": math.sqrt((_taken(sums["squared"], index).sum() / count.sum()).item()),
                "claimed_std": math.sqrt(
                    (_taken(sums["variance"], index).sum() / count.sum()).item()
                ),
            }
            for level in COVERAGE:
                inside = _taken(sums[f"inside_{level:g}"], index)
                _put(row, f"coverage_{100 * level:g}", resampling.ratio(inside, count))
            _put(row, "crps", resampling.ratio(_taken(sums["crps"], index), count))
            score = _taken(sums["log_score"], index).sum() / count.sum()
            row["log_score"] = score.item()
            row |= _nis(sums, index, count, resampling)
            yield row


def _nis(
    sums: Mapping[str, Tensor], index: int | None, count: Tensor, resampling: Resampling
) -> dict[str, Any]:
    """Return NIS over degrees of freedom and the band of a consistent filter."""
    row: dict[str, Any] = {}
    if "nis" not in sums:
        _put(row, "nis_per_dof", (None, None, None))
        return row | {"consistent_low": None, "consistent_high": None}
    nis = sums["nis_joint"].squeeze(-1) if index is None else sums["nis"][:, index]
    _put(row, "nis_per_dof", resampling.ratio(nis, count))
    dof = count.sum()
    band = chi_square_quantile(torch.tensor(_INTERVAL, dtype=torch.float64), dof) / dof
    return row | {"consistent_low": band[0].item(), "consistent_high": band[1].item()}


def reliability_rows(tally: Tally) -> Iterator[dict[str, Any]]:
    """Make the rows of reliability.csv: how often values came under their quantiles.

    Args:
        tally: of an agent at a point.

    Yields:
        Columns and values; ``under_5`` is the share of values under the 5 % quantile.
    """
    for forecast, counts in tally.reliability.items():
        total = tally.honesty[forecast]["count"].sum()
        if not total > 0:
            continue
        shares = (counts.sum(0) / total).tolist()
        yield {
            "estimate": forecast.estimate,
            "sensor_noise": "in" if forecast.noise else "out",
            "held_against": forecast.target,
            "entries": forecast.entries,
            "count": int(total),
        } | {f"under_{100 * p:g}": share for p, share in zip(LEVELS, shares, strict=True)}


def _classes(tally: Tally, sums: Mapping[str, Tensor]) -> Iterator[tuple[str, int | None]]:
    """Yield all entries together, then each class that has any."""
    counts = sums["count"].sum(0)
    if counts.sum() > 0:
        yield ALL, None
    for index, name in enumerate(tally.classes):
        if counts[index] > 0:
            yield name, index


def _taken(sums: Tensor, index: int | None) -> Tensor:
    """Return the sums of one class, or of all, shape (episodes,)."""
    return sums.sum(-1) if index is None else sums[:, index]


def _put(
    row: dict[str, Any], name: str, values: tuple[float | None, float | None, float | None]
) -> None:
    row[name], row[f"{name}_low"], row[f"{name}_high"] = values
