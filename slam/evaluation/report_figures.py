"""The pictures of report.html, as PNG bytes of a bounded size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.evaluation.figure_parts import (
    BLUE,
    GREEN,
    ORANGE,
    RED,
    encoded_png,
    figure_of,
    legend_above,
    plain,
    png_of,
    thinned,
)
from slam.evaluation.uncertainty_figures import ellipses
from slam.mapping.occupancy_grid import FREE, OCCUPIED, StateArray
from slam.measurements import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The long side of the map: a page shows no more, while time and memory would grow. The short side of a
# corridor's map still gets some pixels, for legend and labels.
_LONG_SIDE_PX, _MIN_SIDE_PX = 1000, 320
_LEFT_PX, _RIGHT_PX, _BOTTOM_PX, _TOP_PX = 60, 12, 45, 28
_SMALL_SIDE_PX = 480
_UNKNOWN_GREY, FREE_GREY = 205, 254  # of nav2
_MARGIN_CELLS = 8  # of what is shown around all that is known


@dataclass(frozen=True, slots=True)
class MapPicture:
    """A map as a picture.

    Attributes
    ----------
    image
        (rows, cols) grey values as in a nav2 map.pgm: 254 free, 0 occupied, 205 unknown; or (rows, cols, 3)
        RGB. Row 0 is the top, the largest y.
    resolution_m
        Side of a pixel.
    origin_xy
        Outer corner of the lower-left pixel in the map frame, metres.
    """

    image: NDArray[np.uint8]
    resolution_m: float
    origin_xy: tuple[float, float]

    @classmethod
    def of(cls, states: StateArray, resolution_m: float, T_map_grid: gtsam.Pose2) -> MapPicture:
        """States (row 0 at the lowest y) in grey."""
        image = np.full(states.shape, _UNKNOWN_GREY, np.uint8)
        image[states == FREE] = FREE_GREY
        image[states == OCCUPIED] = 0
        return cls(np.ascontiguousarray(image[::-1]), resolution_m, (T_map_grid.x(), T_map_grid.y()))


def map_png(
    trajectory_xy: FloatArray,
    loops_xyxy: FloatArray,
    picture: MapPicture | None,
    covariances: FloatArray | None = None,
) -> bytes:
    """Draw the map with trajectory and loops.

    Parameters
    ----------
    trajectory_xy
        (N, 2) positions in the map frame, metres.
    loops_xyxy
        (L, 4) both ends of each accepted loop.
    picture
        The ground; None leaves it white. A grey picture is cut to what is known.
    covariances
        (N, d, d) of the poses, drawn as ellipses; None for none.
    """
    image = None
    if picture is not None and picture.image.size:
        image, low = picture.image, np.array(picture.origin_xy, dtype=np.float64)
        if image.ndim == 2:
            image, low = _cropped(picture)
        high = low + picture.resolution_m * np.array(image.shape[1::-1])
    else:
        low, high = _bounds(trajectory_xy)
    figure, axes, ground = _map_axes(image, low, high)
    if len(loops_xyxy):
        # One line with gaps draws faster than one line a loop.
        gap = np.full(len(loops_xyxy), np.nan)
        x = np.column_stack([loops_xyxy[:, 0], loops_xyxy[:, 2], gap]).ravel()
        y = np.column_stack([loops_xyxy[:, 1], loops_xyxy[:, 3], gap]).ravel()
        axes.plot(x, y, color=ORANGE, linewidth=0.9, label=f"loops ({len(loops_xyxy)})")
    if len(trajectory_xy):
        xy = thinned(np.asarray(trajectory_xy, dtype=np.float64))
        axes.plot(xy[:, 0], xy[:, 1], color=BLUE, linewidth=1.1, label="trajectory")
        if covariances is not None:
            outlines, times = ellipses(trajectory_xy, covariances)
            label = "95 % ellipses" + (f", {times} times larger" if times > 1 else "")
            axes.plot(*outlines.T, color=RED, linewidth=0.8, label=label)
        axes.plot(*trajectory_xy[0], "o", color=GREEN, markersize=6, label="start")
        axes.plot(*trajectory_xy[-1], "s", color=RED, markersize=6, label="end")
        legend_above(axes)
    return png_of(figure, ground)


def known_window(image: NDArray[np.uint8]) -> tuple[slice, slice]:
    """Rows and columns of a grey picture that hold all that is known, with a margin; all where nothing is."""
    reported = image != _UNKNOWN_GREY
    rows, columns = np.flatnonzero(reported.any(axis=1)), np.flatnonzero(reported.any(axis=0))
    if not rows.size:
        return slice(0, image.shape[0]), slice(0, image.shape[1])
    return (
        slice(max(rows[0] - _MARGIN_CELLS, 0), min(rows[-1] + _MARGIN_CELLS + 1, image.shape[0])),
        slice(max(columns[0] - _MARGIN_CELLS, 0), min(columns[-1] + _MARGIN_CELLS + 1, image.shape[1])),
    )


def small_map_png(image: NDArray[np.uint8]) -> bytes:
    """A grey picture without axes, small enough to stand beside others."""
    scale = _SMALL_SIDE_PX / max(image.shape)
    rows, columns = (max(1, round(scale * size)) for size in image.shape)
    return encoded_png(_resized(image, rows, columns))


def scores_png(
    stamps_s: FloatArray, inlier_share: FloatArray, residual_m: FloatArray, degenerate: BoolArray
) -> bytes:
    """Draw inlier share and residual over time.

    Parameters
    ----------
    stamps_s, inlier_share, residual_m, degenerate
        (K,) each, one a keyframe; stamps may run backward, so points are not joined.
    """
    figure = figure_of(1000, 510)
    residuals = figure.add_axes((0.065, 0.10, 0.92, 0.39))
    shares = figure.add_axes((0.065, 0.545, 0.92, 0.39), sharex=residuals)
    elapsed_s = stamps_s - stamps_s.min() if stamps_s.size else stamps_s
    _dots(shares, elapsed_s, inlier_share, degenerate)
    shares.set(ylabel="inlier share", ylim=(-0.03, 1.03))
    shares.tick_params(labelbottom=False)
    if stamps_s.size:
        legend_above(shares)
    _dots(residuals, elapsed_s, 1000.0 * residual_m, degenerate)
    residuals.set(ylabel="residual, mm", xlabel="time since the first keyframe, s")
    residuals.set_ylim(bottom=0.0)
    for axes in (shares, residuals):
        plain(axes)
    return png_of(figure)


def times_png(times_s: FloatArray, unit: str) -> bytes:
    """Draw the time a scan or frame, (S,) seconds in the order of the log, over the log."""
    figure = figure_of(1000, 250)
    axes = figure.add_axes((0.065, 0.2, 0.92, 0.67))
    _time_a_scan(axes, 1000.0 * times_s, unit)
    plain(axes)
    return png_of(figure)


def _dots(axes: Axes, x: FloatArray, y: FloatArray, degenerate: BoolArray) -> None:
    """Scores as dots, the degenerate matches in another colour and on top."""
    style: dict[str, Any] = {"linestyle": "none", "marker": "o", "markeredgewidth": 0}
    axes.plot(x[~degenerate], y[~degenerate], color=BLUE, markersize=3, alpha=0.7, label="match", **style)
    if degenerate.any():
        axes.plot(x[degenerate], y[degenerate], color=ORANGE, markersize=4, label="degenerate", **style)


def _time_a_scan(axes: Axes, times_ms: FloatArray, unit: str) -> None:
    """Median and range of the time a scan in stretches of the log: a flat line is a flat cost."""
    axes.set(xlabel=unit, ylabel=f"time a {unit}, ms")
    if not times_ms.size:
        return
    size = -(-times_ms.size // 250)
    count = -(-times_ms.size // size)
    padding = np.full(count * size - times_ms.size, np.nan)
    stretches = np.concatenate([times_ms, padding]).reshape(count, size)
    middle = np.minimum((np.arange(count) + 0.5) * size, times_ms.size)
    high = np.nanpercentile(stretches, 95.0, axis=1)
    axes.fill_between(
        middle, np.nanmin(stretches, axis=1), high, color=BLUE, alpha=0.22, linewidth=0, label="up to 95 %"
    )
    axes.plot(middle, np.nanmedian(stretches, axis=1), color=BLUE, linewidth=1.3, label="median")
    # The first of all loads compiled code: it may leave the picture rather than flatten all others.
    top = min(1.15 * float(high.max()), 4.0 * float(np.percentile(high, 95.0)))
    axes.set_ylim(0.0, max(top, 1e-3))
    legend_above(axes)


def _map_axes(
    image: NDArray[np.uint8] | None, low: FloatArray, high: FloatArray
) -> tuple[Figure, Axes, NDArray[np.uint8]]:
    """Axes in metres from ``low`` to ``high``, the same scale on both, and the ground under them."""
    metres_a_pixel = float((high - low).max()) / _LONG_SIDE_PX
    inner_px = np.maximum(np.round((high - low) / metres_a_pixel), 1).astype(int)
    box_px = np.maximum(inner_px, _MIN_SIDE_PX)
    offset_px = (box_px - inner_px) // 2
    width, height = int(box_px[0]) + _LEFT_PX + _RIGHT_PX, int(box_px[1]) + _BOTTOM_PX + _TOP_PX
    ground = np.full((height, width, 3), 255, dtype=np.uint8)
    if image is not None:
        columns, rows = int(inner_px[0]), int(inner_px[1])
        left, bottom = _LEFT_PX + int(offset_px[0]), height - _BOTTOM_PX - int(offset_px[1])
        picture = _resized(image, rows, columns)
        ground[bottom - rows : bottom, left : left + columns] = (
            picture if picture.ndim == 3 else picture[..., None]
        )
    figure = figure_of(width, height, facecolor="none")
    box = (_LEFT_PX / width, _BOTTOM_PX / height, int(box_px[0]) / width, int(box_px[1]) / height)
    axes = figure.add_axes(box, facecolor="none")
    start = low - offset_px * metres_a_pixel
    stop = start + box_px * metres_a_pixel
    axes.set(xlim=(start[0], stop[0]), ylim=(start[1], stop[1]), xlabel="x, m", ylabel="y, m")
    plain(axes)
    return figure, axes, ground


def _bounds(trajectory_xy: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest corner around the finite positions, with a tenth to spare, at most a metre."""
    known = trajectory_xy[np.isfinite(trajectory_xy).all(axis=1)] if len(trajectory_xy) else trajectory_xy
    if not len(known):
        return np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    low, high = known.min(axis=0), known.max(axis=0)
    margin_m = min(0.1 + 0.1 * float((high - low).max()), 1.0)
    return low - margin_m, high + margin_m


def _cropped(picture: MapPicture) -> tuple[NDArray[np.uint8], FloatArray]:
    """The picture without its unknown margin, and the new lower-left corner."""
    rows, columns = known_window(picture.image)
    shift = np.array([columns.start, picture.image.shape[0] - rows.stop])
    return picture.image[rows, columns], np.array(picture.origin_xy) + picture.resolution_m * shift


def _resized(image: NDArray[np.uint8], rows: int, columns: int) -> NDArray[np.uint8]:
    """The picture in another size; where it shrinks the darkest pixel wins, so that thin walls stay."""
    for axis, size in enumerate((rows, columns)):
        starts = np.arange(size) * image.shape[axis] // size
        shrinks = size < image.shape[axis]
        # Starts are distinct only when shrinking; reduceat takes each stretch up to the next start.
        image = np.minimum.reduceat(image, starts, axis=axis) if shrinks else image.take(starts, axis=axis)
    return image
