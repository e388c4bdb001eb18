"""Path planning on a ground truth grid: clearance, cheapest paths away from walls, and smoothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse

from slam.measurements import BoolArray, FloatArray

IntArray = NDArray[np.int64]

_FEAR = 12.0  # cost factor of a metre along a wall, relative to open space
_SMOOTHING_M = 0.15
_NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))  # the other four are the reverse of these


@dataclass(frozen=True)
class FloorMap:
    """Free floor of a round robot.

    Attributes
    ----------
    clearance_m
        (rows, cols) distance from a cell's centre to the nearest occupied cell, row 0 at the lowest y.
    resolution_m, origin_xy
        Cell edge, and the lower left corner of cell (0, 0) in the map frame.
    required_m
        Clearance below which the robot may not be.
    preferred_m
        Clearance beyond which the cost is constant.
    nodes
        (rows, cols) number of each cell where the robot may be, -1 elsewhere.
    graph
        (nodes, nodes) cost of the step between neighbouring cells.
    """

    clearance_m: FloatArray
    resolution_m: float
    origin_xy: tuple[float, float]
    required_m: float
    preferred_m: float
    nodes: IntArray
    graph: sparse.csr_array

    def cell_of(self, point_m: FloatArray) -> tuple[int, int]:
        """Return row and column of a point, clipped to the grid."""
        column, row = np.floor((np.asarray(point_m)[:2] - self.origin_xy) / self.resolution_m).astype(int)
        rows, columns = self.clearance_m.shape
        return int(np.clip(row, 0, rows - 1)), int(np.clip(column, 0, columns - 1))

    def clearance_at_m(self, points_m: FloatArray) -> FloatArray:
        """Return (N,) clearances at points (N, 2), interpolated between cells, zero outside the grid."""
        at = (np.asarray(points_m)[:, :2] - self.origin_xy) / self.resolution_m - 0.5
        clearance = ndimage.map_coordinates(self.clearance_m, [at[:, 1], at[:, 0]], order=1, cval=0.0)
        return np.asarray(clearance, dtype=np.float64)

    def node_near(self, point_m: FloatArray) -> int:
        """Return the free cell nearest to a point; -1 if none is free."""
        free = np.argwhere(self.nodes >= 0)
        if not len(free):
            return -1
        nearest = free[np.argmin(np.square(free - self.cell_of(point_m)).sum(axis=1))]
        return int(self.nodes[nearest[0], nearest[1]])

    def centres_m(self) -> FloatArray:
        """Return the centre of every node, (nodes, 2)."""
        cells = np.argwhere(self.nodes >= 0)
        return np.asarray((cells[:, ::-1] + 0.5) * self.resolution_m + self.origin_xy)


def floor_map(
    occupied: BoolArray,
    resolution_m: float,
    origin_xy: tuple[float, float],
    required_m: float,
    preferred_m: float,
) -> FloorMap:
    """Return the floor of a ground truth grid, (rows, cols), row 0 at the lowest y; its border is a wall."""
    walled = np.pad(occupied, 1, constant_values=True)
    # Half a cell less: the obstacle's edge is there, not at the centre of its cell.
    distance = ndimage.distance_transform_edt(~walled)[1:-1, 1:-1] - 0.5
    clearance = np.maximum(distance, 0.0) * resolution_m
    free = clearance >= required_m
    nodes = np.full(free.shape, -1, dtype=np.int64)
    nodes[free] = np.arange(np.count_nonzero(free))
    short = np.clip(preferred_m - clearance, 0.0, None) / (preferred_m - required_m)
    price = resolution_m * (1.0 + _FEAR * np.square(short))
    graph = step_graph(nodes, price)
    return FloorMap(clearance, resolution_m, origin_xy, required_m, preferred_m, nodes, graph)


def step_graph(nodes: IntArray, price: FloatArray) -> sparse.csr_array:
    """Return the costs of steps between neighbouring cells, (nodes, nodes); diagonal ones may cut corners.

    Parameters
    ----------
    nodes
        (rows, cols) number of each cell where the robot's centre may be, -1 elsewhere.
    price
        (rows, cols) cost of crossing a cell, edge to edge.
    """
    rows, columns = nodes.shape
    starts, ends, costs = [], [], []
    for down, right in _NEIGHBOURS:
        left, shift = max(0, -right), max(0, right)
        here = (slice(0, rows - down), slice(left, columns - shift))
        there = (slice(down, rows), slice(left + right, columns - shift + right))
        free = (nodes[here] >= 0) & (nodes[there] >= 0)
        starts.append(nodes[here][free])
        ends.append(nodes[there][free])
        costs.append(0.5 * math.hypot(down, right) * (price[here] + price[there])[free])
    count = int(nodes.max(initial=-1)) + 1
    start, end, cost = np.concatenate(starts), np.concatenate(ends), np.concatenate(costs)
    both_ways = (np.concatenate([start, end]), np.concatenate([end, start]))
    return sparse.csr_array((np.concatenate([cost, cost]), both_ways), shape=(count, count))


def chain(before: NDArray[np.integer], start: int, end: int) -> IntArray | None:
    """Return the nodes from start to end by `csgraph`'s predecessors (nodes,); None if there is no path."""
    nodes = [end]
    while nodes[-1] != start:
        previous = int(before[nodes[-1]])
        if previous < 0:
            return None
        nodes.append(previous)
    return np.array(nodes[::-1], dtype=np.int64)


