"""The diagnosis of beliefs, and beliefs that diverge, under test: what they stop, and what not."""

import shutil

import diagnose as recipe
import numpy as np
import pandas as pd
import pytest
import torch
from analysis import calibration as diagnosis
from analysis.calibration import Compared, Tally
from analysis.calibration_figures import outage_figure
from analysis.calibration_tables import calibration_rows
from beliefs import FORECAST, FORECAST_COV
from evaluation.table import Protocol, evaluate_condition
from evaluation.trained import load_trained_agent
from evaluation_tools import diagnose, evaluate, parse
from matplotlib.image import imread
from omegaconf import OmegaConf
from recipe_tools import read_table, refused
from test_calibration_tables import BINS, known_forecasts, steps_with
from training.config import explained
from training.run_folder import load_config, write_config

from torchrl_drbpn import BeliefDivergedError, BeliefFilter, GymnasiumBatchEnv

BELIEFS = ("drbpn", "gru", "gru_action", "fill", "none", "dvrl", "transformer")


@pytest.fixture(scope="module")
def folders(trained_run):
    return {name: trained_run(name) for name in BELIEFS}


@pytest.fixture(scope="module")
def agents(folders):
    return {name: load_trained_agent(folder) for name, folder in folders.items()}


def tally_of(trained, **changes):
    options = {"episodes": 3, "mode": "sampled", "seed": 4, "bins": BINS}
    return diagnosis.diagnose(trained, parse("trained", trained.settings), **(options | changes))


def point(tally, estimate, entries):
    return tally.sums[Compared(estimate, None, "truth", entries)]


def test_steps_since_last_seen_are_those_a_plain_loop_counts(agents, monkeypatch):
    held = []
    add = Tally.add

    def keep(tally, rows, steps):
        held.append({k: v.clone() for k, v in steps.items()})
        add(tally, rows, steps)

    monkeypatch.setattr(Tally, "add", keep)
    tally = tally_of(agents["drbpn"])
    steps = {key: torch.cat([h[key] for h in held], 1) for key in held[0]}
    assert len(held) > 0
    expected = steps_with(steps["observed"])["class"]
    running = steps["running"]
    assert torch.equal(steps["class"][running], expected[running])
    # The last value is that of the latest step at which the sensor was seen.
    readings, last = steps["reading"], torch.zeros_like(steps["reading"][:, 0])
    for t in range(readings.shape[1]):
        last = torch.where(steps["observed"][:, t], readings[:, t], last)
        assert torch.equal(steps["last value"][:, t], last)
    assert torch.equal(running[:, :, 0].sum(1).double(), tally.lengths.double())
    counts = point(tally, "filtered", "missing")["count"]
    assert counts.sum() == (~steps["observed"] & running).sum()
    assert tally.missing_ratio == pytest.approx(0.4, abs=0.12)


@pytest.mark.parametrize("name", ["drbpn", "gru", "gru_action", "transformer"])
def test_a_forecast_gives_what_arrived_the_likelihood_that_the_belief_reports(agents, name):
    trained = agents[name]
    assert trained.agent.observing is not None
    observing = trained.agent.observing()
    env = trained.environments()(0)
    with torch.no_grad():
        data = env.reset()
        for _ in range(4):
            data = observing(trained.agent.norm(data))
            for row in range(2):
                seen = data["observed"][row]
                if seen.any():
                    mean = data[FORECAST][row][seen].double()
                    cov = data[FORECAST_COV][row][seen][:, seen].double()
                    density = torch.distributions.MultivariateNormal(mean, cov).log_prob(
                        data["normalized_observation"][row][seen].double()
                    )
                    reported = data["belief", "log_likelihood"][row].double()
                    torch.testing.assert_close(reported, density, rtol=1e-4, atol=1e-4)
            data = env.step_mdp(env.step(trained.agent.actor(data)))
    env.close()


def test_each_kind_of_belief_has_the_rows_of_what_it_knows(agents):
    known = {name: tally_of(agents[name], episodes=2) for name in BELIEFS}
    estimates = {name: {pair.estimate for pair in tally.sums} for name, tally in known.items()}
    references = {"last value", "running mean"}
    assert estimates["drbpn"] == references | {"filtered", "predicted"}
    assert estimates["fill"] == estimates["dvrl"] == references | {"filtered"}
    for name in ("gru", "gru_action", "transformer"):
        assert estimates[name] == references | {"predicted"}
    assert estimates["none"] == references
    spread = {name for name, tally in known.items() if any(p.noise is not None for p in tally.sums)}
    assert spread == {"drbpn", "gru", "gru_action", "transformer"}


