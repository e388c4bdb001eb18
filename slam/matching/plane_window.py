"""The planes of the newest clouds: what each of them adds to the voxels is counted in, and out again."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from slam.matching.plane_voxels import SIZES, PlaneLevel, PlaneVoxels, VoxelMoments, fitted, voxel_moments
from slam.measurements import BoolArray, FloatArray


class PlaneWindow:
    """Clouds of one frame, of which the oldest is forgotten when another comes.

    Parameters
    ----------
    voxel_m
        Side of the smallest voxels.
    thickness_m
        Standard deviation across a plane, at most.
    length
        Clouds that are kept.
    """

    def __init__(self, voxel_m: float, thickness_m: float, length: int) -> None:
        self._voxel_m, self._length = voxel_m, length
        self._clouds: deque[list[VoxelMoments]] = deque()
        self._levels = [_Level(voxel_m * size, thickness_m) for size in SIZES]

    def add(self, points: FloatArray) -> PlaneVoxels:
        """The planes with the points (N, 3) of another cloud."""
        self._clouds.append(voxel_moments(points, self._voxel_m))
        left = self._clouds.popleft() if len(self._clouds) > self._length else None
        for n, level in enumerate(self._levels):
            level.change(self._clouds[-1][n], None if left is None else left[n])
        return PlaneVoxels([level.planes() for level in self._levels])


class _Level:
    """All voxels of one size that hold points."""

    def __init__(self, size_m: float, thickness_m: float) -> None:
        self._size_m, self._thickness_m = size_m, thickness_m
        self._keys: NDArray[np.int64] = np.zeros(0, dtype=np.int64)
        self._sums: FloatArray = np.zeros((0, 10))
        self._flat: BoolArray = np.zeros(0, dtype=np.bool_)
        self._centers: FloatArray = np.zeros((0, 3))
        self._normals: FloatArray = np.zeros((0, 3))

    def change(self, come: VoxelMoments, gone: VoxelMoments | None) -> None:
        """Count a cloud in, and one out."""
        self._make_room(come.keys)
        touched = np.searchsorted(self._keys, come.keys)
        self._sums[touched] += come.sums
        if gone is not None:
            left = np.searchsorted(self._keys, gone.keys)
            self._sums[left] -= gone.sums
            touched = np.union1d(touched, left)
        moments = VoxelMoments(self._keys[touched], self._sums[touched])
        self._flat[touched], self._centers[touched], self._normals[touched] = fitted(
            moments, self._size_m, self._thickness_m
        )
        self._keep(self._sums[:, 0] > 0.0)

    def planes(self) -> PlaneLevel:
        """Those that hold a plane."""
        flat = self._flat
        return PlaneLevel(self._size_m, self._keys[flat], self._centers[flat], self._normals[flat])

    def _make_room(self, keys: NDArray[np.int64]) -> None:
        """Empty voxels for keys that are new."""
        new = np.setdiff1d(keys, self._keys, assume_unique=True)
        at = np.searchsorted(self._keys, new)
        self._keys = np.insert(self._keys, at, new)
        self._flat = np.insert(self._flat, at, False)
        self._sums, self._centers, self._normals = (
            np.insert(values, at, 0.0, axis=0) for values in (self._sums, self._centers, self._normals)
        )

    def _keep(self, kept: BoolArray) -> None:
        """Forget the other voxels."""
        if kept.all():
            return
        self._keys, self._sums, self._flat = self._keys[kept], self._sums[kept], self._flat[kept]
        self._centers, self._normals = self._centers[kept], self._normals[kept]
