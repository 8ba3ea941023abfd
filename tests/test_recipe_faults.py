"""What goes wrong inside a run ends in one line that says at which step; what was saved is good."""

import re

import pytest
import torch
from recipe_tools import SMOKE, read_table, refused, resume, run
from training.checkpoint import last_checkpoint, load_checkpoint


@pytest.mark.parametrize("belief", ["drbpn", "gru", "none"])
def test_a_run_that_diverges_stops_with_its_step_and_saves_nothing(tmp_path, belief):
    folder = tmp_path / "run"
    with refused(r"training stopped at 0 steps: .*(nan|inf|no longer finite)") as error:
        run(folder, *SMOKE, f"belief={belief}", "optim.lr=1e30")
    assert "checkpoint" not in str(error.value)
    assert not list(folder.rglob("*.pt"))
    assert not read_table(folder / "evaluation.csv")


def test_a_run_that_diverges_later_names_its_last_good_checkpoint(tmp_path, monkeypatch):
    import ppo_drbpn

    collect = ppo_drbpn.collect

    def spoilt(training):
        if training.frames == 256:
            with torch.no_grad():
                next(training.agent.critic.parameters())[0] = torch.inf
        return collect(training)

    monkeypatch.setattr(ppo_drbpn, "collect", spoilt)
    folder = tmp_path / "run"
    what = r"at 256 steps: the (loss|weight|gradient) `.*` is (nan|inf)"
    kept = rf"Its last checkpoint, at 256 steps, is in {re.escape(str(folder))}"
    with refused(f"{what}.* {kept}"):
        run(folder, *SMOKE, "checkpoint.every_frames=128")
    assert load_checkpoint(last_checkpoint(folder))["progress"]["frames"] == 256
    assert "final" not in (folder / "evaluation.csv").read_text()


@pytest.mark.parametrize(
    ("fault", "line"),
    [
        ("reward", "training stopped at 256 steps: the reward of environment 2 is not finite"),
        ("observation", "training stopped at 256 steps: the observation of environment 2 is not"),
        ("raise", "training stopped at 256 steps: the environment failed: motor on fire"),
    ],
)
def test_a_fault_of_the_environment_ends_in_one_line_and_a_saved_run(
    tmp_path, monkeypatch, fault, line
):
    import ppo_drbpn

    collect, calls = ppo_drbpn.collect, []

    def faulty(training):
        calls.append(1)
        if len(calls) == 4:  # the first gives statistics alone
            rollout = training.collector.rollout

            def broken():
                if fault == "raise":
                    raise RuntimeError("motor\non fire")
                data = rollout()
                data["next", fault][2, 5] = torch.nan
                data["next", "observed"][2, 5] = True
                return data

            monkeypatch.setattr(training.collector, "rollout", broken)
        return collect(training)

    monkeypatch.setattr(ppo_drbpn, "collect", faulty)
    folder = tmp_path / "run"
    with refused(line):
        run(folder, *SMOKE, "checkpoint.every_frames=10000")
    assert load_checkpoint(last_checkpoint(folder))["progress"]["frames"] == 256
    monkeypatch.undo()
    assert resume(folder) == 0  # with new episodes
    assert len(read_table(folder / "metrics.csv")) == 4


def test_an_engine_that_resets_itself_is_counted_and_said_once(tmp_path, monkeypatch, capsys):
    import ppo_drbpn

    collect = ppo_drbpn.collect

    def wild(training):
        if 0 < training.frames < 384:
            training.env.base_env.envs[1].unwrapped.data.qvel[0] = 1e12
        return collect(training)

    monkeypatch.setattr(ppo_drbpn, "collect", wild)
    assert run(tmp_path / "run", *SMOKE) == 0
    rows = read_table(tmp_path / "run" / "metrics.csv")
    assert [row["engine_resets"] for row in rows] == ["0", "1", "2", "2"]
    printed = "".join(capsys.readouterr())
    assert printed.count("reset it") == 1
    assert "Warning" not in printed
