"""The pictures of report.html, as PNG bytes of a bounded size."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slam.measurements import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The long side of the map: a page shows no more, while time and memory would grow. The short side of a
# corridor's map still gets some pixels, for legend and labels.
_LONG_SIDE_PX, _MIN_SIDE_PX = 1000, 320
_LEFT_PX, _RIGHT_PX, _BOTTOM_PX, _TOP_PX = 60, 12, 45, 28
_DPI = 100
_UNKNOWN_GREY = 205  # of nav2
_MAX_POINTS = 4000

_BLUE, _ORANGE, _GREEN, _RED, _GREY = "#2563b8", "#d9730d", "#1f8a4c", "#c2352b", "#667281"


def map_png(
    trajectory_xy: FloatArray,
    loops_xyxy: FloatArray,
    *,
    image: NDArray[np.uint8] | None,
    resolution_m: float,
    origin_xy: tuple[float, float],
) -> bytes:
    """Draw the map with trajectory and loops.

    Parameters
    ----------
    trajectory_xy
        (N, 2) positions in the map frame, metres.
    loops_xyxy
        (L, 4) both ends of each accepted loop.
    image
        (rows, cols) grey picture, row 0 at the largest y; None leaves the ground white.
    resolution_m, origin_xy
        Side of a pixel and outer corner of the lower-left one.
    """
    if image is not None and image.size:
        image, low = _cropped(image, resolution_m, origin_xy)
        high = low + resolution_m * np.array(image.shape[::-1])
    else:
        image = None
        low, high = _bounds(trajectory_xy)
    axes, ground = _map_axes(image, low, high)
    if len(loops_xyxy):
        # One line with gaps draws faster than one line a loop.
        gap = np.full(len(loops_xyxy), np.nan)
        x = np.column_stack([loops_xyxy[:, 0], loops_xyxy[:, 2], gap]).ravel()
        y = np.column_stack([loops_xyxy[:, 1], loops_xyxy[:, 3], gap]).ravel()
        axes.plot(x, y, color=_ORANGE, linewidth=0.9, label=f"loops ({len(loops_xyxy)})")
    if len(trajectory_xy):
        xy = _thinned(np.asarray(trajectory_xy, dtype=np.float64))
        axes.plot(xy[:, 0], xy[:, 1], color=_BLUE, linewidth=1.1, label="trajectory")
        axes.plot(*trajectory_xy[0], "o", color=_GREEN, markersize=6, label="start")
        axes.plot(*trajectory_xy[-1], "s", color=_RED, markersize=6, label="end")
        _legend_above(axes)
    return _png(axes, ground)


def scores_png(
    stamps_s: FloatArray,
    inlier_share: FloatArray,
    residual_m: FloatArray,
    degenerate: BoolArray,
    scan_times_s: FloatArray,
) -> bytes:
    """Draw inlier share and residual over time, and the time a scan over the log.

    Parameters
    ----------
    stamps_s, inlier_share, residual_m, degenerate
        (K,) each, one a keyframe; stamps may run backward, so points are not joined.
    scan_times_s
        (S,) seconds, in the order of the log.
    """
    figure = _figure(1000, 760)
    # The upper two share the time axis and stand close; the lower one counts scans.
    residuals = figure.add_axes((0.065, 0.405, 0.92, 0.26))
    shares = figure.add_axes((0.065, 0.70, 0.92, 0.26), sharex=residuals)
    times = figure.add_axes((0.065, 0.065, 0.92, 0.245))
    elapsed_s = stamps_s - stamps_s.min() if stamps_s.size else stamps_s
    _dots(shares, elapsed_s, inlier_share, degenerate)
    shares.set(ylabel="inlier share", ylim=(-0.03, 1.03))
    shares.tick_params(labelbottom=False)
    if stamps_s.size:
        _legend_above(shares)
    _dots(residuals, elapsed_s, 1000.0 * residual_m, degenerate)
    residuals.set(ylabel="residual, mm", xlabel="time since the first keyframe, s")
    residuals.set_ylim(bottom=0.0)
    _time_a_scan(times, 1000.0 * scan_times_s)
    for axes in (shares, residuals, times):
        _plain(axes)
    return _png(times)


def _dots(axes: Axes, x: FloatArray, y: FloatArray, degenerate: BoolArray) -> None:
    """Scores as dots, the degenerate matches in another colour and on top."""
    style: dict[str, Any] = {"linestyle": "none", "marker": "o", "markeredgewidth": 0}
    axes.plot(x[~degenerate], y[~degenerate], color=_BLUE, markersize=3, alpha=0.7, label="match", **style)
    if degenerate.any():
        axes.plot(x[degenerate], y[degenerate], color=_ORANGE, markersize=4, label="degenerate", **style)


def _time_a_scan(axes: Axes, times_ms: FloatArray) -> None:
    """Median and range of the time a scan in stretches of the log: a flat line is a flat cost."""
    axes.set(xlabel="scan", ylabel="time a scan, ms")
    if not times_ms.size:
        return
    size = -(-times_ms.size // 250)
    count = -(-times_ms.size // size)
    padding = np.full(count * size - times_ms.size, np.nan)
    stretches = np.concatenate([times_ms, padding]).reshape(count, size)
    middle = np.minimum((np.arange(count) + 0.5) * size, times_ms.size)
    high = np.nanpercentile(stretches, 95.0, axis=1)
    axes.fill_between(
        middle, np.nanmin(stretches, axis=1), high, color=_BLUE, alpha=0.22, linewidth=0, label="up to 95 %"
    )
    axes.plot(middle, np.nanmedian(stretches, axis=1), color=_BLUE, linewidth=1.3, label="median")
    axes.set_ylim(0.0, max(1.15 * float(high.max()), 1e-3))
    _legend_above(axes)


def _map_axes(
    image: NDArray[np.uint8] | None, low: FloatArray, high: FloatArray
) -> tuple[Axes, NDArray[np.uint8]]:
    """Axes in metres from ``low`` to ``high``, the same scale on both, and the grey ground under them."""
    metres_a_pixel = float((high - low).max()) / _LONG_SIDE_PX
    inner_px = np.maximum(np.round((high - low) / metres_a_pixel), 1).astype(int)
    box_px = np.maximum(inner_px, _MIN_SIDE_PX)
    offset_px = (box_px - inner_px) // 2
    width, height = int(box_px[0]) + _LEFT_PX + _RIGHT_PX, int(box_px[1]) + _BOTTOM_PX + _TOP_PX
    ground = np.full((height, width), 255, dtype=np.uint8)
    if image is not None:
        columns, rows = int(inner_px[0]), int(inner_px[1])
        left, bottom = _LEFT_PX + int(offset_px[0]), height - _BOTTOM_PX - int(offset_px[1])
        ground[bottom - rows : bottom, left : left + columns] = _resized(image, rows, columns)
    figure = _figure(width, height, facecolor="none")
    box = (_LEFT_PX / width, _BOTTOM_PX / height, int(box_px[0]) / width, int(box_px[1]) / height)
    axes = figure.add_axes(box, facecolor="none")
    start = low - offset_px * metres_a_pixel
    stop = start + box_px * metres_a_pixel
    axes.set(xlim=(start[0], stop[0]), ylim=(start[1], stop[1]), xlabel="x, m", ylabel="y, m")
    _plain(axes)
    return axes, ground


def _bounds(trajectory_xy: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest corner around the finite positions, with a metre to spare."""
    known = trajectory_xy[np.isfinite(trajectory_xy).all(axis=1)] if len(trajectory_xy) else trajectory_xy
    if not len(known):
        return np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    return known.min(axis=0) - 1.0, known.max(axis=0) + 1.0


