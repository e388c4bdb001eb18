"""Local map of surfels: per cell and facing side, the mean point and normal of a surface.

Both sides of a thin wall fall into one cell. They are kept separate by the side they face, so that a robot in
one room is never pulled to the other face of its walls.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import NONE, ZERO, kernel
from slam.measurements import AnyFloatArray, FloatArray


class SurfelMap(NamedTuple):
    """Surfels with a dense index grid.

    Attributes
    ----------
    cells
        (rows, columns) number of the first surfel of each cell, -1 for none.
    after
        (K,) number of the next surfel of the same cell, which faces another side; -1 for none.
    surfels
        (K, 6) x, y, normal x, normal y in the map's frame, number of points, side.
    origin_x, origin_y
        Lower-left corner of cell (0, 0), metres.
    """

    cells: NDArray[np.int32]
    after: NDArray[np.int32]
    surfels: FloatArray
    origin_x: float
    origin_y: float
    cell_m: float


def build_surfel_maps(
    points: AnyFloatArray, normals: AnyFloatArray, cells_m: Sequence[float]
) -> list[SurfelMap]:
    """Average oriented points per cell and side, for edges of cells in metres, the finest first.

    Points (M, 2) and their unit normals (M, 2), which face the sensor, are in the map's frame; M may be 0.
    Coarser cells gather the finest one's surfels: where an edge is a whole multiple of the finest, the finest
    cells lie within those, and each point counts in the cell that it is in.
    """
    corners, maps, oriented = np.zeros(4), list[SurfelMap](), np.empty((len(points), 5))
    _bound(points, normals, oriented, corners)
    low_x, low_y, high_x, high_y = corners.tolist()
    for cell_m in cells_m:
        origin_x, origin_y = low_x - 2.0 * cell_m, low_y - 2.0 * cell_m
        spans = (origin_y, high_y), (origin_x, high_x)
        rows, columns = (int((high - low) / cell_m) + 3 for low, high in spans)
        cells, after = np.full((rows, columns), -1, np.int32), np.empty(len(oriented), np.int32)
        sums = np.empty((len(oriented), 6))
        count = _build(oriented, origin_x, origin_y, cell_m, cells, after, sums)
        oriented = sums[:count].copy()
        maps.append(SurfelMap(cells, after[:count].copy(), oriented, origin_x, origin_y, cell_m))
    for part in maps:
        _point(part.surfels)
    return maps


@kernel
def _bound(points, normals, oriented, corners):  # type: ignore[no-untyped-def]
    """Write points (M, 2) as surfels of one (M, 5), and their least x and y and the greatest."""
    if points.shape[0] == 0:
        return
    low_x = high_x = points[0, 0]
    low_y = high_y = points[0, 1]
    for i in range(points.shape[0]):
        x = points[i, 0]
        y = points[i, 1]
        oriented[i, 0] = x
        oriented[i, 1] = y
        oriented[i, 2] = normals[i, 0]
        oriented[i, 3] = normals[i, 1]
        oriented[i, 4] = 1.0
        low_x = x if x < low_x else low_x
        low_y = y if y < low_y else low_y
        high_x = x if x > high_x else high_x
        high_y = y if y > high_y else high_y
    corners[0], corners[1], corners[2], corners[3] = low_x, low_y, high_x, high_y


@kernel
def _build(oriented, origin_x, origin_y, cell_m, cells, after, sums):  # type: ignore[no-untyped-def]
    """Number the cells' sides that have points, and average those points; how many there are."""
    count = ZERO
    for i in range(oriented.shape[0]):
        x = oriented[i, 0]
        y = oriented[i, 1]
        nx = oriented[i, 2]
        ny = oriented[i, 3]
        row = math.floor((y - origin_y) / cell_m)
        column = math.floor((x - origin_x) / cell_m)
        # The quarter of the compass that the normal faces.
        side = 0
        if abs(nx) < abs(ny):
            side = 1 if ny > 0.0 else 3
        elif nx <= 0.0:
            side = 2
        k = cells[row, column]
        while k >= 0 and sums[k, 5] != side:
            k = after[k]
        if k < 0:
            k = count
            after[k] = cells[row, column]
            cells[row, column] = k
            sums[k, 0] = sums[k, 1] = sums[k, 2] = sums[k, 3] = sums[k, 4] = 0.0
            sums[k, 5] = side
            count += 1
        weight = oriented[i, 4]
        sums[k, 0] += weight * x
        sums[k, 1] += weight * y
        sums[k, 2] += weight * nx
        sums[k, 3] += weight * ny
        sums[k, 4] += weight
    for k in range(count):
        for column in range(4):
            sums[k, column] /= sums[k, 4]
    return count


@kernel
def _point(surfels):  # type: ignore[no-untyped-def]
    """Make the mean normals as long as one."""
    for k in range(surfels.shape[0]):
        length = math.hypot(surfels[k, 2], surfels[k, 3])
        surfels[k, 2] /= length
        surfels[k, 3] /= length


@kernel(inline="always")
def nearest_surfel(cells, after, surfels, origin_x, origin_y, cell_m, x, y, nx, ny):  # type: ignore[no-untyped-def]
    """Number of the nearest surfel in the 3 x 3 cells around a point that faces the same way, or -1.

    The first six are a `SurfelMap`; taken apart, they compile faster.
    """
    row = math.floor((y - origin_y) / cell_m)
    column = math.floor((x - origin_x) / cell_m)
    best = NONE
    best_squared = (1.5 * cell_m) * (1.5 * cell_m)
    for r in range(max(row - 1, 0), min(row + 2, cells.shape[0])):
        for c in range(max(column - 1, 0), min(column + 2, cells.shape[1])):
            k = cells[np.uint64(r), np.uint64(c)]
            while k >= 0:
                # 0.6: normals within 53 degrees of each other.
                # Without a sign it cannot count from the end.
                at = np.uint64(k)
                if surfels[at, 2] * nx + surfels[at, 3] * ny >= 0.6:
                    dx = surfels[at, 0] - x
                    dy = surfels[at, 1] - y
                    squared = dx * dx + dy * dy
                    if squared < best_squared:
                        best_squared = squared
                        best = k
                k = after[at]
    return best
