"""What the DRBPN paper gives to compare with: thresholds of the return, margins over DVRL."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from analysis.report_evaluations import Row
from analysis.report_runs import StudyRun, grouped, trained_on
from analysis.report_statistics import interquartile_mean, interval, ratio_of_means

# Returns that an agent shall reach on complete, exact observations, v4, within 2M steps.
THRESHOLDS = {
    "HalfCheetah": 2100.0,
    "Hopper": 2000.0,
    "Ant": 2500.0,
    "InvertedDoublePendulum": 9100.0,
    "InvertedPendulum": 950.0,
    "Swimmer": 90.0,
    "Reacher": -7.0,
    "Walker2d": 3000.0,
}
WITHIN = 2_000_000  # environment steps
# By how much the paper's DRBPN is ahead of its DVRL at missing ratio .5.
MARGINS_OVER_DVRL = {"Hopper": 0.20, "Walker2d": 0.75, "HalfCheetah": 1.00}

_TRAINING = "training"  # in place of a point
_TOP = 10  # episodes
_WINDOW = 100  # episodes of the mean that has to reach the threshold


def task_family(task: str) -> str:
    """Return a Gymnasium id without its version.

    Args:
        task: such as ``Hopper-v4``.

    Returns:
        Such as ``Hopper``.
    """
    return task.rpartition("-")[0] or task


def top_return(run: StudyRun) -> float | None:
    """Return the mean of the ten best training episodes within 2M steps, sampled actions.

    Args:
        run: the run.

    Returns:
        Raw return; None where the run has fewer than ten episodes or no episodes.csv.
    """
    best = sorted((r["return"] for r in run.episodes if r["frames"] <= WITHIN), reverse=True)
    return sum(best[:_TOP]) / _TOP if len(best) >= _TOP else None


def steps_to_threshold(run: StudyRun, threshold: float) -> int | None:
    """Return when the mean of the last 100 training episodes first reached a threshold.

    Args:
        run: the run.
        threshold: raw return.

    Returns:
        Environment steps, to one rollout; None where it was not reached within 2M steps. A mean
        over fewer episodes does not count: the first ones may be lucky.
    """
    reached = (
        int(row["frames"])
        for row in run.training
        if row["frames"] <= WITHIN
        and (row.get("episodes") or 0) >= _WINDOW
        and row["return"] is not None
        and row["return"] >= threshold
    )
    return next(reached, None)


def efficiency_rows(runs: Sequence[StudyRun]) -> list[Row]:
    """Return sample efficiency on complete, exact observations.

    Args:
        runs: of a study; those with missing entries or noise are left out.

    Returns:
        Rows ``task, method, variant, seed, frames, top_10_return, threshold,
        steps_to_threshold``; an empty last cell: not reached.
    """
    rows = []
    for run in runs:
        if run.group["trained_on"] != "none:0" or run.group["noise_sigma"]:
            continue
        threshold = THRESHOLDS.get(task_family(run.group["task"]))
        rows.append(
            {
                "task": run.group["task"],
                "method": run.group["method"],
                "variant": run.group["variant"],
                "seed": run.settings.seed,
                "frames": run.frames,
                "top_10_return": top_return(run),
                "threshold": threshold,
                "steps_to_threshold": (
                    None if threshold is None else steps_to_threshold(run, threshold)
                ),
            }
        )
    return rows


def margin_rows(runs: Sequence[StudyRun], summary: Sequence[Row]) -> list[Row]:
    """Return by how much drbpn is ahead of every other method where half of all may be missing.

    Where the two were trained for unequal numbers of steps, a further row compares their training
    returns at as many steps as the shorter has.

    Args:
        runs: of a study.
        summary: rows of :func:`analysis.report_tables.summary_rows`.

    Returns:
        Rows ``task, trained_on, point, mode, over, steps, steps_over, margin, low, high, paper``:
        a ratio of interquartile means minus one with its 95 % interval, both methods resampled;
        environment steps of drbpn and of the other, of its shortest run. ``point`` is ``training``
        where they are compared at equal steps.
    """
    members = {
        (run.group["task"], trained_on(run.group), run.group["method"]): group
        for group in grouped(runs)
        for run in group[:1]
    }
    returns = {
        (*_place(row), row["method"]): row["values"]
        for row in summary
        if row["quantity"] == "evaluation return" and _half_missing(row["point"])
    }
    order = list(dict.fromkeys(members[0].group["method"] for members in grouped(runs)))
    rows = []
    unequal: dict[tuple[str, str, str], list[Row]] = {}
    for (*place, method), values in returns.items():
        if method != "drbpn":
            continue
        task, trained = place[:2]
        own = members[task, trained, method]
        for other in order:
            against = returns.get((*place, other))
            # Of a return that is not positive no share can be told.
            if other == method or not values or not against or min(against) <= 0:
                continue
            others = members[task, trained, other]
            rows.append(_margin(place, other, (_steps(own), _steps(others)), values, against))
            if _steps(own) != _steps(others):
                unequal.setdefault((task, trained, other), _at_equal_steps(own, others))
    return rows + [row for found in unequal.values() for row in found]


def _steps(members: Sequence[StudyRun]) -> int:
    return min(run.frames for run in members)


def _at_equal_steps(own: Sequence[StudyRun], others: Sequence[StudyRun]) -> list[Row]:
    """Compare training returns at as many steps as the shorter has; no row where there are none."""
    frames = min(_steps(own), _steps(others))
    values, against = ([_training_return(run, frames) for run in side] for side in (own, others))
    known = [value for value in values if value is not None]
    known_other = [value for value in against if value is not None]
    if len(known) < len(values) or len(known_other) < len(against) or min(known_other) <= 0:
        return []
    group = own[0].group
    place = (group["task"], trained_on(group), _TRAINING, "sampled")
    row = _margin(place, others[0].method, (frames, frames), known, known_other)
    return [row if _half_missing(group["trained_on"]) else row | {"paper": None}]


def _training_return(run: StudyRun, frames: int) -> float | None:
    """Return the training return as it stood last within so many steps."""
    reached = [row["return"] for row in run.training if row["frames"] <= frames]
    return reached[-1] if reached else None


def aggregate_rows(summary: Sequence[Row]) -> list[Row]:
    """Return scores over all tasks: returns as shares of the paper's threshold of their task.

    Args:
        summary: rows of :func:`analysis.report_tables.summary_rows`.

    Returns:
        Rows ``trained_on, point, mode, method, tasks, runs, iqm, low, high`` where two tasks or
        more with a positive threshold were evaluated: interquartile mean over all runs of all
        tasks, its 95 % interval with runs resampled within their task. A method that lacks one of
        the tasks, or a seed of one, has no row: it would be compared over others.
    """
    found: dict[tuple[str, str, str], dict[str, dict[str, list[float]]]] = {}
    for row in summary:
        threshold = THRESHOLDS.get(task_family(row["task"]), 0.0)
        if row["quantity"] == "evaluation return" and threshold > 0 and row["values"]:
            task, *place = _place(row)
            by_method = found.setdefault((place[0], place[1], place[2]), {})
            scores = [value / threshold for value in row["values"]]
            by_method.setdefault(row["method"], {})[task] = scores
    rows = []
    for (trained, point, mode), by_method in found.items():
        tasks = sorted({task for by_task in by_method.values() for task in by_task})
        for method, by_task in by_method.items():
            if len(tasks) < 2 or len(by_task) < len(tasks):
                continue
            strata = [by_task[task] for task in tasks]
            ends = interval(strata)
            rows.append(
                {
                    "trained_on": trained,
                    "point": point,
                    "mode": mode,
                    "method": method,
                    "tasks": " ".join(tasks),
                    "runs": sum(map(len, strata)),
                    "iqm": float(interquartile_mean(np.concatenate(strata))),
                    "low": None if ends is None else float(ends[0]),
                    "high": None if ends is None else float(ends[1]),
                }
            )
    return rows


def _half_missing(point: str) -> bool:
    family, ratio, *_ = point.split(" ")[0].split(":")
    return family in ("mcar", "mar", "nmar", "reduction") and float(ratio) == 0.5


def _place(row: Row) -> tuple[str, str, str, str]:
    return (
        row["task"],
        trained_on(row),
        row["point"],
        row["mode"],
    )


def _margin(
    place: Sequence[str],
    other: str,
    steps: tuple[int, int],
    values: list[float],
    against: list[float],
) -> Row:
    ends = interval([values, against], ratio_of_means)
    task, trained, point, mode = place
    paper = MARGINS_OVER_DVRL.get(task_family(task)) if other == "dvrl" else None
    ratio = interquartile_mean(np.array(values)) / interquartile_mean(np.array(against))
    return {
        "task": task,
        "trained_on": trained,
        "point": point,
        "mode": mode,
        "over": other,
        "steps": steps[0],
        "steps_over": steps[1],
        "margin": float(ratio) - 1,
        "low": None if ends is None else float(ends[0]) - 1,
        "high": None if ends is None else float(ends[1]) - 1,
        "paper": paper,
    }
