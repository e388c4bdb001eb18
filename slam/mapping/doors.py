"""Detect doors: openings that beams pass, from a wall face to that of the next room, without any hit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.mapping.floor_plan import Door, Room
from slam.mapping.occupancy_grid import FREE, OccupancyGrid, looked_up
from slam.mapping.wall_gaps import THICKEST_WALL_M
from slam.mapping.wall_segments import SAME_DIRECTION_RAD, WallPoints
from slam.measurements import BoolArray, FloatArray


def find_doors(
    rooms: Sequence[Room], grid: OccupancyGrid, points: WallPoints, path_map: FloatArray
) -> list[Door]:
    """Find openings between neighbouring rooms that are at least as wide as a wall may be thick.

    Parameters
    ----------
    grid
        Free cells.
    points
        Points on straight objects: an opening that contains some, and was not driven through, is glass.
    path_map
        (N, 2) positions of the robot.
    """
    free = grid.states() == FREE
    doors: list[Door] = []
    for index, room in enumerate(rooms):
        for other in rooms[index + 1 :]:
            for shape in room.walls:
                for wall in other.walls:
                    line = _between((shape.begin_m, shape.end_m), (wall.begin_m, wall.end_m))
                    if line is None:
                        continue
                    for begin, end in _open(*line, free, grid):
                        driven = crossed(begin, end, path_map)
                        if driven or not _met(begin, end, points):
                            doors.append(Door(begin, end, (room.number, other.number), driven))
    return doors


def _between(
    one: tuple[FloatArray, FloatArray], other: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Return the ends of the overlap of two walls, halfway between, and the vector to the first."""
    if min(np.hypot(*(one[1] - one[0])), np.hypot(*(other[1] - other[0]))) < THICKEST_WALL_M:
        return None
    along = (one[1] - one[0]) / np.hypot(*(one[1] - one[0]))
    back = (other[1] - other[0]) / np.hypot(*(other[1] - other[0]))
    normal = np.array([-along[1], along[0]])
    if along @ back > -np.cos(SAME_DIRECTION_RAD):
        return None
    reach = np.sort((np.array(other) - one[0]) @ along)
    low, high = max(float(reach[0]), 0.0), min(float(reach[1]), float((one[1] - one[0]) @ along))
    if high - low < THICKEST_WALL_M:
        return None
    # Distance to the other wall at both ends of the overlap.
    slope = float(back @ normal) / float(back @ along)
    behind = np.array(
        [(other[0] - one[0]) @ normal + slope * (at - (other[0] - one[0]) @ along) for at in (low, high)]
    )
    if not (np.abs(behind) < THICKEST_WALL_M).all():
        return None
    begin, end = (
        one[0] + at * along + 0.5 * offset * normal for at, offset in zip((low, high), behind, strict=True)
    )
    return begin, end, 0.5 * abs(float(behind.mean())) * normal


def _open(
    begin_m: FloatArray, end_m: FloatArray, half_m: FloatArray, free: BoolArray, grid: OccupancyGrid
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the stretches of a line that are free from a cell before it to a cell behind it."""
    cell_m = grid.resolution_m
    length = float(np.hypot(*(end_m - begin_m)))
    shares = np.linspace(0.0, 1.0, max(2, int(2.0 * length / cell_m)))
    deep = float(np.hypot(*half_m)) + cell_m
    normal = np.array([-(end_m - begin_m)[1], (end_m - begin_m)[0]]) / length
    steps = np.linspace(-deep, deep, 3 + int(4 * deep / cell_m))
    middles = begin_m + shares[:, None] * (end_m - begin_m)
    across = middles[:, None, :] + steps[:, None] * normal
    is_free = looked_up(free, grid.cells_of(across.reshape(-1, 2))).reshape(len(shares), -1).all(axis=1)
    # A single cell that is not free is noise if its neighbours are free.
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_free, [False]]).astype(np.int8)))
    runs: list[list[int]] = []
    for low, high in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if runs and low - runs[-1][1] <= 4:
            runs[-1][1] = high
        else:
            runs.append([low, high])
    # The sides of the door are in the cells that are not free.
    side = (end_m - begin_m) / length * cell_m
    return [
        (middles[low] - side, middles[high - 1] + side)
        for low, high in runs
        if np.hypot(*(middles[high - 1] - middles[low])) > THICKEST_WALL_M
    ]


def _met(begin_m: FloatArray, end_m: FloatArray, points: WallPoints) -> bool:
    """Return whether beams hit something flat in an opening, apart from its sides."""
    length = float(np.hypot(*(end_m - begin_m)))
    along = (end_m - begin_m) / length
    normal = np.array([-along[1], along[0]])
    offsets = points.points_map - begin_m
    inside = np.abs(offsets @ along / length - 0.5) < 1 / 3
    on_line = (np.abs(offsets @ normal) < THICKEST_WALL_M / 4) & (
        np.abs(points.normals_map @ normal) > np.cos(SAME_DIRECTION_RAD)
    )
    return bool((inside & on_line).any())


def crossed(begin_m: FloatArray, end_m: FloatArray, path_map: FloatArray) -> bool:
    """Return whether a path crosses a line."""
    step = np.diff(path_map, axis=0)
    line, to = end_m - begin_m, begin_m - path_map[:-1]
    cross = step[:, 0] * line[1] - step[:, 1] * line[0]
    with np.errstate(divide="ignore", invalid="ignore"):
        on_way = (to[:, 0] * line[1] - to[:, 1] * line[0]) / cross
        on_line = (to[:, 0] * step[:, 1] - to[:, 1] * step[:, 0]) / cross
    return bool(((on_way >= 0.0) & (on_way <= 1.0) & (on_line >= 0.0) & (on_line <= 1.0)).any())