def test_the_filled_value_is_the_last_value_once_a_sensor_was_seen(agents):
    tally = tally_of(agents["fill"])
    filled = point(tally, "filtered", "missing")["squared"][:, :-1]
    last = point(tally, "last value", "missing")["squared"][:, :-1]
    torch.testing.assert_close(filled, last, rtol=1e-4, atol=1e-6)


def test_the_truth_is_before_the_noise_and_readings_are_after_it(agents):
    # A last value that has just arrived is off by the sensor noise alone.
    trained = agents["none"]
    noise = trained.settings.noise.scale * trained.settings.noise.sigma
    sums = point(tally_of(trained), "last value", "arrived")
    rmse = (sums["squared"].sum() / sums["count"].sum()).sqrt().item()
    assert noise > 0
    norm = trained.agent.norm
    expected = (noise / norm.std).square().mean().sqrt().item()
    assert rmse == pytest.approx(expected, rel=0.5)


def test_the_outage_figure_shows_nis_coverage_and_crps_of_every_class():
    tally = known_forecasts(0.5)
    kind = {"task": "Task-v5", "point": "mcar:0.4", "method": "sure", "trained_on": "none"}
    kind |= {"noise_sigma": 1.0, "runs": 1, "missing_ratio": tally.missing_ratio}
    table = pd.DataFrame([kind | row for row in calibration_rows(tally, resamples=20, seed=0)])
    figure = outage_figure(table)
    assert figure is not None
    drawn = [
        [(list(line.get_xdata()), list(line.get_ydata())) for line in axis.get_lines()]
        for axis in figure.axes
    ]
    rows = table[table["held_against"] == "reading"].set_index("steps_since_seen")
    shown = tally.classes[:-1]
    assert (rows.loc[shown, "count"] >= 30).all()
    for panel, name in zip(drawn, ("nis_per_dof", "coverage_95", "crps"), strict=True):
        assert panel[0][1] == pytest.approx(rows.loc[shown, name].tolist())
        assert panel[1][1] == pytest.approx([rows.loc["never", name]])
    # Half the deviation is claimed: NIS 4, and 67.3 % inside (see above).
    assert drawn[0][0][1][0] == pytest.approx(4, rel=0.1)
    assert drawn[1][0][1][0] == pytest.approx(0.673, abs=0.03)
    assert outage_figure(table[table["held_against"] == "truth"]) is None


def test_the_command_leaves_tables_and_figures_and_says_who_has_no_estimate(
    folders, tmp_path, capsys
):
    chosen = [str(folders[name]) for name in ("drbpn", "gru", "none")]
    points = ["trained", "mcar:0.4", "none:0"]  # the first two are the same
    assert diagnose(chosen, tmp_path / "study", points=points) == 0
    left = sorted(path.name for path in (tmp_path / "study").iterdir())
    figures = [name for name, _ in recipe.FIGURES.values()]
    assert left == sorted(["precision.csv", "calibration.csv", "reliability.csv", *figures])
    said = capsys.readouterr().out
    assert said.count("none: belief=none keeps no estimate") == 1
    rows = read_table(tmp_path / "study" / "precision.csv")
    assert {(r["belief"], r["point"]) for r in rows} == {
        (name, point) for name in ("drbpn", "gru", "none") for point in ("mcar:0.4", "none:0")
    }
    assert all(r["entries"] == "arrived" for r in rows if r["point"] == "none:0")
    assert all(float(r["rmse_low"]) <= float(r["rmse_high"]) for r in rows if r["rmse_low"])
    found = read_table(tmp_path / "study" / "calibration.csv")
    assert {r["belief"] for r in found} == {"drbpn", "gru"}
    for name in figures:
        pixels = imread(tmp_path / "study" / name)[..., :3]
        assert 0.01 < (pixels.min(-1) < 0.9).mean() < 0.9
    figure = tmp_path / "study" / "outages.png"
    first = figure.read_bytes()
    figure.unlink()
    assert diagnose(None, None, redraw=str(tmp_path / "study")) == 0
    assert figure.read_bytes() == first


