"""Beliefs that leave the range of their numbers, under test: what they stop, and what not."""

import diagnose as diagnose_recipe
import numpy as np
import pytest
import torch
from analysis.calibration import diagnose
from evaluation.table import Protocol, evaluate_condition
from evaluation_tools import diagnose as run_diagnosis
from evaluation_tools import evaluate, parse
from recipe_tools import read_table, refused
from training.config import explained

from torchrl_drbpn import BeliefDivergedError, BeliefFilter, GymnasiumBatchEnv


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -3e6])
def test_a_belief_that_diverges_stops_its_own_robot_and_no_other(agent, monkeypatch, value):
    point, protocol = parse("mcar:0.5", agent.settings), Protocol(3, 1, 0, 1, None, 4.0)
    expected = evaluate_condition(agent, point, ["sampled"], protocol).to_dict("records")
    step, calls, actions = BeliefFilter.step, [], []

    def diverge(self, *args, **options):
        out = step(self, *args, **options)
        calls.append(len(calls))
        if len(calls) == 3:  # the second robot's belief, at its third step
            out.mean[1] = value
        return out

    def look(env, *arrays):
        actions.append(arrays[1].action.copy())
        advance(env, *arrays)

    advance = GymnasiumBatchEnv._advance
    monkeypatch.setattr(BeliefFilter, "step", diverge)
    monkeypatch.setattr(GymnasiumBatchEnv, "_advance", look)
    found = evaluate_condition(agent, point, ["sampled"], protocol).to_dict("records")
    assert [row["diverged"] for row in found] == [0, 1, 0]
    assert np.isnan(found[1]["log_likelihood"])
    assert np.isfinite([row["return"] for row in found]).all()
    for row in (0, 2):
        assert found[row] == expected[row]
    assert found[1]["return"] != expected[1]["return"]
    stopped = np.stack(actions)[2 : found[1]["length"], 1]
    assert len(stopped) > 0
    assert (stopped == 0).all()
    assert (np.stack(actions)[:2, 1] != 0).all()
    assert agent.agent.belief.filter.validate  # elsewhere it raises


@pytest.mark.parametrize("command", ["evaluate", "diagnose"])
def test_the_belief_of_an_episode_that_is_over_goes_no_further(agent, monkeypatch, command):
    """Fed its last observation for ever it may diverge, and stop an evaluation of others."""
    step, means, resets = BeliefFilter.step, [], []

    def look(self, *args, **options):
        means.append(args[0].clone())
        resets.append(args[5].clone())
        return step(self, *args, **options)

    monkeypatch.setattr(BeliefFilter, "step", look)
    point = parse("mcar:0.5", agent.settings)
    if command == "evaluate":
        rows = evaluate_condition(
            agent, point, ["sampled"], Protocol(4, 1, 0, 1, None, 4.0)
        ).to_dict("records")
        lengths = [row["length"] for row in rows]
    else:
        tally = diagnose(agent, point, episodes=4, mode="sampled", seed=1, bins=[1, 2])
        lengths = tally.lengths.int().tolist()
    assert len(set(lengths)) > 1
    assert len(means) == max(lengths)
    for row, length in enumerate(lengths):
        reset = torch.stack(resets)[:, row]
        assert reset[0]
        assert not reset[1:length].any()
        assert reset[length:].all()
        assert (torch.stack(means)[length:, row] == 0).all()


def test_the_next_evaluation_begins_with_every_robot(drbpn, tmp_path, monkeypatch):
    step, left = BeliefFilter.step, [1]

    def diverge(self, *args, **options):
        out = step(self, *args, **options)
        if left:
            left.pop()
            out.mean[:] = torch.inf
        return out

    monkeypatch.setattr(BeliefFilter, "step", diverge)
    rows = evaluate(tmp_path / "out.csv", drbpn, points="none:0")
    shares = {m: {row["diverged"] for row in rows if row["mode"] == m} for m in ("sampled", "mean")}
    assert shares == {"sampled": {"1"}, "mean": {"0"}}


def test_a_point_where_a_belief_diverges_is_left_out_with_a_line(
    drbpn, tmp_path, monkeypatch, capsys
):
    whole = diagnose_recipe.diagnose

    def diverging(trained, condition, removed, **how):
        if condition.missingness.eta == 0.8:
            raise BeliefDivergedError("the belief is no longer finite")
        return whole(trained, condition, removed, **how)

    monkeypatch.setattr(diagnose_recipe, "diagnose", diverging)
    assert run_diagnosis(str(drbpn), tmp_path, points=["mcar:0.8", "mcar:0.4"]) == 0
    assert "drbpn, mcar:0.8: no rows, the belief is no longer finite" in capsys.readouterr().out
    assert {row["point"] for row in read_table(tmp_path / "precision.csv")} == {"mcar:0.4"}
    with refused("no point is left: every belief diverged"):
        run_diagnosis(str(drbpn), tmp_path, points=["mcar:0.8"])


def test_an_error_of_the_filter_is_one_line_of_every_command(capsys):
    def job():
        raise BeliefDivergedError("the belief is no longer finite")

    assert explained(job) == 2
    assert capsys.readouterr().err == "error: the belief is no longer finite\n"
