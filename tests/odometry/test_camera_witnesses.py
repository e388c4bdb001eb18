"""Cameras beside the lidar: they outdo a match that few things speak for, and show a corridor's length."""

from __future__ import annotations

import numpy as np
import pytest

from slam.config.stages import MatchConfig, PredictionConfig, WheelConfig
from slam.estimates import MotionEstimate
from slam.matching.motion import Motion
from slam.matching.planar import between, compose
from slam.matching.scan_points import ScanPoints
from slam.measurements import FloatArray, WheelOdometry, pose2_from_row
from slam.odometry.motion_tracker import MotionTracker
from slam.odometry.tracked_scan import TrackedScan
from slam.odometry.wheel_tracker import WheelTracker

SOME = ScanPoints(np.zeros((250, 2), np.float32), np.zeros((250, 2), np.float32))
STEP = np.array([0.1, 0.0, 0.02])
# A person who walks ahead: what little the lidar sees comes along.
WITH_THE_PERSON = np.array([-0.4, 0.3, 0.2])
CONFIDENT = np.eye(3) * 1e-6


class Run:
    """A lidar that answers as set, wheels and cameras that say what the test says; 0.1 s a scan."""

    def __init__(self, *, wheels: bool) -> None:
        self.lidar_offset = np.zeros(3)
        self.lidar_covariance = np.eye(3) * 1e-4
        self.asked: list[list[Motion]] = []
        self.wheels = WheelTracker(WheelConfig()) if wheels else None
        self.tracker = MotionTracker(self, self.wheels, PredictionConfig(), MatchConfig())
        self.stamp_s = 0.0
        self.wheel_pose = np.zeros(3)
        self.true_pose = np.zeros(3)
        self.blind = False
        self.objects = 20

    def match(
        self, points: ScanPoints, guesses: list[Motion], *, alone: bool = False
    ) -> MotionEstimate | None:
        self.asked.append(guesses)
        return None if self.blind else self._motion(compose(self.true_pose, self.lidar_offset), 0.95)

    def match_near(self, points: ScanPoints, pose: FloatArray) -> MotionEstimate | None:
        return self._motion(pose, 0.1)

    def evidence(self, points: ScanPoints, pose: FloatArray, other: FloatArray) -> FloatArray:
        """So many things, all of which say the same."""
        return np.full(self.objects, len(points) * (0.95 - 0.1) / self.objects)

    def add_keyframe(self, points: ScanPoints, pose: FloatArray) -> None: ...

    def _motion(self, pose: FloatArray, fit: float) -> MotionEstimate:
        return MotionEstimate(
            pose2_from_row(pose), self.lidar_covariance, 0.95, fit, 0.01, True, False, np.zeros(3)
        )

    def scan(
        self,
        camera: FloatArray | None = None,
        cameras: int = 1,
        wheels: FloatArray = STEP,
        points: ScanPoints | None = SOME,
    ) -> TrackedScan:
        if self.stamp_s > 0.0:
            self.true_pose = compose(self.true_pose, STEP)
        self.stamp_s += 0.1
        self.wheel_pose = compose(self.wheel_pose, wheels)
        if self.wheels is not None:
            self.wheels.add(WheelOdometry(self.stamp_s, pose2_from_row(self.wheel_pose)))
        seen = [] if camera is None else [Motion(camera, CONFIDENT)] * cameras
        return self.tracker.track(points, self.stamp_s, seen)


def after_start(*, wheels: bool) -> Run:
    run = Run(wheels=wheels)
    for _ in range(5):
        run.scan(STEP)
    return run


def test_the_camera_guesses_first() -> None:
    run = after_start(wheels=True)
    last = run.true_pose
    camera = np.array([0.11, 0.005, 0.02])
    run.scan(camera, wheels=np.array([0.12, 0.0, 0.02]))
    assert len(run.asked[-1]) == 3
    np.testing.assert_allclose(run.asked[-1][0].pose, compose(last, camera), atol=1e-3)


