"""The tables of a report: means over seeds, over tasks, and of one method against the others."""

from typing import Any

import numpy as np
import pandas as pd

from analysis.runs import GROUP, RUN, THRESHOLDS, Study
from analysis.statistics import interquartile_mean, interval, probability_of_improvement, ratio

NOTHING_MISSING, TRAINING, ALL_TASKS = "none:0", "training", "all tasks"
# By how much the paper's DRBPN is ahead of its DVRL at missing ratio .5.
MARGINS_OVER_DVRL = {"Hopper": 0.20, "Walker2d": 0.75, "HalfCheetah": 1.00}
_WHERE = ["trained_on", "noise_sigma", "settings", "point", "mode"]
_HALF = ("mcar", "mar", "nmar", "reduction model", "reduction random")
_KINDS = (
    *("none", "mar", "mcar", "nmar", "outages", "delay", "multi_rate", "reduction"),
    *("noise", "spikes", "stuck", "drift"),
)


def point_kind(point: str) -> tuple[str, float]:
    """Split a point such as ``outages:0.5:20:sensor`` into its kind and level: the 20 steps."""
    family, *words = point.split(":")
    level = words.pop(1 if family == "outages" and len(words) > 1 else 0) if words else "0"
    return " ".join([family, *words]), float(level)


def point_order(points: pd.Series) -> pd.Series:
    """Return a key that sorts points: training, nothing missing, then by kind and level."""

    def key(point: str) -> tuple[int, str, float]:
        kind, level = point_kind(point)
        family = kind.split(" ")[0]
        return (_KINDS.index(family) if family in _KINDS else -1, kind, level)

    return points.map({point: rank for rank, point in enumerate(sorted(set(points), key=key))})


def last_evaluations(study: Study) -> pd.DataFrame:
    """Return the evaluations of each run's last frames; those of evaluate.py take precedence."""
    found = study.evaluation.merge(study.runs[[*RUN, "frames"]], on=[*RUN, "frames"])
    found = found[found.source != "training"].sort_values("source", ascending=False, kind="stable")
    return found.drop_duplicates([*RUN, "point", "mode"])


def summarise(study: Study) -> pd.DataFrame:
    """Return means over the seeds of each group, by point and kind of action.

    ``share``: of the return with nothing missing, a ratio of interquartile means. A group in which
    a seed has no number has no row at a point, and no mean of its training.
    """
    training = study.runs.rename(columns={"return": "return_mean"})
    rows = pd.concat([training.assign(point=TRAINING, mode="sampled"), last_evaluations(study)])
    seeds = study.runs.groupby(GROUP).size()
    out = []
    for key, members in rows.groupby([*GROUP, "point", "mode"], sort=False):
        values = members.return_mean.to_numpy(float)
        known = len(values) == seeds[key[: len(GROUP)]] and not np.isnan(values).any()
        if not known and TRAINING not in key:
            continue
        mean, ends = np.nan, (np.nan, np.nan)
        if known:
            mean, ends = interquartile_mean(values), interval(values)
        own = " ".join(f"{s}={v:.6g}" for s, v in zip(members.seed, values, strict=True))
        means = ("missing_ratio", "log_likelihood", "diverged", "steps_per_second")
        out.append(
            dict(zip([*GROUP, "point", "mode"], key, strict=True))
            | {"seeds": len(values), "return": mean, "low": ends[0], "high": ends[1]}
            | {name: members[name].astype(float).mean() for name in means if name in members}
            | {"per_seed": own}
        )
    summary = pd.DataFrame(out)
    whole = summary[summary.point == NOTHING_MISSING][[*GROUP, "mode", "return"]]
    summary = summary.merge(whole, on=[*GROUP, "mode"], how="left", suffixes=("", "_whole"))
    defined = (summary.return_whole > 0) & ~summary.point.isin([TRAINING, NOTHING_MISSING])
    summary.insert(11, "share", (summary["return"] / summary.return_whole).where(defined))
    summary["order"] = point_order(summary.point)
    summary = summary.sort_values([*GROUP, "mode", "order"], kind="stable")
    sampled_first = summary["mode"].map({"sampled": 0}).fillna(1).argsort(kind="stable")
    return summary.iloc[sampled_first].drop(columns=["return_whole", "order"])


def derived_tables(study: Study, reference: str) -> dict[str, pd.DataFrame]:
    """Return ``summary``, ``aggregate`` and ``comparison``, of the reference with others."""
    summary = summarise(study)
    # Evaluations of groups of which every seed was evaluated at the point.
    rows = last_evaluations(study).merge(summary[[*GROUP, "point", "mode"]])
    comparison = compare(study, rows, reference)
    return {"summary": summary, "aggregate": aggregate(rows), "comparison": comparison}


