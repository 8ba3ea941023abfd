"""Interquartile means, bootstrap intervals and probabilities of improvement (Agarwal et al. 2021).

A sample is the runs of one task, along its last axis: runs are resampled within their task.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.stats import bootstrap, mannwhitneyu, trim_mean


def interquartile_mean(*samples: Any, axis: int = -1) -> Any:
    """Average the middle half of all runs; of fewer than four runs it is their mean."""
    return trim_mean(np.concatenate(samples, axis=axis), 0.25, axis=axis)


def ratio(first: Any, second: Any, axis: int = -1) -> Any:
    """Return the interquartile mean of the first sample over that of the second."""
    return interquartile_mean(first, axis=axis) / interquartile_mean(second, axis=axis)


def probability_of_improvement(*pairs: Any, axis: int = -1) -> Any:
    """Return how often a run of one method beats one of another, of pairs of samples, one a task.

    The mean over tasks; ties are halves.
    """
    tasks = zip(pairs[::2], pairs[1::2], strict=True)
    wins = [
        mannwhitneyu(a, b, axis=axis).statistic / (a.shape[axis] * b.shape[axis]) for a, b in tasks
    ]
    return np.mean(wins, axis=0)


def interval(*samples: Any, statistic: Callable[..., Any] = interquartile_mean) -> tuple[Any, Any]:
    """Return the 95 % percentile bootstrap interval of a statistic; NaN if a sample has one run."""
    arrays = [np.asarray(sample, dtype=np.float64) for sample in samples]
    if min(array.shape[-1] for array in arrays) < 2:
        nothing = np.full(arrays[0].shape[:-1], np.nan)[()]
        return nothing, nothing
    how: Any = {"n_resamples": 5000, "method": "percentile", "rng": np.random.default_rng(0)}
    ends = bootstrap(arrays, statistic, axis=-1, **how).confidence_interval
    return ends.low, ends.high
