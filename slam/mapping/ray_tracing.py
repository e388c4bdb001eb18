"""Kernels that convert one laser scan to evidence for the cells of a grid.

A scan is drawn on a small board of its own, so that each cell gets at most one piece of evidence per scan:
neighbouring beams through one cell see the same surface and are not independent.

Positions are in cells on an infinite grid: cell (row, col) covers [col, col + 1) in x, [row, row + 1) in y.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import TINY
from fusion.kernel import kernel
from slam.measurements import Float32Array, FloatArray

Evidence: TypeAlias = NDArray[np.uint8]
Box: TypeAlias = tuple[int, int, int, int]


class _Kind(IntEnum):
    """Evidence of a beam at its end."""

    NOTHING = 0
    FREE = 1
    HIT = 2
    TAKEN = 3


NOTHING, FREE, HIT, TAKEN = (np.uint8(kind) for kind in _Kind)

# Lines use fixed-point numbers: one addition and shift per cell, no rounding call.
_FRACTION_BITS = np.iinfo(np.int32).bits


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
    """Return where the beams end, Li2020 Eq. (1), and their evidence there.

    Parameters
    ----------
    ranges_m
        (N,) ``inf`` is no return, ``nan`` an invalid reading, negative one that was taken away.
    x_cells, y_cells
        The laser.
    start_rad, step_rad
        Bearing of beam 0 in the lattice, and the increment.
    hit_limit_m, clear_limit_m
        A finite range up to the first is a return; what is beyond counts as none and is free up to the
        second, which must be finite.

    Returns
    -------
    (N, 2) ends x, y in cells; (N,) HIT, FREE (no return), NOTHING (``nan``, zero) or TAKEN; and the box
    (first row, first col, rows, cols) that holds the laser and every end.
    """
    ends, kinds = np.empty((ranges_m.size, 2)), np.zeros(ranges_m.size, np.uint8)
    limits_m = hit_limit_m, clear_limit_m
    box: Box = _shoot(ranges_m, x_cells, y_cells, start_rad, step_rad, cells_per_m, *limits_m, ends, kinds)
    return ends, kinds, box


@kernel
def _shoot(  # type: ignore[no-untyped-def]
    ranges_m, x_cells, y_cells, start_rad, step_rad, cells_per_m, hit_limit_m, clear_limit_m, ends, kinds
):
    """Write the ends and kinds of `beam_ends`; return the box."""
    low_x = high_x = x_cells
    low_y = high_y = y_cells
    cosine, sine = math.cos(start_rad), math.sin(start_rad)
    turn_cosine, turn_sine = math.cos(step_rad), math.sin(step_rad)
    for beam in range(ranges_m.size):
        range_m = np.float64(ranges_m[beam])
        reach_m = 0.0
        if range_m > 0.0:
            if range_m <= hit_limit_m and range_m < math.inf:
                kinds[beam] = HIT
                reach_m = range_m
            elif clear_limit_m > 0.0:
                kinds[beam] = FREE
                reach_m = min(range_m, clear_limit_m)
        elif -hit_limit_m <= range_m < 0.0:
            kinds[beam] = TAKEN
            reach_m = -range_m
        end_x = x_cells + reach_m * cells_per_m * cosine
        end_y = y_cells + reach_m * cells_per_m * sine
        ends[beam, 0] = end_x
        ends[beam, 1] = end_y
        low_x = min(low_x, end_x)
        high_x = max(high_x, end_x)
        low_y = min(low_y, end_y)
        high_y = max(high_y, end_y)
        # The next bearing by one rotation: sine and cosine would cost as much as the line of a beam.
        cosine, sine = cosine * turn_cosine - sine * turn_sine, sine * turn_cosine + cosine * turn_sine
    row, col = math.floor(low_y), math.floor(low_x)
    return row, col, math.floor(high_y) + 1 - row, math.floor(high_x) + 1 - col


@kernel(error_model="numpy")
def mark_lines(ends, kinds, box, x_cells, y_cells, mark, board):  # type: ignore[no-untyped-def]
    """Mark the cells that beams pass, including their ends: one per step of the longer axis.

    ``board`` (rows * cols,) is the box of `beam_ends`, row after row, the lowest y first; the ends may be
    nearer to the laser than there.
    """
    first_row, first_col, rows, cols = box
    # A position just below a border may be rounded onto it when the corner is subtracted.
    last_x, last_y = cols - TINY, rows - TINY
    x, y = min(x_cells - first_col, last_x), min(y_cells - first_row, last_y)
    for beam in range(kinds.size):
        if kinds[beam] == NOTHING:
            continue
        end_x = min(ends[beam, 0] - first_col, last_x)
        end_y = min(ends[beam, 1] - first_row, last_y)
        dx = end_x - x
        dy = end_y - y
        if abs(dx) >= abs(dy):
            major, minor, end, along, across, stride, aside = x, y, end_x, dx, dy, 1, cols
        else:
            major, minor, end, along, across, stride, aside = y, x, end_y, dy, dx, cols, 1
        start = math.floor(major)
        steps = abs(math.floor(end) - start)
        slope = across / abs(along)
        # From the laser to the centre of the next cell along the axis, the first sample of the line.
        offset = major - start + 0.5
        forward = -stride
        if along > 0.0:
            offset = start + 1.5 - major
            forward = stride
        at = start * stride
        place = np.int64((minor + slope * offset) * 2.0**_FRACTION_BITS)
        increment = np.int64(slope * 2.0**_FRACTION_BITS)
        board[math.floor(y) * cols + math.floor(x)] = mark
        for _ in range(1, steps):
            at += forward
            board[np.uint64((place >> _FRACTION_BITS) * aside + at)] = mark
            place += increment
        board[math.floor(end_y) * cols + math.floor(end_x)] = mark
