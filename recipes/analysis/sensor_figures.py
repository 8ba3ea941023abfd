"""Draw what trained beliefs have learned about their sensors: rankings and covariances."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
import torch
from evaluation.sensor_choice import SensorModel
from matplotlib.figure import Figure
from numpy.typing import NDArray
from rendering.style import STYLE, legend_below
from torch.nn.functional import pad

_D, _A, _RANDOM = "#1f6fb4", "#d1622b", "#8a8f94"
_DASHES: Any = (0, (4, 2))
_CURVE_INCHES, _SENSOR_INCHES, _COLUMN_INCHES = 2.1, 0.19, 4.4
_CELL_INCHES, _LABEL_INCHES = 2.35, 1.7
_BAND = (0.05, 0.95)  # of the random orders
_LINEAR = 100.0  # covariances under the largest over this have a linear scale of colours

Groups = Mapping[str, Sequence[SensorModel]]


def random_orders(count: int, sensors: int, seed: int) -> torch.Tensor:
    """Draw orders of sensors, indices of shape ``(count, sensors)``."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, sensors, generator=generator).argsort(-1)


def ranking_figure(groups: Groups, *, orders: int, seed: int) -> Figure:
    """Draw how much is known after k sensors, and in which order they are chosen.

    A column a title of ``groups``: information and variance left beside a band of so many random
    ``orders``, and the sensors by their mean place in the D-optimal order.
    """
    sensors = max(len(models[0].names) for models in groups.values())
    heights = [_CURVE_INCHES, _CURVE_INCHES, _SENSOR_INCHES * sensors + 0.6]
    with mpl.rc_context(STYLE):
        size = (_COLUMN_INCHES * len(groups), sum(heights) + 0.9)
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(3, len(groups), height_ratios=heights, squeeze=False)
        for column, (title, models) in zip(axes.T, groups.items(), strict=True):
            _draw_curves(column[:2], models, random_orders(orders, len(models[0].names), seed))
            column[0].set_title(title)
            _draw_ranking(column[2], models)
        axes[0, 0].set_ylabel("information on the state, nats")
        axes[1, 0].set_ylabel("variance left in the\nsensors' true values")
        legend_below(figure, 4)
    return figure


def covariance_figure(groups: Groups, *, correlation: bool) -> Figure:
    """Draw H P H' + R as heat maps: a line a title of ``groups``, in it a map a training seed."""
    most = max(len(models) for models in groups.values())
    kinds = ("covariance", "correlation") if correlation else ("covariance",)
    columns = most * len(kinds)
    size = (
        _CELL_INCHES * columns + _LABEL_INCHES + 0.9 * len(kinds),
        (_CELL_INCHES + 0.5) * len(groups),
    )
    with mpl.rc_context({**STYLE, "axes.titlesize": 9}):
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(len(groups), columns, squeeze=False)
        for axis in axes.ravel():
            axis.axis("off")
        for line, (title, models) in zip(axes, groups.items(), strict=True):
            for index, kind in enumerate(kinds):
                part = line[index * most : index * most + len(models)]
                _draw_maps(figure, part, models, kind)
            names = [f"{name}  {i}" for i, name in enumerate(models[0].names)]
            line[0].set_yticks(range(len(names)), names, fontsize=7)
            heading = title.replace("\n", ", ")
            line[0].set_title(f"{heading}\n{line[0].get_title(loc='left')}")
    return figure


def mean_places(models: Sequence[SensorModel], criterion: Literal["D", "A"]) -> NDArray[Any]:
    """Return the mean place of each sensor in the orders of the beliefs, 1 the first."""
    orders = torch.stack([model.ranking(criterion) for model in models])
    return (orders.argsort(-1) + 1).double().mean(0).numpy()


