"""The part of report.html about scans and depth images that repaired each other (Xu2024)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from fusion import Grade, Provenance
from slam.evaluation.figure_parts import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    figure_of,
    legend_above,
    plain,
    png_of,
)
from slam.evaluation.pages import render
from slam.mapper.keyframe_fusion import FusionPair, FusionSummary
from slam.measurements import BoolArray, FloatArray, LaserScan

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_GRADE_COLORS = {Grade.LOW: RED, Grade.MIDDLE: ORANGE, Grade.HIGH: GREEN}
_REPAIR_COLORS = {Provenance.FILLED: ORANGE, Provenance.INTERPOLATED: BLUE, Provenance.AVERAGED: GREEN}
_MOST_EXAMPLES, _COLUMNS = 6, 3
_EXAMPLE_PX = 300
# Around what was repaired, so that it can be seen where it lies.
_MARGIN_M = 0.5

Examples = Sequence[tuple[LaserScan, LaserScan]]


def fusion_section(fused: FusionSummary) -> str:
    """What the pairs told of the rig, and what was repaired, as HTML."""
    repaired = [pair for pair in fused.pairs if pair.repaired is not None]
    shown = _spread(fused.examples)
    return render(
        "fusion.html",
        fused=fused,
        grades=_grade_rows(fused) if fused.pairs else [],
        offsets_png=offsets_png(fused) if fused.pairs else None,
        repaired=len(repaired),
        repairs_png=repairs_png(repaired) if repaired else None,
        examples_png=examples_png(shown) if fused.pairs and shown else None,
    )


def offsets_png(fused: FusionSummary) -> bytes:
    """Draw u of every pair over time by grade, and the rig's as a line."""
    figure = figure_of(1000, 300)
    axes = figure.add_axes((0.065, 0.16, 0.92, 0.75))
    stamps_s = np.array([pair.stamp_s for pair in fused.pairs])
    offsets = np.array([pair.u for pair in fused.pairs])
    grades = np.array([pair.grade for pair in fused.pairs])
    for grade, color in _GRADE_COLORS.items():
        chosen = grades == grade
        elapsed_s = stamps_s[chosen] - stamps_s.min()
        axes.plot(elapsed_s, offsets[chosen], ".", color=color, markersize=6, label=grade.name.lower())
    if fused.estimate is not None:
        axes.axhline(fused.estimate.u, color=GREY, linewidth=1.1, label="u of the rig")
    axes.set(xlabel="time since the first pair, s", ylabel="u, samples")
    plain(axes)
    legend_above(axes)
    return png_of(figure)


def repairs_png(repaired: Sequence[FusionPair]) -> bytes:
    """Draw which share of each scan's beams was repaired, by kind of repair."""
    figure = figure_of(1000, 300)
    axes = figure.add_axes((0.065, 0.16, 0.92, 0.75))
    stamps_s = np.array([pair.stamp_s for pair in repaired])
    counts = np.array([pair.repaired for pair in repaired], dtype=np.float64)
    percent = 100.0 * counts / counts.sum(axis=1, keepdims=True)
    for kind, color in _REPAIR_COLORS.items():
        label = kind.name.lower()
        axes.plot(stamps_s - stamps_s.min(), percent[:, kind], ".-", color=color, linewidth=0.8, label=label)
    axes.set(xlabel="time since the first repair, s", ylabel="beams of the scan, %")
    axes.set_ylim(bottom=0.0)
    plain(axes)
    legend_above(axes)
    return png_of(figure)


def examples_png(examples: Examples) -> bytes:
    """Draw scans from above, before (upper picture) and after the repair, like Xu2024's Fig. 7."""
    rows = 2 * -(-len(examples) // _COLUMNS)
    figure = figure_of(1000, rows * _EXAMPLE_PX)
    grid = figure.add_gridspec(
        rows, _COLUMNS, left=0.045, right=0.99, bottom=0.1 / rows, top=1.0 - 0.12 / rows, hspace=0.2
    )
    first_s = examples[0][0].stamp_s
    for number, (before, after) in enumerate(examples):
        row, column = 2 * (number // _COLUMNS), number % _COLUMNS
        was = np.isfinite(before.ranges_m)
        touched = np.isfinite(after.ranges_m) & (after.ranges_m != before.ranges_m)
        seen_before, seen_after = _points(before), _points(after)
        low, high = _window(np.concatenate([seen_before[was & touched], seen_after[touched]]))
        parts = (
            ("before", seen_before, [(was & ~touched, GREY), (was & touched, RED)]),
            ("after", seen_after, [(was & ~touched, GREY), (~was & touched, ORANGE), (was & touched, BLUE)]),
        )
        for place, (name, points, colors) in enumerate(parts):
            axes = figure.add_subplot(grid[row + place, column])
            _draw(axes, points, colors)
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            axes.set_aspect("equal", adjustable="box")
            title = f"{name}, {before.stamp_s - first_s:+.1f} s"
            axes.set_title(title, fontsize=9, color=GREY, loc="left")
    return png_of(figure)


def _draw(axes: Axes, points: FloatArray, colors: Sequence[tuple[BoolArray, str]]) -> None:
    """Points of a scan by what became of them, the rare ones on top."""
    for chosen, color in colors:
        axes.plot(*points[chosen].T, ".", color=color, markersize=3.5, markeredgewidth=0)
    axes.plot(0.0, 0.0, "+", color=GREY, markersize=8)
    plain(axes)


def _points(scan: LaserScan) -> FloatArray:
    """(N, 2) end of every beam, laser frame; not finite where there is no reading."""
    bearings = scan.bearings_rad()
    ranges_m = np.where(np.isfinite(scan.ranges_m), scan.ranges_m, np.nan).astype(np.float64)
    return np.column_stack([ranges_m * np.cos(bearings), ranges_m * np.sin(bearings)])


def _window(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Corners of the square of what is worth seeing: the repaired points and the lidar."""
    worth = np.concatenate([points, np.zeros((1, 2))])
    low, high = worth.min(axis=0), worth.max(axis=0)
    half_m = 0.5 * float((high - low).max()) + _MARGIN_M
    return 0.5 * (low + high) - half_m, 0.5 * (low + high) + half_m


def _spread(examples: Examples) -> Examples:
    """At most six examples, evenly taken."""
    if len(examples) <= _MOST_EXAMPLES:
        return examples
    chosen = np.linspace(0, len(examples) - 1, _MOST_EXAMPLES).round().astype(int)
    return [examples[number] for number in chosen]


def _grade_rows(fused: FusionSummary) -> list[tuple[str, ...]]:
    """Pairs by grade, and how far they are from what all of them tell together."""
    rows: list[tuple[str, ...]] = []
    for grade in sorted(Grade, reverse=True):
        offsets = np.array([pair.u for pair in fused.pairs if pair.grade == grade])
        apart = "–"
        if fused.estimate is not None and offsets.size:
            apart = f"{np.median(np.abs(offsets - fused.estimate.u)):.1f}"
        share = f"{offsets.size / len(fused.pairs):.0%}"
        rows.append((grade.name.lower(), f"{offsets.size:,}", share, apart))
    return rows
