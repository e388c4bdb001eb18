"""Planes in the voxels of a cloud, at several sizes at once: what points are matched to.

Where a large voxel holds one plane it is taken, since more points tell its normal; where it does not, smaller
ones are asked (as the voxel map of Yuan 2022, "Efficient and probabilistic adaptive voxel mapping").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.measurements import BoolArray, FloatArray

# 21 bits an axis make a key.
_HALF_AXIS = 1 << 20
_LEAST_POINTS = 6
# A ring of the lidar alone is a line: its second extent is noise, which tells no plane.
_LEAST_EXTENT = 0.12
_LEAST_FLATNESS = 9.0
SIZES = (4.0, 2.0, 1.0)


@dataclass(frozen=True, slots=True)
class _Level:
    """The planes of one size of voxel, sorted by key."""

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
    """

    found: BoolArray
    centers: FloatArray
    normals: FloatArray


class PlaneVoxels:
    """The planes of a cloud."""

    def __init__(self, levels: list[_Level]) -> None:
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
        return cls([_level(points, voxel_m * size, thickness_m) for size in SIZES])

    def __len__(self) -> int:
        return sum(len(level.keys) for level in self._levels)

    def pairs(self, points: FloatArray) -> PlanePairs:
        """The plane of the largest voxel around each point (N, 3) that has one."""
        found = np.zeros(len(points), dtype=np.bool_)
        centers, normals = np.zeros((len(points), 3)), np.zeros((len(points), 3))
        for level in self._levels:
            if not len(level.keys):
                continue
            open_ = np.flatnonzero(~found)
            keys = _keys(np.floor(points[open_] / level.size_m))
            place = np.minimum(np.searchsorted(level.keys, keys), len(level.keys) - 1)
            hit = level.keys[place] == keys
            rows, place = open_[hit], place[hit]
            found[rows] = True
            centers[rows], normals[rows] = level.centers[place], level.normals[place]
        return PlanePairs(found, centers[found], normals[found])


def _level(points: FloatArray, size_m: float, thickness_m: float) -> _Level:
    """Planes of one size."""
    cells = np.floor(points / size_m)
    keys = _keys(cells)
    order = np.argsort(keys, kind="stable")
    keys, starts, counts = np.unique(keys[order], return_index=True, return_counts=True)
    enough = counts >= _LEAST_POINTS
    if not enough.any():
        return _Level(size_m, keys[:0], np.zeros((0, 3)), np.zeros((0, 3)))
    # About the middle of its voxel a moment loses no digits.
    corners = cells[order][starts] * size_m
    local = points[order] - np.repeat(corners, counts, axis=0)
    sums = np.add.reduceat(local, starts)[enough]
    rows, columns = np.triu_indices(3)
    squares = np.add.reduceat(local[:, rows] * local[:, columns], starts)[enough]
    number = counts[enough, None]
    means = sums / number
    covariances = np.empty((len(means), 3, 3))
    spread = squares / number - means[:, rows] * means[:, columns]
    covariances[:, rows, columns] = spread
    covariances[:, columns, rows] = spread
    values, vectors = np.linalg.eigh(covariances)
    flat = (
        (values[:, 0] < thickness_m**2)
        & (values[:, 1] > (_LEAST_EXTENT * size_m) ** 2)
        & (values[:, 1] > _LEAST_FLATNESS * values[:, 0])
    )
    return _Level(size_m, keys[enough][flat], (means + corners[enough])[flat], vectors[flat, :, 0])


def _keys(cells: FloatArray) -> NDArray[np.int64]:
    """One integer a cell (N, 3)."""
    whole = cells.astype(np.int64) + _HALF_AXIS
    return (whole[:, 0] << 42) | (whole[:, 1] << 21) | whole[:, 2]