def _cropped(
    image: NDArray[np.uint8], resolution_m: float, origin_xy: tuple[float, float]
) -> tuple[NDArray[np.uint8], FloatArray]:
    """The picture without its unknown margin, and the new lower-left corner."""
    told = image != _UNKNOWN_GREY
    rows, columns = np.flatnonzero(told.any(axis=1)), np.flatnonzero(told.any(axis=0))
    if not rows.size:
        return image, np.array(origin_xy, dtype=np.float64)
    margin = 8
    top, bottom = max(rows[0] - margin, 0), min(rows[-1] + margin + 1, image.shape[0])
    left, right = max(columns[0] - margin, 0), min(columns[-1] + margin + 1, image.shape[1])
    corner = np.array(origin_xy) + resolution_m * np.array([left, image.shape[0] - bottom])
    return image[top:bottom, left:right], corner


def _resized(image: NDArray[np.uint8], rows: int, columns: int) -> NDArray[np.uint8]:
    """The picture in another size; where it shrinks the darkest pixel wins, so that thin walls stay."""
    for axis, size in enumerate((rows, columns)):
        starts = np.arange(size) * image.shape[axis] // size
        shrinks = size < image.shape[axis]
        # Starts are distinct only when shrinking; reduceat takes each stretch up to the next start.
        image = np.minimum.reduceat(image, starts, axis=axis) if shrinks else image.take(starts, axis=axis)
    return image


def _thinned(rows: FloatArray) -> FloatArray:
    """At most _MAX_POINTS rows or so, evenly taken, the last one kept."""
    step = max(1, len(rows) // _MAX_POINTS)
    return np.concatenate([rows[:-1:step], rows[-1:]])


def _figure(width_px: int, height_px: int, facecolor: str = "white") -> Figure:
    """A figure without pyplot: no global state, no window system."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width_px / _DPI, height_px / _DPI), dpi=_DPI, facecolor=facecolor)


def _plain(axes: Axes) -> None:
    """Small labels, a faint grid, no box at the right and the top."""
    axes.tick_params(labelsize=8, colors=_GREY)
    axes.xaxis.label.set(fontsize=9, color=_GREY)
    axes.yaxis.label.set(fontsize=9, color=_GREY)
    axes.grid(True, color=_GREY, alpha=0.18, linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_GREY)


def _legend_above(axes: Axes) -> None:
    """A legend in one line above the axes, where it hides nothing."""
    axes.legend(loc="lower left", bbox_to_anchor=(-0.01, 0.985), ncols=4, fontsize=8, frameon=False)


def _png(axes: Axes, ground: NDArray[np.uint8] | None = None) -> bytes:
    """The figure of these axes rendered by Agg, over a grey ground of the same size."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    figure = axes.get_figure(root=True)
    assert figure is not None
    canvas: Any = FigureCanvasAgg(figure)  # its methods bear no types
    canvas.draw()
    drawn = np.asarray(canvas.buffer_rgba())
    rgb = drawn[..., :3]
    if ground is not None:
        # Laid over by hand: imshow would resample by way of several float copies, tens of megabytes.
        alpha = drawn[..., 3:].astype(np.uint16)
        rgb = ((rgb * alpha + ground[..., None] * (255 - alpha)) // 255).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(rgb).save(buffer, format="png")
    return buffer.getvalue()
