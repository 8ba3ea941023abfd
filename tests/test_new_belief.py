"""docs/new_belief.md: a belief of one's own, in two files outside the checkout's folders.

The duties of every belief module hold for the page's example, and its command trains it, saves it
and evaluates it with no edit elsewhere.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("hydra")
from recipe_tools import ROOT, read_table  # isort: skip

EXAMPLE = ROOT / "docs" / "new_belief"
sys.path.insert(0, str(EXAMPLE))

from test_moving_average import TestMovingAverage  # noqa: E402, F401  (collected here)


def command_of_the_page() -> tuple[dict[str, str], list[str]]:
    """Return environment and words of the page's training command, with absolute paths."""
    text = (ROOT / "docs" / "new_belief.md").read_text(encoding="utf-8")
    (line,) = re.findall(r"^PYTHONPATH=.* recipes/ppo_drbpn\.py .*$", text, re.MULTILINE)
    path, python, *words = shlex.split(line)
    assert python == "python"
    words = [str(ROOT / word) if (ROOT / word).exists() else word for word in words]
    kept = os.environ.get("PYTHONPATH", "")
    return {"PYTHONPATH": f"{ROOT / path.partition('=')[2]}:{kept}"}, words


def test_the_command_of_the_page_trains_it_from_anywhere(tmp_path: Path) -> None:
    from evaluation.episodes import evaluate
    from evaluation.trained import load_trained_agent

    extra, words = command_of_the_page()
    done = subprocess.run(
        [sys.executable, *words, "experiment=smoke", "total_frames=128", "hydra.run.dir=run"],
        cwd=tmp_path,
        env={**os.environ, **extra},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    (row,) = read_table(tmp_path / "run" / "metrics.csv")
    assert 0.6 < float(row["decay"]) < 0.8
    trained = load_trained_agent(tmp_path / "run")
    assert trained.settings.belief["name"] == "moving_average"
    result = evaluate(
        trained.agent.policy, trained.environments(), episodes=2, mode="sampled", seed=0
    )
    assert result is not None
    assert min(result.lengths) > 0
