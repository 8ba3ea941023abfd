"""The picture of a belief.

A recording holds the truth, what arrived and the belief of the agent that is read back, all in one
unit and step by step; what is drawn is a PNG with something on it, with or without pictures of the
robot. Every component of every MuJoCo task has a name of its own. Bad input is answered with one
line.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

pytest.importorskip("hydra")
pytest.importorskip("matplotlib")
from recipe_tools import make_config, make_folder  # isort: skip

import plot_belief
from evaluation.conditions import read_point
from evaluation.trained import load_trained_agent
from matplotlib.image import imread
from rendering import frames
from rendering.belief_figure import draw_belief, frame_steps, most_missing, save_figure
from rendering.frames import render_poses
from rendering.trajectory import Recording, record_episode
from training.errors import UserError
from training.sensors import named_tasks, sensor_names

DEFAULTS = {"mode": "sampled", "start": 0, "steps": 12, "sensors": 2, "frames": 0, "seed": 4}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_folder(tmp_path_factory.mktemp("runs") / "smoke")


def record(folder: Path, point: str = "trained", **changes: Any) -> Recording:
    trained = load_trained_agent(folder)
    options = {key: DEFAULTS[key] for key in ("mode", "start", "steps", "seed")} | changes
    return record_episode(trained, read_point(point, trained.settings.missingness), **options)


def draw(folder: Path, to: Path, **changes: Any) -> int:
    base = {"run": str(folder), "point": "trained", "out": str(to), "threads": 1}
    return plot_belief.run(base | DEFAULTS | changes)


# The recording --------------------------------------------------------------------------------


def test_a_recording_holds_every_step_and_component(folder: Path) -> None:
    recording = record(folder, steps=5)
    for values in (recording.complete, recording.arrived, recording.estimate, recording.std):
        assert values.shape == recording.observed.shape == (5, 4)
        assert np.isfinite(values).all()
    assert len(recording.poses) == len(recording.rewards) == 5
    assert (recording.std > 0).all()
    assert 0 < recording.missing_ratio < 1
    assert (recording.arrived[~recording.observed] == 0).all()


def test_truth_and_arrivals_differ_by_the_sensor_noise_alone(folder: Path) -> None:
    def differences(recording: Recording) -> np.ndarray:
        return (recording.complete - recording.arrived)[recording.observed]

    noise = differences(record(folder))
    assert 0 < np.abs(noise).max() < 1.0
    # The truth is the simulator's, shifted and scaled by the same numbers at every step.
    recording = record(folder)
    positions = np.array([np.concatenate(pose) for pose in recording.poses])
    slope = np.diff(recording.complete, axis=0) / np.diff(positions, axis=0)
    np.testing.assert_allclose(slope, np.broadcast_to(slope[0], slope.shape), rtol=1e-3)


def test_the_same_seed_gives_the_same_recording_and_start_only_cuts_it(folder: Path) -> None:
    whole, again, late = record(folder), record(folder), record(folder, start=2, steps=3)
    np.testing.assert_array_equal(whole.estimate, again.estimate)
    np.testing.assert_array_equal(whole.estimate[2:5], late.estimate)
    assert late.first_step == 2


def test_another_missingness_than_in_training_can_be_drawn(folder: Path) -> None:
    assert record(folder, "none:0").missing_ratio == 0
    assert np.isnan(record(folder, "none:0").coverage)
    everything = record(folder, "mcar:1")
    assert everything.missing_ratio == 1
    # Nothing arrives: the belief is the predicted one, less sure than with sensors.
    assert everything.std.mean() > record(folder, "none:0").std.mean()


def test_sensors_that_miss_most_come_first_in_choice_and_stay_in_order() -> None:
    observed = np.array([[1, 0, 1, 0], [1, 0, 0, 0], [1, 1, 0, 0]], dtype=bool)
    recording = Recording(
        "T", list("abcd"), 0, *[np.zeros((3, 4))] * 2, observed, *[np.zeros((3, 4))] * 2,
        [], np.zeros(3), None,
    )  # fmt: skip
    assert most_missing(recording, 1) == [3]
    assert most_missing(recording, 3) == [1, 2, 3]
    assert plot_belief.chosen_sensors(recording, ["d", 0]) == [3, 0]


# The picture ----------------------------------------------------------------------------------


def test_a_picture_is_written_and_shows_something(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "belief.png"
    assert draw(folder, out, frames=2) == 0
    pixels = imread(out)[..., :3]
    assert pixels.shape[1] > 1000
    assert 0.02 < (pixels.min(-1) < 0.9).mean() < 0.9
    assert sorted(tmp_path.iterdir()) == [out]


def test_where_nothing_can_be_rendered_the_rest_is_drawn_and_one_line_says_so(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise RuntimeError("no display")

    monkeypatch.setattr(frames, "render_poses", broken)
    assert draw(folder, tmp_path / "belief.png", frames=2) == 0
    assert (tmp_path / "belief.png").stat().st_size > 10_000
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "no pictures of the robot, off-screen rendering failed: no display"
    assert "intervals hold" in said[1]


def test_the_same_recording_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    recording = record(folder)
    for name in ("a.png", "b.png"):
        save_figure(draw_belief(recording, [0, 1], [], title="x"), tmp_path / name, dpi=60)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_a_robot_is_drawn_on_white_and_its_model_left_alone(folder: Path) -> None:
    recording = record(folder, steps=3)
    before = recording.model.tex_data.copy()
    try:
        (picture,) = render_poses(
            recording.model, recording.task, recording.poses[:1], width=60, height=80
        )
    except RuntimeError as error:
        pytest.skip(f"no off-screen rendering on this machine: {error}")
    assert picture.shape == (80, 60, 3)
    assert (picture[:5] == 255).all()  # the sky
    assert picture.min() < 150  # the robot
    np.testing.assert_array_equal(recording.model.tex_data, before)


def test_pictures_stand_in_the_middle_of_their_share_of_the_time() -> None:
    assert frame_steps(4, 200) == [25, 75, 125, 175]
    assert frame_steps(3, 3) == [0, 1, 2]


# Names ----------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("task", "version"), named_tasks(), ids=lambda value: value)
def test_every_component_of_a_task_has_a_name_of_its_own(task: str, version: str) -> None:
    env = gymnasium.make(f"{task}-{version}")
    names = sensor_names(task, version, env.observation_space.shape[0])
    env.close()
    assert len(set(names)) == len(names) == env.observation_space.shape[0]


def test_all_tasks_of_the_recipe_have_names_in_both_versions() -> None:
    folder = Path(__file__).parents[1] / "conf" / "env"
    tasks = {make_config(f"env={path.stem}")["env"]["id"] for path in folder.glob("*.yaml")}
    assert set(named_tasks()) == {(task, version) for task in tasks for version in ("v4", "v5")}


def test_angles_and_velocities_are_where_the_simulator_has_them() -> None:
    names = sensor_names("Walker2d", "v5", 17)
    env = gymnasium.make("Walker2d-v5").unwrapped
    joints = [env.model.joint(i).name for i in range(env.model.njnt)]
    assert joints[3:6] == ["thigh_joint", "leg_joint", "foot_joint"]
    assert names[2:5] == ["right thigh angle", "right leg angle", "right foot angle"]
    assert names[8] == "torso x velocity"
    assert names[11:14] == ["right thigh velocity", "right leg velocity", "right foot velocity"]


def test_an_unknown_task_has_numbers_for_names_and_a_known_one_of_another_size_is_refused() -> None:
    assert sensor_names("Pusher", "v5", 2) == ["component 0", "component 1"]
    with pytest.raises(UserError, match=r"`Hopper-v5` has 11 named components.* has 12"):
        sensor_names("Hopper", "v5", 12)


# Bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"run": None}, "`run` must name a run folder"),
        ({"run": "nowhere"}, "`nowhere` must be a run folder"),
        ({"point": "mcar:2"}, "`points` must hold"),
        ({"mode": "best"}, "`modes` must hold"),
        ({"steps": 1}, "`steps` must be 2 or more"),
        ({"start": 100_000}, "`start` must lie inside the episode"),
        ({"sensors": ["pole"]}, "`sensors` must be among 0 cart position, .*got 'pole'"),
        ({"sensors": [4]}, "`sensors` must be among .*got 4"),
        ({"sensors": 0}, "`sensors` must be 1 or more"),
        ({"out": "nowhere/belief.png"}, "`out` must lie in an existing folder"),
    ],
)
def test_bad_input_is_answered_with_one_line(
    folder: Path, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError, match=message) as caught:
        draw(folder, tmp_path / "belief.png", **changes)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_an_agent_without_a_belief_is_refused(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "none", "belief=none")
    with pytest.raises(UserError, match="`belief=none` keeps no Gaussian belief"):
        draw(folder, tmp_path / "belief.png")
