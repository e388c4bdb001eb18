"""Match a cloud that was recorded while the lidar rotated and the robot moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from slam.config.clouds import CloudOdometryConfig
from slam.estimates import MotionEstimate
from slam.matching.cloud_alignment import arms_of, levers
from slam.matching.cloud_points import base_points, deskewed
from slam.measurements import FloatArray, PointCloud
from slam.odometry.cloud_odometry import CloudOdometry
from slam.odometry.cloud_velocity import CloudVelocity

# A revolution is deskewed again if the matched motion moves its ends by more voxels than this.
_SKEWED_VOXELS, _DESKEWED_TIMES = 0.05, 3
# Angular rates tried if a cloud does not fit, as offsets from the previous rate.
_TURN_RATE_OFFSETS_RAD_S = (0.5, -0.5, 1.0, -1.0, 1.5, -1.5, 2.0, -2.0)


@dataclass(frozen=True)
class DeskewedCloud:
    """A cloud deskewed with a twist of the base.

    Attributes
    ----------
    points
        (N, 3) usable points, base frame.
    twist
        (6,) twist used for deskewing, if the times of points are known.
    """

    points: FloatArray
    twist: FloatArray

    @classmethod
    def of(cls, cloud: PointCloud, twist: FloatArray, config: CloudOdometryConfig) -> DeskewedCloud:
        """Deskew a cloud."""
        return cls(base_points(cloud, twist, config), twist)

    @cached_property
    def arms_m(self) -> FloatArray:
        """Return (3, 3) arms of the points, see `slam.matching.cloud_alignment.arms_of`."""
        return arms_of(self.points)


@dataclass(frozen=True, slots=True)
class _Trial:
    """A deskewed cloud, its match, and the share of its points on planes there."""

    turn: DeskewedCloud
    motion: MotionEstimate | None
    share: float


class TurnMatcher:
    """Finds pose and twist together if a cloud does not fit with the previous twist."""

    def __init__(
        self, config: CloudOdometryConfig, odometry: CloudOdometry, velocity: CloudVelocity, voxel_m: float
    ) -> None:
        self._config, self._odometry, self._velocity = config, odometry, velocity
        self._voxel_m = voxel_m

    def match(
        self,
        cloud: PointCloud,
        turn: DeskewedCloud,
        guesses: Sequence[gtsam.Pose3],
        before: gtsam.Pose3,
        step_s: float,
        *,
        turn_known: bool,
    ) -> MotionEstimate | None:
        """Return the pose of a cloud in the odometry frame; None if nothing fits.

        Parameters
        ----------
        turn
            The cloud deskewed with the first guess.
        guesses, before
            See `CloudOdometry.match`.
        step_s
            Time since ``before``.
        turn_known
            Whether a gyroscope measured the rotation: then no sudden rotation is searched for.
        """
        turned_rad = max(_TURN_RATE_OFFSETS_RAD_S) * step_s
        best = self._trial(turn, guesses, before, turned_rad)
        if not turn_known and (best.motion is None or not best.motion.converged):
            best = self._after_a_sudden_turn(cloud, best)
        for _ in range(_DESKEWED_TIMES):
            if best.motion is None or not self._is_skewed(cloud, best.turn, best.motion):
                break
            place = pose_of(best.motion)
            redone = DeskewedCloud.of(cloud, self._velocity.at(place, cloud.stamp_s), self._config)
            better = self._trial(redone, [place])
            if better.share <= best.share:
                break
            best = better
        return best.motion

    def fitted(self, cloud: PointCloud, turn: DeskewedCloud, pose: gtsam.Pose3) -> DeskewedCloud:
        """Deskew the first cloud, before which nothing shows a twist, by the yaw rate that fits best."""
        lever_m = np.linalg.norm(turn.arms_m[:, 2])
        step = 2.0 * _SKEWED_VOXELS * self._voxel_m / (0.5 * np.ptp(np.asarray(cloud.times_s)) * lever_m)
        for _ in range(_DESKEWED_TIMES):
            twists = turn.twist + np.outer([-step, 0.0, step], np.eye(6)[2])
            tried = (DeskewedCloud.of(cloud, twist, self._config) for twist in twists)
            fits = [self._trial(turned, [pose]).motion for turned in tried]
            less, here, more = (np.nan if fit is None else fit.residual_m**2 for fit in fits)
            bend = less - 2.0 * here + more
            if not bend > 0.0:
                break
            # The vertex of the parabola through the three.
            share = 0.5 * float(np.clip((less - more) / bend, -2.0, 2.0))
            turn = DeskewedCloud.of(cloud, twists[1] + share * (twists[2] - twists[1]), self._config)
            if abs(share) < 1.0:
                break
        return turn

    def _trial(
        self,
        turn: DeskewedCloud,
        guesses: Sequence[gtsam.Pose3],
        before: gtsam.Pose3 | None = None,
        turned_rad: float = 0.0,
    ) -> _Trial:
        """Match a deskewed cloud."""
        scan = self._odometry.thinned(turn.points)
        motion = self._odometry.match(scan, guesses, before, turned_rad)
        share = 0.0 if motion is None else self._odometry.agreement(scan, pose_of(motion))
        return _Trial(turn, motion, share)

    def _after_a_sudden_turn(self, cloud: PointCloud, first: _Trial) -> _Trial:
        """Return the best match of a robot that may have started or stopped rotating suddenly."""
        tried = []
        for offset_rad_s in _TURN_RATE_OFFSETS_RAD_S:
            twist = first.turn.twist + np.array([0.0, 0.0, offset_rad_s, 0.0, 0.0, 0.0])
            start = self._velocity.carry_on(twist, cloud.stamp_s)
            if start is None:
                return first
            turned = DeskewedCloud.of(cloud, twist, self._config)
            scan = self._odometry.thinned(turned.points)
            pose = self._odometry.nearby(scan, start)
            tried.append((self._odometry.agreement(scan, pose), turned, pose))
        _, turned, pose = max(tried, key=lambda trial: trial[0])
        return max(first, self._trial(turned, [pose]), key=lambda trial: trial.share)

    def _is_skewed(self, cloud: PointCloud, turn: DeskewedCloud, motion: MotionEstimate) -> bool:
        """Return whether the match has another twist than the one used for deskewing."""
        if cloud.times_s is None or not deskewed(cloud, self._config):
            return False
        offset = self._velocity.at(pose_of(motion), cloud.stamp_s) - turn.twist
        turned_m, moved_m = np.linalg.norm((levers(turn.arms_m) @ offset).reshape(2, 3), axis=1)
        return bool(0.5 * np.ptp(cloud.times_s) * (turned_m + moved_m) > _SKEWED_VOXELS * self._voxel_m)


def pose_of(motion: MotionEstimate) -> gtsam.Pose3:
    """Return the 3D pose of a match."""
    assert isinstance(motion.T_reference_base, gtsam.Pose3)
    return motion.T_reference_base
