"""A local map of surfels: per cell and facing side, the mean point and normal of a surface.

Both sides of a thin wall fall into one cell; they are kept apart by the side that they face, so that a
robot in one room is never pulled to the far face of its walls.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import NONE, ZERO, kernel
from slam.measurements import AnyFloatArray, FloatArray

_SIDES = 4


class SurfelMap(NamedTuple):
    """Surfels with a dense index grid.

    Attributes
    ----------
    cells
        (rows, 4 columns) number of the surfel of each cell, side after side, -1 for none.
    surfels
        (K, 4) x, y, normal x, normal y in the map's frame.
    origin_x, origin_y
        Lower-left corner of cell (0, 0), metres.
    cell_m
        Edge of a cell.
    """

    cells: NDArray[np.int32]
    surfels: FloatArray
    origin_x: float
    origin_y: float
    cell_m: float


def build_surfel_map(points: AnyFloatArray, normals: AnyFloatArray, cell_m: float) -> SurfelMap:
    """Average oriented points per cell and side.

    Parameters
    ----------
    points, normals
        (M, 2) each, in the map's frame; unit normals that face the sensor. M may be 0.
    cell_m
        Edge of a cell, metres.
    """
    if points.shape[0] == 0:
        return SurfelMap(np.full((1, _SIDES), -1, np.int32), np.zeros((0, 4)), 0.0, 0.0, cell_m)
    low_x, low_y = (float(points[:, k].min()) for k in (0, 1))
    high_x, high_y = (float(points[:, k].max()) for k in (0, 1))
    origin_x, origin_y = low_x - 2.0 * cell_m, low_y - 2.0 * cell_m
    rows, columns = (int((high - low) / cell_m) + 3 for low, high in ((origin_y, high_y), (origin_x, high_x)))
    cells = np.full((rows, columns * _SIDES), -1, np.int32)
    sums = np.zeros((points.shape[0], 5))
    count = _build(points, normals, origin_x, origin_y, cell_m, cells, sums)
    return SurfelMap(cells, np.ascontiguousarray(sums[:count, :4]), origin_x, origin_y, cell_m)


@kernel
def _build(points, normals, origin_x, origin_y, cell_m, cells, sums):  # type: ignore[no-untyped-def]
    """Number the cells' sides that have points, and average those points; how many there are."""
    count = ZERO
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        nx = normals[i, 0]
        ny = normals[i, 1]
        row = math.floor((y - origin_y) / cell_m)
        # The entry of the quarter of the compass that the normal faces.
        entry = _SIDES * math.floor((x - origin_x) / cell_m)
        if abs(nx) < abs(ny):
            entry += 1 if ny > 0.0 else 3
        elif nx <= 0.0:
            entry += 2
        k = cells[row, entry]
        if k < 0:
            k = count
            cells[row, entry] = k
            count += 1
        sums[k, 0] += x
        sums[k, 1] += y
        sums[k, 2] += nx
        sums[k, 3] += ny
        sums[k, 4] += 1.0
    for k in range(count):
        length = math.hypot(sums[k, 2], sums[k, 3])
        sums[k, 0] = sums[k, 0] / sums[k, 4]
        sums[k, 1] = sums[k, 1] / sums[k, 4]
        sums[k, 2] = sums[k, 2] / length
        sums[k, 3] = sums[k, 3] / length
    return count


@kernel(inline="always")
def nearest_surfel(cells, surfels, origin_x, origin_y, cell_m, x, y, nx, ny):  # type: ignore[no-untyped-def]
    """Number of the nearest surfel in the 3 x 3 cells around a point that faces the same way, or -1.

    The first five are a `SurfelMap`; taken apart, they compile faster.
    """
    row = math.floor((y - origin_y) / cell_m)
    first = _SIDES * (math.floor((x - origin_x) / cell_m) - 1)
    best = NONE
    best_squared = (1.5 * cell_m) * (1.5 * cell_m)
    for r in range(max(row - 1, 0), min(row + 2, cells.shape[0])):
        for entry in range(max(first, 0), min(first + 3 * _SIDES, cells.shape[1])):
            k = cells[r, entry]
            # 0.6: normals within 53 degrees of each other.
            if k >= 0 and surfels[k, 2] * nx + surfels[k, 3] * ny >= 0.6:
                dx = surfels[k, 0] - x
                dy = surfels[k, 1] - y
                squared = dx * dx + dy * dy
                if squared < best_squared:
                    best_squared = squared
                    best = k
    return best
