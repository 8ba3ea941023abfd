"""A transform, a belief, a loss and a robot from files elsewhere, as the pages say."""

import os
import re
import shlex
import sys

import pytest
from omegaconf import OmegaConf
from recipe_tools import ROOT, printed, read_table

EXAMPLE = ROOT / "docs" / "extending"
sys.path[:0] = [str(EXAMPLE), str(ROOT / "docs" / "environment")]

from test_moving_average import TestMovingAverage  # noqa: E402, F401  (collected here)

PAGES = "".join((ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
                for name in ("extending", "environment", "nan"))  # fmt: skip
COMMANDS = re.findall(r"^PYTHONPATH=.* recipes/ppo_drbpn\.py .*$", PAGES, re.MULTILINE)


@pytest.mark.parametrize("line", COMMANDS, ids=["transform", "belief", "loss", "robot", "nan"])
def test_a_command_of_the_page_trains_from_anywhere(line, tmp_path):
    from evaluation.trained import load_trained_agent

    path, python, *words = shlex.split(line)
    assert python == "python"
    words = [str(ROOT / word) if (ROOT / word).exists() else word for word in words]
    kept = os.environ.get("PYTHONPATH", "")
    brief = ("experiment=smoke", "total_frames=128", "hydra.run.dir=run")
    printed(*words, *brief, cwd=tmp_path, PYTHONPATH=f"{ROOT / path.partition('=')[2]}:{kept}")
    (row,) = read_table(tmp_path / "run" / "metrics.csv")
    trained = load_trained_agent(tmp_path / "run")
    if "moving_average" in line:
        assert 0.6 < float(row["decay"]) < 0.8
        assert trained.settings.belief.name == "moving_average"
    if "cautious" in line:
        assert trained.settings.loss.kl_coeff == 2
        assert list((tmp_path / "run" / "logs").rglob("*loss_kl*"))
    if "from_nan" in line:
        assert 0.2 < float(row["missing_ratio"]) < 0.4
        assert OmegaConf.select(trained.settings, "transforms.sensors._target_")
    env = trained.environments()(0)
    names = [type(t).__name__ for t in env.transform]
    assert ("Drift" in names) == ("drift" in line)
    assert trained.agent.policy(env.reset())["action"].isfinite().all()
