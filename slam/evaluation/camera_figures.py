"""Pictures of report.html that only runs with cameras or with a ground truth have."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slam.evaluation.figure_parts import (
    BLUE,
    GREEN,
    GREY,
    RED,
    figure_of,
    legend_above,
    plain,
    png_of,
    thinned,
)
from slam.evaluation.truth_comparison import TruthComparison
from slam.mapper.scan_record import ScanRecord
from slam.measurements import BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# A loss of one frame in an hour would not be seen: it gets this share of the width.
_LEAST_WIDTH = 0.002


def tracking_png(frames: ScanRecord) -> bytes:
    """Draw over time how well the frames of a camera fitted, and where tracking was lost."""
    rows = [
        ("inlier share", frames.inlier_shares),
        ("overlap", frames.overlaps),
        ("features", frames.feature_counts),
        ("reprojection, px", frames.residuals_px),
        ("surface, mm", 1000.0 * frames.residuals_m),
    ]
    figure = figure_of(1000, 900)
    elapsed_s = frames.stamps_s - frames.stamps_s.min() if frames.stamps_s.size else frames.stamps_s
    lowest: Axes | None = None
    for place, (label, values) in enumerate(rows):
        axes = figure.add_axes((0.065, 0.805 - 0.187 * place, 0.92, 0.165), sharex=lowest)
        lowest = lowest or axes
        known = np.isfinite(values)
        axes.plot(elapsed_s[known], values[known], ".", color=BLUE, markersize=3, markeredgewidth=0)
        _mark_losses(axes, elapsed_s, frames.unmatched)
        is_share = place < 2
        axes.set(ylabel=label, ylim=(-0.03, 1.03) if is_share else (0.0, _top(values[known])))
        axes.tick_params(labelbottom=place == len(rows) - 1)
        plain(axes)
        if place == 0 and frames.unmatched.any():
            legend_above(axes)
        if place == len(rows) - 1:
            axes.set_xlabel("time since the first frame, s")
    return png_of(figure)


def truth_png(comparison: TruthComparison, *, spatial: bool) -> bytes:
    """Draw a trajectory over its truth from above, for a spatial run from the side too, and its error."""
    figure = figure_of(1000, 820)
    errors = figure.add_axes((0.065, 0.065, 0.92, 0.22))
    views = [("x, m", "y, m", [0, 1]), ("x, m", "z, m", [0, 2])][: 2 if spatial else 1]
    width = (0.92 - 0.07 * (len(views) - 1)) / len(views)
    for place, (across, upward, columns) in enumerate(views):
        axes = figure.add_axes((0.065 + place * (width + 0.07), 0.365, width, 0.59))
        truth = thinned(comparison.true_positions_m[:, columns])
        path = thinned(comparison.positions_m[:, columns])
        axes.plot(*truth.T, color=GREEN, linewidth=2.4, alpha=0.55, label="truth")
        axes.plot(*path.T, color=BLUE, linewidth=1.1, label="trajectory")
        axes.set(xlabel=across, ylabel=upward)
        axes.set_aspect("equal", adjustable="datalim")
        plain(axes)
        legend_above(axes)
    elapsed_s = comparison.stamps_s - comparison.stamps_s.min()
    errors.plot(elapsed_s, 100.0 * comparison.errors_m, ".", color=RED, markersize=3, markeredgewidth=0)
    errors.axhline(100.0 * comparison.error.translation_m.rmse, color=GREY, linewidth=0.9, linestyle="--")
    errors.set(
        xlabel="time, s", ylabel="error, cm (RMSE dashed)", ylim=(0.0, _top(100.0 * comparison.errors_m))
    )
    plain(errors)
    return png_of(figure)


def side_png(positions_m: FloatArray) -> bytes:
    """Draw a trajectory in space from the side: x to the right, z up."""
    figure = figure_of(1000, 380)
    axes = figure.add_axes((0.065, 0.13, 0.92, 0.79))
    path = thinned(positions_m)
    axes.plot(path[:, 0], path[:, 2], color=BLUE, linewidth=1.1, label="trajectory")
    axes.plot(path[0, 0], path[0, 2], "o", color=GREEN, markersize=6, label="start")
    axes.plot(path[-1, 0], path[-1, 2], "s", color=RED, markersize=6, label="end")
    axes.set(xlabel="x, m", ylabel="z, m")
    axes.set_aspect("equal", adjustable="datalim")
    plain(axes)
    legend_above(axes)
    return png_of(figure)


def _mark_losses(axes: Axes, elapsed_s: FloatArray, lost: BoolArray) -> None:
    """A red band over every stretch of lost frames."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]]).astype(np.int8)))
    starts, ends = edges[::2], edges[1::2] - 1
    if not starts.size:
        return
    least_s = _LEAST_WIDTH * max(float(np.ptp(elapsed_s)), 1e-6)
    # Stamps may run backward; a band has no negative width.
    widths = np.maximum(elapsed_s[ends] - elapsed_s[starts], least_s)
    spans = list(zip(elapsed_s[starts].tolist(), widths.tolist(), strict=True))
    axes.broken_barh(
        spans,
        (0.0, 1.0),
        transform=axes.get_xaxis_transform(),
        color=RED,
        alpha=0.35,
        linewidth=0,
        label="lost",
    )


def _top(values: FloatArray) -> float:
    """Upper end of an axis; a few large values do not flatten all others."""
    return max(1.25 * float(np.percentile(values, 99.5)), 1e-6) if values.size else 1.0
