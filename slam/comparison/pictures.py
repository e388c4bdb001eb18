"""Pictures of a comparison's page, as PNG bytes of limited size."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from slam.evaluation.figure_parts import BLUE, GREEN, GREY, ORANGE, RED, figure_of, png_of
from slam.mapping.occupancy_grid import FREE, OCCUPIED, StateArray
from slam.measurements import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = (BLUE, ORANGE, GREEN, RED, "#7a4fb5", "#0f8b8d", "#b5477a", "#8a6d1d", "#3d5a80", "#94553b")
_PANEL_PX, _MOST_COLUMNS, _MAX_POINTS = 250, 4, 4000


def trajectories_png(paths_m: Mapping[str, FloatArray], truth_m: FloatArray | None) -> bytes:
    """Draw (N, 2) paths on top of each other, the ground truth at the bottom.

    Parameters
    ----------
    paths_m
        Paths by configuration, all in one frame.
    truth_m
        (N, 2) ground truth; if None, the first path defines the extent of the picture, so that a path that
        got lost does not make the others small.
    """
    figure = figure_of(1000, 620)
    axes = figure.add_axes((0.065, 0.085, 0.67, 0.89))
    if truth_m is not None:
        xy = _thinned(truth_m)
        axes.plot(xy[:, 0], xy[:, 1], color=GREY, linewidth=3.5, alpha=0.45, label="truth")
    for color, (name, path) in zip(_colors(paths_m), paths_m.items(), strict=True):
        xy = _thinned(path)
        axes.plot(xy[:, 0], xy[:, 1], color=color, linewidth=1.1, label=name)
    low, high = _reach(
        truth_m if truth_m is not None else next(iter(paths_m.values())), 0.67 / 0.89 * 1000 / 620
    )
    axes.set(xlabel="x, m", ylabel="y, m", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    _legend_beside(figure, axes)
    _plain(axes)
    return png_of(figure)


def errors_png(errors: Mapping[str, tuple[FloatArray, FloatArray]]) -> bytes:
    """Draw the distance to the ground truth over time, on a scale that shows small and large errors.

    Parameters
    ----------
    errors
        By configuration, (N,) seconds and (N,) metres.
    """
    figure = figure_of(1000, 360)
    axes = figure.add_axes((0.075, 0.145, 0.66, 0.82))
    for color, (name, (stamps_s, errors_m)) in zip(_colors(errors), errors.items(), strict=True):
        order = np.argsort(stamps_s, kind="stable")
        rows = _thinned(np.column_stack([stamps_s - stamps_s.min(), errors_m])[order])
        axes.plot(rows[:, 0], np.maximum(rows[:, 1], 1e-4), color=color, linewidth=1.0, label=name)
    axes.set(xlabel="time, s", ylabel="error, m", yscale="log")
    _legend_beside(figure, axes)
    _plain(axes)
    return png_of(figure)


def distribution_png(values: Mapping[str, Sequence[float]], title: str) -> bytes:
    """Draw every value as a dot over a box of quartiles, one row per configuration.

    The scale is logarithmic if the values span more than a factor of fifty.
    """
    names = list(values)
    figure = figure_of(490, 90 + 26 * len(names))
    height = figure.get_size_inches()[1] * figure.dpi
    axes = figure.add_axes((0.36, 48.0 / height, 0.61, 1.0 - 60.0 / height))
    for at, color in zip(range(len(names)), _colors(values), strict=True):
        sample = np.asarray(values[names[at]], dtype=np.float64)
        low, middle, high = np.quantile(sample, [0.25, 0.5, 0.75])
        axes.barh(at, high - low, left=low, height=0.62, color=color, alpha=0.22, linewidth=0)
        axes.plot([middle, middle], [at - 0.33, at + 0.33], color=color, linewidth=2.0)
        spread = 0.24 * np.cos(np.pi * np.arange(sample.size))  # so that equal values do not hide each other
        axes.plot(sample, at + spread * (sample.size > 1), "o", color=color, markersize=3.5, alpha=0.75)
    every = np.concatenate([np.asarray(each, dtype=np.float64) for each in values.values()])
    if every.min() > 0.0 and every.max() > 50.0 * every.min():
        axes.set_xscale("log")
    axes.set(xlabel=title, yticks=range(len(names)), yticklabels=[_short(name, 25) for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    _plain(axes)
    return png_of(figure)


def maps_png(maps: Mapping[str, tuple[StateArray, float]]) -> bytes:
    """Draw maps side by side, each cropped to its known part, all on one scale.

    Parameters
    ----------
    maps
        States (row 0 at the lowest y) and the side of a cell in metres, by name.
    """
    pictures = {name: (_grey(_cut(states)), cell_m) for name, (states, cell_m) in maps.items()}
    columns = min(len(pictures), _MOST_COLUMNS)
    rows = -(-len(pictures) // columns)
    width_m = max(cell_m * picture.shape[1] for picture, cell_m in pictures.values())
    height_m = max(cell_m * picture.shape[0] for picture, cell_m in pictures.values())
    panel_px = min(max(int(_PANEL_PX * height_m / width_m), 80), 2 * _PANEL_PX)
    figure = figure_of(columns * _PANEL_PX, rows * (panel_px + 26))
    for number, (name, (picture, cell_m)) in enumerate(pictures.items()):
        axes = figure.add_subplot(rows, columns, number + 1)
        high_m, wide_m = cell_m * picture.shape[0], cell_m * picture.shape[1]
        box = (-wide_m / 2.0, wide_m / 2.0, -high_m / 2.0, high_m / 2.0)
        axes.imshow(picture, cmap="gray", vmin=0, vmax=255, extent=box, interpolation="nearest")
        axes.set(xlim=(-width_m / 2.0, width_m / 2.0), ylim=(-height_m / 2.0, height_m / 2.0))
        axes.set_axis_off()
        axes.set_title(_short(name), fontsize=9, color=GREY, pad=3)
    figure.subplots_adjust(0.005, 0.005, 0.995, 1.0 - 24.0 / (rows * (panel_px + 26)), 0.03, 0.16)
    return png_of(figure)


def _reach(path_m: FloatArray, wide: float) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest corner of a picture with this aspect ratio around a path, with a margin."""
    low, high = path_m.min(axis=0), path_m.max(axis=0)
    size = high - low + 2.0 * max(float((high - low).max()) / 6.0, 0.5)
    size = np.maximum(size, [wide * size[1], size[0] / wide])  # the same scale on both axes
    return (low + high - size) / 2.0, (low + high + size) / 2.0


