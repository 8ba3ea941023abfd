"""The film of an agent at work: the robot, its sensors, what is missing, and the belief.

The figure is laid out once. A frame restores its still parts and draws what moves over them, on
matplotlib's Agg canvas, without a screen; the robot's pictures are put in as they are.

TorchRL's PixelRenderTransform can't make the frames: a transform of the environment draws an
observation before the agent has read it, and the belief of that step is not there yet. So an
episode is recorded first and drawn afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast, overload

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from rendering.belief_figure import ABSENT, ARRIVED, BELIEF, DASHES, MISSING, STYLE, TRUTH
from rendering.trajectory import INTERVAL_95, Recording

Frame = NDArray[np.uint8]
_INCHES = (6.4, 4.0)
# Left, bottom, width and height, in parts of the film.
_ROBOT = (0.0, 0.235, 0.375, 0.685)
_STRIP = (0.02, 0.12, 0.35, 0.075)
_PANELS = (0.435, 0.165, 0.55, 0.775)
_WIDE_STRIP, _WIDE_PANELS = (0.075, 0.115, 0.91, 0.045), (0.075, 0.25, 0.91, 0.665)
_CELLS_A_ROW = 32
_SIZES: dict[str, Any] = {
    "font.size": 7.5,
    "axes.titlesize": 7.5,
    "axes.titlepad": 2.5,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "xtick.major.size": 2,
    "ytick.major.size": 2,
    "xtick.major.pad": 2,
    "ytick.major.pad": 2,
}
_SAID = {
    "estimate": ("belief", "belief and its 95 % interval"),
    "forecast": ("forecast", "forecast and its 95 % interval"),
}


def film_size(width: int) -> tuple[int, int]:
    """Return width and height of a film, both even: video codecs take no others.

    Args:
        width: pixels.

    Returns:
        Width and height, pixels.
    """
    return 2 * (width // 2), 2 * round(width * _INCHES[1] / _INCHES[0] / 2)


def robot_size(width: int) -> tuple[int, int]:
    """Return width and height of the robot's pictures in a film.

    Args:
        width: of the film, pixels.

    Returns:
        Width and height, pixels.
    """
    across, upward = film_size(width)
    return round(_ROBOT[2] * across), round(_ROBOT[3] * upward)


class Film(Sequence[Frame]):
    """Frames of an episode, each drawn when it is asked for.

    Args:
        recording: of an episode.
        sensors: indices of the sensors that get a panel.
        robot: a picture a frame, of :func:`robot_size`; empty for none.
        steps: indices into the recording, one a frame.
        window: steps that a panel looks back.
        width: pixels.
        title: in the first line.
    """

    def __init__(
        self,
        recording: Recording,
        sensors: Sequence[int],
        robot: Sequence[Frame],
        *,
        steps: Sequence[int],
        window: int,
        width: int,
        title: str,
    ) -> None:
        self.recording, self.sensors, self.robot = recording, list(sensors), robot
        self.steps, self.window = list(steps), window
        self.width, self.height = film_size(width)
        with mpl.rc_context(cast(Any, STYLE | _SIZES)):
            dpi = width / _INCHES[0]
            # A canvas rounds down: the hundredth keeps it from losing a pixel.
            inches = (self.width + 0.01) / dpi, (self.height + 0.01) / dpi
            self._figure = Figure(figsize=inches, dpi=dpi)
            self._canvas = cast(Any, FigureCanvasAgg(self._figure))
            self._figure.text(0.012, 0.965, title, fontsize=8.5, fontweight="bold", va="center")
            self._step = self._figure.text(0.985, 0.965, "", ha="right", va="center", animated=True)
            self._count, self._strip = self._lay_strip(_STRIP if robot else _WIDE_STRIP)
            self.panels = self._lay_panels(_PANELS if robot else _WIDE_PANELS)
            self._figure.legend(
                handles=self._legend(),
                loc="lower center",
                bbox_to_anchor=(0.5, 0.0),
                ncols=4,
                frameon=False,
                fontsize=7,
                handlelength=1.6,
                columnspacing=1.4,
            )
            self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(self._figure.bbox)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.steps)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> list[Frame]: ...
    def __getitem__(self, index: int | slice) -> Frame | list[Frame]:
        """Draw a frame, ``(height, width, 3)``, or several."""
        if isinstance(index, slice):
            return [self._draw(i) for i in range(len(self))[index]]
        return self._draw(range(len(self))[index])

    def mask_pixels(self) -> NDArray[np.int64]:
        """Return row and column of the middle of every sensor's cell in the mask.

        Returns:
            Pixels, shape ``(obs, 2)``.
        """
        rows, columns = self._strip.get_array().shape
        row, column = np.divmod(np.arange(self.recording.observed.shape[1]), columns)
        x, y = self._strip.axes.transAxes.transform(
            np.stack([(column + 0.5) / columns, 1 - (row + 0.5) / rows], 1)
        ).T
        return np.stack([self.height - y, x], 1).astype(int)

    def _draw(self, index: int) -> Frame:
        now = self.steps[index]
        self._canvas.restore_region(self._still)
        self._step.set_text(f"step {self.recording.first_step + now}")
        seen = self.recording.observed[now]
        self._count.set_text(f"sensors now: {seen.sum()} of {len(seen)} arrived")
        cells = self._strip.get_array()
        cells.flat[: len(seen)] = ~seen
        self._strip.set_array(cells)
        for text in (self._step, self._count):
            self._figure.draw_artist(text)
        self._strip.axes.draw_artist(self._strip)
        for panel in self.panels:
            panel.draw(now)
        frame = np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
        if self.robot:
            picture = self.robot[index]
            left, top = round(_ROBOT[0] * self.width), round((1 - _ROBOT[1]) * self.height)
            top -= picture.shape[0]
            frame[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
        return frame

    def _lay_strip(self, place: tuple[float, float, float, float]) -> tuple[Any, Any]:
        """Lay out the mask of all sensors: a cell each, in rows."""
        count = self.recording.observed.shape[1]
        columns = min(count, _CELLS_A_ROW)
        shape = -(-count // columns), columns
        beyond = (np.arange(shape[0] * columns) >= count).reshape(shape)
        cells = np.ma.array(np.zeros(shape), mask=beyond)
        axis = self._figure.add_axes(place)
        axis.axis("off")
        axis.invert_yaxis()
        mesh = axis.pcolormesh(
            cells,
            cmap=mpl.colors.ListedColormap(["white", ABSENT]),
            vmin=0,
            vmax=1,
            edgecolors="#888888",
            linewidth=0.5,
            clip_on=False,
            animated=True,
        )
        above = self._figure.text(place[0], place[1] + place[3] + 0.012, "", animated=True)
        return above, mesh

    def _lay_panels(self, place: tuple[float, float, float, float]) -> list[Panel]:
        """Lay out a panel a sensor, one above the other."""
        left, bottom, width, height = place
        share = height / len(self.sensors)
        panels = []
        for row, sensor in enumerate(self.sensors):
            low = bottom + height - (row + 1) * share
            axis = self._figure.add_axes((left, low, width, 0.68 * share))
            panels.append(Panel(axis, self.recording, sensor, self.window))
            last = row == len(self.sensors) - 1
            axis.tick_params(labelbottom=last)
            if last:
                axis.set_xlabel("steps from now; values in running standard deviations", labelpad=1)
        return panels

    def _legend(self) -> list[Any]:
        line = mpl.lines.Line2D
        handles: list[Any] = [
            line([], [], color=TRUTH, lw=0.9, ls=DASHES, label="true value"),
            line([], [], color=ARRIVED, marker=".", ls="", ms=5, mew=0, label="what arrived"),
            Patch(facecolor=MISSING, label="nothing arrived"),
        ]
        if self.recording.told != "nothing":
            alone, with_interval = _SAID[self.recording.told]
            if np.isnan(self.recording.std).all():
                handles.append(line([], [], color=BELIEF, lw=1.6, label=alone))
            else:
                light = (*mpl.colors.to_rgb(BELIEF), 0.3)
                handles.append(Patch(facecolor=light, edgecolor=BELIEF, label=with_interval))
        return handles


class Panel:
    """Draw one sensor over the latest steps; what moves is made once and given new data.

    Args:
        axis: where to.
        recording: of an episode.
        sensor: index of the component.
        window: steps to look back.
    """

    def __init__(self, axis: Any, recording: Recording, sensor: int, window: int) -> None:
        self.axis = axis
        self._past = np.arange(1 - window, 1)
        seen = recording.observed[:, sensor]
        # Columns: truth, what arrived, estimate, lower and upper end of its interval.
        half = INTERVAL_95 * recording.std[:, sensor]
        mean = recording.estimate[:, sensor]
        arrived = np.where(seen, recording.arrived[:, sensor], np.nan)
        truth = recording.complete[:, sensor]
        self._values = np.stack([truth, arrived, mean, mean - half, mean + half])
        self._missing = ~seen
        # By what there is to know: a wide interval may leave the panel, a far estimate may not.
        shown = self._values[:3][np.isfinite(self._values[:3])]
        low, high = shown.min(), shown.max()
        room = 0.2 * (high - low) + 0.05
        axis.set_xlim(self._past[0] - 0.5, 0.5)
        axis.set_ylim(low - room, high + room)
        axis.locator_params(axis="y", nbins=3)
        axis.set_title(recording.names[sensor])
        axis.spines["left"].set_visible(False)  # gaps are drawn over it
        blank = np.full(window, np.nan)
        self._gaps = axis.imshow(
            np.zeros((1, window)),
            extent=(self._past[0] - 0.5, 0.5, low - room, high + room),
            aspect="auto",
            interpolation="nearest",
            cmap=mpl.colors.ListedColormap([(1, 1, 1, 0), MISSING]),
            vmin=0,
            vmax=1,
            animated=True,
        )
        self._band = axis.fill_between(
            self._past, blank, blank, color=BELIEF, alpha=0.3, lw=0, animated=True
        )
        (self._mean,) = axis.plot(
            self._past, blank, color=BELIEF, lw=1.6, alpha=0.75, animated=True
        )
        (self._truth,) = axis.plot(self._past, blank, color=TRUTH, lw=0.8, ls=DASHES, animated=True)
        (self._arrived,) = axis.plot(
            self._past, blank, ".", color=ARRIVED, ms=3.5, mew=0, animated=True
        )

    def draw(self, now: int) -> None:
        """Draw the steps up to this one.

        Args:
            now: index into the recording.
        """
        steps = now + self._past
        known = steps >= 0
        values = np.where(known, self._values[:, np.maximum(steps, 0)], np.nan)
        truth, arrived, mean, low, high = values
        self._gaps.set_data((known & self._missing[np.maximum(steps, 0)])[None].astype(float))
        self._band.set_data(self._past, low, high)
        for line, data in ((self._mean, mean), (self._truth, truth), (self._arrived, arrived)):
            line.set_ydata(data)
        for artist in (self._gaps, self._band, self._mean, self._truth, self._arrived):
            self.axis.draw_artist(artist)
