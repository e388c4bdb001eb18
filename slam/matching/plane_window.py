"""The planes of the newest clouds: what each of them adds to the voxels is counted in, and out again."""

from __future__ import annotations

from collections import deque

from slam.matching.plane_voxels import PlaneVoxels
from slam.measurements import FloatArray


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

    Attributes
    ----------
    clouds, planes
        Those that are kept, (N, 3) each, and what they hold together.
    """

    def __init__(self, voxel_m: float, thickness_m: float, length: int) -> None:
        self._length = length
        self.clouds: deque[FloatArray] = deque()
        self.planes = PlaneVoxels(voxel_m, thickness_m)

    def add(self, points: FloatArray) -> None:
        """Take another cloud (N, 3)."""
        self.clouds.append(points)
        self.planes.add(points, self.clouds.popleft() if len(self.clouds) > self._length else None)