def _curves(model: SensorModel, order: torch.Tensor) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return information and variance left after each sensor of an order, from none on."""
    information, left = model.along(order)
    return pad(information, (1, 0)).numpy(), pad(left, (1, 0), value=1.0).numpy()


def _draw_curves(axes: Sequence[Any], models: Sequence[SensorModel], orders: torch.Tensor) -> None:
    """Draw information and variance left over the number of sensors, from none to all."""
    count = np.arange(len(models[0].names) + 1)
    looks: tuple[tuple[Literal["A", "D"], str, Any, str], ...] = (
        ("A", _A, _DASHES, "A-optimal: variance first"),
        ("D", _D, "-", "D-optimal: information first"),
    )
    for row, axis in enumerate(axes):
        # The same orders for every belief, so that the band is one of means as the lines are.
        random = np.mean([_curves(model, orders)[row] for model in models], axis=0)
        low, high = np.quantile(random, _BAND, axis=0)
        name = "random order, 5 to 95 %"
        axis.fill_between(count, low, high, color=_RANDOM, alpha=0.35, lw=0, label=name)
        axis.plot(count, random.mean(0), color=_RANDOM, lw=1.2)
        for criterion, colour, dashes, name in looks:
            seeds = [_curves(model, model.ranking(criterion))[row] for model in models]
            axis.plot(count, np.transpose(seeds), color=colour, lw=0.7, alpha=0.45)
            axis.plot(count, np.mean(seeds, axis=0), color=colour, lw=2.0, ls=dashes, label=name)
        axis.set_xlim(0, count[-1])
        axis.set_ylim(bottom=0)
        axis.xaxis.get_major_locator().set_params(integer=True)
    axes[1].set_xlabel("number of sensors")


def _draw_ranking(axis: Any, models: Sequence[SensorModel]) -> None:
    """Draw the information that each sensor adds when it is chosen, first chosen on top."""
    places, places_a = mean_places(models, "D"), mean_places(models, "A")
    gains = []
    for model in models:
        order = model.ranking("D")
        gain = model.along(order)[0].diff(prepend=torch.zeros(1, dtype=torch.float64))
        gains.append(gain[order.argsort()].numpy())
    added = np.array(gains)  # seeds, sensors
    shown = np.argsort(places, kind="stable")
    rows = np.arange(len(shown))
    axis.barh(rows, added.mean(0)[shown], color=_D, alpha=0.55, height=0.72)
    for index, own in enumerate(added):
        name = None if index else "one training seed"
        axis.plot(own[shown], rows, ".", color=_D, ms=4, mew=0, label=name)
    axis.set_yticks(rows, [models[0].names[i] for i in shown], fontsize=8)
    axis.set_ylim(len(shown) - 0.4, -1.6)
    axis.set_xlim(0, 1.28 * added.max())
    axis.set_xlabel("nats added when chosen")
    axis.set_title("mean place in the order", loc="right", fontsize=8)
    where = {"transform": axis.get_yaxis_transform(), "ha": "right", "va": "center"}
    for text, values, at, colour in (("D", places, 0.91, _D), ("A", places_a, 1.0, _A)):
        axis.text(at, -1.0, text, fontsize=8, color=colour, fontweight="bold", **where)
        for row, sensor in zip(rows, shown, strict=True):
            axis.text(at, row, f"{values[sensor]:.1f}", fontsize=7.5, color=colour, **where)


def _draw_maps(
    figure: Figure, axes: Sequence[Any], models: Sequence[SensorModel], kind: str
) -> None:
    """Draw one map a training seed, all in one scale of colours."""
    maps = [model.observation_cov.numpy() for model in models]
    norm: Any = mpl.colors.Normalize(-1, 1)
    if kind == "correlation":
        maps = [cov / np.sqrt(np.outer(cov.diagonal(), cov.diagonal())) for cov in maps]
    else:
        # Two decades: a few sensors vary much more than the others.
        limit = max(np.abs(values).max() for values in maps)
        norm = mpl.colors.SymLogNorm(limit / _LINEAR, vmin=-limit, vmax=limit)
    for axis, values, model in zip(axes, maps, models, strict=True):
        axis.axis("on")
        image = axis.imshow(values, cmap="RdBu_r", norm=norm, interpolation="nearest")
        axis.set_title(f"{kind}, seed {model.seed}")
        ticks = range(0, len(values), max(1, len(values) // 6))
        axis.set_xticks(ticks, ticks, fontsize=7)
        axis.set_yticks(ticks, ticks, fontsize=7)
        axis.spines[:].set_visible(True)
    bar = figure.colorbar(image, ax=list(axes), shrink=0.85, pad=0.02)
    bar.ax.tick_params(labelsize=7)
