"""Side from which each plane of a map was seen: from the next room, a thin wall is a different plane."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from slam.matching.plane_voxels import PlaneVoxels
from slam.measurements import BoolArray, FloatArray

# One beam through a door, or a point on an edge, is no observation of a wall.
LEAST_SEEN = 3
# A plane with a normal closer to horizontal than this is a wall, not a floor.
_LEVEL = 0.5


class OnPlanes(NamedTuple):
    """Relation of each of N points to the planes.

    Attributes
    ----------
    on
        Whether it is on a plane.
    upright
        Whether it is on a vertical one.
    strange
        Whether it is in the voxel of a plane that was seen only from the other side.
    """

    on: BoolArray
    upright: BoolArray
    strange: BoolArray


class SidedPlanes:
    """Planes with the sides from which they were seen.

    Parameters
    ----------
    lidars
        (K, 3) origins of the beams of each cloud, map frame.
    clouds
        K arrays (N, 3) of end points.
    """

    def __init__(self, planes: PlaneVoxels, lidars: FloatArray, clouds: Sequence[FloatArray]) -> None:
        self._planes = planes
        counts = np.zeros((2, len(planes)), np.int64)
        for lidar, cloud in zip(lidars, clouds, strict=True):
            pairs = planes.pairs(cloud)
            ahead = np.einsum("ij,ij->i", lidar - cloud[pairs.found], pairs.normals) > 0.0
            for side in (0, 1):
                counts[side] += np.bincount(pairs.planes[ahead == side], minlength=len(planes))
        self._is_seen = counts >= LEAST_SEEN

    def judge(self, lidar: FloatArray, points: FloatArray, reach_m: float) -> OnPlanes:
        """See `OnPlanes`; for points (N, 3) seen from a lidar (3,), map frame.

        Parameters
        ----------
        reach_m
            A point within this distance of a plane is on it.
        """
        pairs = self._planes.pairs(points)
        placed = points[pairs.found]
        off_m = np.abs(np.einsum("ij,ij->i", placed - pairs.centers, pairs.normals))
        ahead = (np.einsum("ij,ij->i", lidar - placed, pairs.normals) > 0.0).astype(np.int64)
        facing = self._is_seen[ahead, pairs.planes]
        judged = OnPlanes(*np.zeros((3, len(points)), np.bool_))
        judged.on[pairs.found] = (off_m <= reach_m) & facing
        judged.upright[pairs.found] = (off_m <= reach_m) & facing & (np.abs(pairs.normals[:, 2]) < _LEVEL)
        judged.strange[pairs.found] = ~facing
        return judged
