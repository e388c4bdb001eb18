"""Check the beams of a scan against a pose in a known map: explained, contradicted or neutral."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.localization.beams import FREE, NEAR, UNKNOWN, WALL, follow
from slam.mapping.occupancy_grid import OCCUPIED, OccupancyGrid, looked_up
from slam.matching.local_map import OrientedPoints
from slam.matching.planar import between, transform_points
from slam.matching.surfel_map import SurfelMap, nearest_surfel
from slam.measurements import AnyFloatArray, BoolArray, FloatArray, row_from_pose2

# Probability below which a cell is certainly free: about five beams passed it, not one or two through a door.
_SURELY_FREE = 0.12
# A wall does not explain a return farther away than this.
_WALL_REACH_M = 0.1
# A point this far from every wall is not on a wall by a small pose error.
_CLEAR_M = 0.2
# The last part of a beam may be in its wall, at a small angle and with a small error.
END_M = 0.4


class KnownSpace(NamedTuple):
    """Walls, their surroundings, free and unknown space as a grid of cells.

    Attributes
    ----------
    cells
        (columns, rows, 1), see `slam.localization.beams`.
    clear
        (columns, rows) whether a cell is free, and far from any wall.
    frame
        (3,) x, y, yaw of the lower-left corner of cell (0, 0) in the map.
    """

    cells: NDArray[np.uint8]
    clear: BoolArray
    frame: FloatArray
    cell_m: float


class BeamCounts(NamedTuple):
    """Number of beams of a scan in each class; beams that end in unknown space are in none.

    Attributes
    ----------
    explained
        Beams that end on a known wall that faces the same way.
    crossing
        Beams that pass through a known wall.
    in_free
        Beams that end in known free space: a new object, or a wrong pose.
    """

    explained: int
    crossing: int
    in_free: int


def known_space(grid: OccupancyGrid) -> KnownSpace:
    """Prepare a grid for `check_beams`."""
    walls = grid.states() == OCCUPIED
    # A wall that long beams grazed without a hit is where free space ends.
    brushed = np.pad(grid.probabilities() >= _SURELY_FREE, 1, constant_values=True)
    free = ~_within(brushed, _WALL_REACH_M / grid.resolution_m)[1:-1, 1:-1]
    cells = np.where(free, np.uint8(FREE), np.uint8(UNKNOWN))
    cells[_within(walls, _WALL_REACH_M / grid.resolution_m)] = NEAR
    cells[walls] = WALL
    clear = (cells == FREE) & ~_within(walls, _CLEAR_M / grid.resolution_m)
    cells, clear = cells.T, np.ascontiguousarray(clear.T)
    # Contiguous: beams are traced through it in memory order, and a large map is not copied again.
    cells = np.ascontiguousarray(cells[:, :, None])
    return KnownSpace(cells, clear, row_from_pose2(grid.T_map_grid), grid.resolution_m)


def _within(cells: BoolArray, reach_cells: float) -> BoolArray:
    """Return which cells are near the centre of one of these; for a reach of a few cells only."""
    reach = int(reach_cells)
    wide, dilated = np.pad(cells, reach), cells.copy()
    for row, column in np.ndindex(2 * reach + 1, 2 * reach + 1):
        if math.hypot(row - reach, column - reach) <= reach_cells:
            dilated |= wide[row : row + cells.shape[0], column : column + cells.shape[1]]
    return dilated


def in_clear_space(space: KnownSpace, pose: FloatArray, points: AnyFloatArray) -> BoolArray:
    """Return which points (M, 2) of the base frame are in free space of the map, far from walls.

    Parameters
    ----------
    pose
        (3,) x, y, yaw of the base in the map, accurate to some decimetres.
    """
    cells = np.floor(transform_points(points, between(space.frame, pose)) / space.cell_m).astype(np.int64)
    return looked_up(space.clear, cells)


def check_beams(
    space: KnownSpace, surfels: SurfelMap, pose: FloatArray, laser: FloatArray, points: OrientedPoints
) -> BeamCounts:
    """Trace every beam through the known space.

    Parameters
    ----------
    surfels
        Walls of the map around the pose.
    pose
        (3,) x, y, yaw of the base in the map.
    laser
        (2,) origin of the beams, base frame.
    points
        End points of the beams, base frame.
    """
    explained = np.zeros(len(points), np.bool_)
    _explain(*surfels, pose, points.points, points.normals, explained)
    rest = np.vstack([laser, points.points[~explained]])
    in_picture = transform_points(rest, between(space.frame, pose)) / space.cell_m
    lifted = np.column_stack([in_picture, np.full(len(rest), 0.5)])
    first_hits = follow(space.cells, lifted[0], lifted[1:], END_M / space.cell_m)
    against = np.bincount(first_hits, minlength=WALL + 1)
    return BeamCounts(int(explained.sum()), int(against[WALL]), int(against[FREE]))


@kernel
def _explain(cells, after, surfels, origin_x, origin_y, cell_m, pose, points, normals, explained):  # type: ignore[no-untyped-def]
    """Mark which points are on a surfel that faces the same way."""
    cos = math.cos(pose[2])
    sin = math.sin(pose[2])
    for i in range(points.shape[0]):
        x = cos * points[i, 0] - sin * points[i, 1] + pose[0]
        y = sin * points[i, 0] + cos * points[i, 1] + pose[1]
        nx = cos * normals[i, 0] - sin * normals[i, 1]
        ny = sin * normals[i, 0] + cos * normals[i, 1]
        k = nearest_surfel(cells, after, surfels, origin_x, origin_y, cell_m, x, y, nx, ny)
        if k >= 0:
            distance = surfels[k, 2] * (x - surfels[k, 0]) + surfels[k, 3] * (y - surfels[k, 1])
            explained[i] = abs(distance) < _WALL_REACH_M
