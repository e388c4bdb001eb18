"""Planar lidar odometry with KISS-ICP's registration (Vizzo 2023), with a map of keyframes only.

The original pipeline updates its map with every scan and accepts no initial guess; with its low-level parts,
an initial guess and keyframe updates, it is far more accurate on planar scans. Covariance and degeneracy are
added here, because KISS-ICP has none.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from functools import cache, partial

import gtsam
import numpy as np

from slam.config import Config
from slam.estimates import MotionEstimate
from slam.matching.local_map import LocalMap, OrientedPoints
from slam.matching.match_covariance import motion_from_alignment
from slam.matching.motion import Motion
from slam.matching.scan_points import ScanPoints
from slam.matching.visibility import RangeImage
from slam.measurements import AnyFloatArray, FloatArray, pose2_from_row

# Voxel map: side of a voxel, maximum range, and points per voxel; pairs: maximum distance, and scale of the
# robust kernel. KISS-ICP's defaults are for streets.
_VOXEL_M, _MAP_RADIUS_M, _POINTS_A_VOXEL = 0.2, 60.0, 10
_CORRESPONDENCE_M, _KERNEL_M = 0.3, 0.1
_LEAST_POINTS = 10
_ITERATIONS = 100
_CONVERGED = 1e-5


class KissOdometry:
    """Point-to-point registration to a voxel map of the keyframes."""

    def __init__(self, config: Config) -> None:
        from kiss_icp.mapping import VoxelHashMap
        from kiss_icp.registration import Registration

        self._match = config.match
        self._map = VoxelHashMap(
            voxel_size=_VOXEL_M, max_distance=_MAP_RADIUS_M, max_points_per_voxel=_POINTS_A_VOXEL
        )
        self._registration = Registration(
            max_num_iterations=_ITERATIONS, convergence_criterion=_CONVERGED, max_num_threads=1
        )
        self._keyframes: deque[OrientedPoints] = deque(maxlen=config.match.local_map_keyframes)
        self._images: deque[Callable[[], RangeImage]] = deque(maxlen=config.match.local_map_keyframes)
        self._local_map: LocalMap | None = None

    def add_keyframe(self, points: ScanPoints, pose: FloatArray) -> None:
        """Add a scan at a pose (3,) in the odometry frame to the voxel map."""
        if len(points):
            self._map.update(_lifted(points.points_base), _matrix(pose))
        self._keyframes.append(OrientedPoints.from_scan(points).moved(pose))
        self._images.append(cache(partial(RangeImage.of, points.points_base, pose, points.points_base)))
        self._local_map = LocalMap.build(list(self._keyframes), self._match, list(self._images))

    def match(
        self, points: ScanPoints, guesses: list[Motion], *, alone: bool = False
    ) -> MotionEstimate | None:
        """Register from each guess until one is certain; surfels measure the quality of the fit."""
        scan = OrientedPoints.from_scan(points)
        if self._local_map is None or len(scan) < _LEAST_POINTS or self._map.empty():
            return None
        best = None
        for guess in guesses:
            pose = self._register(points, guess.pose)
            judged = self._local_map.judge(scan, pose)
            if best is None or judged.inlier_share > best.inlier_share:
                best = judged
            if best.inlier_share >= self._match.confident_inlier_share:
                break
        if best is None or best.inlier_share < self._match.least_inlier_share:
            return None
        return motion_from_alignment(best, self._match)

    def match_near(self, points: ScanPoints, pose: FloatArray) -> MotionEstimate | None:
        """How well the scan fits at ``pose`` (3,); KISS-ICP cannot be constrained to stay there."""
        scan = OrientedPoints.from_scan(points)
        if self._local_map is None or len(scan) < _LEAST_POINTS:
            return None
        return motion_from_alignment(self._local_map.judge(scan, pose), self._match)

    def evidence(self, points: ScanPoints, pose: FloatArray, other: Motion) -> FloatArray:
        """Evidence of each object in a scan for a pose (3,) against another one, in points; (2, K)."""
        local_map = self._local_map
        if local_map is None:
            return np.zeros((2, 0))
        return local_map.evidence(OrientedPoints.from_scan(points), pose, other)

    def _register(self, points: ScanPoints, guess: FloatArray) -> FloatArray:
        """Run KISS-ICP from a guess (3,); returns the pose (3,) of the scan in the odometry frame."""
        matrix = self._registration.align_points_to_map(
            points=_lifted(points.points_base),
            voxel_map=self._map,
            initial_guess=_matrix(guess),
            max_correspondance_distance=_CORRESPONDENCE_M,
            kernel=_KERNEL_M,
        )
        return np.array([matrix[0, 3], matrix[1, 3], math.atan2(matrix[1, 0], matrix[0, 0])])


def _lifted(points: AnyFloatArray) -> FloatArray:
    """(M, 2) points in the plane z = 0, (M, 3) float64."""
    return np.column_stack([points, np.zeros(len(points))]).astype(np.float64)


def _matrix(pose: FloatArray) -> FloatArray:
    """A planar pose (3,) as a homogeneous matrix (4, 4)."""
    return gtsam.Pose3(pose2_from_row(pose)).matrix()
