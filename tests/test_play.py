"""Videos and pictures of an agent at work."""

import dataclasses
import importlib.util

import gymnasium
import numpy as np
import play
import pytest
from evaluation.conditions import removed_sensors
from evaluation.trained import load_trained_agent
from evaluation_tools import configured, evaluate, parse
from gymnasium.envs.classic_control import PendulumEnv
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from PIL import Image
from recipe_tools import refused
from rendering import trajectory
from rendering.belief_figure import ABSENT, BELIEF, MISSING, chosen_sensors
from rendering.trajectory import Camera, record_episode
from rendering.video import Video, write_video

# Small, and without the robot: rendering needs what a machine may lack.
SMALL = {"start": 0, "steps": 6, "sensors": 2, "window": 4, "size": 240, "robot": False, "seed": 4}


@pytest.fixture(scope="module")
def recording(drbpn):
    return record(drbpn)


def show(folder, out, **changes):
    paths = {"run": str(folder), "out": out and str(out)}
    return play.run(configured("play") | paths | SMALL | changes)


def record(folder, point="mcar:0.5", **changes):
    """Record the episode that :func:`show` shows."""
    trained = load_trained_agent(folder)
    condition = parse(point, trained.settings)
    removed = removed_sensors(condition, trained, episodes=1, reduction_seed=0)
    options = {"mode": "sampled", "seed": 4, "start": 0, "steps": 6} | changes
    return record_episode(trained, condition, removed, **options)


def near(pixels, colour, tolerance=25):
    """Where pixels have a colour, up to the palette of a GIF."""
    return np.abs(pixels.astype(float) - 255 * np.array(to_rgb(colour))).max(-1) < tolerance


def make_video(recording, **changes):
    options = {"steps": range(len(recording.steps)), "window": 4, "width": 640, "title": "x"}
    return Video(recording, [0, 1], **options | changes)


def pixels_of(video, panel, row, window=4):
    """Row and columns of the middles of the steps of a panel, at a share of its height."""
    box = video.axes[panel].get_window_extent()
    columns = box.x0 + box.width * (np.arange(window) + 0.5) / window
    return int(video.height - box.y1 + row * box.height), columns.astype(int)


def test_a_recording_is_the_first_episode_of_an_evaluation(drbpn, tmp_path):
    whole = record(drbpn, steps=100_000)
    rows = evaluate(tmp_path / "t.csv", drbpn, points="'mcar:0.5'", seed=4, modes=["sampled"])
    assert len(whole.steps) == int(rows[0]["length"])
    assert whole.missing_ratio == pytest.approx(float(rows[0]["missing_ratio"]))
    later = record(drbpn, start=2, steps=3)
    np.testing.assert_array_equal(later.steps, [2, 3, 4])
    np.testing.assert_array_equal(later.estimate, whole.estimate[2:5])


def test_what_arrived_is_the_truth_and_some_noise_and_what_did_not_is_zero(
    drbpn, recording, tmp_path, capsys
):
    assert 0 < recording.missing_ratio < 1
    assert (recording.arrived[~recording.observed] == 0).all()
    clean = record(drbpn, "noise:0")
    np.testing.assert_allclose(
        clean.arrived[clean.observed], clean.complete[clean.observed], atol=1e-5
    )
    assert (record(drbpn, "none:0").observed).all()
    assert np.isnan(record(drbpn, "none:0").coverage)
    removed = ~record(drbpn, "reduction:0.5:random").observed.any(0)
    assert removed.sum() == 2
    assert show(drbpn, tmp_path / "belief.png", point="reduction:0.5:random") == 0
    assert "missing 0.50" in capsys.readouterr().out


def test_coverage_counts_the_missing_entries_inside_their_interval(recording):
    for std, expected in ((1e6, 1.0), (0.0, 0.0)):
        changed = dataclasses.replace(recording, std=np.full_like(recording.std, std))
        assert changed.coverage == expected


