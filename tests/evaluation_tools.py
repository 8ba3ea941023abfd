"""What the tests of evaluate, diagnose and play share: the commands as they are called."""

from pathlib import Path
from typing import Any

import diagnose as diagnosis
import evaluate as recipe
from evaluation.conditions import Condition, parse_condition
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from recipe_tools import ROOT, read_table


def configured(command: str = "evaluate", *overrides: str) -> dict[str, Any]:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        composed = OmegaConf.to_container(compose(command, list(overrides)), resolve=True)
    assert isinstance(composed, dict)
    return {str(key): value for key, value in composed.items()}


def parse(text: str, settings: DictConfig) -> Condition:
    return parse_condition(text, settings, spike_std=5.0)


def evaluate(table: Path, *runs: Path, points: str = "", **options: Any) -> list[dict[str, str]]:
    base = configured("evaluate", *([f"points=[{points}]"] if points else []))
    base |= {"run": [str(r) for r in runs], "output": str(table), "processes": 1, "episodes": 2}
    assert recipe.run(base | {"figures": False} | options) == 0
    return read_table(table)


def diagnose(folders: Any, out: Path | None, **changes: Any) -> int:
    few = {"points": ["trained"], "episodes": 2, "seed": 4, "bins": [1, 2, 3, 6], "resamples": 20}
    return diagnosis.run(configured("diagnose") | few | {"run": folders, "out": out} | changes)
