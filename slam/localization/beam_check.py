"""What the beams of a scan say about a pose in a known map: explained, contradicted, or silent."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.mapping.occupancy_grid import OCCUPIED, OccupancyGrid
from slam.matching.local_map import OrientedPoints
from slam.matching.planar import between, transform_points
from slam.matching.surfel_map import SurfelMap, nearest_surfel
from slam.measurements import AnyFloatArray, BoolArray, FloatArray, row_from_pose2

_UNKNOWN, _FREE, _NEAR_WALL, _WALL = 0, 1, 2, 3
# What a beam counts as, after those that are explained.
_CROSSING, _IN_FREE, _SILENT = (np.int64(n) for n in (1, 2, 3))
# Probability below which a cell is surely free: some five beams passed it, not the one or two that a door let
# through.
_SURELY_FREE = 0.12
# Farther than this from a wall a return is not explained by it.
_WALL_REACH_M = 0.1
# Of a point so far from every wall no small error of the pose makes a wall's.
_CLEAR_M = 0.2
# The last stretch of a beam may lie in the wall it ends in, at a small angle and with a little error.
_END_M = 0.4
_STEP_CELLS = 0.7


class KnownSpace(NamedTuple):
    """Walls, their surroundings, free and unknown space as a picture.

    Attributes
    ----------
    cells
        (rows, columns) 0 unknown, 1 free, 2 within reach of a wall, 3 wall.
    clear
        (rows, columns) whether a cell is free, and no wall is anywhere near it.
    frame
        (3,) x, y, yaw of the lower-left corner of cell (0, 0) in the map.
    cell_m
        Side of a cell.
    """

    cells: NDArray[np.uint8]
    clear: BoolArray
    frame: FloatArray
    cell_m: float


class BeamCounts(NamedTuple):
    """How many beams of a scan are what.

    Attributes
    ----------
    explained
        End on a known wall that faces the same way.
    crossing
        Pass through a known wall.
    in_free
        End in known free space: something that was not there when the map was made, or a wrong pose.
    silent
        End where the map knows nothing, or within reach of a wall that is not the one that they saw.
    """

    explained: int
    crossing: int
    in_free: int
    silent: int


def known_space(grid: OccupancyGrid) -> KnownSpace:
    """Prepare a grid for `check_beams`."""
    states = grid.states()
    cells = np.full(states.shape, _UNKNOWN, np.uint8)
    cells[grid.probabilities() < _SURELY_FREE] = _FREE
    walls = states == OCCUPIED
    cells[_surroundings(walls, _WALL_REACH_M / grid.resolution_m)] = _NEAR_WALL
    cells[walls] = _WALL
    clear = (cells == _FREE) & ~_surroundings(walls, _CLEAR_M / grid.resolution_m)
    return KnownSpace(cells, clear, row_from_pose2(grid.T_map_grid), grid.resolution_m)


def in_clear_space(space: KnownSpace, pose: FloatArray, points: AnyFloatArray) -> BoolArray:
    """Which points (M, 2) of the base frame lie where there was nothing when the map was made, by far.

    Parameters
    ----------
    pose
        (3,) x, y, yaw of the base in the map, good to some decimetres.
    """
    cells = np.floor(transform_points(points, between(space.frame, pose)) / space.cell_m).astype(np.int64)
    columns, rows = cells.T
    inside = (rows >= 0) & (rows < space.clear.shape[0]) & (columns >= 0) & (columns < space.clear.shape[1])
    found = np.zeros(len(points), np.bool_)
    found[inside] = space.clear[rows[inside], columns[inside]]
    return found


def check_beams(
    space: KnownSpace, surfels: SurfelMap, pose: FloatArray, laser: FloatArray, points: OrientedPoints
) -> BeamCounts:
    """Follow every beam through the known space.

    Parameters
    ----------
    space
        The map.
    surfels
        Its walls around the pose.
    pose
        (3,) x, y, yaw of the base in the map.
    laser
        (2,) where the beams begin, base frame.
    points
        Where they end, base frame.
    """
    in_picture = between(space.frame, pose)
    counts = np.zeros(4, np.int64)
    scan = points.points, points.normals
    _count(space.cells, 1.0 / space.cell_m, *surfels, pose, in_picture, laser, *scan, counts)
    return BeamCounts(*counts.tolist())


def _surroundings(walls: NDArray[np.bool_], reach: float) -> NDArray[np.bool_]:
    """All cells within so many cells of a wall."""
    near = walls.copy()
    whole = int(reach)
    rows, columns = walls.shape
    for dr in range(-whole, whole + 1):
        for dc in range(-whole, whole + 1):
            if 0 < math.hypot(dr, dc) <= reach:
                near[max(dr, 0) : rows + dr, max(dc, 0) : columns + dc] |= walls[
                    max(-dr, 0) : rows - dr, max(-dc, 0) : columns - dc
                ]
    return near


@kernel
def _count(  # type: ignore[no-untyped-def]
    picture,
    scale,
    cells,
    surfels,
    origin_x,
    origin_y,
    cell_m,
    pose,
    in_picture,
    laser,
    points,
    normals,
    counts,
):
    """Add to the numbers of explained, crossing, in free and silent beams."""
    cos = math.cos(in_picture[2])
    sin = math.sin(in_picture[2])
    x0 = (cos * laser[0] - sin * laser[1] + in_picture[0]) * scale
    y0 = (sin * laser[0] + cos * laser[1] + in_picture[1]) * scale
    map_cos = math.cos(pose[2])
    map_sin = math.sin(pose[2])
    for i in range(points.shape[0]):
        bx = points[i, 0]
        by = points[i, 1]
        x = map_cos * bx - map_sin * by + pose[0]
        y = map_sin * bx + map_cos * by + pose[1]
        nx = map_cos * normals[i, 0] - map_sin * normals[i, 1]
        ny = map_sin * normals[i, 0] + map_cos * normals[i, 1]
        k = nearest_surfel(cells, surfels, origin_x, origin_y, cell_m, x, y, nx, ny)
        if k >= 0:
            away = surfels[k, 2] * (x - surfels[k, 0]) + surfels[k, 3] * (y - surfels[k, 1])
            if abs(away) < _WALL_REACH_M:
                counts[0] += 1
                continue
        x1 = (cos * bx - sin * by + in_picture[0]) * scale
        y1 = (sin * bx + cos * by + in_picture[1]) * scale
        length = math.hypot(x1 - x0, y1 - y0)
        steps = max(math.floor((length - _END_M * scale) / _STEP_CELLS), 0)
        # The way there, all but its last stretch, and then where it ends; unknown beyond the picture.
        kind = _SILENT
        for n in range(steps + 1):
            x = x1
            y = y1
            if n < steps:
                share = n * _STEP_CELLS / length
                x = x0 + share * (x1 - x0)
                y = y0 + share * (y1 - y0)
            row = math.floor(y)
            column = math.floor(x)
            if 0 <= row < picture.shape[0] and 0 <= column < picture.shape[1]:
                met = picture[row, column]
                if n < steps and met == _WALL:
                    kind = _CROSSING
                    break
                if n == steps and met == _FREE:
                    kind = _IN_FREE
        counts[kind] += 1
