"""A map of clouds to match to: planes from a near guess, else KISS-ICP (Vizzo 2023) first finds the way.

Indoors the rings on floor and ceiling travel with the lidar, and as points they pull every motion short; as
planes they tell only height and tilt. So a point-to-plane alignment has the last word, and its Hessian gives
the covariance that KISS-ICP has not. Where it does not settle within a voxel of the guess, KISS-ICP's
registration, which nearly always arrives, comes before it; it takes more time than all the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from fusion.estimation import FEWEST, SETTLED
from slam.config import Config
from slam.matching.cloud_alignment import CloudAlignment, agreement, align_cloud, motion_of
from slam.matching.plane_voxels import PlaneVoxels
from slam.measurements import FloatArray, MotionEstimate

if TYPE_CHECKING:
    from kiss_icp.mapping import VoxelHashMap

# Points of a voxel that KISS-ICP keeps, as its authors do (Vizzo 2023).
KISS_POINTS_A_VOXEL = 20
_KISS_ITERATIONS = 50
# In voxels: how far a pose may be off that KISS-ICP is to find. All kernels are a voxel wide.
REACH = 5.0
# Points that find the way: what follows takes them all.
_ARRIVING_POINTS = 3000
# Points that know nothing of the planes lie evenly within the kernel; so many voxels RMS are nearly that.
_CHANCE = 0.45


@dataclass(frozen=True, slots=True)
class Aligned:
    """An alignment with the motion made of it.

    Attributes
    ----------
    near
        Whether it settled where it was expected, and nearly all points agree: no other guess is needed.
    """

    found: CloudAlignment
    motion: MotionEstimate
    near: bool


class LocalCloud:
    """A map to match to: points for KISS-ICP, planes for what follows.

    Parameters
    ----------
    points
        KISS-ICP's map.
    planes
        Of the same clouds.
    voxel_m
        Side of a voxel.
    """

    def __init__(self, points: VoxelHashMap, planes: PlaneVoxels, voxel_m: float, config: Config) -> None:
        self._points, self.planes = points, planes
        self._config, self._voxel_m = config, voxel_m

    @classmethod
    def of(cls, points: FloatArray, voxel_m: float, config: Config) -> LocalCloud:
        """The map of a cloud (N, 3)."""
        planes = PlaneVoxels.build(points, voxel_m, config.cloud_odometry.thickness_m)
        return cls(kiss_map(points, voxel_m, config), planes, voxel_m, config)

    @classmethod
    def of_planes(cls, planes: PlaneVoxels, voxel_m: float, config: Config) -> LocalCloud:
        """A map of planes, to which nothing arrives from afar."""
        return cls(kiss_map(np.zeros((0, 3)), voxel_m, config), planes, voxel_m, config)

    def align(
        self,
        scan: FloatArray,
        guess: gtsam.Pose3,
        reach_m: float | None = None,
        least_agreement: float = 0.0,
    ) -> Aligned | None:
        """Align a thinned scan (N, 3), base frame; None where too little is known.

        Parameters
        ----------
        guess
            ``T_map_base``.
        reach_m
            How far the guess may be off; None where it is expected to be right within a voxel.
        least_agreement
            Share of points on planes with which planes alone are believed.
        """
        if len(scan) < FEWEST or not len(self.planes):
            return None
        found = self._by_planes(scan, guess) if reach_m is None else None
        near = found is not None and self._is_near(found, guess) and found.agreement >= least_agreement
        if not near:
            start = self._arrive(scan, guess, REACH * self._voxel_m if reach_m is None else reach_m)
            found = self._by_planes(scan, start)
        return self._aligned(found, guess, near=near)

    def refine(self, scan: FloatArray, guess: gtsam.Pose3) -> Aligned | None:
        """The same from a guess that is right within a voxel, by the planes alone."""
        if len(scan) < FEWEST or not len(self.planes):
            return None
        found = self._by_planes(scan, guess)
        return self._aligned(found, guess, near=found is not None and self._is_near(found, guess))

    def _aligned(self, found: CloudAlignment | None, guess: gtsam.Pose3, *, near: bool) -> Aligned | None:
        """An alignment, if enough points fit better than by chance."""
        if found is None or found.pair_count < self._config.cloud_odometry.least_pairs:
            return None
        if not found.residual_m < _CHANCE * self._voxel_m:
            return None
        return Aligned(found, motion_of(found, self._config, guess), near)

    def best_of(self, scan: FloatArray, starts: Sequence[gtsam.Pose3]) -> gtsam.Pose3:
        """The start ``T_map_base``, moved to where a part of the scan fits, with most points on planes there.

        KISS-ICP holds on to where it starts along a street of flat walls, since rings travel with the lidar.
        """
        part = _part(scan, _ARRIVING_POINTS // 2)
        found = [self._by_planes(part, start) for start in starts]
        best = max(found, key=lambda one: 0.0 if one is None else one.agreement)
        return starts[0] if best is None else best.pose

    def agreement(self, scan: FloatArray, pose: gtsam.Pose3) -> float:
        """Share of a thinned scan (N, 3), base frame, that lies on planes from ``T_map_base``."""
        return agreement(scan, self.planes, pose, self._voxel_m)

    def _by_planes(self, scan: FloatArray, start: gtsam.Pose3) -> CloudAlignment | None:
        """The point-to-plane alignment."""
        return align_cloud(scan, self.planes, start, self._config.match.iterations, self._voxel_m)

    def _is_near(self, found: CloudAlignment, guess: gtsam.Pose3) -> bool:
        """Whether an alignment settled where it was expected."""
        moved_m = np.abs(gtsam.Pose3.Logmap(guess.between(found.pose))) * ([found.lever_m] * 3 + [1.0] * 3)
        confident = found.converged and found.inlier_share >= self._config.match.confident_inlier_share
        return bool(confident and moved_m.max() <= self._voxel_m)

    def _arrive(self, scan: FloatArray, guess: gtsam.Pose3, reach_m: float) -> gtsam.Pose3:
        """KISS-ICP's registration of a part of the scan; the guess itself where it breaks down."""
        from kiss_icp.registration import Registration

        registration = Registration(_KISS_ITERATIONS, SETTLED, max_num_threads=1)
        matrix = registration.align_points_to_map(
            points=_part(scan, _ARRIVING_POINTS),
            voxel_map=self._points,
            initial_guess=guess.matrix(),
            max_correspondance_distance=reach_m,
            kernel=self._voxel_m,
        )
        return gtsam.Pose3(matrix) if np.isfinite(matrix).all() else guess


def kiss_map(points: FloatArray, voxel_m: float, config: Config) -> VoxelHashMap:
    """KISS-ICP's map of a cloud (N, 3)."""
    from kiss_icp.mapping import VoxelHashMap

    made = VoxelHashMap(voxel_m, config.cloud_odometry.range_max_m, KISS_POINTS_A_VOXEL)
    if len(points):
        made.add_points(points)
    return made


def _part(scan: FloatArray, count: int) -> FloatArray:
    """About so many points, evenly taken."""
    return scan[:: -(-len(scan) // count)]


def moved(points: FloatArray, pose: gtsam.Pose3) -> FloatArray:
    """Points (N, 3) of frame b in frame a by ``T_a_b``."""
    return np.asarray(points @ pose.rotation().matrix().T + pose.translation())