def test_the_sensors_that_miss_most_are_chosen_in_the_order_of_the_observation(recording):
    observed = np.ones((5, 4), dtype=bool)
    observed[:3, 3], observed[:2, 1] = False, False
    one = dataclasses.replace(recording, observed=observed)
    assert chosen_sensors(one, 2) == [1, 3]
    assert chosen_sensors(one, ["pole angle", 0]) == [1, 0]


def test_a_gif_has_the_frames_the_size_and_the_pace_that_were_asked_for(drbpn, tmp_path, capsys):
    out, again = tmp_path / "video.gif", tmp_path / "again.gif"
    for path in (out, again):
        assert show(drbpn, path, point="mcar:0.5", steps=5, every=2, fps=25, size=321) == 0
    with Image.open(out) as video:
        assert (video.format, video.n_frames, video.size) == ("GIF", 3, (320, 200))
        assert (video.info["duration"], video.info["loop"]) == (40, 0)
    assert out.read_bytes() == again.read_bytes()
    assert sorted(tmp_path.iterdir()) == [again, out]
    said = capsys.readouterr().out
    assert said.startswith("steps 0 to 4, missing 0.")
    assert "3 frames of 320 x 200; written" in said


def test_a_video_that_breaks_off_leaves_what_was_there(tmp_path):
    class Broken(list):
        def __iter__(self):
            yield self[0]
            raise RuntimeError("the light went out")

    out = tmp_path / "video.gif"
    out.write_bytes(b"before")
    frames = Broken([np.zeros((8, 8, 3), dtype=np.uint8), np.full((8, 8, 3), 9, dtype=np.uint8)])
    with pytest.raises(RuntimeError, match="the light went out"):
        write_video(out, frames, fps=10, colours=8)
    assert out.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [out]


def test_an_mp4_has_the_frames_and_the_size_that_were_asked_for(drbpn, tmp_path):
    import imageio_ffmpeg as ffmpeg

    out = tmp_path / "video.mp4"
    assert show(drbpn, out, size=242, fps=30, steps=4) == 0
    # Two even sides, neither a multiple of 16.
    about, *frames = ffmpeg.read_frames(str(out))
    assert (about["size"], about["fps"], len(frames)) == ((242, 152), 30, 4)
    assert list(tmp_path.iterdir()) == [out]


def test_a_png_is_the_figure_of_the_belief_the_same_bytes_each_time(drbpn, tmp_path, capsys):
    for name in ("a.png", "b.png"):
        assert show(drbpn, tmp_path / name, point="mcar:0.5", start=1) == 0
    assert "the 95 % intervals hold" in capsys.readouterr().out
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    pixels = imread(tmp_path / "a.png")[..., :3]
    assert 0.01 < (pixels.min(-1) < 0.9).mean() < 0.9
    assert near(255 * pixels, ABSENT).mean() > 0.01


def test_a_frame_shows_masks_and_gaps_up_to_its_step_and_nothing_after(recording):
    sensor = int((~recording.observed).sum(0).argmax())
    # No band: it may reach over the shading.
    plain = dataclasses.replace(recording, std=np.zeros((6, 4)))
    video = Video(plain, [sensor], steps=range(6), window=4, width=640, title="x")
    for index in (5, 3, 0):  # in any order
        frame, steps = video[index], np.arange(index - 3, index + 1)
        known = steps >= 0
        for each in range(4):
            row, columns = pixels_of(video, 0, (each + 0.5) / 4)
            missing = known & ~recording.observed[np.maximum(steps, 0), each]
            np.testing.assert_array_equal(near(frame[row, columns], ABSENT), missing)
        # Just under the upper edge, where no line runs.
        row, columns = pixels_of(video, 1, 0.03)
        missing = known & ~recording.observed[np.maximum(steps, 0), sensor]
        np.testing.assert_array_equal(near(frame[row, columns], MISSING, 8), missing)
    np.testing.assert_array_equal(video[0], video[:][0])
    with pytest.raises(IndexError):
        video[6]


