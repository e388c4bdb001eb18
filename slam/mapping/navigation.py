"""Ways over a finished map: inflation by the robot's radius, connected free space, the shortest path."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse import csgraph

from slam.errors import ScanweaveError
from slam.mapping.occupancy_grid import FREE, OCCUPIED, StateArray
from slam.measurements import BoolArray, FloatArray

Labels: TypeAlias = NDArray[np.int32]
CellNumbers: TypeAlias = NDArray[np.int64]
Cell: TypeAlias = tuple[int, int]

_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))  # the other four are these, walked backward


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
    region, _ = ndimage.label(allowed)
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
    here = space.region == space.region[start]
    nodes = np.where(here, np.cumsum(here).reshape(here.shape) - 1, -1)
    ends = int(nodes[start]), int(nodes[goal])
    graph = step_graph(nodes, np.ones(nodes.shape))
    before = csgraph.dijkstra(graph, indices=[ends[0]], return_predecessors=True)[1]
    nodes_on_path = chain(before[0], *ends)
    assert nodes_on_path is not None  # of one region
    cells = np.argwhere(here)[nodes_on_path]
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


def step_graph(nodes: CellNumbers, price: FloatArray, *, over_corners: bool = False) -> sparse.csr_array:
    """Costs of the steps between neighbouring cells, symmetric, (nodes, nodes).

    Parameters
    ----------
    nodes
        (rows, cols) number of each cell where the robot's centre may be, -1 elsewhere.
    price
        (rows, cols) cost of crossing a cell, edge to edge.
    over_corners
        Whether a diagonal step may have a cell beside it where the centre may not be.
    """
    rows, columns = nodes.shape
    starts, ends, costs = [], [], []
    for down, right in _NEIGHBOURS:
        left, shift = max(0, -right), max(0, right)
        here = (slice(0, rows - down), slice(left, columns - shift))
        there = (slice(down, rows), slice(left + right, columns - shift + right))
        free = (nodes[here] >= 0) & (nodes[there] >= 0)
        if not over_corners:
            free &= (nodes[here[0], there[1]] >= 0) & (nodes[there[0], here[1]] >= 0)
        starts.append(nodes[here][free])
        ends.append(nodes[there][free])
        costs.append(0.5 * math.hypot(down, right) * (price[here] + price[there])[free])
    count = int(nodes.max(initial=-1)) + 1
    start, end, cost = np.concatenate(starts), np.concatenate(ends), np.concatenate(costs)
    both_ways = (np.concatenate([start, end]), np.concatenate([end, start]))
    return sparse.csr_array((np.concatenate([cost, cost]), both_ways), shape=(count, count))


def chain(before: NDArray[np.integer], start: int, end: int) -> CellNumbers | None:
    """The nodes from start to end by `csgraph`'s predecessors (nodes,); None where no way leads."""
    found = [end]
    while found[-1] != start:
        previous = int(before[found[-1]])
        if previous < 0:
            return None
        found.append(previous)
    return np.array(found[::-1], dtype=np.int64)
