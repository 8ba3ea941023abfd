"""The training recipe over EnvPool: `env.backend=envpool`.

One seed gives one result. The simulators keep their state to themselves, so that a resumed run
goes on with new episodes, says so in one line, and keeps everything else: weights, optimiser,
statistics, counters. Without EnvPool the answer is one line.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest
import torch

pytest.importorskip("hydra")
pytest.importorskip(
    "envpool", reason="EnvPool is not installed: pip install 'torchrl-drbpn[envpool]'"
)
from recipe_tools import differences, make_config, read_table  # isort: skip

from training.checkpoint import last_checkpoint, load_checkpoint
from training.config import read_settings
from training.errors import UserError
from training.loop import assemble, restore, train_rollout, training_state
from training.resume import resumed_config
from training.run import run

SMOKE = (
    "experiment=smoke",
    "env.backend=envpool",
    "missingness=mcar",
    "missingness.eta=0.2",
    "evaluation.every_frames=0",
)
LINE = "env.backend=envpool can't save the state of InvertedPendulum-v5: going on with new episodes"


@pytest.fixture(scope="module")
def half(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the first half of the smoke experiment once."""
    folder = tmp_path_factory.mktemp("run") / "half"
    with torch.random.fork_rng(devices=[]):
        assert run(make_config(*SMOKE, "total_frames=256"), folder) == 0
    return folder


def resume(folder: Path, *overrides: str) -> int:
    return run(resumed_config(make_config(*overrides), ["resume=x", *overrides], folder), folder)


def test_one_seed_gives_one_result_whatever_the_threads(half: Path, tmp_path: Path) -> None:
    run(make_config(*SMOKE, "total_frames=256", "collector.num_threads=2"), tmp_path / "again")
    for table in ("metrics.csv", "episodes.csv", "evaluation.csv"):
        assert read_table(half / table) == read_table(tmp_path / "again" / table), table


def test_a_resumed_run_says_in_one_line_that_it_goes_on_with_new_episodes(
    half: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [shutil.copytree(half, tmp_path / name) for name in "ab"]
    for folder in folders:
        assert resume(folder, "total_frames=512") == 0
        assert "".join(capsys.readouterr()).count(LINE) == 1
        rows = read_table(folder / "metrics.csv")
        assert [int(row["frames"]) for row in rows] == [128, 256, 384, 512]
    first, second = (load_checkpoint(last_checkpoint(folder)) for folder in folders)
    assert differences(first, second) == []


def test_a_new_run_does_not_speak_of_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(make_config(*SMOKE, "total_frames=128", "evaluation.final_episodes=0"), tmp_path / "new")
    assert "new episodes" not in "".join(capsys.readouterr())


def test_all_but_the_episodes_is_restored_and_the_first_ones_are_not_repeated() -> None:
    settings = read_settings(make_config(*SMOKE))
    training = assemble(settings)
    start = training.collector._carrier["observation"].clone()
    train_rollout(training, settings)
    state = training_state(training)
    assert state["simulators"] is None
    fresh = assemble(settings)
    restore(fresh, state, "here")
    again = training_state(fresh)
    # New episodes draw from the generators of the corruption and of torch.
    for changed in ("torch_generator", "transforms"):
        state.pop(changed), again.pop(changed)
    assert differences(state, again) == []
    carrier = fresh.collector._carrier
    assert carrier["is_init"].all()
    assert not carrier["step_count"].any()
    assert not (carrier["observation"] == start).all(-1).any()


def test_without_envpool_the_answer_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "envpool", None)
    with pytest.raises(UserError, match=r"pip install 'torchrl-drbpn\[envpool\]'") as error:
        assemble(read_settings(make_config(*SMOKE)))
    assert "\n" not in str(error.value)
