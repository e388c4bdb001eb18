"""Scan by scan motion: predictions with learned uncertainty, and the lidar match that checks them.

Cameras, wheel odometry and constant velocity predict where a scan was taken; the lidar match measures it.
Each prediction has its claimed covariance, scaled by what recent matches have shown. If a camera or the
wheels contradict a match, it must be more likely than the predicted pose, according to the objects of the
scan and to all predictions, which have heavy tails (Student's t with three degrees of freedom). It must be
far more likely; if neither pose is, the result is marked as disputed.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion.estimation import gate
from fusion.time_alignment import GAP_S
from slam.config.stages import MatchConfig, PredictionConfig
from slam.estimates import MotionEstimate
from slam.matching.match_covariance import OPEN_M
from slam.matching.motion import Motion, log_likelihood
from slam.matching.planar import between, compose, wrap
from slam.matching.scan_points import ScanPoints
from slam.measurements import FloatArray, row_from_pose2
from slam.odometry.constant_velocity import Velocity, repeated
from slam.odometry.gyro_yaw import GyroMoment, YawGyro
from slam.odometry.lidar_odometry import LidarOdometry
from slam.odometry.predictor import LEAST_SHARE, Predictor
from slam.odometry.tracked_scan import TrackedScan
from slam.odometry.wheel_tracker import SHORTEST_STEP_S, WheelMoment, WheelTracker, thrown_aside

# Sigmas between a scan and another sensor if both are correct: x, y, yaw.
_SENSOR_FLOOR = np.diag([0.01, 0.01, 0.008]) ** 2
# An object of a scan counts once: with any number of beams, its evidence is at most this (nats). Where
# it fits while the area at the other pose is unknown, this may be by chance: rooms look alike.
_MOST_AN_OBJECT = np.array([[5.0], [1.0]])
# Matches with small errors in the same direction at every scan contradict the wheels over this time.
_WINDOW_S = 1.0
# Only a match with this share of inliers may judge a predictor.
_JUDGE_INLIER_SHARE = 0.8


class MotionTracker:
    """Predict the pose of each scan, match it, and update the velocity."""

    def __init__(
        self,
        odometry: LidarOdometry,
        wheels: WheelTracker | None,
        config: PredictionConfig,
        match: MatchConfig,
        gyro: YawGyro | None = None,
    ) -> None:
        self._odometry = odometry
        self._wheels, self._gyro = wheels, gyro
        self._config = config
        self._noise = match
        self._by_wheels = Predictor(config.memory_scans, LEAST_SHARE)
        self._by_velocity = Predictor(config.memory_scans, LEAST_SHARE if wheels is None else 1.0)
        self._by_camera = Predictor(config.memory_scans)
        self._recent: deque[tuple[float, TrackedScan]] = deque()
        self._by_window: list[Motion] = []
        self._last: TrackedScan | None = None
        self._stamp_s = 0.0
        self._velocity = Velocity()
        # Sums of squared distances, rotations and times, for its usual speed.
        self._squares = np.zeros(3)
        # Pose by the velocity if nothing else predicts it, and the time for which it was the only predictor.
        self._blind: FloatArray | None = None
        self._blind_s = 0.0

    def wheel_motion(
        self,
        begun: WheelMoment | None,
        ended: WheelMoment | None,
        elapsed_s: float,
        dispute: FloatArray | None = None,
    ) -> Motion | None:
        """Return the wheel motion with learned uncertainty; None if the wheels measured nothing.

        ``dispute`` (3, 3) is added to the claimed covariance, and is rescaled too.
        """
        step = None if self._wheels is None else self._wheels.motion(begun, ended, elapsed_s)
        if self._wheels is None or step is None or begun is None or ended is None:
            return None
        claimed = self._wheels.covariance(step) + (0.0 if dispute is None else dispute)
        motion = self._by_wheels.rescaled(step, claimed).widened(self._wheels.on_top(step, begun, ended))
        return motion.widened(thrown_aside(motion))

    def gyro_turn(
        self, begun: TrackedScan, gyro: GyroMoment | None, *, chained: bool = False
    ) -> tuple[float, float] | None:
        """Return the rotation by the gyroscope since a scan and its variance, see `YawGyro.turn`."""
        return None if self._gyro is None else self._gyro.turn(begun.gyro, gyro, chained=chained)

    def track(self, points: ScanPoints | None, stamp_s: float, cameras: Sequence[Motion] = ()) -> TrackedScan:
        """Find the pose of the next scan; the first one is the origin of the odometry frame.

        Parameters
        ----------
        points
            Points of the scan; None without a scan: then the best prediction is the pose.
        cameras
            Motion since the last scan, measured by each camera.
        """
        wheels = self._wheels.moment(stamp_s, in_order=points is not None) if self._wheels else None
        gyro = self._gyro.moment(stamp_s) if self._gyro else None
        if self._last is None:
            tracked = TrackedScan(np.zeros(3), None, wheels, np.zeros((3, 3)), gyro)
        else:
            step_s = stamp_s - self._stamp_s
            guesses = self._predict(self._last, wheels, cameras, step_s, gyro)
            self._by_window = self._predict_by_window(stamp_s, wheels, gyro)
            motion, dispute = None, np.zeros((3, 3))
            if points is not None:
                motion, dispute = self._match(points, guesses, step_s, gyro)
            pose = guesses[0].pose if motion is None else self._fused(motion)
            tracked = TrackedScan(pose, motion, wheels, dispute, gyro)
            # Errors along a corridor are corrected at once at its end: this is no motion of the robot.
            if not (self._last.open and tracked.determined):
                self._learn_velocity(self._last, tracked, step_s)
        self._last = tracked
        self._stamp_s = stamp_s
        self._recent.append((stamp_s, tracked))
        return tracked

    def add_keyframe(self, points: ScanPoints, tracked: TrackedScan) -> None:
        """Add a tracked scan to the local map."""
        self._odometry.add_keyframe(points, tracked.pose)

    def _predict(
        self,
        last: TrackedScan,
        wheels: WheelMoment | None,
        cameras: Sequence[Motion],
        step_s: float,
        gyro: GyroMoment | None,
    ) -> list[Motion]:
        """Predict by cameras, wheels if plausible, and constant velocity: the most certain comes first.

        A dispute about the pose that they start from is added to the claimed covariance, and is rescaled too:
        an exact predictor is trusted through a dispute, or a person walking ahead would win at the next scan.
        """
        predictors = (self._by_camera, self._by_wheels, self._by_velocity)
        for predictor in predictors:
            predictor.guesses = []
        for camera in sorted(cameras, key=lambda camera: float(np.trace(camera.covariance))):
            covariance = camera.covariance + _SENSOR_FLOOR + last.dispute
            self._by_camera.predict(compose(last.pose, camera.pose), covariance)
        moved = self.wheel_motion(last.wheels, wheels, step_s, last.dispute)
        if moved is not None:
            self._by_wheels.guesses = [Motion(compose(last.pose, moved.pose), moved.covariance)]
        alone = moved is None and not cameras
        on = repeated(self._velocity.step, self._velocity.step_s, step_s, self._config, alone=alone)
        onward = compose(last.pose, on.pose)
        # After a long gap, it has no information: it would be one of many places that look alike.
        if alone or on.covariance[0, 0] <= OPEN_M**2:
            self._by_velocity.predict(onward, on.covariance + last.dispute)
        if alone and step_s > GAP_S:
            # By then, the robot may also stand still.
            self._by_velocity.predict(last.pose, on.covariance + last.dispute)
        for predictor in predictors:
            predictor.guesses = [self._turned(guess, last, gyro) for guess in predictor.guesses]
        self._blind = self._by_velocity.guesses[0].pose if alone else None
        guesses = [guess for predictor in predictors for guess in predictor.guesses]
        return sorted(guesses, key=Motion.volume)

    def _turned(self, guess: Motion, begun: TrackedScan, gyro: GyroMoment | None) -> Motion:
        """Return a pose corrected by the rotation of the gyroscope since a scan; unchanged without one."""
        turn = self.gyro_turn(begun, gyro)
        if turn is None:
            return guess
        looking = guess.looking(begun.pose[2] + turn[0], turn[1] + float(begun.dispute[2, 2]))
        return looking.widened(np.diag([0.0, 0.0, _SENSOR_FLOOR[2, 2]]))

    def _learn_velocity(self, last: TrackedScan, tracked: TrackedScan, step_s: float) -> None:
        """Learn from a step, except one that repeats the velocity, and the next, which corrects it."""
        step, measured = between(last.pose, tracked.pose), tracked.pose is not self._blind
        if measured and not self._blind_s and abs(step_s) > SHORTEST_STEP_S:
            if self._blind is None or tracked.motion is None:
                self._velocity.learn(step, step_s)
            else:
                self._velocity.follow(step, step_s, tracked.motion.weak_direction)
            if step_s <= GAP_S:
                self._squares += step[0] ** 2 + step[1] ** 2, step[2] ** 2, step_s**2
        self._blind_s = 0.0 if measured else self._blind_s + abs(step_s)
        if self._blind_s >= GAP_S:
            self._velocity.stop()

    def _predict_by_window(
        self, stamp_s: float, wheels: WheelMoment | None, gyro: GyroMoment | None
    ) -> list[Motion]:
        """Return the pose by the wheels since some time ago; nothing if the wheels measured nothing."""
        while self._recent and stamp_s - self._recent[0][0] > _WINDOW_S:
            self._recent.popleft()
        if len(self._recent) < 2:
            return []
        begun_s, begun = self._recent[0]
        moved = self.wheel_motion(begun.wheels, wheels, stamp_s - begun_s, begun.dispute)
        # Wheels that report no motion at all stand still or are dead.
        if moved is None or not np.count_nonzero(moved.pose):
            return []
        return [self._turned(Motion(compose(begun.pose, moved.pose), moved.covariance), begun, gyro)]

    def _match(
        self, points: ScanPoints, guesses: list[Motion], step_s: float, gyro: GyroMoment | None
    ) -> tuple[MotionEstimate | None, FloatArray]:
        """Match, decide contradictions, update the predictors; return the match and the dispute."""
        motion = self._odometry.match(points, guesses, alone=self._blind is not None)
        if motion is None:
            return None, np.zeros((3, 3))
        if (offset := self._other_way_round(points, motion, guesses)) is not None:
            return motion, np.outer(offset, offset)
        if (offset := self._another_corridor(motion, step_s)) is not None:
            return motion, np.outer(offset, offset)
        if (unseen := self._out_of_sight(motion, step_s, gyro)) is not None:
            return motion, unseen
        rivals = [
            *self._rivals(points, motion, self._contesting(step_s), guesses),
            *self._rivals(points, motion, self._by_window, self._by_window),
        ]
        log_odds, local, prediction = max(rivals, key=lambda rival: rival[0], default=(0.0, None, guesses[0]))
        if log_odds < -self._config.disputed_within:
            self._recent.clear()  # the wheels have slipped: their path until now is not usable
            rivals, motion = [], self._led_by_others(points, motion, guesses)
        if not rivals:
            self._judge(motion, gyro)
            return motion, np.zeros((3, 3))
        decided = log_odds > self._config.disputed_within
        by_camera = any(prediction is camera for camera in self._by_camera.guesses)
        if local is None and (decided or by_camera):
            guesses.insert(0, prediction)  # it is the pose
            return None, np.zeros((3, 3))
        matched = row_from_pose2(motion.T_reference_base)
        if local is None:
            # It fits at the only pose where it was matched, and still may be elsewhere.
            offset = between(matched, prediction.pose)
            return motion, np.outer(offset, offset)
        if any(prediction is guess for guess in self._by_window):
            self._follow_the_wheels()
        if decided:
            return local, np.zeros((3, 3))
        offset = between(matched, row_from_pose2(local.T_reference_base))
        return local, np.outer(offset, offset)

    def _other_way_round(
        self, points: ScanPoints, motion: MotionEstimate, guesses: list[Motion]
    ) -> FloatArray | None:
        """Return the offset from a match in a corridor to the reversed pose; None if that is impossible.

        After some time without a scan the robot may have turned around. If the pose is already in dispute,
        both directions are open, and the test is not repeated.
        """
        if not motion.degenerate or (self._last is not None and self._last.dispute.any()):
            return None
        matched = row_from_pose2(motion.T_reference_base)
        turned = compose(matched, np.array([0.0, 0.0, math.pi]))
        if not all(guess.holds(turned) for guess in guesses):
            return None
        local = self._odometry.match_near(points, turned)
        if local is None or local.inlier_share < self._noise.least_inlier_share:
            return None
        return between(matched, row_from_pose2(local.T_reference_base))

    def _another_corridor(self, motion: MotionEstimate, step_s: float) -> FloatArray | None:
        """Return the offset from a corridor match to the wheels' pose after a gap; None if plausible.

        Corridors look alike, and meet at right angles. If the wheels turned by more than half a right angle,
        and moved elsewhere, the robot may be in another one. A heading alone may be due to slip.
        """
        if not motion.degenerate or step_s <= GAP_S or not self._by_wheels.guesses:
            return None
        offset = between(row_from_pose2(motion.T_reference_base), self._by_wheels.guesses[0].pose)
        elsewhere = math.hypot(offset[0], offset[1]) > self._noise.search_half_width_m
        return offset if elsewhere and abs(offset[2]) > 0.25 * math.pi else None

    def _out_of_sight(
        self, motion: MotionEstimate, step_s: float, gyro: GyroMoment | None
    ) -> FloatArray | None:
        """Return the covariance (3, 3) of a match after an unmeasured gap; None if the gap was short.

        At its usual speed the robot has left the range of a match, and a match may be at a place that looks
        the same. Path and rotation are taken as uniform from none to twice the usual; a heading that the
        gyroscope confirms is kept as matched.
        """
        if self._by_camera.guesses or self._by_wheels.guesses or step_s <= GAP_S or not self._squares[2]:
            return None
        way2, turn2 = self._squares[:2] / self._squares[2] * step_s**2
        if way2 <= self._noise.search_half_width_m**2:
            return None
        turn = None if self._last is None else self.gyro_turn(self._last, gyro)
        if self._last is not None and turn is not None:
            error_rad = wrap(float(row_from_pose2(motion.T_reference_base)[2] - self._last.pose[2]) - turn[0])
            if error_rad**2 <= gate() * (turn[1] + float(motion.covariance[2, 2])):
                turn2 = 0.0
        return np.diag([way2, way2, min(turn2, math.pi**2)]) / 3.0

    def _contesting(self, step_s: float) -> list[Motion]:
        """Return the predictions that may contradict a match.

        Constant velocity is no measurement. Only where nothing else measures may it contradict a match that
        follows a determined one: the robot cannot have accelerated so much.
        """
        measured = [*self._by_camera.guesses, *self._by_wheels.guesses]
        if measured or step_s > GAP_S or self._last is None or not self._last.determined:
            return measured
        return self._by_velocity.guesses[:1]

    def _rivals(
        self, points: ScanPoints, motion: MotionEstimate, contesting: list[Motion], asked: list[Motion]
    ) -> list[tuple[float, MotionEstimate | None, Motion]]:
        """Return log-odds against a match, and the scan fixed at it, for predictions it contradicts.

        Predictions are compared without the match's covariance: a wrong match may claim a small one. Only
        those that start at the same pose are used. A camera needs no scan: it also measures the rotation, and
        a person walking ahead turns with the robot.
        """
        matched, rivals = row_from_pose2(motion.T_reference_base), []
        for prediction in contesting:
            if prediction.holds(matched):
                continue
            rival, local = prediction, None
            if not any(prediction is camera for camera in self._by_camera.guesses):
                local = self._odometry.match_near(points, prediction.pose)
                if local is not None and local.inlier_share < self._noise.least_inlier_share:
                    local = None
                if local is not None:
                    rival = Motion(row_from_pose2(local.T_reference_base), np.zeros((3, 3)))
            log_odds = log_likelihood(asked, rival.pose) - log_likelihood(asked, matched)
            rivals.append((log_odds - self._evidence(points, motion, rival), local, prediction))
        return rivals

    def _led_by_others(
        self, points: ScanPoints, motion: MotionEstimate, guesses: list[Motion]
    ) -> MotionEstimate:
        """Match without the guesses that were refuted: one of them led the match along a corridor."""
        matched = Motion(row_from_pose2(motion.T_reference_base), motion.covariance)
        others = [guess for guess in guesses if guess.agrees(matched)]
        if not (motion.degenerate and others) or others[0] is guesses[0]:
            return motion
        return self._odometry.match(points, others) or motion

    def _follow_the_wheels(self) -> None:
        """Assume that the last part of the path is as the wheels say: the matches are still misled."""
        begun = self._recent[0][1]
        for n, (stamp_s, tracked) in enumerate(self._recent):
            if begun.wheels is not None and tracked.wheels is not None:
                pose = compose(begun.pose, between(begun.wheels.pose, tracked.wheels.pose))
                self._recent[n] = stamp_s, replace(tracked, pose=pose, dispute=begun.dispute)

    def _evidence(self, points: ScanPoints, motion: MotionEstimate, rival: Motion) -> float:
        """Return the log-likelihood ratio of two poses: about the difference of Geman-McClure costs."""
        residual_m = max(motion.residual_m, self._noise.minimal_residual_m)
        scale = 0.5 * (0.5 * self._noise.cell_m / residual_m) ** 2
        objects = scale * self._odometry.evidence(points, row_from_pose2(motion.T_reference_base), rival)
        return float(np.clip(objects, -_MOST_AN_OBJECT, _MOST_AN_OBJECT).sum())

    def _fused(self, motion: MotionEstimate) -> FloatArray:
        """Fuse match and most certain camera by covariance: the camera measures along a corridor."""
        matched = Motion(row_from_pose2(motion.T_reference_base), motion.covariance)
        if not self._by_camera.guesses or not matched.agrees(self._by_camera.guesses[0]):
            return matched.pose
        camera = self._by_camera.guesses[0]
        gain = matched.covariance @ np.linalg.inv(matched.covariance + camera.covariance)
        return compose(matched.pose, gain @ between(matched.pose, camera.pose))

    def _judge(self, motion: MotionEstimate, gyro: GyroMoment | None) -> None:
        """Update the predictors with a match that is certain."""
        last = self._last
        if motion.inlier_share < _JUDGE_INLIER_SHARE or motion.degenerate:
            return
        pose = row_from_pose2(motion.T_reference_base)
        if self._gyro is not None:
            self._gyro.learn(gyro, float(pose[2]), float(motion.covariance[2, 2]))
        if last is None:
            return
        for predictor in (self._by_camera, self._by_wheels, self._by_velocity):
            predictor.judge(pose)
        if self._wheels is None or last.open:
            return
        if not self._wheels.moved:
            self._wheels.dead |= math.hypot(pose[0], pose[1]) > self._noise.search_half_width_m
        if self._by_wheels.guesses and last.determined:
            guess = self._by_wheels.guesses[0].pose
            self._wheels.learn_scale(between(last.pose, guess), between(last.pose, pose))
