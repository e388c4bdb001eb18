"""The kernels that turn one laser scan into evidence for the cells of a grid.

A scan is drawn on a small board of its own: lines of free cells first, the ends on top. So each cell takes at
most one piece of evidence a scan (neighbouring beams through one cell see the same surface and are not
independent), and a cell in which a beam ended is never cleared by the neighbour that passes it.

Positions are in cells on an endless lattice: cell (row, col) spans [col, col + 1) in x, [row, row + 1) in y.
"""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.measurements import Float32Array, FloatArray

Evidence: TypeAlias = NDArray[np.uint8]
Box: TypeAlias = tuple[int, int, int, int]

NOTHING = np.uint8(0)
FREE = np.uint8(1)
HIT = np.uint8(2)

# Lines are followed in fixed point: an addition and a shift a cell, no rounding call.
_FRACTION_BITS = 32
_ONE = float(1 << _FRACTION_BITS)
_HAIR = 1e-9


@kernel
def beam_ends(
    ranges_m: Float32Array,
    x_cells: float,
    y_cells: float,
    start_rad: float,
    step_rad: float,
    cells_per_m: float,
    hit_limit_m: float,
    clear_limit_m: float,
) -> tuple[FloatArray, Evidence, Box]:
    """Where the beams end, Li2020 Eq. (1), and what they say there.

    Parameters
    ----------
    ranges_m
        (N,) ``inf`` is no return, ``nan`` an invalid reading.
    x_cells, y_cells
        The laser.
    start_rad, step_rad
        Bearing of beam 0 in the lattice, and the increment.
    hit_limit_m, clear_limit_m
        A finite range up to the first is a return; what is beyond counts as none and is free up to the
        second, which must be finite.

    Returns
    -------
    (N, 2) ends x, y in cells; (N,) HIT, FREE (no return) or NOTHING (``nan``, zero or less); and the box
    (first row, first col, rows, cols) that holds the laser and every end.
    """
    count = ranges_m.size
    ends = np.empty((count, 2))
    kinds = np.zeros(count, np.uint8)
    low_x = high_x = x_cells
    low_y = high_y = y_cells
    cosine, sine = math.cos(start_rad), math.sin(start_rad)
    turn_cosine, turn_sine = math.cos(step_rad), math.sin(step_rad)
    for beam in range(count):
        reach_m = 0.0
        if 0.0 < ranges_m[beam] <= hit_limit_m and ranges_m[beam] < math.inf:
            kinds[beam] = HIT
            reach_m = ranges_m[beam]
        elif ranges_m[beam] > 0.0 and clear_limit_m > 0.0:
            kinds[beam] = FREE
            reach_m = min(ranges_m[beam], clear_limit_m)
        end_x = x_cells + reach_m * cells_per_m * cosine
        end_y = y_cells + reach_m * cells_per_m * sine
        ends[beam, 0], ends[beam, 1] = end_x, end_y
        low_x, high_x = min(low_x, end_x), max(high_x, end_x)
        low_y, high_y = min(low_y, end_y), max(high_y, end_y)
        # The next bearing by one rotation: a sine and a cosine a beam cost as much as its line.
        cosine, sine = cosine * turn_cosine - sine * turn_sine, sine * turn_cosine + cosine * turn_sine
    row, col = math.floor(low_y), math.floor(low_x)
    return ends, kinds, (row, col, math.floor(high_y) + 1 - row, math.floor(high_x) + 1 - col)


@kernel
def draw_scan(ends: FloatArray, kinds: Evidence, box: Box, x_cells: float, y_cells: float) -> Evidence:
    """The board of a scan: what it says about every cell of its box.

    Parameters
    ----------
    ends, kinds, box
        From `beam_ends`.
    x_cells, y_cells
        The laser.

    Returns
    -------
    (rows, cols) of NOTHING, FREE or HIT; row 0 at the lowest y.
    """
    first_row, first_col, rows, cols = box
    board = np.zeros(rows * cols, np.uint8)
    # A place a hair below a border may be rounded onto it when the corner is taken off.
    last_x, last_y = cols - _HAIR, rows - _HAIR
    x, y = min(x_cells - first_col, last_x), min(y_cells - first_row, last_y)
    for beam in range(kinds.size):
        if kinds[beam] != NOTHING:
            end_x, end_y = min(ends[beam, 0] - first_col, last_x), min(ends[beam, 1] - first_row, last_y)
            _clear_line(board, cols, x, y, end_x, end_y)
    for kind in (FREE, HIT):
        for beam in range(kinds.size):
            if kinds[beam] == kind:
                end_x, end_y = min(ends[beam, 0] - first_col, last_x), min(ends[beam, 1] - first_row, last_y)
                board[int(end_y) * cols + int(end_x)] = kind
    return board.reshape(rows, cols)


@kernel
def add_evidence(
    log_odds: Float32Array,
    board: Evidence,
    first_row: int,
    first_col: int,
    hit_log_odds: np.float32,
    miss_log_odds: np.float32,
) -> None:
    """Li2020 Eq. (8) for every cell of a board, in place; in log-odds it is a sum.

    Parameters
    ----------
    log_odds
        (rows, cols) of the grid.
    board
        From `draw_scan`; must lie inside the grid.
    first_row, first_col
        The board's corner in the grid.
    """
    rows, cols = board.shape
    if first_row < 0 or first_col < 0:
        raise IndexError("the board lies outside the grid")
    if first_row + rows > log_odds.shape[0] or first_col + cols > log_odds.shape[1]:
        raise IndexError("the board lies outside the grid")
    for row in range(rows):
        line = log_odds[first_row + row, first_col : first_col + cols]
        kinds = board[row]
        # A choice without a branch, so that the compiler does many cells at once.
        for col in range(cols):
            is_free, is_hit = np.float32(kinds[col] & FREE), np.float32(kinds[col] >> FREE)
            line[col] += is_free * miss_log_odds + is_hit * hit_log_odds


@kernel(error_model="numpy")
def _clear_line(board: Evidence, cols: int, x: float, y: float, end_x: float, end_y: float) -> None:
    """Set the cells of a line to FREE but for its last; one cell a step along the longer axis."""
    dx, dy = end_x - x, end_y - y
    along_x = abs(dx) >= abs(dy)
    if along_x:
        major, minor, steps, slope = x, y, abs(int(end_x) - int(x)), dy / abs(dx)
        stride, forward = 1, dx > 0.0
    else:
        major, minor, steps, slope = y, x, abs(int(end_y) - int(y)), dx / abs(dy)
        stride, forward = cols, dy > 0.0
    board[int(y) * cols + int(x)] = FREE
    # From the laser to the middle of the next cell along the axis: there the line is looked at first.
    offset = int(major) + 1.5 - major if forward else major - int(major) + 0.5
    direction = stride if forward else -stride
    at = int(major) * stride
    across = int((minor + slope * offset) * _ONE)
    increment = int(slope * _ONE)
    if along_x:
        for step in range(1, steps):
            board[np.uint64((across >> _FRACTION_BITS) * cols + at + direction * step)] = FREE
            across += increment
    else:
        for step in range(1, steps):
            board[np.uint64((across >> _FRACTION_BITS) + at + direction * step)] = FREE
            across += increment