@pytest.mark.parametrize(
    ("wheels", "cameras", "objects", "believed"),
    [
        (False, 1, 1, True),
        (False, 2, 3, True),
        (True, 1, 2, True),
        (False, 1, 20, False),
        (False, 2, 20, False),
        (False, 0, 1, True),
        (False, 0, 20, False),
    ],
    ids=[
        "a person",
        "a few things",
        "wheels too",
        "a room",
        "a room and two cameras",
        "no camera: against the robot's own velocity",
        "no camera, a room",
    ],
)
def test_cameras_beat_a_match_that_few_things_speak_for(
    wheels: bool, cameras: int, objects: int, believed: bool
) -> None:
    run = after_start(wheels=wheels)
    run.lidar_offset, run.objects = WITH_THE_PERSON, objects
    tracked = run.scan(STEP if cameras else None, cameras)
    expected = run.true_pose if believed else compose(run.true_pose, WITH_THE_PERSON)
    np.testing.assert_allclose(tracked.pose, expected, atol=1e-3)


def test_the_more_cameras_the_more_things_they_outdo() -> None:
    """A match by six things is believed against one camera, not against three."""
    believed = []
    for cameras in (1, 3):
        run = after_start(wheels=False)
        run.lidar_offset, run.objects = WITH_THE_PERSON, 6
        believed.append(run.scan(STEP, cameras).motion is not None)
    assert believed == [True, False]


def test_a_camera_that_errs_a_little_yields_to_a_room() -> None:
    """Six centimetres too far: for a camera that is sure a contradiction, for wheels a matter of course."""
    run = after_start(wheels=True)
    tracked = run.scan(STEP + np.array([0.06, 0.0, 0.0]), 1)
    assert tracked.motion is not None
    np.testing.assert_allclose(tracked.pose, run.true_pose, atol=0.02)


def test_cameras_do_not_mind_a_match_that_agrees() -> None:
    run = after_start(wheels=True)
    run.lidar_offset = np.array([0.01, -0.01, 0.003])
    tracked = run.scan(STEP, 2)
    assert tracked.motion is not None
    assert tracked.confident


def test_match_and_camera_are_averaged_by_their_covariances() -> None:
    """The lidar knows nothing of x, the camera little of nothing: x is the camera's, y nearly the lidar's."""
    run = after_start(wheels=False)
    last = run.true_pose
    run.lidar_covariance = np.diag([1.0, 1e-8, 1e-8])
    run.lidar_offset = np.array([-0.3, 0.01, 0.0])
    tracked = run.scan(STEP)
    in_truth = between(compose(last, STEP), tracked.pose)
    np.testing.assert_allclose(in_truth, [0.0, 0.01, 0.0], atol=2e-3)


def test_what_contradicts_is_not_averaged() -> None:
    run = after_start(wheels=False)
    run.lidar_offset = WITH_THE_PERSON
    tracked = run.scan(STEP)
    np.testing.assert_allclose(tracked.pose, compose(run.true_pose, WITH_THE_PERSON), atol=1e-3)


def test_without_a_scan_the_camera_carries_on() -> None:
    run = after_start(wheels=True)
    for _ in range(10):
        tracked = run.scan(STEP, wheels=np.array([0.15, 0.0, 0.0]), points=None)
        assert tracked.motion is None
    np.testing.assert_allclose(tracked.pose, run.true_pose, atol=1e-3)


def test_a_scan_that_fits_nothing_leaves_the_camera() -> None:
    run = after_start(wheels=True)
    run.blind = True
    tracked = run.scan(STEP, wheels=np.array([0.15, 0.0, 0.0]))
    np.testing.assert_allclose(tracked.pose, run.true_pose, atol=1e-3)


def test_a_camera_that_proves_wrong_loses_the_first_word_and_gets_it_back() -> None:
    run = after_start(wheels=False)
    backward = np.array([-0.3, 0.0, 0.0])
    for _ in range(40):
        run.scan(backward)
    np.testing.assert_allclose(run.asked[-1][0].pose, run.true_pose, atol=1e-2)
    for _ in range(250):
        run.scan(STEP + np.array([0.02, 0.0, 0.0]))
    expected = run.true_pose + 0.02 * np.array([np.cos(run.true_pose[2]), np.sin(run.true_pose[2]), 0.0])
    np.testing.assert_allclose(run.asked[-1][0].pose[:2], expected[:2], atol=0.01)


def test_a_camera_that_is_silent_is_not_asked() -> None:
    run = after_start(wheels=True)
    for _ in range(20):
        run.scan(None)
    assert all(len(guesses) == 2 for guesses in run.asked[-20:])
