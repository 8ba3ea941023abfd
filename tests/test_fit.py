"""Fitting the filter to logged data: what is read, what is learned, what an agent starts from."""

from pathlib import Path

import fit as recipe
import numpy as np
import pandas as pd
import pytest
import recipe_tools  # finds recipes/
import references
import torch
from estimation import fitting
from estimation.fitting import Sequences, fit, hide, run, split
from estimation.logs import read_log
from evaluation.trained import load_trained_agent
from evaluation_tools import configured
from filter_problems import space
from recipe_tools import assembled, refused
from safetensors.torch import load_file

from torchrl_drbpn import BeliefFilter, GaussianTransition
from torchrl_drbpn.functional import filter_sequence

SENSORS, TORQUES = [f"x{i}" for i in range(4)], ["u0", "u1"]


def logged(episodes=10, time=60):
    """Noisy, incomplete readings of a linear system, each sensor in units of its own."""
    system = references.random_system(3, 4, seed=1)
    data = references.simulate(system, episodes, time, seed=1, missing_rate=0.3)
    data.reset[:, 0] = True
    readings = torch.where(data.observed, data.observation, torch.nan)
    readings = readings * torch.tensor([1.0, 100.0, 1e-3, 1.0]).double() + 5
    taken = torch.cat([data.previous_action[:, 1:], 0 * data.previous_action[:, :1]], 1)
    flat = torch.cat([readings, 40 * taken], -1).flatten(0, 1)
    table = pd.DataFrame(flat.numpy(), columns=[*SENSORS, *TORQUES])
    return system, table.assign(run=np.repeat([f"run {i}" for i in range(episodes)], time))


def write(table, path):
    if path.suffix == ".csv":
        table.to_csv(path, index=False)
    elif path.suffix == ".parquet":
        table.to_parquet(path)
    else:
        run = table["run"].str.removeprefix("run ").astype(int).to_numpy()
        x, u = table[SENSORS].to_numpy(), table[TORQUES].to_numpy()
        np.savez(path, x=x, u=u, run=run)
    return path


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet"])
def test_every_kind_of_file_is_the_same_log(tmp_path, suffix):
    _, table = logged(3, 6)
    table = table.drop(index=17).sample(frac=1, random_state=0).sort_values("run", kind="stable")
    table.iloc[5, table.columns.get_loc("u0")] = np.nan  # the last of an episode leads nowhere
    expected = table[SENSORS].to_numpy()
    names = (["x"], ["u"]) if suffix == ".npz" else (SENSORS, TORQUES)
    log = read_log(str(write(table, tmp_path / f"log{suffix}")), *names, "run")
    assert log.observation.shape == (3, 6, 4)
    assert len(log.episodes) == 3
    found = torch.where(log.observed, log.observation, torch.nan).flatten(0, 1)[:17].numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert log.reset.tolist() == [[True, *[False] * 5]] * 2 + [[True, *[False] * 4, True]]
    actions = table[TORQUES].to_numpy()
    np.testing.assert_allclose(log.previous_action[1, 1:].numpy(), actions[6:11], rtol=1e-6)
    assert not log.previous_action[:, 0].any()
    assert not log.observed[2, 5].any()
    assert not log.observation[~log.observed].any()


EVERY = slice(None)


