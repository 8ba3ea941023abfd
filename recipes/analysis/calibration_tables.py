"""Tables of a diagnosis: one row a class of entries, with 95 % intervals over episodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from scipy import stats
from torch import Tensor

from analysis.calibration import ALL, ARRIVED, COVERAGE, LEVELS, MISSING, Forecast, Sums, Tally


class Resampling:
    r"""Draw episodes with replacement, to tell how far a number would be off with others.

    Entries of one episode are correlated, those of two are not: whole episodes are drawn (the
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
        self.weights = torch.nn.functional.one_hot(drawn, episodes).sum(1).double()

    def ratio(
        self, numerator: Tensor, denominator: Tensor, then: Callable[[Any], Any] = float
    ) -> tuple[float | None, float | None, float | None]:
        """Return a ratio of sums and its 95 % interval.

        Args:
            numerator: sums of each episode, shape ``(episodes,)``.
            denominator: the same shape.
            then: monotonous, applied to the ratio and its ends.

        Returns:
            The number, None where there is nothing to divide by, and the ends of its interval,
            None where fewer than two episodes have anything to say.
        """
        if not denominator.sum() > 0:
            return None, None, None
        value = then((numerator.sum() / denominator.sum()).item())
        count = int((denominator > 0).sum())
        if count < 2:
            return value, None, None
        student = stats.t.ppf(0.975, count - 1) * math.sqrt(count / (count - 1))
        levels = torch.tensor(stats.norm.cdf([-student, student]))
        ratios = (self.weights @ numerator) / (self.weights @ denominator)
        low, high = torch.nanquantile(ratios, levels).tolist()
        return value, then(low), then(high)


def precision_rows(tally: Tally, *, resamples: int, seed: int) -> Iterator[dict[str, Any]]:
    """Make the rows of precision.csv: how far estimates are from the noiseless truth.

    Args:
        tally: of an agent under a condition.
        resamples: for the intervals.
        seed: of them.

    Yields:
        Columns and values. Steps since last seen are 0 for entries that arrived.
    """
    resampling = Resampling(len(tally.lengths), resamples, seed)
    for (estimate, entries), sums in tally.errors.items():
        for name, own in _classes(tally, sums):
            if entries == MISSING or name == ALL:
                yield {
                    "estimate": estimate,
                    "entries": entries,
                    "steps_since_seen": "0" if entries == ARRIVED else name,
                    "count": int(own["count"].sum()),
                } | _interval("rmse", resampling.ratio(own["squared"], own["count"], math.sqrt))


def calibration_rows(tally: Tally, *, resamples: int, seed: int) -> Iterator[dict[str, Any]]:
    """Make the rows of calibration.csv: whether claimed deviations are right.

    Args:
        tally: of an agent under a condition.
        resamples: for the intervals.
        seed: of them.

    Yields:
        Columns and values. ``consistent_low`` and ``consistent_high`` are the band in which NIS
        over entries of a right belief lies in 95 of 100 cases.
    """
    resampling = Resampling(len(tally.lengths), resamples, seed)
    for forecast, sums in tally.forecasts.items():
        for name, own in _classes(tally, sums):
            count = own["count"]
            total = count.sum().item()
            nis = own.get("nis_joint" if name == ALL else "nis")
            band = (None, None) if nis is None else stats.chi2.ppf([0.025, 0.975], total) / total
            row = {
                **_columns(forecast),
                "steps_since_seen": name,
                "count": int(total),
                "rmse": math.sqrt(own["squared"].sum() / total),
                "claimed_std": math.sqrt(own["variance"].sum() / total),
            }
            for level in COVERAGE:
                inside = resampling.ratio(own[f"inside_{level:g}"], count)
                row |= _interval(f"coverage_{100 * level:g}", inside)
            row |= _interval("crps", resampling.ratio(own["crps"], count))
            row["log_score"] = own["log_score"].sum().item() / total
            ratio = (None, None, None) if nis is None else resampling.ratio(nis, count)
            row |= _interval("nis_per_dof", ratio)
            yield row | {"consistent_low": band[0], "consistent_high": band[1]}


def reliability_rows(tally: Tally) -> Iterator[dict[str, Any]]:
    """Make the rows of reliability.csv: how often values came under their quantiles.

    Args:
        tally: of an agent under a condition.

    Yields:
        Columns and values; ``under_5`` is the share of values under the 5 % quantile.
    """
    for forecast, sums in tally.forecasts.items():
        total = sums["count"].sum().item()
        if total > 0:
            shares = (sums["under"].sum(0) / total).tolist()
            under = {f"under_{100 * p:g}": share for p, share in zip(LEVELS, shares, strict=True)}
            yield {**_columns(forecast), "count": int(total), **under}


def _columns(forecast: Forecast) -> dict[str, str]:
    return {
        "estimate": forecast.estimate,
        "sensor_noise": "in" if forecast.noise else "out",
        "held_against": forecast.target,
        "entries": forecast.entries,
    }


def _classes(tally: Tally, sums: Sums) -> Iterator[tuple[str, Sums]]:
    """Yield the sums of all entries together, then of each class that has any, (episodes,) each."""
    if sums["count"].sum() > 0:
        yield ALL, {name: value.sum(-1) for name, value in sums.items()}
    for index, name in enumerate(tally.classes):
        if sums["count"][:, index].sum() > 0:
            by_class = sums.keys() - {"under", "nis_joint"}
            yield name, {key: sums[key][:, index] for key in by_class}


def _interval(name: str, values: tuple[float | None, float | None, float | None]) -> dict[str, Any]:
    return dict(zip((name, f"{name}_low", f"{name}_high"), values, strict=True))
