"""Where in a map of clouds a scan may have been taken, by looks: scan contexts."""

from __future__ import annotations

import math
from collections.abc import Sequence

import gtsam
import numpy as np

from slam.config.localization import CloudLocalizationConfig
from slam.localization.known_clouds import KnownClouds
from slam.matching.cloud_points import thinned
from slam.matching.scan_context import SECTORS, ContextBank, scan_context
from slam.measurements import Float32Array, FloatArray

# How far a scan context reaches, in voxels.
_LOOKS_REACH = 80.0
# Of two guesses nearer in heading an alignment makes the same.
_SAME_RAD = 0.5
# Where else than at the robot a place may have been seen from, in units of `looks_beside_voxels`.
_BESIDE = np.array([(x, y, 0.0) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0)])


class CloudPlaces:
    """The scan contexts of all keyframes of a map."""

    def __init__(self, known: KnownClouds, voxel_m: float, config: CloudLocalizationConfig) -> None:
        self._poses = known.poses
        self._voxel_m, self._config = voxel_m, config
        clouds = (thinned(known.clouds.points(key), voxel_m) for key in range(len(known.clouds)))
        self._bank = ContextBank([self._context(points) for points in clouds])

    def propose(self, points: FloatArray) -> list[gtsam.Pose3]:
        """``T_map_base`` of places that look as a thinned scan (N, 3), base frame, does; the likest first.

        A context changes with the place that it is seen from, and the robot may be beside the way that was
        mapped: the scan is looked at from beside the robot as well.
        """
        beside_m = _BESIDE * self._config.looks_beside_voxels * self._voxel_m
        unlike = np.array([self._bank.unlikeness(self._context(points - offset)) for offset in beside_m])
        turns, least = unlike.argmin(axis=2), unlike.min(axis=2)
        chosen: list[gtsam.Pose3] = []
        for flat in np.argsort(least, axis=None, kind="stable").tolist():
            if len(chosen) == self._config.looks:
                break
            side, key = divmod(flat, len(self._poses))
            turn = gtsam.Rot3.Yaw(2.0 * math.pi * float(turns[side, key]) / SECTORS)
            # The lidar of the keyframe stands where the offset is.
            pose = self._poses[key].compose(gtsam.Pose3(turn, -turn.rotate(beside_m[side])))
            if not any(self._same(pose, other) for other in chosen):
                chosen.append(pose)
        return chosen

    def apart(self, guesses: Sequence[gtsam.Pose3]) -> list[gtsam.Pose3]:
        """Those of poses that are not the same as an earlier one."""
        kept: list[gtsam.Pose3] = []
        for guess in guesses:
            if not any(self._same(guess, other) for other in kept):
                kept.append(guess)
        return kept

    def _context(self, points: FloatArray) -> Float32Array:
        """The scan context of a thinned cloud (N, 3)."""
        return scan_context(points, _LOOKS_REACH * self._voxel_m)

    def _same(self, one: gtsam.Pose3, other: gtsam.Pose3) -> bool:
        """Whether an alignment from one finds the same as from the other."""
        step = one.between(other)
        near = float(np.linalg.norm(step.translation())) < self._config.looks_apart_voxels * self._voxel_m
        return near and abs(step.rotation().yaw()) < _SAME_RAD