@pytest.mark.parametrize(
    ("cell", "changes", "line"),
    [
        (None, {"episode": None}, "`episode` must name the column .* there are x0, x1"),
        (None, {"episode": "runs"}, "`episode`: there is no column `runs`: did you mean `run`?"),
        (None, {"observation": ["x0", "y"]}, "`observation`: there is no column `y`: there are"),
        (None, {"observation": None}, "`observation` must name columns"),
        (None, {"action": ["x0"]}, "column `x0` is named twice"),
        (None, {"data": "log.txt"}, "`data` must be .csv, .parquet or .npz, got"),
        (None, {"data": "nowhere.csv"}, "`data` must be a file .* there is no nowhere.csv"),
        (None, {"data": "broken.npz"}, "broken.npz can't be read as a table"),
        (None, {"data": "broken.csv"}, "broken.csv can't be read as a table"),
        ((3, "x1", "off"), {}, "column `x1` holds 'off' in row 4, which is no finite number"),
        ((EVERY, "x1", np.inf), {}, "column `x1` holds .*inf.* in row 1"),
        ((EVERY, "x1", 2.0), {}, "column `x1` is constant at 2: there is nothing to learn"),
        ((EVERY, "x1", np.nan), {}, "column `x1` has no reading at all"),
        ((4, "u1", np.nan), {}, "`action`: a cell is empty in row 5"),
        ((4, "run", None), {}, "`episode`: column `run` is empty in row 5"),
        ((EVERY, "run", "the only one"), {}, "`episode` must tell two episodes apart"),
        (None, {"out": None}, "`out` must be a folder"),
        (None, {"steps": 0}, "`steps` must be at least 1, got 0"),
        (None, {"hold_out": 1.5}, "`hold_out` must be in"),
        (None, {"hide": 0.9, "hide_length": 2}, "`hide`, `hide_length`: `mean_length` must be"),
        (None, {"belief": {"name": "gru"}}, "`belief` must be drbpn or .* here, got gru"),
        (None, {"belief": {"mask_model": True}}, "`belief.mask_model` must be false"),
        (None, {"belief": {"pretrained": "x"}}, "`belief.pretrained` is what this command makes"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_nothing_is_written(tmp_path, monkeypatch, cell, changes, line):
    monkeypatch.chdir(tmp_path)
    for name in ("log.txt", "broken.npz"):
        Path(name).write_text("no table")
    Path("broken.csv").write_bytes(b"\xff\xfe\x00a,b\n1")
    table = logged(3, 6)[1].astype(object)
    if cell is not None:
        rows, columns, value = cell
        table.loc[rows, columns] = value
    write(table, Path("log.csv"))
    config = configured("fit") | {
        "data": "log.csv", "observation": SENSORS, "action": TORQUES, "episode": "run",
        "out": "out", "steps": 1,
    }  # fmt: skip
    with refused(line):
        recipe.run(config | changes)
    assert not Path("out").exists()


def test_episodes_are_split_and_every_one_is_somewhere():
    for episodes, sizes in ((2, (1, 1, 1)), (3, (1, 1, 1)), (10, (6, 2, 2)), (50, (30, 10, 10))):
        parts = split(episodes, 0.2, seed=0)
        assert tuple(map(len, parts)) == sizes
        assert torch.cat(parts).unique().tolist() == list(range(episodes))
        assert not set(parts[0].tolist()) & set(parts[2].tolist())


def sequences(system, batch, time, seed=3):
    data = references.simulate(system, batch, time, seed=seed)
    data.reset[:, 0] = True
    data.previous_action[:, 0] = 0
    parts = (data.previous_action, data.observation, data.observed, data.reset)
    return Sequences(*(x.float() if x.is_floating_point() else x for x in parts))


def test_windows_of_a_cut_are_the_sequence_and_its_padding_is_reset():
    data = sequences(references.random_system(3, 4), 2, 11)
    windows = data.cut(4)
    assert windows.reset.shape == (6, 4)
    assert torch.equal(windows.observation.reshape(2, 12, 4)[:, :11], data.observation)
    assert not windows.observed.reshape(2, 12, 4)[:, 11].any()
    assert windows.reset.reshape(2, 12)[:, 11].all()


def test_a_linear_filter_nearly_reaches_the_likelihood_of_the_system_itself():
    """With actions in units of a thousand, which the scale must take out and put back."""
    system = references.random_system(3, 4, seed=1)
    train, held = sequences(system, 40, 64), sequences(system, 40, 64, seed=4)
    data = [x._replace(previous_action=1e3 * x.previous_action) for x in (train, held)]
    transition = GaussianTransition(3, 2, hidden_sizes=[], residual=False)
    belief_filter = BeliefFilter(4, 2, 3, transition=transition)
    before = run(belief_filter, data[1])[1].item()
    options = {"length": 32, "batch_size": 16, "lr": 2e-2, "max_grad_norm": 10.0, "patience": 50}
    history = list(fit(belief_filter, *data, steps=200, seed=0, weight_decay=0.0, **options))
    after = run(belief_filter, data[1])[1].item()
    assert after == pytest.approx(max(history), abs=2e-3)  # folding the scale changes nothing
    model = space(system.to(torch.float32))
    start = torch.zeros(40, 3)
    truth = filter_sequence(model, start, *held).log_likelihood.sum() / held.observed.sum()
    assert after > truth.item() - 0.08 > before


def test_the_weights_of_the_best_epoch_stay_and_patience_is_the_end_of_it():
    system = references.random_system(3, 4, seed=1)
    train, held = sequences(system, 2, 8), sequences(system, 20, 16, seed=4)
    belief_filter = BeliefFilter(4, 2, 3)
    options = {"length": 8, "batch_size": 8, "max_grad_norm": 10.0, "weight_decay": 0.0}
    options |= {"steps": 100, "lr": 0.02, "patience": 5, "seed": 0}
    history = list(fit(belief_filter, train, held, **options))
    best = max(history)
    assert history[-6] == best  # then five epochs without a better one
    assert history[-1] < best - 0.1
    after = run(belief_filter, held)[1].item()
    assert after == pytest.approx(best, abs=2e-3)


def test_windows_start_from_the_beliefs_and_the_jacobian_of_the_whole_sequences(monkeypatch):
    data = sequences(references.random_system(3, 4), 2, 12)
    belief_filter = BeliefFilter(4, 2, 3, covariance="propagated")
    calls = []

    def watched(own, given, before=None):
        jacobian = own.mean_jacobian.clone()
        out = beliefs, _ = run(own, given, before)
        f = own.transition.mean_network()
        mean, action = beliefs.mean[:, :-1], given.previous_action[:, 1:]
        calls.append((given, before, beliefs, jacobian, f.jacobian(mean, action, average=True)))
        return out

    monkeypatch.setattr(fitting, "run", watched)
    options = {"length": 4, "batch_size": 6, "lr": 1e-3, "max_grad_norm": 1.0, "patience": 1}
    list(fit(belief_filter, data, data, steps=1, seed=0, weight_decay=0.0, **options))
    (_, _, whole, _, expected), (windows, before, _, jacobian, _), _ = calls
    torch.testing.assert_close(jacobian, expected)
    cut = data.cut(4).observation
    for row, window in enumerate(windows.observation):
        (place,) = (cut == window).flatten(1).all(1).nonzero().flatten().tolist()
        episode, step = divmod(4 * place, 12)
        for found, values in zip(before, whole, strict=True):
            last = values[episode, step - 1] if step else torch.zeros_like(found[row])
            torch.testing.assert_close(found[row], last)


def test_the_weights_of_the_transition_alone_decay():
    data = sequences(references.random_system(3, 4), 2, 8)
    belief_filter = BeliefFilter(4, 2, 3)
    options = {"length": 8, "batch_size": 2, "max_grad_norm": 1.0, "patience": 1, "seed": 0}
    list(fit(belief_filter, data, data, steps=1, lr=1e-3, weight_decay=1e3, **options))
    for name, parameter in belief_filter.named_parameters():
        if name.startswith("transition") and name.endswith("weight"):
            assert parameter[:, :3].abs().max() < 2e-3, name
    assert belief_filter.emission.matrix.diagonal().min() > 0.9


def test_the_last_value_of_a_sensor_is_what_it_showed_last_and_zero_before():
    data = sequences(references.random_system(3, 4), 2, 8)
    found = fitting.estimates({"filter": BeliefFilter(4, 2, 3)}, data)["last value"].mean
    last = torch.zeros(2, 4)
    for t in range(8):
        last = data.observation[:, t].where(data.observed[:, t], last)
        assert torch.equal(found[:, t], last)


def test_what_is_hidden_was_there_and_is_the_share_asked_for_in_stretches():
    observed = torch.rand(40, 200, 5) < 0.8
    hidden = hide(observed, 0.3, 10.0, seed=0)
    assert not (hidden & ~observed).any()
    assert hidden.sum() / observed.sum() == pytest.approx(0.3, abs=0.03)
    everything = hide(torch.ones_like(observed), 0.3, 10.0, seed=0)
    starts = (everything[:, 1:] & ~everything[:, :-1]).sum()
    assert everything.sum() / starts == pytest.approx(10.0, rel=0.1)
    assert torch.equal(hidden, hide(observed, 0.3, 10.0, seed=0))


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fit")
    data = write(logged(20, 50)[1], folder / "log.csv")
    config = configured("fit", "belief.transition.hidden_sizes=[16]") | {
        "data": str(data), "observation": SENSORS, "action": TORQUES, "episode": "run",
        "out": str(folder / "out"), "steps": 150, "lr": 0.02, "batch_size": 16, "hide_length": 4,
    }  # fmt: skip
    assert recipe.run(config) == 0
    return folder / "out"


def test_the_table_holds_every_method_and_component_and_the_last_value_is_behind(fitted):
    assert {path.name for path in fitted.iterdir()} == {
        "table.csv", "estimates.png", "filter.safetensors",
    }  # fmt: skip
    table = pd.read_csv(fitted / "table.csv").set_index(["method", "component"])
    methods = ["filter", "linear Kalman filter", "filter, smoothed", "last value"]
    assert list(dict.fromkeys(table.index.get_level_values(0))) == methods
    assert set(table.index.get_level_values(1)) == {"all", *SENSORS}
    overall = table.xs("all", level="component")
    assert overall["rmse_std"].idxmax() == "last value"
    assert (overall["hidden_entries"] == overall["hidden_entries"].iloc[0]).all()
    ratio = table["rmse"] / table["rmse_std"]  # in units of the column: x1 is a hundred times x0
    assert ratio["filter", "x1"] / ratio["filter", "x0"] > 10
    for column, expected in (("coverage_50", 0.5), ("coverage_90", 0.9)):
        assert overall.loc["linear Kalman filter", column] == pytest.approx(expected, abs=0.2)
        assert np.isnan(overall.loc["last value", column])


def test_an_agent_starts_from_the_filter_and_its_normalisation(fitted, tmp_path):
    """InvertedPendulum has four sensors too, and one action."""
    table = logged(4, 20)[1]
    config = configured("fit") | {
        "data": str(write(table, tmp_path / "log.csv")), "observation": SENSORS, "action": "u0",
        "episode": "run", "out": str(tmp_path / "out"), "steps": 2, "hide_length": 4,
    }  # fmt: skip
    assert recipe.run(config) == 0
    path = tmp_path / "out" / "filter.safetensors"
    words = ("belief=drbpn_propagated", f"belief.pretrained={path}")
    started = assembled("experiment=smoke", *words)[0].agent.state_dict()
    for name, value in load_file(path).items():
        assert torch.equal(started[name], value), name
    assert started["norm.count"].min() > 10
    assert recipe_tools.run(
        tmp_path / "run", "experiment=smoke", *words, "total_frames=128",
        "evaluation.final_episodes=0",
    ) == 0  # fmt: skip
    path.unlink()  # a run needs it once
    assert load_trained_agent(tmp_path / "run").frames == 128
    assert recipe_tools.resume(tmp_path / "run", "total_frames=256") == 0
    with refused("does not fit the settings of this run"):
        assembled(
            "experiment=smoke", words[0], f"belief.pretrained={fitted / 'filter.safetensors'}"
        )
    with refused(r"`belief.pretrained` must be a file of recipes/fit.py"):
        assembled("experiment=smoke", *words)
