"""The video of an agent at work: the robot, its sensors, what is missing, and the belief.

TorchRL's PixelRenderTransform draws an observation before the agent has read it, when the belief of
that step is not there yet: an episode is recorded first and drawn afterwards.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import imageio.v3 as iio
import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from training.run_folder import whole

from rendering.belief_figure import draw_panels, legend_of
from rendering.style import STYLE
from rendering.trajectory import Picture, Recording

_PALETTE_FRAMES = 8  # from as many frames the colours of a GIF are taken
_INCHES = (6.4, 4.0)
_ROBOT = (0.0, 0.12, 0.36, 0.8)  # left, bottom, width and height, in parts of the video
_SMALL: dict[str, Any] = {
    "font.size": 7.5,
    "axes.titlesize": 7.5,
    "axes.titlepad": 2.5,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
}


def video_size(width: int) -> tuple[int, int]:
    """Return width and height of a video, pixels, both even: video codecs take no others."""
    return 2 * (width // 2), 2 * round(width * _INCHES[1] / _INCHES[0] / 2)


def robot_size(width: int) -> tuple[int, int]:
    """Return width and height of the robot's pictures in a video of a width, pixels."""
    across, upward = video_size(width)
    return round(_ROBOT[2] * across), round(_ROBOT[3] * upward)


class Video(Sequence[Picture]):
    """Frames of an episode, each drawn when it is asked for.

    The panels are drawn once; a frame, one for each index of the recording in ``steps``, shows the
    ``window`` of steps up to its own.
    """

    def __init__(
        self,
        recording: Recording,
        sensors: Sequence[int],
        *,
        steps: Sequence[int],
        window: int,
        width: int,
        title: str,
    ) -> None:
        self.recording, self.steps, self.window = recording, list(steps), window
        self.width, self.height = video_size(width)
        with mpl.rc_context(STYLE | _SMALL):
            dpi = width / _INCHES[0]
            # A canvas rounds down: the hundredth keeps it from losing a pixel.
            inches = (self.width + 0.01) / dpi, (self.height + 0.01) / dpi
            figure = Figure(figsize=inches, dpi=dpi)
            self._canvas: Any = FigureCanvasAgg(figure)
            figure.text(0.012, 0.965, title, fontsize=8.5, fontweight="bold", va="center")
            self._now = figure.text(0.985, 0.965, "", ha="right", va="center")
            self._robot: Any = None
            if recording.pictures:
                axis = figure.add_axes(_ROBOT)
                axis.axis("off")
                self._robot = axis.imshow(recording.pictures[0], interpolation="lanczos")
            left = 0.43 if recording.pictures else 0.075
            edges: Any = {"left": left, "right": 0.985, "bottom": 0.17, "top": 0.91}
            grid = figure.add_gridspec(len(sensors) + 1, 1, hspace=0.55, **edges)
            self.axes = list(grid.subplots(sharex=True, squeeze=False).ravel())
            draw_panels(self.axes, recording, sensors)
            place: Any = {"loc": "lower center", "bbox_to_anchor": (0.5, 0.0), "fontsize": 7}
            figure.legend(handles=legend_of(recording), ncols=4, frameon=False, **place)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.steps)

    def __getitem__(self, index: Any) -> Any:
        """Draw a frame, ``(height, width, 3)``, or a list of several."""
        if isinstance(index, slice):
            return [self[i] for i in range(len(self))[index]]
        now = self.steps[index]
        step, seen = self.recording.steps[now], self.recording.observed[now]
        self._now.set_text(f"step {step}: {seen.sum()} of {len(seen)} sensors arrived")
        self.axes[0].set_xlim(step - self.window + 0.5, step + 0.5)
        if self._robot is not None:
            self._robot.set_data(self.recording.pictures[now])
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


def write_video(path: Path, frames: Sequence[Picture], *, fps: float, colours: int) -> None:
    """Write a GIF or MP4 whole or not at all, by the suffix; fewer colours make a smaller GIF."""
    if path.suffix == ".mp4":
        # H.264 works in blocks of 16 pixels, but asks for even sides only.
        options: dict[str, Any] = {"plugin": "FFMPEG", "fps": fps, "macro_block_size": 2}
        pictures = list(frames)
    else:
        options = {"plugin": "pillow", "duration": 10 * round(100 / fps), "loop": 0}
        pictures = list(_few_colours(frames, colours))
    with whole(path) as temporary:
        iio.imwrite(temporary, cast(Any, pictures), **options)


def _few_colours(frames: Sequence[Picture], colours: int) -> Iterator[Picture]:
    """Draw all frames in the same colours, without dithering: what stands still costs nothing."""
    count = min(_PALETTE_FRAMES, len(frames))
    some = [frames[round(i)] for i in np.linspace(0, len(frames) - 1, count)]
    palette = Image.fromarray(np.concatenate(some)).quantize(colours, kmeans=1)
    for frame in frames:
        few = Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        yield np.asarray(few.convert("RGB"))
