"""The film of an agent at work.

What is specified: a GIF or MP4 of as many frames as the episode and the options give, of the size
asked for, written whole or not at all; in every frame the mask of that step of the episode, and in
the panels the truth, the arrivals and the gaps of the steps before it; the belief where there is
one, the sensors alone where there is none. Pictures of the robot are needed by nothing else. Bad
input is answered with one line, before anything is done.
"""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

pytest.importorskip("hydra")
pytest.importorskip("matplotlib")
from recipe_tools import make_folder  # isort: skip

import play
from evaluation.conditions import parse_point
from evaluation.trained import load_trained_agent
from omegaconf import OmegaConf
from rendering import frames
from rendering.belief_figure import ABSENT, BELIEF, MISSING
from rendering.film import Film, robot_size
from rendering.trajectory import Recording, record_episode
from rendering.video_file import write_video
from training.errors import UserError

CONF = Path(__file__).parents[1] / "conf" / "play.yaml"
# Small, and without the robot: rendering needs what a machine may lack.
SMALL = {"start": 0, "steps": 6, "sensors": 2, "window": 4, "size": 240, "robot": False, "seed": 4}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_folder(tmp_path_factory.mktemp("runs") / "smoke")


def film(folder: Path, out: Path | None, **changes: Any) -> int:
    defaults = OmegaConf.to_container(OmegaConf.load(CONF))
    assert isinstance(defaults, dict)
    return play.run(defaults | {"run": str(folder), "out": out and str(out)} | SMALL | changes)


def record(folder: Path, point: str = "mcar:0.5", **changes: Any) -> Recording:
    """Record the episode that :func:`film` shows."""
    trained = load_trained_agent(folder)
    read = parse_point(point, trained.settings, spike_std=5.0)
    options = {"mode": "sampled", "seed": 4, "start": 0, "steps": 6} | changes
    return record_episode(trained, read.missingness, noise=read.noise, **options)


def read_frames(path: Path) -> list[np.ndarray]:
    with Image.open(path) as video:
        frames = []
        for index in range(video.n_frames):
            video.seek(index)
            frames.append(np.asarray(video.convert("RGB")))
    return frames


def near(pixels: np.ndarray, colour: str, tolerance: float = 25) -> np.ndarray:
    """Where pixels have a colour, up to the palette of a GIF."""
    return np.abs(pixels.astype(float) - 255 * np.array(to_rgb(colour))).max(-1) < tolerance


def make_film(recording: Recording, **changes: Any) -> Film:
    options = {"steps": range(len(recording.poses)), "window": 4, "width": 320, "title": "x"}
    return Film(recording, [0, 1], [], **options | changes)


# The file -------------------------------------------------------------------------------------


