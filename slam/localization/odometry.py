"""Motion of the robot during localisation, from its lidar and wheels only, and when this odometry breaks."""

from __future__ import annotations

from typing import NamedTuple

import gtsam
import numpy as np

from fusion.estimation import TINY
from fusion.time_alignment import GAP_S
from slam.config import Config
from slam.localization.poses import Measured, diagonal, position_sigma_m, squared_mahalanobis
from slam.localization.scan_view import ScanView
from slam.matching.planar import between
from slam.measurements import (
    FloatArray,
    PointCloud,
    Pose,
    WheelOdometry,
    composed,
    pose2_from_row,
    row_from_pose2,
)
from slam.odometry.clock_learner import Turns
from slam.odometry.cloud_tracker import CloudTracker, TrackedCloud
from slam.odometry.constant_velocity import repeated, stretch
from slam.odometry.motion_tracker import MotionTracker
from slam.odometry.surfel_odometry import SurfelOdometry
from slam.odometry.tracked_scan import TrackedScan
from slam.odometry.wheel_tracker import WheelTracker

# So many readings in a row that match nothing cut the thread: wheels do not tell that a robot is kidnapped.
_LOST_READINGS = 3
# A longer time between two readings is a gap in which anything may have happened.
_LONG_GAP_S = 5.0


class OdometryStep(NamedTuple):
    """Where a reading was taken, by odometry.

    Attributes
    ----------
    pose
        ``T_odom_base``; the odometry frame begins anew where nobody knows the motion.
    moved
        Motion since the last reading; None if nobody knows it.
    """

    pose: Pose
    moved: Measured | None


