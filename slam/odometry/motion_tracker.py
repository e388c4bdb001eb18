"""Scan by scan motion: predictors that must prove themselves, and the lidar match that judges them.

Neither the wheels nor a match is sure alone. Each predictor (wheels, constant velocity) is scored by the
matches; the better one starts the next match, and a match that contradicts it wildly must fit much better
than the scan does at the predicted pose.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from slam.config.stages import MatchConfig, PredictionConfig
from slam.matching.planar import between, compose
from slam.matching.scan_points import ScanPoints
from slam.measurements import FloatArray, MotionEstimate, row_from_pose2
from slam.odometry.lidar_odometry import Guess, LidarOdometry
from slam.odometry.wheel_tracker import WheelTracker
from slam.vision.planar_motion import WitnessedMotion

# A velocity is carried over at most this many times the step that it was measured over.
_GREATEST_STRETCH = 3.0
# One wild step says no more about a predictor than this many times its variance.
_GREATEST_SURPRISE = 10.0
# Wheels whose doubt is this much greater than constant velocity's are no longer asked first.
_WHEELS_LOSE_AT = 3.0
# What scan and camera differ by though both are right: x, y, yaw.
_CAMERA_FLOOR = np.array([0.01, 0.01, 0.008])
# Squared sigmas up to which a match and a camera tell the same (three degrees of freedom, 99.9 %).
_AGREE = 16.0
# So many that agree with each other are believed against a match.
_WITNESSES = 2
# An object of a scan is one witness: however many beams it catches, it says no more than this (nats).
_MOST_AN_OBJECT = 5.0
# Wheels that did well of late are taken to be surer of the way, but not of the turn, than they claim: a slip
# of time turns a robot that moves straight on. By no more than this share of the variance.
_LEAST_SHARE = 0.02
# Matches that err a little at every scan, all the same way, contradict the wheels' way over this time.
_WINDOW_S = 1.0
# Only a match that this share of the points agrees with may judge a predictor.
_JUDGE_INLIER_SHARE = 0.8


@dataclass(frozen=True, slots=True)
class TrackedScan:
    """Where a scan was taken, in the odometry frame.

    Attributes
    ----------
    pose
        (3,) x, y, yaw of the base.
    motion
        The lidar match; None where nothing fitted and the pose is dead reckoning.
    wheel_pose
        (3,) pose by the wheels alone at the scan's stamp, odom frame; None without wheels.
    dispute
        (3, 3) covariance that match and wheels both get on top where they contradict each other and the
        scan does not say clearly who is right; zero otherwise.
    """

    pose: FloatArray
    motion: MotionEstimate | None
    wheel_pose: FloatArray | None
    dispute: FloatArray

    @property
    def sure(self) -> bool:
        """Whether the lidar matched and nothing contradicts it; the first scan is the origin, and sure."""
        return not self.dispute.any() and (self.motion is not None or not self.pose.any())


class _Predictor:
    """How far a kind of prediction can be trusted, learned from the matches.

    Parameters
    ----------
    memory_scans
        Scans over which it is judged.
    least_share
        Share of the claimed variance of the way that it may be taken to have; 1 to believe no less than all.
    """

    def __init__(self, memory_scans: float, least_share: float = 1.0) -> None:
        self._rate = 1.0 / memory_scans
        self._least_share = least_share
        self._share = 1.0
        self.doubt = 1.0
        self.guess: Guess | None = None

    def predict(
        self, pose: FloatArray, covariance: FloatArray, dispute: FloatArray, swing_m: float = 0.0
    ) -> None:
        """Expect a pose (3,) with a covariance (3, 3) as claimed, rescaled by what was learned so far.

        The dispute (3, 3) about the pose that it starts from comes on top, rescaled too: who proved exact
        is believed through a dispute too, or whoever walks ahead would win at the next scan.
        """
        self.guess = self.rescaled(pose, covariance + dispute, swing_m)

    def rescaled(self, pose: FloatArray, covariance: FloatArray, swing_m: float = 0.0) -> Guess:
        """A pose (3,) with a covariance (3, 3) as claimed, rescaled by what was learned so far.

        ``swing_m`` is a sigma of the way that whoever proved exact on the straight has all the same.
        """
        scale = np.sqrt(self.doubt * np.array([self._share, self._share, 1.0]))
        swing = np.diag([swing_m**2, swing_m**2, 0.0])
        return Guess(pose, covariance * np.outer(scale, scale) + swing)

    def judge(self, pose: FloatArray) -> None:
        """Learn from where the scan was really taken: the mean of the normalised squared error."""
        if self.guess is None:
            return
        squares = self.doubt * _squared_sigmas(self.guess, pose) / 3.0
        average = self.doubt + self._rate * (min(squares, _GREATEST_SURPRISE * self.doubt) - self.doubt)
        self.doubt = max(1.0, average)
        way = between(self.guess.pose, pose)[:2]
        squares = self._share * float(way @ np.linalg.solve(self.guess.covariance[:2, :2], way)) / 2.0
        average = self._share + self._rate * (min(squares, _GREATEST_SURPRISE * self._share) - self._share)
        self._share = min(max(self._least_share, average), 1.0)


class MotionTracker:
    """Predicts each scan's pose, matches it, and keeps the velocity."""

    def __init__(
        self,
        odometry: LidarOdometry,
        wheels: WheelTracker | None,
        config: PredictionConfig,
        match: MatchConfig,
    ) -> None:
        self._odometry = odometry
        self._wheels = wheels
        self._config = config
        self._noise = match
        self._by_wheels = _Predictor(config.memory_scans, _LEAST_SHARE)
        self._by_velocity = _Predictor(config.memory_scans)
        self._by_camera = _Predictor(config.memory_scans)
        self._witnesses = 0
        self._recent: deque[tuple[float, TrackedScan]] = deque()
        self._window_guess: Guess | None = None
        self._last: TrackedScan | None = None
        self._stamp_s = 0.0
        self._velocity_step = np.zeros(3)
        self._velocity_step_s = 0.0

    @property
    def wheel_doubt(self) -> float:
        """Factor on the wheels' variance, 1 or more, that the matches of late ask for."""
        return self._by_wheels.doubt

    @property
    def camera_doubt(self) -> float:
        """Factor on the cameras' variance, 1 or more, that the matches of late ask for."""
        return self._by_camera.doubt

    def track(
        self, points: ScanPoints | None, stamp_s: float, camera: WitnessedMotion | None = None
    ) -> TrackedScan:
        """Pose of the next scan; the first one is the origin of the odometry frame.

        Parameters
        ----------
        points
            None where there is no scan: the best prediction is the pose then.
        camera
            Motion since the last scan as a camera measured it.
        """
        wheel_pose = self._wheels.pose_at(stamp_s) if self._wheels else None
        if self._last is None:
            tracked = TrackedScan(np.zeros(3), None, wheel_pose, np.zeros((3, 3)))
        else:
            step_s = stamp_s - self._stamp_s
            guesses = self._predict(self._last, wheel_pose, camera, step_s)
            self._window_guess = self._by_window(stamp_s, wheel_pose)
            motion, dispute = None, np.zeros((3, 3))
            if points is not None:
                motion, dispute = self._match(points, guesses)
            pose = guesses[0].pose if motion is None else self._fused(motion)
            tracked = TrackedScan(pose, motion, wheel_pose, dispute)
            self._velocity_step = between(self._last.pose, pose)
            self._velocity_step_s = step_s
        self._last = tracked
        self._stamp_s = stamp_s
        self._recent.append((stamp_s, tracked))
        return tracked

    def add_keyframe(self, points: ScanPoints, tracked: TrackedScan) -> None:
        """Let the local map grow by a tracked scan."""
        self._odometry.add_keyframe(points, tracked.pose)

    def _predict(
        self, last: TrackedScan, wheel_pose: FloatArray | None, camera: WitnessedMotion | None, step_s: float
    ) -> list[Guess]:
        """By camera, by wheels, if a robot can move so, and by constant velocity, while they prove it."""
        self._by_camera.guess = self._by_wheels.guess = None
        if camera is not None:
            covariance = camera.covariance + np.diag(_CAMERA_FLOOR**2)
            self._by_camera.predict(compose(last.pose, camera.motion), covariance, last.dispute)
            self._witnesses = camera.witnesses
        if self._wheels is not None and wheel_pose is not None and last.wheel_pose is not None:
            step = between(last.wheel_pose, wheel_pose)
            if self._wheels.plausible(step, step_s):
                covariance = self._wheels.covariance(step)
                swing_m = self._wheels.swing_m(step)
                self._by_wheels.predict(compose(last.pose, step), covariance, last.dispute, swing_m)
        stretch = 1.0
        if step_s > 0.0 and self._velocity_step_s > 0.0:
            stretch = min(step_s / self._velocity_step_s, _GREATEST_STRETCH)
        step = self._velocity_step * stretch
        covariance = self._velocity_covariance(step)
        self._by_velocity.predict(compose(last.pose, step), covariance, last.dispute)
        predictors = [self._by_wheels, self._by_velocity]
        if self._by_wheels.doubt > _WHEELS_LOSE_AT * self._by_velocity.doubt:
            predictors.reverse()
        # A camera outdoes the others until it contradicts the matches for long.
        first = self._by_camera.doubt <= _WHEELS_LOSE_AT * predictors[0].doubt
        predictors.insert(0 if first else len(predictors), self._by_camera)
        return [predictor.guess for predictor in predictors if predictor.guess is not None]

    def _by_window(self, stamp_s: float, wheel_pose: FloatArray | None) -> Guess | None:
        """Where the wheels say that the robot went since a while ago; None where they do not tell."""
        while self._recent and stamp_s - self._recent[0][0] > _WINDOW_S:
            self._recent.popleft()
        if self._wheels is None or wheel_pose is None or len(self._recent) < 2:
            return None
        begun_s, begun = self._recent[0]
        if begun.wheel_pose is None:
            return None
        step = between(begun.wheel_pose, wheel_pose)
        # Wheels that report no motion at all stand still or are dead.
        if not step.any() or not self._wheels.plausible(step, stamp_s - begun_s):
            return None
        covariance = self._wheels.covariance(step) + begun.dispute
        return self._by_wheels.rescaled(compose(begun.pose, step), covariance, self._wheels.swing_m(step))

    def _velocity_covariance(self, step: FloatArray) -> FloatArray:
        """Covariance (3, 3) of a step (3,) that repeats the last one."""
        config = self._config
        sigma_m = config.velocity_floor_m + config.velocity_share * math.hypot(step[0], step[1])
        sigma_rad = config.velocity_floor_rad + config.velocity_share * abs(float(step[2]))
        return np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])

    def _match(self, points: ScanPoints, guesses: list[Guess]) -> tuple[MotionEstimate | None, FloatArray]:
        """Match, judge the predictors by it, settle a contradiction: the match and the dispute."""
        config = self._config
        motion = self._odometry.match(points, guesses)
        if motion is not None and self._outvoted(motion):
            return None, np.zeros((3, 3))
        contradicted = None if motion is None else self._contradicted(guesses[0], motion)
        if motion is None or contradicted is None:
            self._judge(motion)
            return motion, np.zeros((3, 3))
        for guess in guesses[1:]:
            other = self._odometry.match(points, [guess])
            if other is not None and other.fit > motion.fit:
                motion = other
        held = self._odometry.match_near(points, contradicted.pose)
        if self._contradicted(guesses[0], motion) is None or held is None:
            self._judge(motion)
            return motion, np.zeros((3, 3))
        # Log-likelihood ratio: what the scan says for the match, what a heavy tail (Student's t with three
        # degrees of freedom) says for the prediction.
        for_match = self._evidence(points, motion, held)
        for_prediction = sum(
            2.0 * math.log1p(_squared_sigmas(guess, row_from_pose2(motion.T_reference_base)) / 3.0)
            for guess in [contradicted, *guesses[1:]]
        )
        if for_match - for_prediction > config.disputed_within:
            self._recent.clear()  # the wheels have slipped: their way until now tells nothing
            self._judge(motion)
            return motion, np.zeros((3, 3))
        offset = between(row_from_pose2(motion.T_reference_base), row_from_pose2(held.T_reference_base))
        if for_prediction <= for_match:
            return motion, np.outer(offset, offset)
        if contradicted is self._window_guess:
            self._follow_the_wheels()
        return held, np.outer(offset, offset)

    def _follow_the_wheels(self) -> None:
        """Take it that the last while went as the wheels say: what led the matches astray leads on."""
        begun = self._recent[0][1]
        for n, (stamp_s, tracked) in enumerate(self._recent):
            if begun.wheel_pose is not None and tracked.wheel_pose is not None:
                pose = compose(begun.pose, between(begun.wheel_pose, tracked.wheel_pose))
                self._recent[n] = stamp_s, replace(tracked, pose=pose, dispute=begun.dispute)

    def _contradicted(self, guess: Guess, motion: MotionEstimate) -> Guess | None:
        """The best guess, or else the wheels' over the last while, if a match contradicts it."""
        for one in (guess, self._window_guess):
            if one is not None and self._sigmas(one, motion) > self._config.surprise_sigmas:
                return one
        return None

    def _outvoted(self, motion: MotionEstimate) -> bool:
        """Whether two witnesses (two cameras, or a camera and the wheels) agree and contradict the match.

        A lidar that sees little but the person who walks before it matches that person very well.
        """
        camera, wheels = self._by_camera.guess, self._by_wheels.guess
        surprise = self._config.surprise_sigmas
        if camera is None or self._sigmas(camera, motion) <= surprise:
            return False
        # Wheels too unsure to contradict the match are no witness against it.
        agree = (
            wheels is not None
            and _apart(camera, wheels) <= surprise
            and self._sigmas(wheels, motion) > surprise
        )
        return self._witnesses + agree >= _WITNESSES

    def _evidence(self, points: ScanPoints, motion: MotionEstimate, held: MotionEstimate) -> float:
        """Log-likelihood of a match over a held one: about the difference of their Geman-McClure costs."""
        residual_m = max(motion.residual_m, self._noise.minimal_residual_m)
        scale = 0.5 * (0.5 * self._noise.cell_m / residual_m) ** 2 / self._noise.correlated_beams
        poses = (row_from_pose2(estimate.T_reference_base) for estimate in (motion, held))
        objects = scale * self._odometry.evidence(points, *poses)
        return float(np.clip(objects, -_MOST_AN_OBJECT, _MOST_AN_OBJECT).sum())

    def _fused(self, motion: MotionEstimate) -> FloatArray:
        """Match and camera, each by its covariance: a corridor is as long as it looks."""
        matched = row_from_pose2(motion.T_reference_base)
        guess = self._by_camera.guess
        if guess is None:
            return matched
        offset = between(matched, guess.pose)
        gain = motion.covariance @ np.linalg.inv(motion.covariance + guess.covariance)
        if offset @ np.linalg.solve(motion.covariance + guess.covariance, offset) > _AGREE:
            return matched
        return compose(matched, gain @ offset)

    def _judge(self, motion: MotionEstimate | None) -> None:
        """Let a match that is sure score the predictors."""
        if motion is not None and motion.inlier_share >= _JUDGE_INLIER_SHARE and not motion.degenerate:
            pose = row_from_pose2(motion.T_reference_base)
            self._by_camera.judge(pose)
            self._by_wheels.judge(pose)
            self._by_velocity.judge(pose)

    @staticmethod
    def _sigmas(guess: Guess, motion: MotionEstimate) -> float:
        """Distance of a match from a prediction in its standard deviations."""
        return math.sqrt(_squared_sigmas(guess, row_from_pose2(motion.T_reference_base)))


def _apart(one: Guess, other: Guess) -> float:
    """Distance of two guesses in their common standard deviations."""
    offset = between(one.pose, other.pose)
    return math.sqrt(float(offset @ np.linalg.solve(one.covariance + other.covariance, offset)))


def _squared_sigmas(guess: Guess, pose: FloatArray) -> float:
    """Squared Mahalanobis distance of a pose (3,) from a guess."""
    offset = between(guess.pose, pose)
    return float(offset @ np.linalg.solve(guess.covariance, offset))
