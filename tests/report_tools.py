"""Run folders with numbers that are easy to sum up, and a look into the reports made of them."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("hydra")
pytest.importorskip("matplotlib")
from recipe_tools import make_config  # isort: skip

from report import run
from training.run_folder import EVALUATION_COLUMNS, Table, write_config

ASKED = dict.fromkeys(("run", "out", "index", "title", "rows", "unfinished"))
FRAMES = [100, 200, 300, 400]
VERSIONS = {"python": "3.11.7", "torch": "2.13.0", "platform": "here", "git_commit": "abc"}


def make_run(
    folder: Path,
    *overrides: str,
    seed: int = 0,
    final: float = 50.0,
    frames: list[int] = FRAMES,
    points: bool = True,
    versions: dict[str, str] = VERSIONS,
    method: str | None = None,
    **choices: str,
) -> Path:
    """Write what a run leaves behind, with numbers that are easy to sum up."""
    folder.mkdir(parents=True)
    usual = ("env=hopper", "env.version=v4", "total_frames=400", f"seed={seed}")
    config = make_config(*usual, *overrides)
    write_config(folder, config)
    (folder / "versions.json").write_text(json.dumps(versions))
    if method is not None:
        named = choices | {"method": method, "seed": f"s{seed}"}
        cell = {"study": "grid", "choices": named, "overrides": []}
        (folder / "cell.json").write_text(json.dumps(cell))
    columns = ("frames", "return", "missing_ratio", "log_likelihood", "steps_per_second")
    last = {"return": final, "missing_ratio": 0.3, "log_likelihood": 1.5, "steps_per_second": 200.0}
    first = last | {"return": None, "missing_ratio": 0.1, "steps_per_second": 100.0}
    rows = [{"frames": n, **(first if n == frames[0] else last)} for n in frames]
    Table(folder / "metrics.csv", columns).append(rows)
    numbers = {"return_std": 1.0, "length_mean": 9.0, "missing_ratio": 0.25, "log_likelihood": 1.0}
    evaluations = [
        {"frames": n, "kind": kind, "mode": mode, "episodes": 3, "return_mean": final} | numbers
        for n, kind in ((200, "training"), (400, "final"))
        for mode in ("sampled", "mean")
        if n <= frames[-1]
    ]
    Table(folder / "evaluation.csv", EVALUATION_COLUMNS).append(evaluations)
    if points:
        episodes = [
            {"frames": 400, "mechanism": mechanism, "eta": eta, "mode": "sampled", "episode": i}
            | {"return": value, "length": length, "missing_ratio": eta, "log_likelihood": None}
            for mechanism, eta, returns in (("none", 0.0, (90, 110)), ("mcar", 0.5, (80, 90)))
            for i, (value, length) in enumerate(zip(returns, (10, 30), strict=True))
        ]
        Table(folder / "points.csv", ("frames", *(k for k in episodes[0] if k != "frames"))).append(
            episodes
        )
    return folder


def report(folders: list[Path] | str, out: Path, **options: Any) -> None:
    wanted = folders if isinstance(folders, str) else [str(folder) for folder in folders]
    assert run(ASKED | {"run": wanted, "out": str(out)} | options) == 0


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def quantity(out: Path, name: str, **where: str) -> dict[str, str]:
    found = [
        row
        for row in table(out / "summary.csv")
        if row["quantity"] == name and all(row[key] == value for key, value in where.items())
    ]
    assert len(found) == 1, (name, where, found)
    return found[0]
