"""Tables of a diagnosis: one row a class of entries, with 95 % intervals over episodes."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch
from scipy import stats
from torch import Tensor

from analysis.calibration import ALL, ARRIVED, COVERAGE, LEVELS, MISSING, Compared, Sums, Tally

Row = dict[str, Any]


class Resampling:
    r"""Draw episodes with replacement: how far would a number be off with other episodes?

    Entries of one episode are correlated: whole episodes are drawn. Of few episodes the 95 %
    percentiles are too narrow; the interval takes those that a Student interval of a mean would
    reach: :math:`\Phi(\mp t_{n-1} \sqrt{n / (n - 1)})`, the expanded percentile interval of
    Hesterberg, *What Teachers Should Know About the Bootstrap*, 2015.
    """

    def __init__(self, episodes: int, resamples: int, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.randint(episodes, (resamples, episodes), generator=generator)
        self.weights = torch.nn.functional.one_hot(drawn, episodes).sum(1).double()

    def ratio(
        self,
        name: str,
        numerator: Tensor | None,
        denominator: Tensor,
        then: Callable[[Any], Any] = float,
    ) -> Row:
        """Return a ratio of sums over episodes and the ends of its 95 % interval.

        ``then`` is monotonous, applied to all three; None is what is not known.
        """
        value = low = high = None
        if numerator is not None and denominator.sum() > 0:
            value = then((numerator.sum() / denominator.sum()).item())
            count = int((denominator > 0).sum())
            if count > 1:
                student = stats.t.ppf(0.975, count - 1) * math.sqrt(count / (count - 1))
                levels = torch.tensor(stats.norm.cdf([-student, student]))
                ratios = (self.weights @ numerator) / (self.weights @ denominator)
                low, high = map(then, torch.nanquantile(ratios, levels).tolist())
        return {name: value, f"{name}_low": low, f"{name}_high": high}


def precision_rows(tally: Tally, *, resamples: int, seed: int) -> Iterator[Row]:
    """Yield the rows of precision.csv: how far estimates are from the noiseless truth."""
    resampling = Resampling(len(tally.lengths), resamples, seed)
    for pair, sums in tally.sums.items():
        for name, own in _classes(tally, sums) if pair.noise is None else ():
            if pair.entries == MISSING or name == ALL:
                yield {
                    "estimate": pair.estimate,
                    "entries": pair.entries,
                    "steps_since_seen": "0" if pair.entries == ARRIVED else name,
                    "count": int(own["count"].sum()),
                } | resampling.ratio("rmse", own["squared"], own["count"], math.sqrt)


def calibration_rows(tally: Tally, *, resamples: int, seed: int) -> Iterator[Row]:
    """Yield the rows of calibration.csv: whether claimed deviations are right.

    Between the ``consistent`` ends NIS over entries of a right belief lies in 95 of 100 cases.
    """
    resampling = Resampling(len(tally.lengths), resamples, seed)
    for pair, sums in tally.sums.items():
        for name, own in _classes(tally, sums) if pair.noise is not None else ():
            count = own["count"]
            total = count.sum().item()
            nis = own.get("nis_joint" if name == ALL else "nis")
            band = (None, None) if nis is None else stats.chi2.ppf([0.025, 0.975], total) / total
            row = _columns(pair) | {
                "steps_since_seen": name,
                "count": int(total),
                "rmse": math.sqrt(own["squared"].sum() / total),
                "claimed_std": math.sqrt(own["variance"].sum() / total),
            }
            for level in COVERAGE:
                inside = own[f"inside_{level:g}"]
                row |= resampling.ratio(f"coverage_{100 * level:g}", inside, count)
            row |= resampling.ratio("crps", own["crps"], count)
            row["log_score"] = own["log_score"].sum().item() / total
            row |= resampling.ratio("nis_per_dof", nis, count)
            yield row | {"consistent_low": band[0], "consistent_high": band[1]}


def reliability_rows(tally: Tally) -> Iterator[Row]:
    """Yield the rows of reliability.csv: ``under_5`` is the share under the 5 % quantile."""
    for pair, sums in tally.sums.items():
        total = sums["count"].sum().item()
        if pair.noise is not None and total > 0:
            shares = (sums["under"].sum(0) / total).tolist()
            under = {f"under_{100 * p:g}": share for p, share in zip(LEVELS, shares, strict=True)}
            yield {**_columns(pair), "count": int(total), **under}


def _columns(pair: Compared) -> Row:
    return {
        "estimate": pair.estimate,
        "sensor_noise": "in" if pair.noise else "out",
        "held_against": pair.target,
        "entries": pair.entries,
    }


def _classes(tally: Tally, sums: Sums) -> Iterator[tuple[str, Sums]]:
    """Yield the sums of all entries together, then of each class that has any, (episodes,) each."""
    if sums["count"].sum() > 0:
        yield ALL, {name: value.sum(-1) for name, value in sums.items()}
    for index, name in enumerate(tally.classes):
        if sums["count"][:, index].sum() > 0:
            by_class = sums.keys() - {"under", "nis_joint"}
            yield name, {key: sums[key][:, index] for key in by_class}
