"""The tables of a study: learning curves, evaluations, means over seeds."""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from analysis.report_evaluations import Row, mean_of_known, point_order
from analysis.report_runs import StudyRun, grouped
from analysis.report_statistics import interquartile_mean, interval


def training_rows(run: StudyRun, count: int) -> list[Row]:
    """Return a learning curve of about ``count`` rows.

    Args:
        run: the run.
        count: rows wanted.

    Returns:
        Rows: the return as it stood (it is a mean over 100 episodes already), means of missing
        ratio and log-likelihood since the row before, steps per second since then.
    """
    rows, total = run.training, len(run.training)
    count = min(count, total)
    cuts = [total * i // count for i in range(count + 1)]
    out = []
    for start, stop in itertools.pairwise(cuts):
        part, last = rows[start:stop], rows[stop - 1]
        out.append(
            run.group
            | {
                "seed": run.settings.seed,
                "frames": int(last["frames"]),
                "return": last["return"],
                "missing_ratio": mean_of_known(row["missing_ratio"] for row in part),
                "log_likelihood": mean_of_known(row.get("log_likelihood") for row in part),
                "steps_per_second": _speed(part),
            }
        )
    return out


def _speed(rows: Sequence[Row]) -> float | None:
    """Return frames over seconds; every row holds as many frames as the next."""
    seconds = [1 / row["steps_per_second"] for row in rows if row.get("steps_per_second")]
    return len(seconds) / sum(seconds) if seconds else None


def evaluation_rows(run: StudyRun) -> list[Row]:
    """Return every evaluation of a run.

    Args:
        run: the run.

    Returns:
        Rows: ``source`` is ``training`` or ``final`` (by the training recipe) or ``points``
        (by recipes/evaluate.py).
    """
    head = run.group | {"seed": run.settings.seed}
    rows = [head | {**row, "frames": int(row["frames"])} for row in run.evaluations]
    rows = [row | {"episodes": int(row["episodes"])} for row in rows]
    order = {"training": 0, "final": 1, "points": 2}
    rows.sort(key=lambda r: (order[r["source"]], r["frames"], point_order(r["point"]), r["mode"]))
    return rows


_WORDS = {
    "return_mean": "return",
    "missing_ratio": "missing ratio",
    "log_likelihood": "log-likelihood",
}
NOTHING_MISSING = "none:0"
KEPT = "evaluation return kept"  # as a share of the return where nothing is missing
DIVERGED = "evaluation episodes diverged"  # as a share; told where there are any
# What is summed up about a training run: name, and the number of a run.
_TRAINING_NUMBERS: dict[str, Callable[[StudyRun], float | None]] = {
    "training return": lambda run: run.training[-1]["return"],
    "training missing ratio": lambda run: run.missing_ratio,
    "training log-likelihood": lambda run: mean_of_known(
        row.get("log_likelihood") for row in run.training[-max(1, len(run.training) // 10) :]
    ),
    "training steps/s": lambda run: _speed(run.training),
}


def summary_rows(runs: Sequence[StudyRun]) -> list[Row]:
    """Return means over seeds with every seed's own number beside them.

    Args:
        runs: of a study.

    Returns:
        Rows ``task, method, trained_on, noise_sigma, variant, quantity, point, mode, seeds, mean,
        std, iqm, low, high, per_seed``: std between seeds, interquartile mean and the ends of its
        95 % interval, empty for one seed; per_seed ``seed=number`` joined by spaces. ``values``,
        the same as numbers, is empty where a seed has none, and is no column of summary.csv.
    """
    rows = []
    for members in grouped(runs):
        for name, number in _TRAINING_NUMBERS.items():
            rows.append(_summary(members, name, members[0].group["trained_on"], "sampled", number))
        for point, mode in _evaluated_points(members):
            for name in _WORDS:
                words = f"evaluation {_WORDS[name]}"

                def number(
                    run: StudyRun, name: str = name, at: tuple[str, str] = (point, mode)
                ) -> float | None:
                    found = final_evaluation(run, *at)
                    return found[name] if found else None

                rows.append(_summary(members, words, point, mode, number))
            if point != NOTHING_MISSING:
                rows.append(_summary(members, KEPT, point, mode, _kept(point, mode)))
            rows.append(_summary(members, DIVERGED, point, mode, _diverged(point, mode)))
    return [
        row
        for row in rows
        if not (row["quantity"] == KEPT and row["mean"] is None)
        and not (row["quantity"] == DIVERGED and not row["mean"])
    ]


def _diverged(point: str, mode: str) -> Callable[[StudyRun], float | None]:
    """Return what gives the share of a run's episodes that were stopped at a point."""

    def number(run: StudyRun) -> float | None:
        found = final_evaluation(run, point, mode)
        return None if found is None else found.get("diverged") or 0.0

    return number


def _kept(point: str, mode: str) -> Callable[[StudyRun], float | None]:
    """Return what gives a run's share of its return where nothing is missing."""

    def number(run: StudyRun) -> float | None:
        here, clean = (final_evaluation(run, p, mode) for p in (point, NOTHING_MISSING))
        if here is None or clean is None or clean["return_mean"] <= 0:
            return None  # of a cost, no share can be told
        return here["return_mean"] / clean["return_mean"]

    return number


def _summary(
    members: Sequence[StudyRun],
    quantity: str,
    point: str,
    mode: str,
    number: Callable[[StudyRun], float | None],
) -> Row:
    values = {run.settings.seed: number(run) for run in members}
    known = [value for value in values.values() if value is not None]
    # A mean that leaves out a seed would be no mean over the seeds.
    known = known if len(known) == len(values) else []
    ends = interval([known]) if known else None
    return members[0].group | {
        "quantity": quantity,
        "point": point,
        "mode": mode,
        "seeds": len(values),
        "mean": mean_of_known(known),
        "std": statistics.stdev(known) if len(known) > 1 else None,
        "iqm": float(interquartile_mean(np.array(known))) if known else None,
        "low": None if ends is None else float(ends[0]),
        "high": None if ends is None else float(ends[1]),
        "per_seed": " ".join(f"{seed}={format_number(v)}" for seed, v in sorted(values.items())),
        "values": known,
    }


def _evaluated_points(members: Sequence[StudyRun]) -> list[tuple[str, str]]:
    found = {
        (row["point"], row["mode"])
        for run in members
        for row in run.evaluations
        if row["source"] != "training"
    }
    return sorted(found, key=lambda key: (point_order(key[0]), key[1] != "sampled"))


def final_evaluation(run: StudyRun, point: str, mode: str) -> Row | None:
    """Return the evaluation of a run's last checkpoint at a point.

    Args:
        run: the run.
        point: ``mechanism:eta``.
        mode: ``sampled`` or ``mean``.

    Returns:
        Its row: that of recipes/evaluate.py where there is one, else the run's own; or None.
    """
    found = [
        row
        for source in ("points", "final")
        for row in run.evaluations
        if (row["source"], row["point"], row["mode"]) == (source, point, mode)
        and row["frames"] == run.frames
    ]
    return found[0] if found else None


def format_number(value: Any) -> str:
    """Return a number in the one way that every table has: six significant digits.

    Args:
        value: a number, text, or None for an empty cell.

    Returns:
        Its text.
    """
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return ""
    if isinstance(value, float):
        # No exponents and no minus before a zero.
        text = f"{value:.{max(0, 5 - _magnitude(value))}f}"
        text = text.rstrip("0").rstrip(".") if "." in text else text
        return "0" if text == "-0" else text
    return str(value)


def _magnitude(value: float) -> int:
    return math.floor(math.log10(abs(value))) if abs(value) > 1e-12 else 0
