"""What the tests of evaluate, diagnose and play share: the commands as they are called."""

import diagnose as diagnosis
import evaluate as recipe
from evaluation.conditions import parse_condition
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from recipe_tools import ROOT, read_table


def configured(command="evaluate", *overrides):
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        composed = OmegaConf.to_container(compose(command, list(overrides)), resolve=True)
    assert isinstance(composed, dict)
    return {str(key): value for key, value in composed.items()}


def parse(text, settings):
    return parse_condition(text, settings)


def evaluate(table, *runs, points="", **options):
    base = configured("evaluate", *([f"points=[{points}]"] if points else []))
    base |= {"run": [str(r) for r in runs], "output": str(table), "processes": 1, "episodes": 2}
    assert recipe.run(base | {"figures": False} | options) == 0
    return read_table(table)


def diagnose(folders, out, **changes):
    few = {"points": ["trained"], "episodes": 2, "seed": 4, "bins": [1, 2, 3, 6], "resamples": 20}
    return diagnosis.run(configured("diagnose") | few | {"run": folders, "out": out} | changes)
