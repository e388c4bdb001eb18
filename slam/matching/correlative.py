"""Correlative scan matching: the best of all poses in a window, by branch and bound.

Olson 2009 (correlative matching on a likelihood field), Hess 2016 Sec. V-B (the bound by max-pooled fields
and the depth-first search). A field is an image of a local map blurred by the range noise; the score of a
pose is the mean of the field at the points of the scan.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import NONE, ONE, ZERO, kernel
from slam.measurements import AnyFloatArray, FloatArray

_LEVELS = 5


class LikelihoodField(NamedTuple):
    """A likelihood field and its max-pooled copies.

    Attributes
    ----------
    levels
        (levels, rows, columns) uint8 pictures; pixel (r + w - 1, c + w - 1) of level k is the maximum of
        level 0 over rows r..r+w-1 and columns c..c+w-1, with w = 2^k. 255 stands for likelihood 1.
    origin_x, origin_y
        Lower-left corner of pixel (0, 0) of level 0, metres.
    """

    levels: NDArray[np.uint8]
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
    level, origin_x, origin_y = blurred(points, cell_m, sigma_m)
    widest = 1 << (_LEVELS - 1)
    levels = np.zeros((_LEVELS, level.shape[0] + widest - 1, level.shape[1] + widest - 1), np.uint8)
    levels[0, : level.shape[0], : level.shape[1]] = level
    for k in range(1, _LEVELS):
        # From maxima over some pixels to maxima over twice as many.
        width = 1 << (k - 1)
        levels[k] = levels[k - 1]
        np.maximum(levels[k, width:], levels[k - 1, :-width], out=levels[k, width:])
        np.maximum(levels[k, :, width:], levels[k, :, :-width].copy(), out=levels[k, :, width:])
    return LikelihoodField(levels, origin_x, origin_y, cell_m)


def blurred(points: AnyFloatArray, cell_m: float, sigma_m: float) -> tuple[NDArray[np.uint8], float, float]:
    """Return an image of (M, 2) points, M > 0, each a Gaussian blob, and x, y of its lower-left corner.

    Where blobs overlap, the higher one counts.
    """
    margin = 3.0 * sigma_m + cell_m
    origin_x = float(points[:, 0].min()) - margin
    origin_y = float(points[:, 1].min()) - margin
    columns = int((float(points[:, 0].max()) + margin - origin_x) / cell_m) + 1
    rows = int((float(points[:, 1].max()) + margin - origin_y) / cell_m) + 1
    radius = math.ceil(3.0 * sigma_m / cell_m)
    level = np.zeros((rows + 2 * radius, columns + 2 * radius), np.uint8)
    pixels = ((points - (origin_x, origin_y)) / cell_m).astype(np.int64) + radius
    level[pixels[:, 1], pixels[:, 0]] = 1
    hits = np.flatnonzero(level)
    dy, dx = np.indices((2 * radius + 1, 2 * radius + 1)) - radius
    squared = dx * dx + dy * dy
    # From the border of the blobs to their centres: the last value drawn is the highest.
    for distance in np.unique(squared)[::-1].tolist():
        height = int(255.0 * math.exp(-0.5 * (distance * cell_m * cell_m) / (sigma_m * sigma_m)))
        ring = (dy * level.shape[1] + dx)[squared == distance]
        level.ravel()[hits[:, None] + ring] = height
    return np.ascontiguousarray(level[radius : radius + rows, radius : radius + columns]), origin_x, origin_y


def search_window(
    field: LikelihoodField,
    points: AnyFloatArray,
    guess: FloatArray,
    half_width_m: float,
    half_yaw_rad: float,
    least_score: float,
    turns: FloatArray | None = None,
) -> SearchResult:
    """Find the pose with the highest score within a window around a guess.

    Parameters
    ----------
    points
        (M, 2) scan points, base frame, M > 0.
    guess
        (3,) centre of the window, field frame.
    half_width_m, half_yaw_rad
        Half size of the window in x and y, and in yaw.
    least_score
        Poses at or below this score are not looked for; a higher value makes the search faster.
    turns
        (k,) further yaws of the guess, each of which has a window of its own; none by default.
    """
    reach_m = max(1.0, float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 90)))
    step_rad = field.cell_m / reach_m
    yaw_steps = math.ceil(half_yaw_rad / step_rad)
    width_steps = math.ceil(half_width_m / field.cell_m)
    steps = np.arange(-yaw_steps, yaw_steps + 1) * step_rad
    yaws = guess[2] + (steps if turns is None else (turns[:, None] + steps).ravel())
    least = int(least_score * 255.0 * len(points))
    best, dx, dy, turn = _branch_and_bound(field, points, guess, yaws, width_steps, least)
    if turn < 0:
        return SearchResult(guess.copy(), least_score, False)
    pose = np.array([guess[0] + dx * field.cell_m, guess[1] + dy * field.cell_m, yaws[turn]])
    return SearchResult(pose, best / (255.0 * len(points)), True)


def _branch_and_bound(
    field: LikelihoodField,
    points: AnyFloatArray,
    guess: FloatArray,
    yaws: FloatArray,
    width_steps: int,
    least: int,
) -> tuple[int, int, int, int]:
    """Return the best score sum, its x, y offset in pixels and its yaw index (-1 if not above ``least``)."""
    levels, top = field.levels, len(field.levels) - 1
    while top > 0 and (1 << top) > 2 * width_steps + 1:
        top -= 1
    side = (2 * width_steps + (1 << top)) // (1 << top)
    columns, rows = np.empty((2, len(yaws), len(points)), np.int32)
    bounds = np.empty(len(yaws) * side * side, np.int64)
    _bound_all(*field, points, guess, yaws, columns, rows, width_steps, top, side, bounds)
    (above,) = np.nonzero(bounds > least)
    order = above[np.argsort(-bounds[above], kind="stable")]
    stack = np.empty((4 * (top + 1), 4), np.int64)
    return _descend(levels, columns, rows, width_steps, least, top, side, bounds, order, stack)


@kernel(error_model="numpy")
def _bound_all(  # type: ignore[no-untyped-def]
    levels, origin_x, origin_y, cell_m, points, guess, yaws, columns, rows, width, top, side, bounds
):
    """Write each point's pixel (turns, M), and each block's bound, (turns * side * side,), x fastest."""
    for turn in range(yaws.size):
        cos, sin = math.cos(yaws[turn]), math.sin(yaws[turn])
        for i in range(columns.shape[1]):
            x, y = points[i, 0], points[i, 1]
            columns[turn, i] = math.floor((cos * x - sin * y + guess[0] - origin_x) / cell_m)
            rows[turn, i] = math.floor((sin * x + cos * y + guess[1] - origin_y) / cell_m)
    block = 1 << top
    for node in range(bounds.size):
        dx = node % side * block - width
        dy = node // side % side * block - width
        bounds[node] = _score(levels, top, columns, rows, node // (side * side), dx, dy)


@kernel
def _descend(levels, columns, rows, width_steps, least, top, side, bounds, order, stack):  # type: ignore[no-untyped-def]
    """Search the blocks depth first, in the order of their bounds.

    A row of ``stack`` names one quarter of a block that was cut: its bound times four and which quarter, its
    level, and the first x and y of the block.
    """
    block = 1 << top
    best = least
    best_dx = best_dy = ZERO
    best_turn = NONE
    for node in order:
        if bounds[node] <= best:
            break
        turn = node // (side * side)
        stack[0, 0] = 4 * bounds[node]
        stack[0, 1] = top
        stack[0, 2] = node % side * block - width_steps
        stack[0, 3] = node // side % side * block - width_steps
        depth = ONE
        while depth > 0:
            depth -= 1
            key = stack[depth, 0]
            level = stack[depth, 1]
            if key >> 2 <= best:
                continue
            dx = stack[depth, 2] + ((key & 1) << level)
            dy = stack[depth, 3] + ((key >> 1 & 1) << level)
            if level == 0:
                best, best_dx, best_dy, best_turn = key >> 2, dx, dy, turn
                continue
            level -= 1
            first = depth
            for quarter in range(4):
                x = dx + ((quarter & 1) << level)
                y = dy + ((quarter >> 1) << level)
                # The last block of a row extends beyond the window.
                if x > width_steps or y > width_steps:
                    continue
                bound = _score(levels, level, columns, rows, turn, x, y)
                if bound <= best:
                    continue
                # The quarter with the highest bound on top.
                key = 4 * bound + quarter
                place = depth
                while place > first and stack[place - 1, 0] > key:
                    stack[place, 0] = stack[place - 1, 0]
                    place -= 1
                stack[place, 0] = key
                stack[depth, 1] = level
                stack[depth, 2] = dx
                stack[depth, 3] = dy
                depth += 1
    return best, best_dx, best_dy, best_turn


@kernel(inline="always")
def _score(levels, level, columns, rows, turn, dx, dy):  # type: ignore[no-untyped-def]
    """Return an upper bound of the score sum over a block of 2^level x 2^level offsets from (dx, dy)."""
    total = ZERO
    reach = (1 << level) - 1
    for i in range(columns.shape[1]):
        column = columns[turn, i] + dx + reach
        row = rows[turn, i] + dy + reach
        if 0 <= column < levels.shape[2] and 0 <= row < levels.shape[1]:
            total += levels[level, row, column]
    return total
