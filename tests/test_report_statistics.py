"""Interquartile means and bootstrap intervals: what a few numbers give by hand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import recipe_tools  # noqa: F401  (puts recipes/ on the path)
from analysis.report_statistics import interquartile_mean, interval


def test_the_interquartile_mean_leaves_out_a_quarter_on_each_side() -> None:
    values = np.array([[100.0, 1.0, 2.0, 3.0], [-7.0, 5.0, 5.0, 90.0]])
    assert interquartile_mean(values).tolist() == [2.5, 5.0]
    assert interquartile_mean(np.array([1.0, 2.0, 6.0])) == 3.0  # of three none is left out
    eight = np.arange(8.0) ** 2
    assert interquartile_mean(eight) == eight[2:6].mean()


def test_the_interval_of_few_runs_is_that_of_every_resample() -> None:
    ends = interval([[6.0, 1.0, 2.0]])
    assert ends is not None
    # One of 27 resamples is three times the lowest run: more than one in forty.
    assert [float(end) for end in ends] == [1.0, 6.0]
    five = np.array([3.0, -1.0, 4.0, 1.0, -5.0])
    resamples = (sorted(runs) for runs in itertools.product(five, repeat=5))
    means = sorted(np.mean(runs[1:4]) for runs in resamples)
    ends = interval([five])
    assert ends is not None
    # The 79th lowest of 3125 is the first that at least 2.5 % do not exceed.
    np.testing.assert_allclose(ends, [means[78], means[-79]], rtol=1e-12)
    assert interval([[1.0]]) is None
    assert interval([[1.0, 2.0], [1.0]]) is None  # of one run nothing can be told


@pytest.mark.parametrize(("runs", "share"), [(2, 0.5), (3, 0.75), (5, 0.9)])
def test_how_often_the_interval_of_few_runs_holds_the_true_mean(runs: int, share: float) -> None:
    """What the pages say about their intervals."""
    data = np.random.default_rng(runs).normal(size=(runs, 4000))
    ends = interval([data])
    assert ends is not None
    assert ((ends[0] <= 0) & (ends[1] >= 0)).mean() == pytest.approx(share, abs=0.03)


def test_runs_are_resampled_within_their_stratum() -> None:
    """Pooled, two tasks on other scales would make an interval as wide as their distance."""
    ends = interval([[0.0, 0.1, 0.2], [10.0, 10.1, 10.2]])
    assert ends is not None
    low, high = (float(end) for end in ends)
    assert 4.95 < low < 5.1 < high < 5.25


def test_drawn_resamples_agree_with_the_normal_approximation_and_do_not_vary() -> None:
    values = np.random.default_rng(3).normal(size=40)
    state = np.random.get_state()[1].copy()
    ends = interval([values], lambda resampled: resampled[0].mean(-1))
    again = interval([values], lambda resampled: resampled[0].mean(-1))
    assert ends is not None
    assert again is not None
    half = 1.96 * values.std() / np.sqrt(40)
    np.testing.assert_allclose(ends, [values.mean() - half, values.mean() + half], atol=0.03)
    assert (ends[0], ends[1]) == (again[0], again[1])
    assert (np.random.get_state()[1] == state).all()


def test_a_curve_has_the_interval_of_its_points() -> None:
    curves = np.array([[1.0, 5.0, 0.0], [2.0, 6.0, 0.0], [4.0, 4.0, 3.0]])
    ends = interval([curves])
    assert ends is not None
    for i in range(3):
        point = interval([curves[:, i]])
        assert point is not None
        np.testing.assert_array_equal(np.array(ends)[:, i], np.array(point))
