"""Time candidates in turns, in one run, so that a slow moment of the machine meets all of them.

A round times every candidate once, in an order that rotates. A table shows the medians over the
rounds, half the distance between the quartiles, and the median of the ratio within a round.
"""

import argparse
import importlib.metadata
import json
import os
import sys
import time
import timeit
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import torch

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "recipes"))
PACKAGES = ("torch", "torchrl", "gymnasium", "mujoco", "stable-baselines3", "torchrl-drbpn")


def start(description: str, **options: Any) -> argparse.Namespace:
    """Read the command line, set torch's threads, print what identifies the run.

    Args:
        description: docstring of the benchmark.
        **options: further options and their defaults; a list takes several words.

    Returns:
        The options, with ``rounds``, ``threads``, ``clock``, ``quick``, ``json``.
    """
    layout = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=description, formatter_class=layout)
    parser.add_argument("--rounds", type=int, default=9, help="samples of each candidate")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    parser.add_argument("--clock", choices=("wall", "cpu"), default="wall")
    parser.add_argument("--quick", action="store_true", help="smallest sizes: shows that it runs")
    parser.add_argument("--json", type=Path, help="also write the tables to this file")
    for name, default in options.items():
        several = {"nargs": "+", "type": type(default[0])} if isinstance(default, list) else {}
        kind = {} if several else {"type": type(default)}
        parser.add_argument(f"--{name.replace('_', '-')}", default=default, **several, **kind)
    args = parser.parse_args()
    for name, value in vars(args).items():
        if type(value) is int and value < 1:
            parser.error(f"--{name.replace('_', '-')} must be at least 1, got {value}")
    args.rounds = 2 if args.quick else args.rounds
    torch.set_num_threads(args.threads)
    versions = {d.metadata["Name"]: d.version for d in importlib.metadata.distributions()}
    known = ", ".join(f"{name} {versions[name]}" for name in PACKAGES if name in versions)
    load = os.getloadavg()[0]
    args.banner = (
        f"{known}; torch threads {args.threads} of {os.cpu_count()} cores, load {load:.2f}"
    )
    print(f"# {Path(sys.argv[0]).name} {' '.join(sys.argv[1:])}\n# {args.banner}")
    args.tables = {}
    return args


def measure(
    candidates: Mapping[str, Callable[[], object]], args: argparse.Namespace, *, calls: int = 1
) -> pd.DataFrame:
    """Time candidates in turns.

    Args:
        candidates: name and what to call.
        args: from :func:`start`.
        calls: calls in a sample, for what takes microseconds.

    Returns:
        Seconds a call, one row a round.
    """
    clock = time.process_time if args.clock == "cpu" else time.perf_counter
    names, rows, repeats = list(candidates), [], 1 if args.quick else calls
    for call in candidates.values():
        call()
    for turn in range(args.rounds):
        order = names[turn % len(names) :] + names[: turn % len(names)]
        # torch.utils.benchmark would call each twice more in every round: too much for a rollout.
        rows.append({n: timeit.timeit(candidates[n], timer=clock, number=repeats) for n in order})
    return pd.DataFrame(rows)[names] / repeats


def show(
    title: str, seconds: pd.DataFrame, base: str, args: argparse.Namespace, **columns: Any
) -> pd.DataFrame:
    """Print one table and keep it for ``--json``.

    Args:
        title: line above it.
        seconds: from :func:`measure`.
        base: candidate that the ratios are over.
        args: from :func:`start`.
        **columns: further columns, values in the order of the candidates.

    Returns:
        The table, one row a candidate.
    """
    quartiles = seconds.quantile(0.75) - seconds.quantile(0.25)
    table = pd.DataFrame(
        {
            "ms": 1e3 * seconds.median(),
            "+- %": 50 * quartiles / seconds.median(),
            f"time over {base}": seconds.div(seconds[base], axis=0).median(),
            **columns,
        }
    ).reindex(seconds.columns)
    print(f"\n{title}\n{table.to_string(float_format='{:.4g}'.format)}")
    args.tables[title] = table.to_dict("index")
    if args.json is not None:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        part = args.json.with_suffix(".part")
        part.write_text(json.dumps({"run": args.banner, "tables": args.tables}, indent=1))
        part.replace(args.json)
    return table


def recipe(*overrides: str) -> tuple[Any, Any]:
    """Assemble a training run as the command line does.

    Args:
        overrides: as on the command line of ``recipes/ppo_drbpn.py``.

    Returns:
        The run's parts and its configuration.
    """
    from ppo_drbpn import assemble
    from training.config import composed_config

    config = composed_config([*overrides, f"threads={torch.get_num_threads()}"])
    return assemble(config), config
