"""Odometry of a 3D lidar: each scan against the clouds of the newest keyframes."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from slam.config_clouds import CloudOdometryConfig
from slam.matching.cloud_points import thinned
from slam.matching.local_cloud import Aligned, LocalCloud, kiss_map, moved
from slam.matching.plane_voxels import PlaneVoxels, VoxelMoments, voxel_moments
from slam.measurements import FloatArray, MotionEstimate

if TYPE_CHECKING:
    from kiss_icp.mapping import VoxelHashMap

_RENEWED_SHARE = 4
# This share of the points on planes is nearly as many.
_NEARLY = 0.75


class CloudOdometry:
    """Matches scans against the newest keyframes.

    Parameters
    ----------
    voxel_m
        Side of a voxel.
    """

    def __init__(self, config: CloudOdometryConfig, voxel_m: float) -> None:
        self._config, self._voxel_m = config, voxel_m
        self._clouds: deque[FloatArray] = deque(maxlen=config.local_map_keyframes)
        self._moments: deque[list[VoxelMoments]] = deque(maxlen=config.local_map_keyframes)
        self._points: VoxelHashMap | None = None
        self._grown = 0
        self._map: LocalCloud | None = None
        self._expected = 0.0

    def restart(self) -> None:
        """Forget the local map."""
        self._clouds.clear()
        self._moments.clear()
        self._map = self._points = None

    def add_keyframe(self, points: FloatArray, pose: gtsam.Pose3) -> None:
        """Take points (N, 3), base frame, at ``T_odom_base`` into the local map."""
        if not len(points):
            return
        cloud = moved(thinned(points, 0.5 * self._voxel_m), pose)
        self._clouds.append(cloud)
        self._moments.append(voxel_moments(cloud, self._voxel_m))
        self._grown += 1
        # KISS-ICP's map forgets by distance only; now and then it is made anew of what is still in the map.
        if self._points is None or self._grown * _RENEWED_SHARE >= self._config.local_map_keyframes:
            self._points = kiss_map(np.vstack(self._clouds), self._voxel_m, self._config)
            self._grown = 0
        else:
            self._points.add_points(cloud)
        planes = PlaneVoxels.merged(self._moments, self._voxel_m, self._config.thickness_m)
        self._map = LocalCloud(self._points, planes, self._voxel_m, self._config)
        self._expected = self._map.agreement(thinned(points, self._voxel_m), pose)

    def match(self, points: FloatArray, guesses: Sequence[gtsam.Pose3]) -> MotionEstimate | None:
        """Pose of a scan (N, 3), base frame, in the odometry frame; None where nothing fits.

        Parameters
        ----------
        guesses
            Tried in this order until a match settles near one, with nearly as many points on planes as the
            newest keyframe has. Where none does, the match with most of them is taken: from wheels that slip,
            or a robot that was pushed, a match arrives at what fits in part.
        """
        if self._map is None:
            return None
        scan = thinned(points, self._voxel_m)
        found: list[Aligned] = []
        for guess in guesses:
            aligned = self._map.align(scan, guess)
            if aligned is None or aligned.motion.inlier_share < self._config.least_inlier_share:
                continue
            if aligned.near and aligned.found.agreement >= _NEARLY * self._expected:
                return aligned.motion
            found.append(aligned)
        if not found:
            return None
        best = max(found, key=lambda aligned: aligned.found.agreement)
        return self._believed(best, found)

    def _believed(self, best: Aligned, rivals: Sequence[Aligned]) -> MotionEstimate:
        """The motion of a match; rivals that fit as well make it as unsure as they are far away."""
        apart = [
            gtsam.Pose3.Logmap(best.found.pose.between(rival.found.pose))
            for rival in rivals
            if rival.found.agreement >= _NEARLY * best.found.agreement
        ]
        doubt = sum((np.outer(way, way) for way in apart), start=np.zeros((6, 6)))
        return replace(best.motion, covariance=best.motion.covariance + doubt)
