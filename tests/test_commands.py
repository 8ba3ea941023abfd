"""What the commands of the recipes can not do is said in one line, before anything is done."""

import importlib
import sys

import pytest
from evaluation_tools import ROOT, configured
from recipe_tools import refused
from training.config import command

NO_RUN = "`run` must name "
COMMANDS = ("evaluate", "diagnose", "export", "play", "plot_sensors", "report", "save_agent")


@pytest.mark.parametrize(
    ("name", "changes", "line"),
    [
        ("evaluate", {"run": None}, NO_RUN),
        ("evaluate", {"episodes": 0}, "`episodes` must be at least 1, got 0"),
        ("evaluate", {"processes": 1.5}, "`processes` must be at least 1, got 1.5"),
        ("evaluate", {"modes": ["best"]}, "`modes` must hold sampled and mean"),
        ("evaluate", {"modes": []}, "`modes` must hold sampled, mean or both"),
        ("evaluate", {"output": "no/such/folder/x.csv"}, "`output` must lie in an existing folder"),
        ("evaluate", {"points": ["reduction:0.5:random"], "reduction_seed": -1},
         "`reduction_seed` must be"),
        ("evaluate", {"robust": "gate"}, "`robust` must be one of huber, imq, or None"),
        (
            "evaluate",
            {"robust": "imq", "robust_threshold": 0},
            "`robust_threshold` must be a positive, finite",
        ),
        ("diagnose", {"run": None}, NO_RUN),
        ("diagnose", {"redraw": "nowhere"}, "nowhere has no tables"),
        ("diagnose", {"points": []}, "`points` must hold at least one"),
        ("diagnose", {"mode": "best"}, "`modes` must hold"),
        ("diagnose", {"episodes": 0}, "`episodes` must be at least 1, got 0"),
        ("diagnose", {"bins": [1, 3, 3]}, "`bins` must be whole numbers that start at 1 and asc"),
        ("diagnose", {"resamples": 1}, "`resamples` must be at least 2"),
        ("diagnose", {"out": __file__}, "`out` must be a folder, .* is a file"),
        ("export", {"run": None}, "`run` must name a run folder"),
        ("export", {"run": str(ROOT)}, f"`{ROOT}` must be a run folder with config.yaml"),
        ("export", {"out": "p.bin"}, "`out` must end in .pt2 for format=aoti, got p.bin"),
        ("export", {"out": "p.pt2", "format": "onnx"}, "`out` must end in .onnx for format=onnx"),
        ("export", {"out": "nowhere/p.pt2"}, "`out` must lie in an existing folder"),
        ("export", {"format": "tflite"}, "`format` must be aoti, export or onnx, got 'tflite'"),
        ("export", {"robots": 0}, "`robots` must be at least 1, got 0"),
        ("play", {"run": None}, NO_RUN),
        ("play", {"point": "mcar:2"}, "`points` must hold"),
        ("play", {"mode": "best"}, "`modes` must hold"),
        ("play", {"steps": 0}, "`steps` must be at least 1, got 0"),
        ("play", {"start": -1}, "`start` must be at least 0, got -1"),
        ("play", {"start": 100_000}, "`start` must lie inside the episode"),
        ("play", {"fps": 60}, r"`fps` must be in \[1, 50\], got 60"),
        ("play", {"sensors": ["pole"]}, "`sensors` must be among 0 cart position, .*got 'pole'"),
        ("play", {"sensors": [4]}, "`sensors` must be among .*got 4"),
        ("play", {"sensors": 0}, "`sensors` must be 1 or more"),
        ("play", {"out": "nowhere/film.gif"}, "`out` must lie in an existing folder"),
        ("play", {"out": "film.avi"}, r"`out` must end in .gif, .mp4 or .png, got film.avi"),
        ("plot_sensors", {"run": None}, NO_RUN),
        ("plot_sensors", {"run": "nowhere/*"}, "run folders, nowhere/\\* matches none"),
        ("plot_sensors", {"run": "nowhere"}, "there is no folder nowhere"),
        ("plot_sensors", {"orders": 5}, "`orders` must be at least 20"),
        ("plot_sensors", {"dpi": 0}, "`dpi` must be at least 1"),
        ("report", {"run": "nowhere"}, "`run` must name run folders, there is no folder nowhere"),
        ("report", {"run": None}, NO_RUN),
        ("report", {"out": None}, "`out` must be the folder of a study"),
        ("report", {"from": "nowhere"}, "`from` reads and writes the tables of a study: leave out"),
        ("report", {"from": "nowhere", "run": None, "out": None}, "`from` must name folders with"),
        ("report", {"rows": 1}, "`rows` must be at least 2, got 1"),
        ("save_agent", {"run": None}, "`run` must name a folder"),
        ("save_agent", {"out": None}, "`out` must name a folder"),
        ("save_agent", {}, "has no final evaluation yet"),
    ],
)  # fmt: skip
def test_bad_input_is_answered_with_one_line_before_anything_is_done(
    drbpn, tmp_path, name, changes, line
):
    config = configured(name) | {"run": str(drbpn), "start": 0} | changes
    if "out" not in changes:
        written = {"play": "film.gif", "export": "policy.pt2"}.get(name, "out")
        config["out"] = str(tmp_path / written)
    if name == "evaluate" and "output" not in changes:
        config |= {"output": str(tmp_path / "out.csv"), "processes": changes.get("processes", 1)}
    with refused(line):
        importlib.import_module(name).run(config)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["diagnose", "plot_sensors"])
def test_several_runs_need_a_folder(drbpn, feedforward, name):
    with refused("`out` must name a folder for 2 runs"):
        importlib.import_module(name).run(
            configured(name) | {"run": [str(drbpn), str(feedforward)]}
        )


@pytest.mark.parametrize("name", COMMANDS)
def test_the_line_goes_to_standard_error_with_status_2(name, tmp_path, monkeypatch, capsys):
    for words in (["run=nowhere", f"out={tmp_path}"], ["runs=x"]):
        if name == "evaluate":
            words = words[:1]
        monkeypatch.setenv("HYDRA_FULL_ERROR", "0")  # the command sets it: undone after the test
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *words])
        with pytest.raises(SystemExit) as left:
            command(name, importlib.import_module(name).run)
        (line,) = capsys.readouterr().err.splitlines()
        assert left.value.code == 2
        assert line.startswith(("error: `run", "error: `nowhere"))
