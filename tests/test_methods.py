"""What a method is called, and that figures never pool two of them.

A cell of a study has the study's name for its method, any other run its belief's and what sets it
apart. The figure of an evaluation draws two methods, and two levels of the noise in training, as
two curves.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("hydra")
pytest.importorskip("matplotlib")
from recipe_tools import BELIEFS, ROOT, make_config  # isort: skip

from analysis.robustness_figure import draw_robustness, read_rows
from training.config import read_settings
from training.errors import UserError
from training.methods import method_label, method_name, read_cell, training_labels
from training.run_folder import read_config


def named(*overrides: str) -> str:
    return method_name(read_settings(make_config(*overrides)), {})


# Names ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("belief", BELIEFS)
def test_a_plain_run_is_called_by_its_belief(belief: str) -> None:
    assert named(f"belief={belief}") == belief


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        (("belief=drbpn", "loss.model_coeff=0"), "drbpn (model_coeff 0)"),
        (("belief=none", "algo=acktr"), "none (acktr)"),
        (("belief=gru", "belief.cell=lstm"), "gru (cell lstm)"),
        (("belief=gru", "belief.with_action=true"), "gru (with_action)"),
        (("belief=gru_action", "belief.with_action=false"), "gru_action (no with_action)"),
        (("belief=fill", "belief.with_mask=true"), "fill (with_mask)"),
        (("belief=none", "heads.critic_input=complete"), "none (critic_input complete)"),
        (
            ("belief=drbpn", "belief.policy_input=mean_cov", "loss.detach_belief=true"),
            "drbpn (policy_input mean_cov, detach_belief)",
        ),
    ],
)
def test_what_sets_a_run_apart_stands_behind_its_belief(
    overrides: tuple[str, ...], name: str
) -> None:
    assert named(*overrides) == name


def test_a_cell_is_called_as_its_study_calls_it_with_its_further_choices(tmp_path: Path) -> None:
    settings = read_settings(make_config("loss.model_coeff=0"))
    assert read_cell(tmp_path) == (None, {})
    cell = {"task": "hopper", "rate": "lr1e-3", "method": "ppo_ours", "seed": "s0"}
    (tmp_path / "cell.json").write_text(json.dumps({"study": "rates", "choices": cell}))
    study, choices = read_cell(tmp_path)
    assert study == "rates"
    assert method_name(settings, choices) == "ppo_ours"
    assert method_label(settings, choices) == "ppo_ours, lr1e-3"
    (tmp_path / "cell.json").write_text("{}")
    with pytest.raises(UserError, match=r"cell.json` can't be read: remove it"):
        read_cell(tmp_path)


def test_committed_runs_keep_their_names() -> None:
    names: dict[str, set[str]] = {}
    for path in sorted((ROOT / "results").glob("*/runs/*/config.yaml")):
        settings = read_settings(read_config(path.parent))
        method = method_name(settings, read_cell(path.parent)[1])
        names.setdefault(path.parts[-4], set()).add(method)
    assert names["mujoco-v4-1m"] == {"drbpn"}
    assert names["acktr-v4-1m"] == {"none (acktr)"}
    assert names["ppo-v4-1m"] == {"none"}
    assert names["beliefs-v4-500k"] == {"drbpn", "gru", "fill", "none"}


def test_labels_tell_what_differs_and_nothing_else() -> None:
    mar, clean = ("gru", "mar:0.5", 1.0), ("gru", "none:0", 1.0)
    assert training_labels([mar, ("drbpn", "mar:0.5", 1.0)]) == {
        mar: "gru",
        ("drbpn", "mar:0.5", 1.0): "drbpn",
    }
    loud = ("gru", "mar:0.5", 3.0)
    assert training_labels([mar, loud, clean]) == {
        mar: "gru, mar:0.5, sigma 1",
        loud: "gru, mar:0.5, sigma 3",
        clean: "gru, none:0, sigma 1",
    }


# Figures ----------------------------------------------------------------------------------------


def episode(method: str, sigma: float, eta: float, value: float) -> dict[str, Any]:
    """A row of the table of recipes/evaluate.py, as far as the figure reads it."""
    empty = dict.fromkeys(("mean_length", "removed_ratio", "spike_probability", "spike_std"), "")
    return empty | {
        "run": f"{method}-{sigma:g}",
        "env": "Hopper-v4",
        "belief": "drbpn",
        "method": method,
        "trained_on": "mar:0.5",
        "trained_noise_sigma": sigma,
        "family": "mcar",
        "eta": eta,
        "noise_sigma": sigma,
        "mode": "mean",
        "return": value,
        "length": 10,
        "missing_ratio": eta,
    }


def test_an_evaluation_draws_two_methods_of_one_belief_apart() -> None:
    kinds = {"drbpn": 3000.0, "ppo_ours": 100.0}
    rows = [episode(method, 1.0, eta, kinds[method]) for method in kinds for eta in (0.2, 0.5)]
    (figure,) = draw_robustness(read_rows(rows)).values()
    curves = figure.axes[0].get_lines()
    drawn = {str(curve.get_label()): set(curve.get_ydata()) for curve in curves}
    assert drawn == {"drbpn (1 run)": {3000.0}, "ppo_ours (1 run)": {100.0}}
    assert len({curve.get_color() for curve in curves}) == 2
    rows = [episode("drbpn", sigma, eta, sigma) for sigma in (1.0, 3.0) for eta in (0.2, 0.5)]
    (figure,) = draw_robustness(read_rows(rows)).values()
    labels = [str(curve.get_label()) for curve in figure.axes[0].get_lines()]
    assert labels == ["drbpn, sigma 1 (1 run)", "drbpn, sigma 3 (1 run)"]
