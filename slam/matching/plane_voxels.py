"""Planes in the voxels of clouds, at several sizes at once, to which points are matched.

If a large voxel contains one plane, it is used, since more points determine its normal; otherwise smaller
voxels are used (like the voxel map of Yuan 2022, "Efficient and probabilistic adaptive voxel mapping").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.voxel_hash import AXIS_BITS, entries_at, index_keys, table_for
from slam.matching.normal_kernels import smooth_normals
from slam.matching.plane_kernels import count_points, fit_planes, normal_equations, pair_up, pull
from slam.measurements import BoolArray, FloatArray

SIZES = np.array([4.0, 2.0, 1.0])


@dataclass(frozen=True, slots=True)
class PlanePairs:
    """Points and their planes.

    Attributes
    ----------
    found
        (N,) whether a point is in a voxel with a plane.
    centers, normals
        (M, 3) centres and normals of these planes, in order.
    planes
        (M,) number of the plane of each.
    """

    found: BoolArray
    centers: FloatArray
    normals: FloatArray
    planes: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Residuals:
    """Distances of M of a cloud's points from their planes.

    Attributes
    ----------
    which, voxels
        (M,) numbers of the points, and of the voxels that hold their planes.
    distances_m
        (M,), with the sign of the side.
    """

    which: NDArray[np.int64]
    voxels: NDArray[np.int64]
    distances_m: FloatArray


class PlaneVoxels:
    """Voxels with the moments of clouds, and their planes.

    Parameters
    ----------
    voxel_m
        Side of the smallest voxels.
    thickness_m
        Largest standard deviation across a plane.
    rough
        1 if thicker ones count, too, by their thickness.
    least_sine
        Least sine of the angle between a plane and the rays that saw it.
    """

    def __init__(self, voxel_m: float, thickness_m: float, least_sine: float = 0.0, rough: int = 0) -> None:
        self._sizes_m, self._thickness_m, self._least_sine = SIZES * voxel_m, thickness_m, least_sine
        self._count, self._table, self._rough = 0, table_for(1), rough
        self._keys, self._sums = np.empty(1, np.int64), np.empty((1, 10))
        self._flat, self._marks = np.zeros(1, np.int8), np.zeros(1, np.bool_)
        self._planes = np.empty((1, 6))

    @classmethod
    def build(cls, points: FloatArray, voxel_m: float, thickness_m: float, rough: int = 0) -> PlaneVoxels:
        """Create the planes of a cloud (N, 3); other parameters as above."""
        made = cls(voxel_m, thickness_m, rough=rough)
        made.add(points)
        return made

    def __len__(self) -> int:
        return int(np.count_nonzero(self._flat[: self._count]))

    def add(
        self, points: FloatArray, removed: FloatArray | None = None, lidar: FloatArray | None = None
    ) -> None:
        """Add a cloud (N, 3), seen from (3,), remove another, and fit the touched voxels again."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        removed = np.empty((0, 3)) if removed is None else np.ascontiguousarray(removed, dtype=np.float64)
        touched = np.empty((len(points) + len(removed)) * len(self._sizes_m), np.int64)
        most = self._count + len(points) * len(self._sizes_m)
        if most > len(self._keys):
            self._store(max(most, 2 * len(self._keys)), np.arange(self._count))
        changed = 0
        for cloud, sign in ((points, 1.0), (removed, -1.0)):
            voxels = self._table, self._keys, self._sums, self._marks, touched[changed:]
            self._count, more = count_points(cloud, sign, self._sizes_m, self._count, *voxels)
            changed += more
        fit_planes(
            self._keys,
            self._sums,
            self._sizes_m,
            self._thickness_m,
            self._rough,
            np.zeros(3) if lidar is None else lidar,
            self._least_sine,
            self._marks,
            touched[:changed],
            self._flat,
            self._planes,
        )
        remains = self._sums[: self._count, 0] > 0.5
        if len(removed) and 2 * np.count_nonzero(remains) < self._count:
            kept = np.flatnonzero(remains)
            self._store(len(kept), kept)

    def settle(self) -> None:
        """Compact the planes and centres for matching; no cloud can be added afterwards."""
        largest = self._keys[: self._count] >> 3 * AXIS_BITS == 0
        kept = np.flatnonzero((self._flat[: self._count] > 0) | largest)
        self._store(len(kept), kept)

    def residuals(
        self, points: FloatArray, T_map_base: FloatArray, last_at: NDArray[np.int64] | None = None
    ) -> Residuals:
        """Return the residuals of points (N, 3), base frame, at a pose (4, 4).

        Parameters
        ----------
        last_at
            (2, N) filled with -1, then changed by each call with these points: in an alignment, most points
            stay in their voxels.
        """
        last_at = np.full((2, len(points)), -1) if last_at is None else last_at
        which, voxels = np.empty(len(points), np.int64), np.empty(len(points), np.int64)
        distances_m = np.empty(len(points))
        known = self._sizes_m, self._table, self._keys, self._flat, self._planes
        count = pair_up(points, T_map_base, *known, last_at, which, voxels, distances_m)
        return Residuals(which[:count], voxels[:count], distances_m[:count])

    def normal_equations(
        self, points: FloatArray, T_map_base: FloatArray, residuals: Residuals, kernel_m: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return robust weights (M,), weighted gradients (M, 6), and Hessian over their sum (7, 6).

        In GTSAM's tangent of the base.
        """
        weights, gradients = np.empty(len(residuals.which)), np.empty((len(residuals.which), 6))
        sums = np.zeros((7, 6))
        pairs = residuals.which, residuals.voxels, residuals.distances_m
        normal_equations(points, T_map_base, self._planes, *pairs, kernel_m, weights, gradients, sums)
        return weights, gradients, sums

    def roughness(self, voxels: NDArray[np.int64]) -> float:
        """Return the mean square thickness of planes in voxels (M,) over that of plain ones, at least 1."""
        return float(np.mean(1.0 / np.square(self._planes[voxels, 3:]).sum(axis=1)))

    def pulls(
        self, points: FloatArray, T_map_base: FloatArray, reach_m: float
    ) -> tuple[FloatArray, FloatArray]:
        """Return Hessian (6, 6) and gradient (6,) of squared distances to the nearest voxel centres."""
        sums = np.zeros(16)
        pull(points, T_map_base, self._sizes_m[0], self._table, self._keys, self._sums, reach_m, sums)
        weight, (x, y, z), hessian = sums[0], sums[1:4], np.zeros((6, 6))
        row, column = np.triu_indices(3)
        hessian[row, column] = hessian[column, row] = -sums[4:10]
        hessian[:3, :3] -= np.trace(hessian[:3, :3]) * np.eye(3)
        hessian[:3, 3:] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
        hessian[3:, :3], hessian[3:, 3:] = hessian[:3, 3:].T, weight * np.eye(3)
        return hessian, sums[10:]

    def pairs(self, points: FloatArray) -> PlanePairs:
        """Return the plane of the largest voxel with one around each point (N, 3), map frame."""
        residuals, flat = self.residuals(points, np.eye(4)), self._flat[: self._count] == 2
        voxels, is_paired = residuals.voxels[flat[residuals.voxels]], np.zeros(len(points), dtype=np.bool_)
        is_paired[residuals.which[flat[residuals.voxels]]] = True
        planes, numbers = self._planes[voxels], np.cumsum(flat)[voxels] - 1
        return PlanePairs(is_paired, planes[:, :3], planes[:, 3:], numbers)

    def _store(self, room: int, kept: NDArray[np.int64]) -> None:
        """Allocate arrays for so many voxels, and copy the existing ones."""
        count = self._count = len(kept)
        room = max(room, 1)
        keys, sums, planes = np.empty(room, np.int64), np.empty((room, 10)), np.empty((room, 6))
        flat, self._marks = np.zeros(room, np.int8), np.zeros(room, np.bool_)
        keys[:count], sums[:count] = self._keys[kept], self._sums[kept]
        planes[:count], flat[:count] = self._planes[kept], self._flat[kept]
        self._keys, self._sums, self._planes, self._flat = keys, sums, planes, flat
        self._table = table_for(room)
        index_keys(keys[:count], self._table)


def surface_normals(points: FloatArray, size_m: float) -> FloatArray:
    """Return unoriented normals (N, 3) from the points in and around each cell, else vertical ones."""
    points = np.ascontiguousarray(points, dtype=np.float64)
    count, table = len(points), table_for(len(points))
    keys, sums, marks = np.empty(count, np.int64), np.empty((count, 10)), np.zeros(count, np.bool_)
    entries = np.empty(count, np.int64)
    cells, _ = count_points(points, 1.0, np.array([size_m]), 0, table, keys, sums, marks, entries)
    # In the order of their keys, all neighbours are found in one pass.
    order = np.argsort(keys[:cells])
    of_cells, normals = np.empty((cells, 3)), np.empty((cells, 3))
    begun = np.zeros(9, np.int64)
    smooth_normals(keys[order], sums[order], size_m, begun, np.empty((27, 4)), of_cells)
    normals[order] = of_cells
    entries_at(points, size_m, table, keys, entries)
    return np.asarray(normals[entries])