def family(tasks: Any) -> Any:
    """Return Gymnasium ids without their versions."""
    return tasks.str.rsplit("-", n=1).str[0]


def aggregate(rows: pd.DataFrame) -> pd.DataFrame:
    """Return interquartile means over all runs of all tasks, as shares of the paper's thresholds.

    Of two tasks or more with a positive threshold, by methods that were evaluated on all of them.
    """
    rows = rows.assign(score=rows.return_mean / family(rows.task).map(THRESHOLDS))
    rows = rows[family(rows.task).map(THRESHOLDS) > 0]
    out = []
    for key, members in rows.groupby(_WHERE):
        tasks = members.task.nunique()
        for method, own in members.groupby("method"):
            samples = [task.score.to_numpy() for _, task in own.groupby("task")]
            if tasks > 1 and len(samples) == tasks:
                low, high = interval(*samples)
                score = {"score": interquartile_mean(*samples), "low": low, "high": high}
                where = dict(zip(_WHERE, key, strict=True))
                out.append(where | {"method": method, "tasks": tasks, "runs": len(own)} | score)
    return pd.DataFrame(out)


def compare(study: Study, rows: pd.DataFrame, reference: str) -> pd.DataFrame:
    """Compare a method with every other where half of all entries may be missing.

    ``margin`` is a ratio of interquartile means less one, none where the other has a return that is
    not positive. Where the two have unequal steps, a further row compares their training returns at
    equal ones. Task ``all tasks``: the mean probability.
    """
    rows = rows[[point_kind(p)[0] in _HALF and point_kind(p)[1] == 0.5 for p in rows.point]]
    rows = pd.concat([rows, _at_equal_steps(study, reference)])
    out: list[dict[str, Any]] = []
    for key, members in rows.groupby(_WHERE, sort=False):
        where = dict(zip(_WHERE, key, strict=True))
        for other in sorted(set(members.method) - {reference}):
            both = members[members.method.isin([reference, other])]
            named, pairs = {"method": reference, "over": other}, []
            for task, here in both.groupby("task"):
                values = [here[here.method == name].return_mean for name in (reference, other)]
                if min(map(len, values)):
                    pairs.append([value.to_numpy(float) for value in values])
                    steps = [here[here.method == n].frames.min() for n in (reference, other)]
                    at = {"task": task, "steps": steps[0], "steps_over": steps[1]}
                    out.append(named | at | where | _comparison(pairs[-1:]))
            if len(pairs) > 1:
                out.append(named | {"task": ALL_TASKS} | where | _comparison(pairs))
    table = pd.DataFrame(out)
    if len(table):
        paper = family(table.task).map(MARGINS_OVER_DVRL)
        table["paper"] = paper.where((table.over == "dvrl") & (table.point != TRAINING))
    return table


def _comparison(pairs: list[list[Any]]) -> dict[str, float]:
    flat = [sample for pair in pairs for sample in pair]
    low, high = interval(*flat, statistic=probability_of_improvement)
    row = {
        "probability": probability_of_improvement(*flat),
        "probability_low": low,
        "probability_high": high,
    }
    if len(pairs) == 1 and flat[1].min() > 0:
        low, high = interval(*flat, statistic=ratio)
        row |= {"margin": ratio(*flat) - 1, "low": low - 1, "high": high - 1}
    return row


def _at_equal_steps(study: Study, reference: str) -> pd.DataFrame:
    """Return training returns at the steps of the shorter, where methods of a task differ."""
    out = [study.training.head(0)]
    shared = [name for name in GROUP if name != "method"]
    lengths = study.runs.groupby(GROUP, as_index=False).frames.min()
    pairs = lengths[lengths.method == reference].merge(lengths, on=shared)
    for _, pair in pairs[pairs.frames_x != pairs.frames_y].iterrows():
        frames = min(pair.frames_x, pair.frames_y)
        curves = study.training[study.training.frames <= frames].dropna(subset="return")
        here = curves[(curves[shared] == pair[shared]).all(axis=1)]
        for name in (reference, pair.method_y):
            last = here[here.method == name].groupby(RUN, as_index=False).tail(1)
            out.append(last.assign(frames=frames))
    found = pd.concat(out) if len(out) > 1 else out[0]
    return found.rename(columns={"return": "return_mean"}).assign(point=TRAINING, mode="sampled")