def cheapest_paths(floor: FloorMap, stops: Sequence[int]) -> tuple[FloatArray, list[list[IntArray | None]]]:
    """Find the cheapest paths between all pairs of stops.

    Parameters
    ----------
    stops
        Nodes, as from `FloorMap.node_near`.

    Returns
    -------
    FloatArray
        (stops, stops) costs, ``inf`` without a path.
    list[list[IntArray | None]]
        The nodes of each path, including both ends.
    """
    costs, before = sparse.csgraph.dijkstra(floor.graph, indices=list(stops), return_predecessors=True)
    paths: list[list[IntArray | None]] = []
    for index, start in enumerate(stops):
        paths.append([chain(before[index], start, end) for end in stops])
    return costs[:, list(stops)], paths


def smooth_path(floor: FloorMap, points_m: FloatArray, spacing_m: float) -> FloatArray:
    """Return evenly spaced points along a smoothed path, (N, 2).

    Where smoothing would cut a corner closer than allowed, the path stays as planned.

    Parameters
    ----------
    points_m
        (M, 2) corners of the planned path, map frame.
    """
    even = resample(points_m, spacing_m)
    smooth = ndimage.gaussian_filter1d(even, _SMOOTHING_M / spacing_m, axis=0, mode="nearest")
    smooth[0], smooth[-1] = even[0], even[-1]
    kept = np.minimum(floor.clearance_at_m(even), floor.preferred_m)
    unsafe = floor.clearance_at_m(smooth) < np.minimum(kept, floor.required_m + 0.5 * floor.resolution_m)
    # Blend over a few points, so that the fallback creates no new corner.
    weight = ndimage.gaussian_filter1d(unsafe.astype(np.float64), 2.0, mode="nearest")[:, None]
    share = np.minimum(1.0, 2.0 * weight)
    return resample(share * even + (1.0 - share) * smooth, spacing_m)


def resample(points_m: FloatArray, spacing_m: float) -> FloatArray:
    """Return points (N, 2) at equal arc length along a polyline (M, 2), including both ends."""
    lengths = np.linalg.norm(np.diff(points_m, axis=0), axis=1)
    keep = np.concatenate([[True], lengths > 1e-9])
    points, at = points_m[keep], np.concatenate([[0.0], np.cumsum(lengths[lengths > 1e-9])])
    distances = np.linspace(0.0, at[-1], max(2, round(at[-1] / spacing_m) + 1))
    return np.column_stack([np.interp(distances, at, points[:, 0]), np.interp(distances, at, points[:, 1])])