def test_a_gif_has_the_frames_the_size_and_the_pace_that_were_asked_for(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "film.gif"
    assert film(folder, out, point="mcar:0.5", steps=7, every=2, fps=25, size=321) == 0
    with Image.open(out) as video:
        assert (video.format, video.n_frames, video.size) == ("GIF", 4, (320, 200))
        assert (video.info["duration"], video.info["loop"]) == (40, 0)
    assert list(tmp_path.iterdir()) == [out]
    said = capsys.readouterr().out
    assert said.startswith("4 frames of 320 x 200, steps 0 to 6, missing 0.")


def test_without_a_name_the_film_lies_in_the_run_folder(folder: Path) -> None:
    before = set(folder.iterdir())
    assert film(folder, None, steps=2) == 0
    (out,) = set(folder.iterdir()) - before
    assert out.name == "play.gif"
    with Image.open(out) as video:
        assert (video.format, video.n_frames) == ("GIF", 2)
    out.unlink()


def test_the_same_command_gives_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    for name in ("a.gif", "b.gif"):
        film(folder, tmp_path / name, steps=3)
    assert (tmp_path / "a.gif").read_bytes() == (tmp_path / "b.gif").read_bytes()


def test_a_film_that_breaks_off_leaves_what_was_there(tmp_path: Path) -> None:
    class Broken(list):
        def __iter__(self):
            yield self[0]
            raise RuntimeError("the light went out")

    out = tmp_path / "film.gif"
    out.write_bytes(b"before")
    frames = Broken([np.zeros((8, 8, 3), dtype=np.uint8), np.full((8, 8, 3), 9, dtype=np.uint8)])
    with pytest.raises(RuntimeError, match="the light went out"):
        write_video(out, frames, fps=10, colours=8)
    assert out.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [out]


def test_an_mp4_has_the_frames_and_the_size_that_were_asked_for(
    folder: Path, tmp_path: Path
) -> None:
    ffmpeg = pytest.importorskip("imageio_ffmpeg")
    out = tmp_path / "film.mp4"
    assert film(folder, out, size=242, fps=30) == 0
    # Two even sides, neither a multiple of 16.
    about, *frames = ffmpeg.read_frames(str(out))
    assert about["size"] == (242, 152)
    assert about["fps"] == 30
    assert len(frames) == SMALL["steps"]
    assert list(tmp_path.iterdir()) == [out]


# The frames -----------------------------------------------------------------------------------


def test_the_masks_in_the_file_are_those_of_the_episode(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "film.gif"
    film(folder, out, point="mcar:0.5", start=2, steps=6, every=2)
    recording = record(folder, steps=8)
    shown = recording.observed[2:8:2]
    assert 0 < shown.mean() < 1
    rows, columns = make_film(recording, width=240).mask_pixels().T
    for frame, observed in zip(read_frames(out), shown, strict=True):
        cells = frame[rows, columns]
        np.testing.assert_array_equal(near(cells, ABSENT), ~observed)
        np.testing.assert_array_equal(near(cells, "white"), observed)


def test_a_mask_of_many_sensors_has_a_cell_for_each() -> None:
    observed = np.random.default_rng(0).random((2, 77)) < 0.5
    values = np.zeros((2, 77))
    names = [str(i) for i in range(77)]
    many = Recording("T", names, 0, values, values, observed, values, values, [], values[0], None)
    frames = make_film(many, steps=[0, 1], width=640)
    rows, columns = frames.mask_pixels().T
    assert len(set(zip(rows.tolist(), columns.tolist(), strict=True))) == 77
    for index in (1, 0):  # in any order
        np.testing.assert_array_equal(near(frames[index][rows, columns], ABSENT), ~observed[index])


def test_a_panel_shades_the_gaps_of_the_latest_steps_and_leaves_the_future_open(
    folder: Path,
) -> None:
    # No band: it may reach over the shading.
    recording = dataclasses.replace(record(folder), std=np.zeros((6, 4)))
    sensor = int((~recording.observed).sum(0).argmax())
    window = 4
    drawn = Film(recording, [sensor], [], steps=[0, 5], window=window, width=320, title="x")
    box = drawn.panels[0].axis.get_window_extent()
    # Just under the upper edge, where no line runs; in the middle of each step.
    row = int(drawn.height - box.y1 + 3)
    columns = (box.x0 + box.width * (np.arange(window) + 0.5) / window).astype(int)
    np.testing.assert_array_equal(
        near(drawn[1][row, columns], MISSING, 8), ~recording.observed[2:6, sensor]
    )
    first = [False] * (window - 1) + [not recording.observed[0, sensor]]
    np.testing.assert_array_equal(near(drawn[0][row, columns], MISSING, 8), first)


def test_frames_are_drawn_in_any_order_and_nothing_of_one_stays_in_the_next(folder: Path) -> None:
    frames = make_film(record(folder))
    forward = frames[:]
    np.testing.assert_array_equal(frames[0], forward[0])
    np.testing.assert_array_equal(frames[-1], forward[5])
    assert (forward[0] != forward[5]).any()
    with pytest.raises(IndexError):
        frames[6]


def test_the_robot_is_put_in_as_it_was_drawn(folder: Path) -> None:
    recording = record(folder, steps=2)
    width, height = robot_size(320)
    greens = (np.uint8([0, 200, 0]), np.uint8([0, 250, 0]))
    robot = [np.broadcast_to(green, (height, width, 3)) for green in greens]
    frames = Film(recording, [0], robot, steps=[0, 1], window=4, width=320, title="x")
    for index, green in enumerate(greens):
        assert (frames[index] == green).all(-1).sum() == width * height


def test_the_film_shows_the_robot_where_this_machine_can_draw_one(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    film(folder, tmp_path / "with.gif", steps=2, robot=True)
    if "off-screen rendering failed" in capsys.readouterr().out:
        pytest.skip("no off-screen rendering on this machine")
    film(folder, tmp_path / "without.gif", steps=2)
    one, other = (read_frames(tmp_path / f"{name}.gif")[0] for name in ("with", "without"))
    left = np.s_[40:140, 5:85]  # where the robot stands
    assert (one[left] != other[left]).any(-1).mean() > 0.1


def test_where_nothing_can_be_rendered_the_rest_is_filmed_and_one_line_says_so(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def broken(*_: Any, **__: Any) -> None:
        raise RuntimeError("no display")

    monkeypatch.setattr(frames, "render_poses", broken)
    assert film(folder, tmp_path / "film.gif", robot=True) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "no pictures of the robot, off-screen rendering failed: no display"
    assert len(read_frames(tmp_path / "film.gif")) == SMALL["steps"]


# Points and beliefs ---------------------------------------------------------------------------


def test_a_point_may_take_sensors_away_for_good(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "film.gif"
    film(folder, out, point="reduction:0.5:random")
    rows, columns = make_film(record(folder), width=240).mask_pixels().T
    masks = [near(frame[rows, columns], ABSENT) for frame in read_frames(out)]
    assert all(mask.sum() == 2 for mask in masks)
    assert all((mask == masks[0]).all() for mask in masks)


@pytest.mark.parametrize(
    ("belief", "told", "has_interval"),
    [("none", "nothing", False), ("fill", "estimate", False), ("gru", "forecast", True)],
)
def test_another_belief_shows_what_it_says_and_no_more(
    tmp_path: Path, belief: str, told: str, has_interval: bool
) -> None:
    other = make_folder(tmp_path / belief, f"belief={belief}")
    recording = record(other)
    assert recording.told == told
    assert np.isfinite(recording.std).all() == has_interval
    assert np.isfinite(recording.estimate).all() == (told != "nothing")
    assert (recording.arrived[~recording.observed] == 0).all()
    blue = near(make_film(recording)[5], BELIEF, 60)
    assert blue.any() == (told != "nothing")
    assert film(other, tmp_path / "film.gif", steps=2) == 0


# Bad input ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"run": None}, "`run` must name a run folder"),
        ({"run": "nowhere"}, "`run` must be a run folder, got nowhere"),
        ({"point": "mcar:2"}, "`points` must hold"),
        ({"mode": "best"}, "`modes` must hold"),
        ({"steps": 0}, "`steps` must be 1 or more, got 0"),
        ({"every": 0}, "`every` must be 1 or more, got 0"),
        ({"window": 1}, "`window` must be 2 or more, got 1"),
        ({"start": -1}, "`start` must be 0 or more, got -1"),
        ({"start": 100_000}, "`start` must lie inside the episode"),
        ({"size": 100}, r"`size` must be in \[240, 1920\], got 100"),
        ({"colours": 300}, r"`colours` must be in \[8, 256\], got 300"),
        ({"fps": 60}, r"`fps` must be in \[1, 50\], got 60"),
        ({"sensors": ["pole"]}, "`sensors` must be among 0 cart position, .*got 'pole'"),
        ({"out": "nowhere/film.gif"}, "`out` must lie in an existing folder"),
        ({"out": "film.avi"}, r"`out` must end in .gif or .mp4, got film.avi"),
    ],
)
def test_bad_input_is_answered_with_one_line(
    folder: Path, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError, match=message) as caught:
        film(folder, **({"out": tmp_path / "film.gif"} | changes))
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_an_episode_that_ends_inside_the_window_before_the_start_is_refused(folder: Path) -> None:
    length = len(record(folder, steps=100_000).poses)
    with pytest.raises(UserError, match=f"`start` must lie .* after {length} steps"):
        film(folder, folder / "film.gif", point="mcar:0.5", start=length + 2, window=10)


def test_an_mp4_without_its_package_is_refused_before_anything_is_done(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent(name: str, *_: Any) -> None:
        assert name == "imageio_ffmpeg"

    with monkeypatch.context() as patch:
        patch.setattr(importlib.util, "find_spec", absent)
        with pytest.raises(UserError, match=r"needs imageio-ffmpeg: .* film.gif"):
            film(folder, tmp_path / "film.mp4")
    assert not list(tmp_path.iterdir())
