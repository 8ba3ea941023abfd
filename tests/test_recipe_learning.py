"""The recipe learns: a short real training run, and the same run without learning as its control.

InvertedPendulum with every component missing with probability .2 and the default noise: the last 20
episodes return at least five times what the first 20 did. With learning rate 0 they do not.
"""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("hydra")
from recipe_tools import read_table, run  # isort: skip


def improvement(folder: Path, *overrides: str) -> float:
    """Train and return the ratio of the last to the first 20 episodes' mean return."""
    assert run(folder, "experiment=inverted_pendulum_test", *overrides) == 0
    returns = [float(row["return"]) for row in read_table(folder / "episodes.csv")]
    assert len(returns) >= 40
    return sum(returns[-20:]) / sum(returns[:20])


@pytest.mark.slow
def test_the_agent_learns_to_balance_with_a_fifth_of_its_sensors_missing(tmp_path: Path) -> None:
    assert improvement(tmp_path / "run") >= 5


@pytest.mark.slow
def test_without_learning_the_returns_do_not_rise(tmp_path: Path) -> None:
    assert improvement(tmp_path / "run", "optim.lr=0") < 2
