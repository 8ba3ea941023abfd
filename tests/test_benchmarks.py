"""The benchmarks run, print what they should, and write their numbers whole.

Specified here: each file of `benchmarks/` that is a command ends well with --quick, prints versions
and threads, and writes JSON; the ratio of two candidates comes from pairs of one round; the verdict
knows targets that want small and targets that want large figures. Speed itself is not tested: a
test that fails on a loaded machine tells nothing.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BENCHMARKS = ROOT / "benchmarks"
sys.path.append(str(BENCHMARKS))

import timing  # noqa: E402

HELPERS = {"timing.py", "recipe.py"}
COMMANDS = sorted(p.name for p in BENCHMARKS.glob("*.py") if p.name not in HELPERS)


def test_every_question_of_the_performance_page_has_its_file():
    wanted = {"filter", "decision", "update", "collection", "peers", "growth"}
    assert wanted <= {Path(name).stem for name in COMMANDS}
    text = (ROOT / "docs" / "performance.md").read_text()
    for name in COMMANDS:
        assert f"benchmarks/{name}" in text, name


@pytest.mark.parametrize("name", COMMANDS)
def test_a_benchmark_runs_with_quick_and_writes_its_numbers(name, tmp_path):
    if name == "environments.py":
        pytest.importorskip("envpool")
    target = tmp_path / "deep" / "out.json"
    done = subprocess.run(
        [sys.executable, str(BENCHMARKS / name), "--quick", "--json", str(target)],
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "torchrl 0." in done.stdout
    assert "torch threads 1" in done.stdout
    written = json.loads(target.read_text())
    assert written["run"]["threads"] == 1
    assert written["results"]
    assert [p.name for p in target.parent.iterdir()] == ["out.json"]
    assert [p.name for p in tmp_path.iterdir()] == ["deep"], "leaves nothing else behind"


def test_a_ratio_compares_within_a_round():
    # The machine slows down tenfold after two rounds; a is twice as slow as b in every one.
    times = timing.Times({"a": [2.0, 2.0, 20.0], "b": [1.0, 1.0, 10.0]})
    assert times.ratio("a", "b") == 2.0
    assert times.median("a") == 2.0


def test_every_candidate_is_timed_once_a_round_and_warmed_up_before():
    calls: list[str] = []
    times = timing.interleave(
        {name: lambda name=name: calls.append(name) for name in "abc"}, rounds=3, warmup=1
    )
    assert "".join(calls) == "abc" + "abc" + "bca" + "cab"
    assert {len(v) for v in times.seconds.values()} == {3}


@pytest.mark.parametrize(
    ("value", "must", "aim", "word"),
    [
        (0.9, 2.0, 1.0, "aim reached"),
        (1.5, 2.0, 1.0, "must reached"),
        (2.1, 2.0, 1.0, "missed"),
        (0.9, 0.5, 0.65, "aim reached"),
        (0.6, 0.5, 0.65, "must reached"),
        (0.4, 0.5, 0.65, "missed"),
        (1.0, 1.0, 1.0, "aim reached"),
        (1.1, 1.0, 1.0, "missed"),
    ],
)
def test_a_verdict_knows_which_direction_is_better(value, must, aim, word):
    assert word in timing.verdict("x", value, must, aim)
    assert word not in timing.verdict("x", value, must, aim, quick=True)
