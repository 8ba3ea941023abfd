"""The look of every figure, and how one is written."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from training.run_folder import whole, write_table

STYLE: Any = {
    "font.size": 9.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}
_COLOURS = (
    *("#1f6fb4", "#d1622b", "#3a923a", "#8d5aa8", "#7f6a4f", "#c44e7f", "#5f6b73"),
    *("#b59b00", "#17a2a2", "#222222"),
)


def colours(labels: Iterable[Any]) -> dict[Any, str]:
    """Return a colour for each label, by the order in which they come."""
    return {name: _COLOURS[i % len(_COLOURS)] for i, name in enumerate(dict.fromkeys(labels))}


def panel_grid(lines: int, columns: int, panel: tuple[float, float]) -> tuple[Figure, Any]:
    """Return a figure and its axes, ``(lines, columns)``, each panel of a size in inches."""
    size = (max(panel[0] * columns, 5.0), panel[1] * lines + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(lines, columns, squeeze=False)


def legend_below(figure: Figure, columns: int, **look: Any) -> None:
    """Put one legend below all panels, each label once; switch empty panels off."""
    found: dict[str, Any] = {}
    for axis in figure.axes:
        if not axis.has_data():
            axis.axis("off")
        for handle, text in zip(*axis.get_legend_handles_labels(), strict=True):
            found.setdefault(text, handle)
    look |= {"loc": "outside lower center", "frameon": False}
    canvas: Any = FigureCanvasAgg(figure)
    for ncols in range(min(max(1, len(found)), columns), 0, -1):  # as many as the figure is wide
        legend = figure.legend(found.values(), found.keys(), ncols=ncols, **look)
        size = legend.get_window_extent(canvas.get_renderer())
        if ncols == 1 or size.width <= figure.bbox.width:
            break
        legend.remove()
    if size.height > figure.bbox.height / 4:  # it would take the panels' room
        figure.set_figheight(figure.get_figheight() + size.height / figure.dpi)


def save_figure(figure: Figure, path: Path, *, dpi: int, palette: bool = False) -> None:
    """Write a PNG whole or not at all; ``palette``: 256 colours, a third of the size."""
    with whole(path) as temporary:
        # No date and no version: the same figure gives the same bytes.
        figure.savefig(temporary, format="png", dpi=dpi, metadata={"Software": None})
        if palette:
            with Image.open(temporary) as picture:
                few = picture.convert("RGB").quantize(256, kmeans=1)
            few.save(temporary, format="png", optimize=True)


def write_or_remove(path: Path, content: Any, **look: Any) -> None:
    """Write a table, or a figure with its looks; None removes that of an earlier call."""
    if content is None:
        path.unlink(missing_ok=True)
    elif isinstance(content, Figure):
        save_figure(content, path, **look)
    else:
        write_table(path, content)
