"""A tracker of steps on scripted matches."""

from collections.abc import Callable

import numpy as np

from slam.config.stages import MatchConfig, PredictionConfig, WheelConfig
from slam.estimates import MotionEstimate
from slam.matching.motion import Motion
from slam.matching.planar import compose
from slam.matching.scan_points import ScanPoints
from slam.measurements import FloatArray, WheelOdometry, pose2_from_row
from slam.odometry.motion_tracker import MotionTracker
from slam.odometry.tracked_scan import TrackedScan
from slam.odometry.wheel_tracker import WheelMoment, WheelTracker

NOTHING = ScanPoints(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32))
SOME = ScanPoints(np.zeros((250, 2), np.float32), np.zeros((250, 2), np.float32))
STEP = np.array([0.1, 0.0, 0.02])


def motion_at(
    pose: FloatArray, fit: float = 0.95, inlier_share: float = 0.95, degenerate: bool = False
) -> MotionEstimate:
    return MotionEstimate(
        pose2_from_row(pose), np.eye(3) * 1e-4, inlier_share, fit, 0.01, True, degenerate, np.zeros(3)
    )


class ScriptedOdometry:
    """Answers as set: the truth's match, or none; near a pose, a fit that the test chooses."""

    def __init__(self) -> None:
        self.answer: Callable[[list[Motion]], MotionEstimate | None] = lambda guesses: None
        self.near_fit: float | None = 0.0
        self.match_fit = 0.0
        self.objects = 20
        self.asked: list[list[Motion]] = []

    def match(
        self, points: ScanPoints, guesses: list[Motion], *, alone: bool = False
    ) -> MotionEstimate | None:
        self.asked.append(guesses)
        motion = self.answer(guesses)
        self.match_fit = 0.0 if motion is None else motion.fit
        return motion

    def match_near(self, points: ScanPoints, pose: FloatArray) -> MotionEstimate | None:
        return None if self.near_fit is None else motion_at(pose, fit=self.near_fit)

    def evidence(self, points: ScanPoints, pose: FloatArray, other: Motion) -> FloatArray:
        """Every object says the same; 25 points are one witness."""
        gain = self.match_fit - (self.near_fit or 0.0)
        known = np.full(self.objects, len(points) / 25.0 * gain / self.objects)
        return np.stack([known, np.zeros_like(known)])

    def add_keyframe(self, points: ScanPoints, pose: FloatArray) -> None: ...


class Run:
    """A tracker on scripted answers, 0.1 s a scan, wheels that say what the test says."""

    def __init__(self, wheels: bool = True) -> None:
        self.odometry = ScriptedOdometry()
        self.wheels = WheelTracker(WheelConfig()) if wheels else None
        self.tracker = MotionTracker(self.odometry, self.wheels, PredictionConfig(), MatchConfig())
        self.stamp_s = 0.0
        self.wheel_pose = np.array([7.0, -3.0, 1.0])  # the odom frame begins anywhere
        self.true_pose = np.zeros(3)

    @classmethod
    def sure(cls, scans: int = 0, wheels: bool = True) -> "Run":
        """One that sees the truth, after some scans."""
        run = cls(wheels)
        run.see_the_truth()
        for _ in range(scans):
            run.scan()
        return run

    def scan(self, wheel_step: FloatArray = STEP, true_step: FloatArray = STEP) -> TrackedScan:
        if self.stamp_s > 0.0:  # the first scan is the origin
            self.true_pose = compose(self.true_pose, true_step)
        self.stamp_s += 0.1
        self.wheel_pose = compose(self.wheel_pose, wheel_step)
        if self.wheels is not None:
            self.wheels.add(WheelOdometry(self.stamp_s, pose2_from_row(self.wheel_pose)))
        return self.tracker.track(SOME, self.stamp_s)

    def wheel_doubt(self) -> float:
        """How many times more of the turn than they claim the wheels are taken to be wrong by."""
        begun, ended = WheelMoment(np.zeros(3), 0.0), WheelMoment(np.array([0.1, 0.0, 0.0]), 0.0)
        moved = self.tracker.wheel_motion(begun, ended, 0.1)
        assert moved is not None
        claimed = WheelTracker(WheelConfig()).covariance(moved.pose)
        return float(moved.covariance[2, 2] / claimed[2, 2])

    def see_the_truth(self) -> None:
        """From now on every match shows where the robot is."""
        self.odometry.answer = lambda guesses: motion_at(self.true_pose)
