"""An agent saved by itself: it acts as the run did, and its card says how it was trained."""

from typing import Any

import play
import pytest
import save_agent
import torch
from evaluation.trained import WEIGHTS, load_trained_agent
from evaluation_tools import ROOT, configured, evaluate
from recipe_tools import refused


@pytest.fixture(scope="module")
def finished(trained_run):
    return trained_run("drbpn", "evaluation.final_episodes=2")


def save(run: Any, out: Any) -> int:
    return save_agent.run({"run": run and str(run), "out": out and str(out)})


def test_a_saved_agent_acts_as_the_run_did(finished, tmp_path):
    out = tmp_path / "agents" / "pendulum"
    assert save(finished, out) == 0
    left = {path.name for path in out.iterdir()}
    assert left == {"README.md", WEIGHTS, "config.yaml", "evaluation.csv", "versions.json"}
    first, second = load_trained_agent(finished), load_trained_agent(out)
    assert first.frames == second.frames
    for name, value in first.agent.state_dict().items():  # the normalisation's among them
        assert torch.equal(second.agent.state_dict()[name], value), name
    tables = [
        evaluate(tmp_path / f"{i}.csv", folder, points="'mcar:0.5'")
        for i, folder in enumerate((finished, out))
    ]
    assert tables[0] == [row | {"run": finished.name} for row in tables[1]]
    film = configured("play") | {"run": str(out), "robot": False, "start": 0, "steps": 2}
    assert play.run(film) == 0
    assert (out / "play.gif").is_file()
    card = (out / "README.md").read_text()
    for text in ("# InvertedPendulum-v5, drbpn", "mcar:0.4", "| 128 |", "| seed | 0 |", "sampled"):
        assert text in card


@pytest.mark.parametrize("folder", sorted((ROOT / "agents").iterdir()), ids=lambda path: path.name)
def test_an_agent_of_the_repository_acts_under_this_code(folder, tmp_path):
    trained = load_trained_agent(folder)
    env = trained.environments()(0)
    with torch.no_grad():
        data = env.rollout(20, trained.agent.policy, break_when_any_done=False)
    assert data["action"].isfinite().all()
    assert (data["next", "reward"] > 0).float().mean() > 0.9
    film = {"run": str(folder), "robot": False, "start": 0, "steps": 2, "out": tmp_path / "x.gif"}
    assert play.run(configured("play") | film) == 0


def test_a_run_folder_is_not_written_into_and_broken_weights_are_one_line(
    finished, drbpn, tmp_path
):
    with refused("`out` must be a folder for an agent"):
        save(finished, drbpn)
    save(finished, tmp_path / "agent")
    weights = tmp_path / "agent" / WEIGHTS
    weights.write_bytes(weights.read_bytes()[:-40])
    with refused("can't be read as weights"):
        load_trained_agent(tmp_path / "agent")
