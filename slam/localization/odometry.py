"""Motion of the robot during localisation, without its cameras, and when this odometry breaks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
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
    ImuReading,
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
from slam.odometry.imu_tracker import ImuTracker, UnfitImuError
from slam.odometry.motion_tracker import MotionTracker
from slam.odometry.surfel_odometry import SurfelOdometry
from slam.odometry.tracked_scan import TrackedScan
from slam.odometry.wheel_tracker import WheelTracker

# So many consecutive unmatched readings end the odometry: wheels do not detect kidnapping.
_LOST_READINGS = 3
# A longer time between two readings is a gap with unknown motion.
_LONG_GAP_S = 5.0


class OdometryStep(NamedTuple):
    """Pose of a reading by odometry.

    Attributes
    ----------
    pose
        ``T_odom_base``; a new odometry frame starts if the motion is unknown.
    moved
        Motion since the last reading; None if unknown.
    """

    pose: Pose
    moved: Measured | None


class ScanOdometry:
    """Odometry by matching scans to recent scans, with wheels if there are any."""

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
        # Sums of squared distances, rotations and times of matched steps, for the usual speed.
        self._squares = np.zeros(3)
        self._turns = Turns()

    def add_wheels(self, reading: WheelOdometry) -> None:
        """Add a wheel reading."""
        if self._wheels is not None:
            self._wheels.add(reading)
            self._silent_s = max(self._silent_s, abs(reading.stamp_s - self._wheels_s))
            self._wheels_s = reading.stamp_s

    def expected_step(self, stamp_s: float) -> Measured:
        """Return the motion from the last scan to one at a stamp, before matching.

        It is measured by the wheels; without them, the last motion is repeated.
        """
        step_s = stamp_s - self._stamp_s
        if self._wheels is not None and self._last is not None:
            moved = self._tracker.wheel_motion(self._last.wheels, self._wheels.moment(stamp_s), step_s)
            if moved is not None:
                return Measured(pose2_from_row(moved.pose), moved.covariance)
        return self._repeated(step_s)

    def _repeated(self, step_s: float) -> Measured:
        """Repeat the last motion for another time, with the steadiness that was measured.

        Its undetermined directions stay undetermined, and a standing robot may move at its usual speed.
        """
        steady_s, config = max(GAP_S, self._step_s), self._config.prediction
        step = row_from_pose2(self._step.pose)
        motion = repeated(step, self._step_s, step_s, config, steady_s=steady_s)
        usual = self._squares[:2] / max(self._squares[2], TINY) * step_s**2
        faster = np.maximum(usual - [motion.pose[:2] @ motion.pose[:2], motion.pose[2] ** 2], 0.0)
        unknown = stretch(step_s, self._step_s) ** 2 * self._step.covariance + np.diag(faster[[0, 0, 1]])
        return Measured(pose2_from_row(motion.pose), motion.covariance + unknown)

    def add(self, view: ScanView) -> OdometryStep:
        """Add a scan."""
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
        """Start a new odometry frame."""
        config = self._config
        odometry = SurfelOdometry(config)
        return MotionTracker(odometry, self._wheels, config.prediction, config.match)

    def _is_cut(self, last: TrackedScan, tracked: TrackedScan, elapsed_s: float) -> bool:
        """Return whether the motion of the robot is unknown."""
        if tracked.motion is not None:
            self._unmatched = 0
            return False
        self._unmatched += 1
        if self._wheels is None or last.wheels is None or tracked.wheels is None:
            return True
        measured = self._wheels.motion(last.wheels, tracked.wheels, elapsed_s) is not None
        silent_s = max(self._silent_s, abs(self._stamp_s - self._wheels_s))
        # A path that the wheels did not measure is a guess, with its covariance.
        guessed = tracked.wheels.guessed_m > last.wheels.guessed_m
        gap = min(elapsed_s, silent_s) > _LONG_GAP_S and not guessed
        return not measured or gap or self._unmatched >= _LOST_READINGS

    def _fused(self, row: FloatArray, tracked: TrackedScan, expected: Measured, elapsed_s: float) -> Measured:
        """Fuse a match and the prediction to a step (3,) by covariance: wheels measure along a corridor.

        After a gap a match may be at another place that looks the same: with wheels, it must agree with them,
        be undisputed, and the wheels must be accurate enough. Without a gap, wheels that contradict the match
        have slipped; the last motion is then repeated in directions that the match leaves open.
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
    """Odometry by matching clouds to recent clouds, with wheels and an IMU if there are any.

    Attributes
    ----------
    unfit
        Why an IMU that contradicts the lidar is left out; empty without one.
    """

    def __init__(self, config: Config) -> None:
        self._config, self._guess = config, config.prediction
        self._wheels = WheelTracker(config.wheels) if config.sensors.wheels else None
        self.unfit = ""
        self._begin()
        self._last: TrackedCloud | None = None
        self._unmatched = 0
        self._stamp_s = 0.0

    def add_wheels(self, reading: WheelOdometry) -> None:
        """Add a wheel reading."""
        if self._wheels is not None:
            self._tracker.roll(reading.stamp_s, self._wheels.add(reading))

    def add_imu(self, reading: ImuReading) -> None:
        """Add a reading of the IMU, before the clouds whose revolution it covers."""
        if self._imu is not None:
            with self._imu_judged():
                self._tracker.hear(reading)

    def add(self, cloud: PointCloud) -> tuple[FloatArray, OdometryStep]:
        """Process a cloud; return its usable points (N, 3), base frame, deskewed, and its pose."""
        last, elapsed_s = self._last, cloud.stamp_s - self._stamp_s
        self._stamp_s = cloud.stamp_s
        gap = last is not None and not 0.0 <= elapsed_s <= _LONG_GAP_S
        tracked = None
        with self._imu_judged():
            tracked = None if gap else self._tracker.follow(cloud)
        if tracked is not None:
            first = last is None or tracked.motion is not None
            self._unmatched = 0 if first else self._unmatched + 1
        if tracked is None or self._unmatched >= _LOST_READINGS:
            self._begin()
            self._unmatched, last = 0, None
            tracked = self._tracker.follow(cloud)
        self._last = tracked
        return tracked.points, OdometryStep(tracked.pose, None if last is None else self._step(last, tracked))

    def _begin(self) -> None:
        """Start a new odometry frame."""
        self._imu = ImuTracker() if self._config.sensors.imu and not self.unfit else None
        self._tracker = CloudTracker(self._config, self._wheels, imu=self._imu)

    @contextmanager
    def _imu_judged(self) -> Iterator[None]:
        """Go on without an IMU that contradicts the lidar, in a new odometry frame."""
        try:
            yield
        except UnfitImuError as unfit:
            self.unfit = f"{unfit.args[0]} is left out: {unfit.args[1]}"
            self._last = None
            self._begin()

    def _step(self, last: TrackedCloud, tracked: TrackedCloud) -> Measured:
        """Return the motion between two clouds, both matched to the same recent clouds; or a guess."""
        step = last.pose.between(tracked.pose)
        if tracked.motion is None and self._imu is not None and (spread := self._imu.spread()) is not None:
            return Measured(step, spread)
        if tracked.motion is None:
            return Measured(step, diagonal(step, self._guess.velocity_floor, self._guess.velocity_floor))
        before = np.zeros((6, 6))
        if last.motion is not None:
            adjoint = step.inverse().AdjointMap()
            before = adjoint @ last.motion.covariance @ adjoint.T
        return Measured(step, np.asarray(before + tracked.motion.covariance))