class ScanOdometry:
    """Scan to recent scans, with wheels where there are any."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._wheels = WheelTracker(config.wheels) if config.sensors.wheels else None
        self._tracker = self._new_tracker()
        self._last: TrackedScan | None = None
        self._keyframe: TrackedScan | None = None
        self._unmatched = 0
        self._stamp_s = self._wheels_s = 0.0
        self._silent_s = 0.0
        self._step, self._step_s = Measured(gtsam.Pose2(), np.zeros((3, 3))), 0.0
        # Sums of squared ways, turns and times of the steps that matches told: how it moves as a rule.
        self._squares = np.zeros(3)
        self._turns = Turns()

    def add_wheels(self, reading: WheelOdometry) -> None:
        """Take a wheel reading."""
        if self._wheels is not None:
            self._wheels.add(reading)
            self._silent_s = max(self._silent_s, abs(reading.stamp_s - self._wheels_s))
            self._wheels_s = reading.stamp_s

    def expected_step(self, stamp_s: float) -> Measured:
        """Motion from the last scan to one at a stamp, before it is matched.

        By the wheels; as before, where they say nothing.
        """
        step_s = stamp_s - self._stamp_s
        if self._wheels is not None and self._last is not None:
            moved = self._tracker.wheel_motion(self._last.wheels, self._wheels.moment(stamp_s), step_s)
            if moved is not None:
                return Measured(pose2_from_row(moved.pose), moved.covariance)
        return self._repeated(step_s)

    def _repeated(self, step_s: float) -> Measured:
        """The last motion once more, for another time: as steady as it was while it was measured.

        What that did not tell is not told by repeating it, and who stands may go as fast as usual.
        """
        steady_s, config = max(GAP_S, self._step_s), self._config.prediction
        step = row_from_pose2(self._step.pose)
        motion = repeated(step, self._step_s, step_s, config, steady_s=steady_s)
        usual = self._squares[:2] / max(self._squares[2], TINY) * step_s**2
        faster = np.maximum(usual - [motion.pose[:2] @ motion.pose[:2], motion.pose[2] ** 2], 0.0)
        unknown = stretch(step_s, self._step_s) ** 2 * self._step.covariance + np.diag(faster[[0, 0, 1]])
        return Measured(pose2_from_row(motion.pose), motion.covariance + unknown)

    def add(self, view: ScanView) -> OdometryStep:
        """Take a scan."""
        expected = self.expected_step(view.stamp_s)
        tracked = self._tracker.track(view.points, view.stamp_s)
        last, begun_s = self._last, self._stamp_s
        elapsed_s, self._stamp_s = view.stamp_s - begun_s, view.stamp_s
        if last is not None and self._is_cut(last, tracked, elapsed_s):
            self._tracker, self._keyframe, self._unmatched = self._new_tracker(), None, 0
            tracked, last = self._tracker.track(view.points, view.stamp_s), None
        self._last = tracked
        moved = None
        if last is not None:
            step = between(last.pose, tracked.pose)
            moved = self._fused(step, tracked, expected, elapsed_s)
            if tracked.confident:
                self._turns.add_turn(begun_s, view.stamp_s, float(step[2]))
                if self._wheels is not None:
                    self._wheels.learn_clock(self._turns)
                if tracked.determined:
                    self._squares += step[0] ** 2 + step[1] ** 2, step[2] ** 2, elapsed_s**2
        self._silent_s = 0.0
        self._step = moved or Measured(gtsam.Pose2(), np.zeros((3, 3)))
        self._step_s = elapsed_s
        before, limits = self._keyframe, self._config.keyframes
        if before is None or limits.due(*between(before.pose, tracked.pose).tolist()):
            self._tracker.add_keyframe(view.points, tracked)
            self._keyframe = tracked
        return OdometryStep(pose2_from_row(tracked.pose), moved)

    def _new_tracker(self) -> MotionTracker:
        """A new odometry frame."""
        config = self._config
        odometry = SurfelOdometry(config)
        return MotionTracker(odometry, self._wheels, config.prediction, config.match)

    def _is_cut(self, last: TrackedScan, tracked: TrackedScan, elapsed_s: float) -> bool:
        """Whether nothing tells how the robot moved."""
        if tracked.motion is not None:
            self._unmatched = 0
            return False
        self._unmatched += 1
        if self._wheels is None or last.wheels is None or tracked.wheels is None:
            return True
        told = self._wheels.motion(last.wheels, tracked.wheels, elapsed_s) is not None
        silent_s = max(self._silent_s, abs(self._stamp_s - self._wheels_s))
        # A way that the wheels left out is a guess, with the covariance of one.
        guessed = tracked.wheels.guessed_m > last.wheels.guessed_m
        gap = min(elapsed_s, silent_s) > _LONG_GAP_S and not guessed
        return not told or gap or self._unmatched >= _LOST_READINGS

    def _fused(self, row: FloatArray, tracked: TrackedScan, expected: Measured, elapsed_s: float) -> Measured:
        """A step (3,) by match and expectation, by their covariances: wheels tell how long a corridor is.

        Past a gap a match may have found another place that looks the same: where there are wheels, it must
        agree with them, be beyond dispute, and they must tell the way well enough. Before one, wheels that
        contradict the match have slipped, and the robot goes on as before where the match does not tell.
        """
        past_gap = self._wheels is not None and elapsed_s > _LONG_GAP_S
        vague = position_sigma_m(expected) > self._config.localization.dead_reckoning_m
        if tracked.motion is None or (past_gap and (vague or tracked.dispute.any())):
            return expected
        matched = Measured(pose2_from_row(row), tracked.motion.covariance + tracked.dispute)
        gate = self._config.localization.gate_sigmas**2
        if squared_mahalanobis(matched, expected) > gate:
            if past_gap:
                return expected
            expected = self._repeated(elapsed_s)
            if squared_mahalanobis(matched, expected) > gate:
                return matched
        gain = matched.covariance @ np.linalg.inv(matched.covariance + expected.covariance)
        correction = pose2_from_row(gain @ between(row, row_from_pose2(expected.pose)))
        return Measured(composed(matched.pose, correction), matched.covariance - gain @ matched.covariance)


class CloudOdometry:
    """Cloud to recent clouds."""

    def __init__(self, config: Config) -> None:
        self._config, self._guess = config, config.prediction
        self._wheels = WheelTracker(config.wheels) if config.sensors.wheels else None
        self._tracker = CloudTracker(self._config, self._wheels)
        self._last: TrackedCloud | None = None
        self._unmatched = 0
        self._stamp_s = 0.0

    def add_wheels(self, reading: WheelOdometry) -> None:
        """Take a wheel reading."""
        if self._wheels is not None:
            self._wheels.add(reading)

    def add(self, cloud: PointCloud) -> tuple[FloatArray, OdometryStep]:
        """Take a cloud: its usable points (N, 3), base frame, deskewed, and where it was taken."""
        last, elapsed_s = self._last, cloud.stamp_s - self._stamp_s
        self._stamp_s = cloud.stamp_s
        gap = last is not None and not 0.0 <= elapsed_s <= _LONG_GAP_S
        tracked = None if gap else self._tracker.follow(cloud)
        if tracked is not None:
            first = last is None or tracked.motion is not None
            self._unmatched = 0 if first else self._unmatched + 1
        if tracked is None or self._unmatched >= _LOST_READINGS:
            self._tracker, self._unmatched, last = CloudTracker(self._config, self._wheels), 0, None
            tracked = self._tracker.follow(cloud)
        self._last = tracked
        return tracked.points, OdometryStep(tracked.pose, None if last is None else self._step(last, tracked))

    def _step(self, last: TrackedCloud, tracked: TrackedCloud) -> Measured:
        """Motion between two clouds, each matched to the same recent ones; or as good as a guess."""
        step = last.pose.between(tracked.pose)
        if tracked.motion is None:
            sigmas = self._guess.velocity_floor_m, self._guess.velocity_floor_rad
            return Measured(step, diagonal(step, *sigmas))
        before = np.zeros((6, 6))
        if last.motion is not None:
            adjoint = step.inverse().AdjointMap()
            before = adjoint @ last.motion.covariance @ adjoint.T
        return Measured(step, np.asarray(before + tracked.motion.covariance))