def test_the_robot_of_each_step_is_in_its_frame(recording):
    greens = [np.full((160, 115, 3), (0, 150 + 20 * i, 0), dtype=np.uint8) for i in range(6)]
    video = make_video(dataclasses.replace(recording, pictures=greens))
    for index in (0, 4):
        assert (video[index] == greens[index][0, 0]).all(-1).sum() > 10_000


def test_the_robot_is_drawn_where_this_machine_can_and_else_one_line_says_why(
    drbpn, tmp_path, monkeypatch, capsys
):
    pictures = record(drbpn, steps=2, picture_size=(60, 80)).pictures
    failed = "off-screen rendering failed" in capsys.readouterr().out
    assert failed == (not pictures)
    for picture in pictures:
        assert picture.shape == (80, 60, 3)
        assert picture[:5].min() == 255  # no sky: white as the page
        assert picture.min() < 150

    def broken(*_, **__):
        raise RuntimeError("no display")

    monkeypatch.setattr(trajectory.Camera, "picture", broken)
    assert record(drbpn, steps=2, picture_size=(60, 80)).pictures == []
    said = capsys.readouterr().out
    assert said == "no pictures of the robot, off-screen rendering failed: no display\n"


class Dial(PendulumEnv):
    """A pendulum that draws its angle as a shade: Gymnasium's picture needs a package more."""

    def render(self):
        return np.full((4, 4, 3), int(100 * self.state[0]), dtype=np.uint8)


def test_a_task_that_is_not_mujocos_is_drawn_where_its_state_can_be_set(monkeypatch):
    spec = gymnasium.envs.registration.EnvSpec("Dial-v0", entry_point=Dial)
    monkeypatch.setitem(gymnasium.registry, "Dial-v0", spec)
    camera, simulator = Camera("Dial-v0", (60, 80)), Dial()
    for angle in (0.0, 1.5):
        simulator.state = np.array([angle, 0.0])
        assert (camera.picture(simulator) == int(100 * angle)).all()

    class Closed:
        """A simulator that keeps its state to itself."""

    with pytest.raises(RuntimeError, match="the state of Closed can't be set"):
        camera.picture(Closed())


@pytest.mark.parametrize(
    ("belief", "kind", "has_interval"),
    [("none", "nothing", False), ("fill", "estimate", False), ("gru", "forecast", True)],
)
def test_another_belief_shows_what_it_says_and_no_more(
    trained_run, tmp_path, belief, kind, has_interval
):
    other = trained_run(belief)
    recording = record(other)
    assert recording.kind == kind
    assert np.isfinite(recording.std).all() == has_interval
    assert np.isfinite(recording.estimate).all() == (kind != "nothing")
    assert near(make_video(recording)[-1], BELIEF, 60).any() == (kind != "nothing")
    assert show(other, tmp_path / "belief.png", steps=2) == 0


def test_an_episode_that_ends_inside_the_window_before_the_start_is_refused(drbpn):
    length = len(record(drbpn, steps=100_000).steps)
    with refused(f"`start` must lie .* after {length} steps"):
        show(drbpn, drbpn / "video.gif", point="mcar:0.5", start=length + 2, window=10)


def test_an_mp4_without_its_package_is_refused_before_anything_is_done(
    drbpn, tmp_path, monkeypatch
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *_: None)
    with refused(r"needs imageio-ffmpeg: .* video.gif"):
        show(drbpn, tmp_path / "video.mp4")
    assert not list(tmp_path.iterdir())


def test_the_camera_follows_the_robot():
    walker = gymnasium.make("Walker2d-v5").unwrapped
    walker.reset(seed=0)
    camera = Camera("Walker2d-v5", (96, 128))

    def coloured_pixels(x):
        position = walker.data.qpos.copy()
        position[0] = x
        walker.set_state(position, walker.data.qvel)
        try:
            picture = camera.picture(walker).astype(float)
        except Exception as error:  # each OpenGL back end fails in its own way
            pytest.skip(f"nothing can be drawn here: {error}")
        return int(((picture[..., 0] > 1.15 * picture[..., 1]) & (picture.max(-1) > 60)).sum())

    assert coloured_pixels(50.0) > 0.5 * coloured_pixels(0.0) > 50