def _colors(names: Mapping[str, object]) -> list[str]:
    """One colour per configuration; the first ten are distinct."""
    return [COLORS[number % len(COLORS)] for number in range(len(names))]


def _legend_beside(figure: Figure, axes: Axes) -> None:
    """A legend at the right, where it hides nothing; long names are shortened."""
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles,
        [_short(label) for label in labels],
        loc="upper left",
        bbox_to_anchor=(0.745, 0.98),
        fontsize=8,
        frameon=False,
    )


def _short(name: str, length: int = 30) -> str:
    """A name shortened to ``length`` characters."""
    return name if len(name) <= length else name[: length - 1] + "…"


def _grey(states: StateArray) -> NDArray[np.uint8]:
    """nav2's grey values, the highest y on top."""
    image = np.full(states.shape, 205, dtype=np.uint8)
    image[states == FREE] = 254
    image[states == OCCUPIED] = 0
    return image[::-1]


def _cut(states: StateArray) -> StateArray:
    """The states without unknown borders."""
    known = states != -1
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if not rows.size:
        return states[:1, :1]
    return states[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]


def _plain(axes: Axes) -> None:
    """Use small labels, a faint grid, and no frame at the right and the top."""
    axes.tick_params(labelsize=8, colors=GREY)
    axes.xaxis.label.set(fontsize=9, color=GREY)
    axes.yaxis.label.set(fontsize=9, color=GREY)
    axes.grid(True, color=GREY, alpha=0.18, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)


def _thinned(rows: FloatArray) -> FloatArray:
    """About _MAX_POINTS rows at equal intervals, including the last one."""
    step = max(1, len(rows) // _MAX_POINTS)
    return np.concatenate([rows[:-1:step], rows[-1:]])
