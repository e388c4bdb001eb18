"""Ways over a finished map: inflation by the robot's radius, connected free space, the shortest path."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from typing import TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from fusion.kernel import kernel
from slam.errors import ScanweaveError
from slam.mapping.occupancy_grid import FREE, OCCUPIED, StateArray
from slam.measurements import BoolArray, FloatArray

Labels: TypeAlias = NDArray[np.int32]
Cell: TypeAlias = tuple[int, int]

_EDGES = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]])


@dataclass(frozen=True, slots=True)
class FreeSpace:
    """Where the robot's centre may be.

    Attributes
    ----------
    allowed
        (rows, cols), row 0 at the lowest y.
    region
        (rows, cols) number of the connected part of each allowed cell, 0 elsewhere.
    resolution_m
        Side of a cell.
    T_map_grid
        The lower-left corner of cell (0, 0).
    """

    allowed: BoolArray
    region: Labels
    resolution_m: float
    T_map_grid: gtsam.Pose2

    def cell_of(self, xy: tuple[float, float]) -> Cell:
        """Row and column of a point of the map; it may lie outside."""
        point = self.T_map_grid.transformTo(np.array(xy, dtype=np.float64))
        return math.floor(point[1] / self.resolution_m), math.floor(point[0] / self.resolution_m)

    def middle_of(self, cells: NDArray[np.int64]) -> FloatArray:
        """(N, 2) x, y in the map of the middles of (N, 2) rows and columns."""
        points = (cells[:, ::-1] + 0.5) * self.resolution_m
        moved: FloatArray = points @ self.T_map_grid.rotation().matrix().T + self.T_map_grid.translation()
        return moved


@dataclass(frozen=True, slots=True)
class Path:
    """A way for the robot's centre.

    Attributes
    ----------
    points_map
        (N, 2) x, y from the start's cell to the goal's, cell by cell.
    length_m
        Along it.
    clearance_m
        Least distance from the path to an obstacle's cell.
    """

    points_map: FloatArray
    length_m: float
    clearance_m: float


def clearance_m(states: StateArray, resolution_m: float) -> FloatArray:
    """(rows, cols) distance from each cell's middle to the nearest edge of an occupied cell.

    Cells are squares: half a cell less than from middle to middle. Where nothing is occupied, infinity.
    """
    occupied = states == OCCUPIED
    if not occupied.any():
        return np.full(states.shape, np.inf)
    distance = np.asarray(ndimage.distance_transform_edt(~occupied), dtype=np.float64)
    return np.maximum(distance - 0.5, 0.0) * resolution_m


def inflate(states: StateArray, resolution_m: float, radius_m: float) -> StateArray:
    """The map for a robot that is a point: cells nearer than its radius to an obstacle become occupied.

    Unknown cells stay unknown, where no obstacle is near.
    """
    inflated = states.copy()
    inflated[clearance_m(states, resolution_m) < radius_m] = OCCUPIED
    return inflated


def free_space(
    states: StateArray, resolution_m: float, T_map_grid: gtsam.Pose2, radius_m: float
) -> FreeSpace:
    """Known free cells with room for the robot, connected over their edges (Yang2021: 4-neighbourhood).

    Raises
    ------
    ScanweaveError
        Where the radius is negative or not a number.
    """
    if not 0.0 <= radius_m < math.inf:
        raise ScanweaveError(f"robot radius is {radius_m:g} m; it must be 0 or more")
    allowed = inflate(states, resolution_m, radius_m) == FREE
    region, _ = ndimage.label(allowed, structure=_EDGES)
    return FreeSpace(np.asarray(allowed), np.asarray(region, dtype=np.int32), resolution_m, T_map_grid)


def shortest_path(
    space: FreeSpace, start_xy: tuple[float, float], goal_xy: tuple[float, float], clearance: FloatArray
) -> Path | None:
    """The shortest way over cells, also diagonally where both neighbours are free; None where there is none.

    Parameters
    ----------
    start_xy, goal_xy
        Metres, map frame.
    clearance
        From `clearance_m`; only told of the path, not planned by.

    Raises
    ------
    ScanweaveError
        Where an end lies outside the map, or the robot has no room there.
    """
    start, goal = _free_cell(space, start_xy, "start"), _free_cell(space, goal_xy, "goal")
    if space.region[start] != space.region[goal]:
        return None
    cells = _search(space.allowed, start[0], start[1], goal[0], goal[1])
    points = space.middle_of(cells)
    length_m = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    return Path(points, length_m, float(clearance[cells[:, 0], cells[:, 1]].min()))


def _free_cell(space: FreeSpace, xy: tuple[float, float], what: str) -> Cell:
    """The cell of an end, in which the robot must have room."""
    row, col = space.cell_of(xy)
    rows, cols = space.allowed.shape
    if not (0 <= row < rows and 0 <= col < cols):
        raise ScanweaveError(f"{what} {xy[0]:g},{xy[1]:g} lies outside the map of {rows} x {cols} cells")
    if not space.allowed[row, col]:
        raise ScanweaveError(
            f"{what} {xy[0]:g},{xy[1]:g} is occupied, unknown or too near to an obstacle; "
            "choose another point or a smaller --radius"
        )
    return row, col


@kernel
def _search(
    allowed: BoolArray, start_row: int, start_col: int, goal_row: int, goal_col: int
) -> NDArray[np.int64]:
    """A* from start to goal, (N, 2) rows and columns; (0, 2) where no way leads."""
    rows, cols = allowed.shape
    start, goal = start_row * cols + start_col, goal_row * cols + goal_col
    cost = np.full(rows * cols, np.inf, np.float32)
    before = np.full(rows * cols, -1, np.int32)
    done = np.zeros(rows * cols, np.bool_)
    cost[start] = 0.0
    queue = [(0.0, start)]
    while len(queue) > 0:
        _, cell = heapq.heappop(queue)
        if done[cell]:
            continue
        done[cell] = True
        if cell == goal:
            break
        row, col = cell // cols, cell % cols
        for down in range(-1, 2):
            for right in range(-1, 2):
                r, c = row + down, col + right
                if (down == 0 and right == 0) or r < 0 or c < 0 or r >= rows or c >= cols:
                    continue
                # No step over a corner: the robot would cut it, and the cells hang together by edges only.
                if not (allowed[r, c] and allowed[row, c] and allowed[r, col]):
                    continue
                found = cost[cell] + (math.sqrt(2.0) if down != 0 and right != 0 else 1.0)
                at = r * cols + c
                if found < cost[at]:
                    cost[at], before[at] = found, cell
                    far, near = abs(r - goal_row), abs(c - goal_col)
                    ahead = max(far, near) + (math.sqrt(2.0) - 1.0) * min(far, near)
                    heapq.heappush(queue, (found + ahead, at))
    return _chain(before, start, goal, cols)


@kernel
def _chain(before: Labels, start: int, goal: int, cols: int) -> NDArray[np.int64]:
    """The cells from start to goal."""
    count, cell = 1, goal
    while cell != start and cell >= 0:
        cell = before[cell]
        count += 1
    cells = np.empty((count if cell == start else 0, 2), np.int64)
    if cell == start:
        cell = goal
        for place in range(count - 1, -1, -1):
            cells[place, 0], cells[place, 1] = cell // cols, cell % cols
            cell = before[cell]
    return cells
