"""Correlative scan matching: the best of all poses in a window, by branch and bound.

Olson 2009 (correlative matching on a likelihood field), Hess 2016 Sec. V-B (the bound by max-pooled fields
and the depth-first search). A field is a picture of a local map blurred by the range noise; a pose's score
is the mean of the field under the scan's points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.measurements import AnyFloatArray, FloatArray

_LEVELS = 5


class LikelihoodField(NamedTuple):
    """A likelihood field and its max-pooled copies.

    Attributes
    ----------
    levels
        uint8 pictures; pixel (r + w - 1, c + w - 1) of level k is the maximum of level 0 over
        rows r..r+w-1 and columns c..c+w-1, with w = 2^k. 255 stands for likelihood 1.
    origin_x, origin_y
        Lower-left corner of pixel (0, 0) of level 0, metres.
    cell_m
        Edge of a pixel.
    """

    levels: tuple[NDArray[np.uint8], ...]
    origin_x: float
    origin_y: float
    cell_m: float


class SearchResult(NamedTuple):
    """The best pose of a window.

    Attributes
    ----------
    pose
        (3,) x, y, yaw in the field's frame.
    score
        Mean likelihood of the points, 0..1; where nothing was found, the least score that none reached.
    found
        False when no pose reached the least score; ``pose`` is then the guess.
    """

    pose: FloatArray
    score: float
    found: bool


def build_field(points: AnyFloatArray, cell_m: float, sigma_m: float) -> LikelihoodField:
    """Blur (M, 2) map points, M > 0, into a likelihood field of standard deviation ``sigma_m``."""
    margin = 3.0 * sigma_m + cell_m
    origin_x = float(points[:, 0].min()) - margin
    origin_y = float(points[:, 1].min()) - margin
    columns = int((float(points[:, 0].max()) + margin - origin_x) / cell_m) + 1
    rows = int((float(points[:, 1].max()) + margin - origin_y) / cell_m) + 1
    level = np.zeros((rows, columns), np.uint8)
    _stamp(points, level, origin_x, origin_y, cell_m, sigma_m)
    levels = [level]
    for k in range(1, _LEVELS):
        levels.append(_pool_twice(levels[-1], 1 << (k - 1)))
    return LikelihoodField(tuple(levels), origin_x, origin_y, cell_m)


def search_window(
    field: LikelihoodField,
    points: AnyFloatArray,
    guess: FloatArray,
    half_width_m: float,
    half_yaw_rad: float,
    least_score: float,
) -> SearchResult:
    """Find the pose with the highest score within a window around a guess.

    Parameters
    ----------
    field
        The map's likelihood field.
    points
        (M, 2) scan points, base frame, M > 0.
    guess
        (3,) centre of the window, field frame.
    half_width_m, half_yaw_rad
        Half size of the window in x and y, and in yaw.
    least_score
        Poses at or below this score are not looked for; a higher value makes the search faster.
    """
    reach_m = max(1.0, float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 90)))
    step_rad = field.cell_m / reach_m
    yaw_steps = math.ceil(half_yaw_rad / step_rad)
    width_steps = math.ceil(half_width_m / field.cell_m)
    columns, rows = _rotated_pixels(
        points, guess, yaw_steps, step_rad, field.origin_x, field.origin_y, field.cell_m
    )
    best, dx, dy, turn = _branch_and_bound(
        field.levels, columns, rows, width_steps, int(least_score * 255.0 * len(points))
    )
    if turn < 0:
        return SearchResult(guess.copy(), least_score, False)
    offset = np.array([dx * field.cell_m, dy * field.cell_m, (turn - yaw_steps) * step_rad])
    return SearchResult(guess + offset, best / (255.0 * len(points)), True)


@kernel
def _stamp(points, level, origin_x, origin_y, cell_m, sigma_m):  # type: ignore[no-untyped-def]
    """Draw a Gaussian blob around the pixel of every point, keeping the maximum."""
    radius = math.ceil(3.0 * sigma_m / cell_m)
    blob = np.empty((2 * radius + 1, 2 * radius + 1), np.uint8)
    for a in range(-radius, radius + 1):
        for b in range(-radius, radius + 1):
            squared = (a * a + b * b) * cell_m * cell_m
            blob[a + radius, b + radius] = int(255.0 * math.exp(-0.5 * squared / (sigma_m * sigma_m)))
    rows, columns = level.shape
    for i in range(points.shape[0]):
        column = int((points[i, 0] - origin_x) / cell_m)
        row = int((points[i, 1] - origin_y) / cell_m)
        if level[row, column] == 255:
            continue
        for a in range(max(-radius, -row), min(radius + 1, rows - row)):
            for b in range(max(-radius, -column), min(radius + 1, columns - column)):
                value = blob[a + radius, b + radius]
                if value > level[row + a, column + b]:
                    level[row + a, column + b] = value


@kernel
def _pool_twice(level, width):  # type: ignore[no-untyped-def]
    """From maxima over ``width`` pixels to maxima over twice as many."""
    rows, columns = level.shape
    wide = np.zeros((rows, columns + width), np.uint8)
    for r in range(rows):
        for c in range(columns):
            wide[r, c] = max(wide[r, c], level[r, c])
            wide[r, c + width] = level[r, c]
    pooled = np.zeros((rows + width, columns + width), np.uint8)
    for r in range(rows):
        for c in range(columns + width):
            pooled[r, c] = max(pooled[r, c], wide[r, c])
            pooled[r + width, c] = max(pooled[r + width, c], wide[r, c])
    return pooled


@kernel
def _rotated_pixels(points, guess, yaw_steps, step_rad, origin_x, origin_y, cell_m):  # type: ignore[no-untyped-def]
    """Pixel of every point for every yaw of the window, (turns, M) columns and rows."""
    turns = 2 * yaw_steps + 1
    columns = np.empty((turns, points.shape[0]), np.int32)
    rows = np.empty((turns, points.shape[0]), np.int32)
    for t in range(turns):
        yaw = guess[2] + (t - yaw_steps) * step_rad
        cos = math.cos(yaw)
        sin = math.sin(yaw)
        for i in range(points.shape[0]):
            x = cos * points[i, 0] - sin * points[i, 1] + guess[0] - origin_x
            y = sin * points[i, 0] + cos * points[i, 1] + guess[1] - origin_y
            columns[t, i] = math.floor(x / cell_m)
            rows[t, i] = math.floor(y / cell_m)
    return columns, rows


@kernel
def _score(level, width, columns, rows, dx, dy):  # type: ignore[no-untyped-def]
    """Upper bound of the score sum over the ``width`` x ``width`` offsets that start at (dx, dy)."""
    total = 0
    for i in range(columns.size):
        c = columns[i] + dx + width - 1
        r = rows[i] + dy + width - 1
        if 0 <= c < level.shape[1] and 0 <= r < level.shape[0]:
            total += level[r, c]
    return total


@kernel
def _block_bounds(level, block, columns, rows, width_steps, side):  # type: ignore[no-untyped-def]
    """Bound of every block of the window: (turns * side * side,), x fastest."""
    turns = columns.shape[0]
    bounds = np.empty(turns * side * side, np.int64)
    for t in range(turns):
        for a in range(side):
            for b in range(side):
                bounds[(t * side + a) * side + b] = _score(
                    level, block, columns[t], rows[t], b * block - width_steps, a * block - width_steps
                )
    return bounds


def _branch_and_bound(
    levels: tuple[NDArray[np.uint8], ...],
    columns: NDArray[np.int32],
    rows: NDArray[np.int32],
    width_steps: int,
    least: int,
) -> tuple[int, int, int, int]:
    """Best score sum, its x and y offset in pixels and its turn (-1 when none is above ``least``)."""
    top = len(levels) - 1
    while top > 0 and (1 << top) > 2 * width_steps + 1:
        top -= 1
    block = 1 << top
    side = (2 * width_steps + block) // block
    bounds = _block_bounds(levels[top], block, columns, rows, width_steps, side)
    order = np.argsort(-bounds, kind="stable")
    return _descend(levels, columns, rows, width_steps, least, top, side, bounds, order)


@kernel
def _descend(levels, columns, rows, width_steps, least, top, side, bounds, order):  # type: ignore[no-untyped-def]
    """Depth first through the blocks in the order of their bounds."""
    block = 1 << top
    best = least
    best_dx = best_dy = 0
    best_turn = -1
    stack = np.empty((4 * (top + 1), 4), np.int64)
    for node in order:
        if bounds[node] <= best:
            break
        t = node // (side * side)
        stack[0, 0] = top
        stack[0, 1] = node % side * block - width_steps
        stack[0, 2] = (node // side) % side * block - width_steps
        stack[0, 3] = bounds[node]
        depth = 1
        while depth > 0:
            depth -= 1
            level, dx, dy, bound = stack[depth]
            if bound <= best:
                continue
            if level == 0:
                best, best_dx, best_dy, best_turn = bound, dx, dy, t
                continue
            half = 1 << (level - 1)
            first = depth
            for child in range(4):
                x = dx + (child & 1) * half
                y = dy + (child >> 1) * half
                # The last block of a row reaches beyond the window.
                if x > width_steps or y > width_steps:
                    continue
                bound = _score(levels[level - 1], half, columns[t], rows[t], x, y)
                if bound <= best:
                    continue
                # Insert so that the child with the highest bound lies on top.
                place = depth
                while place > first and stack[place - 1, 3] > bound:
                    for k in range(4):
                        stack[place, k] = stack[place - 1, k]
                    place -= 1
                stack[place, 0] = level - 1
                stack[place, 1] = x
                stack[place, 2] = y
                stack[place, 3] = bound
                depth += 1
    return best, best_dx, best_dy, best_turn
