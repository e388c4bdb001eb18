"""Odometry of a 3D lidar: each scan against the clouds of the newest keyframes."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import gtsam
import numpy as np

from slam.config_clouds import CloudOdometryConfig
from slam.matching.cloud_points import thinned
from slam.matching.local_cloud import LocalCloud, moved
from slam.measurements import FloatArray, MotionEstimate


class CloudOdometry:
    """Matches scans against the newest keyframes.

    Parameters
    ----------
    voxel_m
        Side of a voxel.
    """

    def __init__(self, config: CloudOdometryConfig, voxel_m: float) -> None:
        self._config, self._voxel_m = config, voxel_m
        self._keyframes: deque[FloatArray] = deque(maxlen=config.local_map_keyframes)
        self._map: LocalCloud | None = None

    def restart(self) -> None:
        """Forget the local map."""
        self._keyframes.clear()
        self._map = None

    def add_keyframe(self, points: FloatArray, pose: gtsam.Pose3) -> None:
        """Take points (N, 3), base frame, at ``T_odom_base`` into the local map."""
        if len(points):
            self._keyframes.append(moved(thinned(points, 0.5 * self._voxel_m), pose))
        self._map = None

    def match(self, points: FloatArray, guesses: Sequence[gtsam.Pose3]) -> MotionEstimate | None:
        """Pose of a scan (N, 3), base frame, in the odometry frame; None where nothing fits.

        Parameters
        ----------
        guesses
            Tried in this order until one fits.
        """
        if not self._keyframes:
            return None
        if self._map is None:
            self._map = LocalCloud(np.vstack(self._keyframes), self._voxel_m, self._config)
        scan = thinned(points, self._voxel_m)
        best: MotionEstimate | None = None
        for guess in guesses:
            aligned = self._map.align(scan, guess)
            if aligned is None:
                continue
            if best is None or aligned.motion.inlier_share > best.inlier_share:
                best = aligned.motion
            if best.inlier_share >= self._config.least_inlier_share:
                return best
        return None
