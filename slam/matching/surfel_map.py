"""A local map of surfels: per cell and facing side, the mean point and normal of a surface.

Both sides of a thin wall fall into one cell; they are kept apart by the side that they face, so that a
robot in one room is never pulled to the far face of its walls.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.measurements import AnyFloatArray, FloatArray

_SIDES = 4


class SurfelMap(NamedTuple):
    """Surfels with a dense index grid.

    Attributes
    ----------
    cells
        (rows, columns, 4) number of the surfel of each cell and facing side, -1 for none.
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
        return SurfelMap(np.full((1, 1, _SIDES), -1, np.int32), np.zeros((0, 4)), 0.0, 0.0, cell_m)
    index, surfels, origin_x, origin_y = _build(points, normals, cell_m)
    return SurfelMap(index, surfels, origin_x, origin_y, cell_m)


@kernel
def _side(nx: float, ny: float) -> int:
    """The quarter of the compass that a normal faces."""
    if abs(nx) >= abs(ny):
        return 0 if nx > 0.0 else 2
    return 1 if ny > 0.0 else 3


@kernel
def _build(
    points: AnyFloatArray, normals: AnyFloatArray, cell_m: float
) -> tuple[NDArray[np.int32], FloatArray, float, float]:
    min_x = max_x = points[0, 0]
    min_y = max_y = points[0, 1]
    for i in range(points.shape[0]):
        min_x = min(min_x, points[i, 0])
        max_x = max(max_x, points[i, 0])
        min_y = min(min_y, points[i, 1])
        max_y = max(max_y, points[i, 1])
    origin_x = min_x - 2.0 * cell_m
    origin_y = min_y - 2.0 * cell_m
    columns = int((max_x - origin_x) / cell_m) + 3
    rows = int((max_y - origin_y) / cell_m) + 3
    index = np.full((rows, columns, _SIDES), -1, np.int32)
    sums = np.zeros((points.shape[0], 5))
    count = 0
    for i in range(points.shape[0]):
        column = int((points[i, 0] - origin_x) / cell_m)
        row = int((points[i, 1] - origin_y) / cell_m)
        side = _side(normals[i, 0], normals[i, 1])
        k = index[row, column, side]
        if k < 0:
            k = count
            index[row, column, side] = k
            count += 1
        sums[k, 0] += points[i, 0]
        sums[k, 1] += points[i, 1]
        sums[k, 2] += normals[i, 0]
        sums[k, 3] += normals[i, 1]
        sums[k, 4] += 1.0
    surfels = np.empty((count, 4))
    for k in range(count):
        length = math.hypot(sums[k, 2], sums[k, 3])
        surfels[k, 0] = sums[k, 0] / sums[k, 4]
        surfels[k, 1] = sums[k, 1] / sums[k, 4]
        surfels[k, 2] = sums[k, 2] / length
        surfels[k, 3] = sums[k, 3] / length
    return index, surfels, origin_x, origin_y


@kernel
def nearest_surfel(surfel_map: SurfelMap, x: float, y: float, nx: float, ny: float) -> int:
    """Number of the nearest surfel in the 3 x 3 cells around a point that faces the same way, or -1."""
    index = surfel_map.cells
    surfels = surfel_map.surfels
    cell_m = surfel_map.cell_m
    column = math.floor((x - surfel_map.origin_x) / cell_m)
    row = math.floor((y - surfel_map.origin_y) / cell_m)
    best = -1
    best_squared = (1.5 * cell_m) ** 2
    for r in range(max(row - 1, 0), min(row + 2, index.shape[0])):
        for c in range(max(column - 1, 0), min(column + 2, index.shape[1])):
            for side in range(_SIDES):
                k = index[r, c, side]
                # 0.6: normals within 53 degrees of each other.
                if k < 0 or surfels[k, 2] * nx + surfels[k, 3] * ny < 0.6:
                    continue
                squared = (surfels[k, 0] - x) ** 2 + (surfels[k, 1] - y) ** 2
                if squared < best_squared:
                    best_squared = squared
                    best = k
    return best
