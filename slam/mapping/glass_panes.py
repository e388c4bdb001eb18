"""Detect panes of glass in the scans of a lidar: walls that only return beams at a right angle.

A pane returns a beam that hits it at a right angle; else the beam passes or is lost (Foster et al. 2013). So
beams that pass elsewhere prove nothing: only the beams at right angles, returned or passed, are counted.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fusion.depth_model import RangeNoise
from fusion.kernel import kernel
from slam.mapping.evidence_tiles import SIDE
from slam.measurements import BoolArray, Float32Array, LaserScan

# Deviation from the right angle at which a pane still returns a beam.
_LOBE_RAD = np.radians(8.0)
# Shorter objects are persons, or cabinets that were moved.
SHORTEST_M = 0.4


def head_on(scan: LaserScan, noise: RangeNoise, cell_m: float) -> LaserScan:
    """Keep the beams that hit a flat object at a right angle; the others become invalid.

    Parameters
    ----------
    noise
        Of a range: neighbours within twice its standard deviation of a line are flat.
    cell_m
        Side of a cell; if the noise is as large, no beam is kept.
    """
    half = max(2, round(0.5 * _LOBE_RAD / abs(scan.step_rad)))
    limits = np.tan(_LOBE_RAD), 2.0 * noise.floor_m, 2.0 * noise.share, cell_m
    # Removed readings count as flat as they were.
    ranges_m = np.abs(np.asarray(scan.ranges_m, dtype=np.float32))
    is_kept = np.zeros(ranges_m.size, np.bool_)
    _flat(ranges_m, half, abs(float(scan.step_rad)), limits, is_kept)
    return replace(scan, ranges_m=np.where(is_kept, scan.ranges_m, np.float32(np.nan)))


@kernel
def _flat(
    ranges_m: Float32Array,
    half: int,
    step_rad: float,
    limits: tuple[float, float, float, float],
    is_flat: BoolArray,
) -> None:
    """Mark (N,) beams whose window fits a line across them, by its slope and residuals."""
    turns = step_rad**2 * half * (half + 1) * (2 * half + 1) / 3
    for middle in range(half, ranges_m.size - half):
        total = squares = moment = 0.0
        for beam in range(-half, half + 1):
            # Invalid and infinite ranges propagate, and all comparisons are then false.
            reading = np.float64(ranges_m[middle + beam])
            total += reading
            squares += reading * reading
            moment += reading * beam * step_rad
        count = 2 * half + 1
        mean, slope = total / count, moment / turns
        residual = (squares - total * mean - slope * moment) / count
        spread = limits[1] + limits[2] * mean
        if abs(slope) < limits[0] * mean and residual < spread**2 and spread <= limits[3]:
            for beam in range(-half, half + 1):
                is_flat[middle + beam] = True


def straight_runs(cells: BoolArray, resolution_m: float) -> BoolArray:
    """Return the (rows, cols) cells in a straight row at least as long as the smallest pane."""
    length = max(3, round(SHORTEST_M / resolution_m))
    (rows, cols), room = cells.shape, np.pad(cells, length)

    def seen(grid: BoolArray, down: int, right: int) -> BoolArray:
        return grid[length + down : length + down + rows, length + right : length + right + cols]

    runs, wide, complete = np.zeros_like(cells), np.zeros_like(room), np.zeros_like(room)
    for angle in np.pi / length * np.arange(length):
        at = np.linspace(-0.5, 0.5, 4 * length) * (length - 1)
        offsets = np.rint(np.column_stack([np.sin(angle) * at, np.cos(angle) * at])).astype(int)
        row = set(map(tuple, offsets.tolist()))
        # Cells of a slanted row may be beside the line.
        down, right = (1, 0) if abs(np.cos(angle)) > abs(np.sin(angle)) else (0, 1)
        seen(wide, 0, 0)[:] = cells | seen(room, down, right) | seen(room, -down, -right)
        seen(complete, 0, 0)[:] = np.all([seen(wide, *cell) for cell in row], axis=0)
        runs |= np.any([seen(complete, -down, -right) for down, right in row], axis=0)
    return runs & cells


def in_straight_runs(cells: NDArray[np.intp], shape: tuple[int, int], resolution_m: float) -> BoolArray:
    """Return (C,) which cells of a grid, by ascending index, are among its `straight_runs`.

    Works in bands of rows with enough margin: a large grid is never in memory as a whole.
    """
    margin = max(3, round(SHORTEST_M / resolution_m)) + 2
    rows, cols = np.divmod(cells, shape[1])
    in_run = np.zeros(len(cells), np.bool_)
    for first in range(0, shape[0], SIDE):
        inside = slice(*np.searchsorted(rows, [first, first + SIDE]))
        around = slice(*np.searchsorted(rows, [first - margin, first + SIDE + margin]))
        if inside.start < inside.stop:
            row, col = rows[around].min(), cols[around].min()
            band = np.zeros((np.ptp(rows[around]) + 1, np.ptp(cols[around]) + 1), np.bool_)
            band[rows[around] - row, cols[around] - col] = True
            in_run[inside] = straight_runs(band, resolution_m)[rows[inside] - row, cols[inside] - col]
    return in_run
