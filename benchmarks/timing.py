"""What every benchmark shares: interleaved timing, the banner, tables, and the JSON output.

A benchmark compares candidates inside one run. Each round times every candidate once, in an order
that rotates, and a ratio is the median over the rounds of the ratio within a round: a machine that
slows down for a while slows both sides of it.
"""

from __future__ import annotations

import argparse
import gc
import importlib.metadata
import json
import os
import platform
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[1]

CLOCKS: dict[str, Callable[[], float]] = {"wall": time.perf_counter, "cpu": time.process_time}

_PACKAGES = (
    "torch",
    "torchrl",
    "tensordict",
    "gymnasium",
    "mujoco",
    "envpool",
    "numpy",
    "torchrl-drbpn",
    "stable-baselines3",
    "sb3-contrib",
)


@dataclass
class Times:
    """Seconds per call of every candidate, one entry a round."""

    seconds: dict[str, list[float]] = field(default_factory=dict)

    def median(self, name: str) -> float:
        """Return the median seconds of a call."""
        return statistics.median(self.seconds[name])

    def spread(self, name: str) -> float:
        """Return half the distance between the quartiles, relative to the median."""
        values = sorted(self.seconds[name])
        if len(values) < 4:
            return (values[-1] - values[0]) / 2 / self.median(name)
        low, _, high = statistics.quantiles(values, n=4)
        return (high - low) / 2 / self.median(name)

    def percent(self, name: str) -> str:
        """Return :meth:`spread` for printing."""
        return f"{100 * self.spread(name):.0f}%"

    def ratio(self, name: str, base: str) -> float:
        """Return the median over the rounds of time(name) / time(base) within a round."""
        pairs = zip(self.seconds[name], self.seconds[base], strict=True)
        return statistics.median(a / b for a, b in pairs)


def interleave(
    candidates: Mapping[str, Callable[[], object]],
    *,
    rounds: int,
    warmup: int = 2,
    sample_seconds: float = 0.0,
    clock: Callable[[], float] = time.perf_counter,
) -> Times:
    """Time candidates against each other.

    Args:
        candidates: name and what to call.
        rounds: samples of each candidate.
        warmup: calls of each candidate before the first sample.
        sample_seconds: a sample repeats the call until it lasts about this long; 0: one call.
        clock: what is read, see ``--clock``.

    Returns:
        The times of one call.
    """
    names = list(candidates)
    repeats = {}
    for name in names:
        for _ in range(warmup):
            candidates[name]()
        if not sample_seconds:
            repeats[name] = 1
            continue
        start = clock()
        candidates[name]()
        once = clock() - start
        repeats[name] = max(1, round(sample_seconds / max(once, 1e-9)))
    times = Times({name: [] for name in names})
    collecting = gc.isenabled()
    gc.disable()
    try:
        for i in range(rounds):
            shift = i % len(names)
            for name in names[shift:] + names[:shift]:
                call, count = candidates[name], repeats[name]
                gc.collect(0)
                start = clock()
                for _ in range(count):
                    call()
                times.seconds[name].append((clock() - start) / count)
    finally:
        if collecting:
            gc.enable()
    return times


def parser(description: str) -> argparse.ArgumentParser:
    """Make the command line that every benchmark has.

    Args:
        description: the docstring of the benchmark.

    Returns:
        A parser with ``--rounds``, ``--threads``, ``--clock``, ``--quick`` and ``--json``.
    """
    out = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    out.add_argument("--rounds", type=int, default=None, help="samples of each candidate")
    out.add_argument("--threads", type=int, default=1, help="threads of torch (default 1)")
    out.add_argument(
        "--clock",
        choices=CLOCKS,
        default="wall",
        help="wall: elapsed time; cpu: CPU time of this process, which other jobs disturb less "
        "(one thread only: the seconds of several threads add up)",
    )
    out.add_argument("--quick", action="store_true", help="smallest sizes: only shows that it runs")
    out.add_argument("--json", type=Path, default=None, help="also write the numbers to this file")
    return out


def start(args: argparse.Namespace) -> dict[str, Any]:
    """Set the threads, print the banner and return what identifies the run.

    Args:
        args: from :func:`parser`.

    Returns:
        Command, versions, threads, machine, load before the run.
    """
    torch.set_num_threads(args.threads)
    versions = {}
    for name in _PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    run = {
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "python": platform.python_version(),
        "versions": versions,
        "threads": torch.get_num_threads(),
        "clock": args.clock,
        "cores": os.cpu_count(),
        "cpu": _cpu(),
        "load": round(os.getloadavg()[0], 2),
        "quick": bool(args.quick),
    }
    print(f"# {run['command']}")
    print(f"# python {run['python']}, " + ", ".join(f"{k} {v}" for k, v in versions.items()))
    print(
        f"# {run['cpu']}, {run['cores']} cores, torch threads {run['threads']}, "
        f"{run['clock']} clock, load average before the run {run['load']}"
    )
    return run


def _cpu() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print a table, the first column to the left and the others to the right.

    Args:
        title: the line above it.
        columns: headings.
        rows: cells; floats are printed with three significant digits.
    """
    cells = [[_cell(value) for value in row] for row in rows]
    widths = [max(len(c), *(len(r[i]) for r in cells)) for i, c in enumerate(columns)]
    print(f"\n{title}")
    for row in [list(columns), *cells]:
        first = row[0].ljust(widths[0])
        print("  ".join([first, *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))]))


def _cell(value: object) -> str:
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def verdict(name: str, value: float, must: float, aim: float, *, quick: bool = False) -> str:
    """Say whether a target is reached.

    Args:
        name: what was measured.
        value: the figure.
        must: the target to reach; above ``aim`` where smaller is better, below where larger is.
        aim: the target to hope for.
        quick: whether the sizes were those of ``--quick``, which say nothing about the target.

    Returns:
        One line.
    """
    smaller = must >= aim
    reached_must, reached_aim = (
        (value <= must, value <= aim) if smaller else (value >= must, value >= aim)
    )
    if quick:
        return f"{name}: {value:.3g} (--quick: not to be held against the targets)"
    word = "aim reached" if reached_aim else "must reached" if reached_must else "missed"
    return f"{name}: {value:.3g} (must {must:g}, aim {aim:g}: {word})"


def finish(args: argparse.Namespace, run: dict[str, Any], results: object) -> None:
    """Write the numbers to ``--json``, whole or not at all.

    Args:
        args: from :func:`parser`.
        run: from :func:`start`.
        results: plain containers.
    """
    if args.json is None:
        return
    args.json.parent.mkdir(parents=True, exist_ok=True)
    text = json.dumps({"run": run, "results": results}, indent=1) + "\n"
    with tempfile.NamedTemporaryFile("w", dir=args.json.parent, delete=False) as file:
        file.write(text)
    Path(file.name).chmod(0o644)
    Path(file.name).replace(args.json)