def test_the_same_seed_gives_the_same_bytes_beside_the_run_where_no_folder_is_named(
    folders, tmp_path
):
    folder = shutil.copytree(folders["drbpn"], tmp_path / "drbpn")
    assert diagnose(str(folder), None) == 0
    assert diagnose(str(folder), tmp_path / "out") == 0
    for path in (tmp_path / "out").iterdir():
        assert path.read_bytes() == (folder / path.name).read_bytes(), path.name


def test_every_point_of_an_evaluation_can_be_diagnosed(folders, tmp_path):
    points = ["reduction:0.5:random", "noise:30", "spikes:0.5"]
    assert diagnose(str(folders["drbpn"]), tmp_path, points=points) == 0
    rows = pd.read_csv(tmp_path / "precision.csv")
    assert set(rows.point) == {"reduction:0.5:random", "noise:30", "spikes:0.5:5"}
    # Removed sensors are never seen: all that is missing is of that class.
    lost = rows[(rows.point == "reduction:0.5:random") & (rows.entries == "missing")]
    assert set(lost.steps_since_seen) == {"all", "never"}
    assert set(lost.missing_ratio) == {0.5}
    found = pd.read_csv(tmp_path / "calibration.csv")
    found = found[(found.held_against == "reading") & (found.steps_since_seen == "all")]
    nis = found.set_index("point").nis_per_dof
    assert nis["spikes:0.5:5"] > 3 * nis["reduction:0.5:random"]


def test_runs_of_one_kind_are_pooled_and_those_of_two_methods_are_not(folders, tmp_path):
    """All are belief=drbpn: what is pooled goes by the method."""
    twin, plain = (shutil.copytree(folders["drbpn"], tmp_path / n) for n in ("twin", "plain"))
    write_config(twin, OmegaConf.merge(load_config(twin), {"seed": 1}))
    write_config(plain, OmegaConf.merge(load_config(plain), {"method": "no_likelihood"}))
    assert diagnose([str(folders["drbpn"]), str(twin), str(plain)], tmp_path / "out") == 0
    rows = read_table(tmp_path / "out" / "precision.csv")
    found = {" ".join(row[key] for key in ("run", "method", "runs")) for row in rows}
    assert found == {"drbpn drbpn 1", "twin drbpn 1", "all drbpn 2", "plain no_likelihood 1"}
    kind = {"estimate": "filtered", "entries": "missing", "steps_since_seen": "all"}
    counts = {row["run"]: int(row["count"]) for row in rows if kind.items() <= row.items()}
    assert counts["all"] == counts["drbpn"] + counts["twin"]


def test_a_belief_without_a_spread_leaves_no_older_calibration_behind(folders, tmp_path):
    assert diagnose(str(folders["gru"]), tmp_path) == 0
    assert diagnose(str(folders["fill"]), tmp_path) == 0
    left = {path.name for path in tmp_path.iterdir()}
    assert left - {"precision.png"} == {"precision.csv"}  # few entries are not drawn


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -3e6])
def test_a_belief_that_diverges_stops_its_own_robot_and_no_other(agent, monkeypatch, value):
    point, protocol = parse("mcar:0.5", agent.settings), Protocol(3, 2, 0, 1, None, 4.0)
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
        tally = diagnosis.diagnose(agent, point, episodes=4, mode="sampled", seed=1, bins=[1, 2])
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
    whole = recipe.diagnose

    def diverging(trained, condition, removed, **how):
        if condition.missingness.eta == 0.8:
            raise BeliefDivergedError("the belief is no longer finite")
        return whole(trained, condition, removed, **how)

    monkeypatch.setattr(recipe, "diagnose", diverging)
    assert diagnose(str(drbpn), tmp_path, points=["mcar:0.8", "mcar:0.4"]) == 0
    assert "drbpn, mcar:0.8: no rows, the belief is no longer finite" in capsys.readouterr().out
    assert {row["point"] for row in read_table(tmp_path / "precision.csv")} == {"mcar:0.4"}
    with refused("no point is left: every belief diverged"):
        diagnose(str(drbpn), tmp_path, points=["mcar:0.8"])


def test_an_error_of_the_filter_is_one_line_of_every_command(capsys):
    def job():
        raise BeliefDivergedError("the belief is no longer finite")

    assert explained(job) == 2
    assert capsys.readouterr().err == "error: the belief is no longer finite\n"
