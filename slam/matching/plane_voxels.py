"""Planes in the voxels of a cloud, at several sizes at once: what points are matched to.

Where a large voxel holds one plane it is taken, since more points tell its normal; where it does not, smaller
ones are asked (as the voxel map of Yuan 2022, "Efficient and probabilistic adaptive voxel mapping").
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.measurements import BoolArray, FloatArray

# Three axes make a key.
_AXIS_BITS = 21
_LEAST_POINTS = 6
# A ring of the lidar alone is a line: its second extent is noise, which tells no plane.
_LEAST_EXTENT = 0.12
_LEAST_FLATNESS = 9.0
SIZES = (4.0, 2.0, 1.0)


@dataclass(frozen=True, slots=True)
class VoxelMoments:
    """Sums over the points in each voxel of one size, about the voxel's corner; those of two clouds add up.

    Attributes
    ----------
    keys
        (V,) of the voxels, in order.
    sums
        (V, C) one row a voxel; of a surface (V, 10): number, sum of x, y, z, sums of their products.
    """

    keys: NDArray[np.int64]
    sums: FloatArray


@dataclass(frozen=True, slots=True)
class PlaneLevel:
    """The planes of one size of voxel.

    Attributes
    ----------
    size_m
        Side of a voxel.
    keys
        (V,) of the voxels that hold a plane, in order.
    centers, normals
        (V, 3) of their planes.
    """

    size_m: float
    keys: NDArray[np.int64]
    centers: FloatArray
    normals: FloatArray


@dataclass(frozen=True, slots=True)
class PlanePairs:
    """Points and their planes.

    Attributes
    ----------
    found
        (N,) whether a point lies in a voxel with a plane.
    centers, normals
        (M, 3) of those, in their order.
    planes
        (M,) number of the plane of each.
    """

    found: BoolArray
    centers: FloatArray
    normals: FloatArray
    planes: NDArray[np.int64]


class PlaneVoxels:
    """The planes of a cloud."""

    def __init__(self, levels: Sequence[PlaneLevel]) -> None:
        self._levels = levels

    @classmethod
    def build(cls, points: FloatArray, voxel_m: float, thickness_m: float) -> PlaneVoxels:
        """Fit planes.

        Parameters
        ----------
        points
            (N, 3).
        voxel_m
            Side of the smallest voxels.
        thickness_m
            Standard deviation across a plane, at most.
        """
        return cls.merged([voxel_moments(points, voxel_m)], voxel_m, thickness_m)

    @classmethod
    def merged(
        cls, parts: Collection[Sequence[VoxelMoments]], voxel_m: float, thickness_m: float
    ) -> PlaneVoxels:
        """Fit planes to several clouds at once, at least one, each as `voxel_moments` tells it."""
        levels = []
        for of_size, size in zip(zip(*parts, strict=True), SIZES, strict=True):
            moments = added(of_size)
            flat, centers, normals = fitted(moments, voxel_m * size, thickness_m)
            levels.append(PlaneLevel(voxel_m * size, moments.keys[flat], centers[flat], normals[flat]))
        return cls(levels)

    def __len__(self) -> int:
        return sum(len(level.keys) for level in self._levels)

    def pairs(self, points: FloatArray) -> PlanePairs:
        """The plane of the largest voxel around each point (N, 3) that has one."""
        found = np.zeros(len(points), dtype=np.bool_)
        centers, normals = np.zeros((len(points), 3)), np.zeros((len(points), 3))
        planes, before = np.zeros(len(points), dtype=np.int64), 0
        for level in self._levels:
            if not len(level.keys):
                continue
            open_ = np.flatnonzero(~found)
            keys = voxel_keys(points[open_], level.size_m)
            place = np.minimum(np.searchsorted(level.keys, keys), len(level.keys) - 1)
            hit = level.keys[place] == keys
            rows, place = open_[hit], place[hit]
            found[rows] = True
            centers[rows], normals[rows] = level.centers[place], level.normals[place]
            planes[rows] = before + place
            before += len(level.keys)
        return PlanePairs(found, centers[found], normals[found], planes[found])


def voxel_moments(points: FloatArray, voxel_m: float) -> list[VoxelMoments]:
    """What a cloud (N, 3) adds to the voxels of every size."""
    return [_moments(points, voxel_m * size) for size in SIZES]


def _moments(points: FloatArray, size_m: float) -> VoxelMoments:
    """Of one size."""
    keys = voxel_keys(points, size_m)
    order = np.argsort(keys, kind="stable")
    keys, ordered = keys[order], points[order]
    # About the corner of its voxel a moment loses no digits.
    local = ordered - np.floor(ordered / size_m) * size_m
    row, column = np.triu_indices(3)
    rows = np.column_stack([np.ones(len(local)), local, local[:, row] * local[:, column]])
    return summed(keys, rows)


def added(parts: Sequence[VoxelMoments]) -> VoxelMoments:
    """The moments of several clouds together."""
    if len(parts) == 1:
        return parts[0]
    keys, sums = np.concatenate([part.keys for part in parts]), np.vstack([part.sums for part in parts])
    order = np.argsort(keys, kind="stable")
    return summed(keys[order], sums[order])


def summed(keys: NDArray[np.int64], rows: FloatArray) -> VoxelMoments:
    """Rows of equal keys, which stand together, added up."""
    if not len(keys):
        return VoxelMoments(keys, rows)
    starts = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    return VoxelMoments(keys[starts], np.add.reduceat(rows, starts))


def fitted(
    moments: VoxelMoments, size_m: float, thickness_m: float
) -> tuple[BoolArray, FloatArray, FloatArray]:
    """Whether each voxel (V,) of one size holds a plane, and the planes' centers and normals, both (V, 3)."""
    keys, sums = moments.keys, moments.sums
    flat = sums[:, 0] >= _LEAST_POINTS
    centers, normals = np.zeros((len(keys), 3)), np.zeros((len(keys), 3))
    if not flat.any():
        return flat, centers, normals
    means = sums[flat, 1:4] / sums[flat, :1]
    row, column = np.triu_indices(3)
    spread = sums[flat, 4:] / sums[flat, :1] - means[:, row] * means[:, column]
    covariances = np.empty((len(means), 3, 3))
    covariances[:, row, column] = spread
    covariances[:, column, row] = spread
    values, vectors = np.linalg.eigh(covariances)
    axes = np.stack([keys >> 2 * _AXIS_BITS, keys >> _AXIS_BITS, keys], axis=1)[flat] & (
        (1 << _AXIS_BITS) - 1
    )
    centers[flat] = means + (axes - (1 << _AXIS_BITS - 1)) * size_m
    normals[flat] = vectors[:, :, 0]
    flat[flat] = (
        (values[:, 0] < thickness_m**2)
        & (values[:, 1] > (_LEAST_EXTENT * size_m) ** 2)
        & (values[:, 1] > _LEAST_FLATNESS * values[:, 0])
    )
    return flat, centers, normals


def voxel_keys(points: FloatArray, size_m: float) -> NDArray[np.int64]:
    """One integer for the voxel of each point."""
    whole = np.floor(points / size_m).astype(np.int64) + (1 << _AXIS_BITS - 1)
    return (whole[:, 0] << 2 * _AXIS_BITS) | (whole[:, 1] << _AXIS_BITS) | whole[:, 2]
