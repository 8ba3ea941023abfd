"""The benchmarks run and write their tables; a test of speed would fail on a loaded machine."""

import argparse
import json
import sys

import pytest
from recipe_tools import ROOT, printed

BENCHMARKS = ROOT / "benchmarks"
sys.path.append(str(BENCHMARKS))

import interleaved  # noqa: E402

HELPERS = {"interleaved.py"}
COMMANDS = sorted(p.name for p in BENCHMARKS.glob("*.py") if p.name not in HELPERS)


def test_the_performance_page_names_every_command():
    text = (ROOT / "docs" / "performance.md").read_text()
    assert {"collection.py", "filter.py", "peers.py", "update.py"} <= set(COMMANDS)
    for name in COMMANDS:
        assert f"benchmarks/{name}" in text, name


@pytest.mark.parametrize("name", COMMANDS)
def test_a_benchmark_runs_with_quick_and_writes_its_tables(name, tmp_path):
    target = tmp_path / "deep" / "out.json"
    words = ["--beliefs", "none"] if name == "peers.py" else []
    out = printed(BENCHMARKS / name, "--quick", "--json", str(target), *words, cwd=tmp_path)
    assert "torchrl 0." in out
    assert "torch threads 1" in out
    assert all(json.loads(target.read_text()).values())
    assert [p.name for p in target.parent.iterdir()] == ["out.json"]
    assert [p.name for p in tmp_path.iterdir()] == ["deep"], "leaves nothing else behind"


def test_the_calibration_example_runs(tmp_path):
    out = printed("docs/calibration/constant_covariance.py", "--quick", cwd=tmp_path)
    assert "MSE, constant over exact" in out


def test_candidates_are_timed_once_a_round_in_turns_after_a_warm_up():
    calls = []
    args = argparse.Namespace(clock="wall", threads=1, rounds=3, quick=True)
    candidates = {name: lambda name=name: calls.append(name) for name in "abc"}
    seconds = interleaved.measure(candidates, args)
    assert "".join(calls) == "abc" + "abc" + "bca" + "cab"
    assert seconds.shape == (3, 3)


def test_a_ratio_compares_within_a_round(capsys):
    # The machine slows down tenfold after two rounds; a is twice as slow as b in every one.
    seconds = interleaved.pd.DataFrame({"a": [2.0, 2.0, 20.0], "b": [1.0, 1.0, 10.0]})
    args = argparse.Namespace(json=None, tables={})
    table = interleaved.show("x", seconds, "b", args)
    assert table.loc["a", "time over b"] == 2.0
    assert table.loc["a", "ms"] == 2000.0
