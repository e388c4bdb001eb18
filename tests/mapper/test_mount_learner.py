"""Learning where a camera sits from motions of base and camera."""

from __future__ import annotations

import gtsam
import numpy as np

from slam.mapper.mount_learner import KeyframeStep, MountLearner
from slam.matching.motion import Motion
from slam.vision.camera_frame import T_BODY_CAMERA

MOUNT = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, 0.1, 0.0), np.array([0.2, -0.05, 0.7])).compose(T_BODY_CAMERA)
SIGMAS = np.array([0.003, 0.003, 0.002])
CAMERA_SIGMAS = np.array([0.002] * 3 + [0.004] * 3)


def drive(learner: MountLearner, steps: int, turn_rad: float, seed: int = 0, false: float = 0.0) -> None:
    """Feed steps of 0.25 m with turns, measured with noise; false ones stand still or jump."""
    rng = np.random.default_rng(seed)
    for number in range(steps):
        motion = np.array([0.25, 0.0, turn_rad * np.sin(0.7 * number)])
        base = gtsam.Pose2(*motion)
        camera = MOUNT.inverse().compose(gtsam.Pose3(base)).compose(MOUNT)
        noisy = camera.retract(CAMERA_SIGMAS * rng.standard_normal(6))
        if rng.random() < false:
            noisy = [gtsam.Pose3(), noisy.retract(0.3 * rng.standard_normal(6))][rng.integers(2)]
        step = KeyframeStep(number, number + 1, noisy, np.diag(CAMERA_SIGMAS**2))
        learner.add(step, Motion(motion + SIGMAS * rng.standard_normal(3), np.diag(SIGMAS**2)))


def test_a_mounting_that_nobody_stated_is_learned() -> None:
    learner = MountLearner(None)
    drive(learner, 120, 0.4)
    found = learner.T_base_camera
    assert found is not None
    error = MOUNT.between(found)
    assert abs(np.degrees((found.compose(MOUNT.inverse())).rotation().yaw())) < 1.0
    assert np.abs(found.translation() - MOUNT.translation())[:2].max() < 0.03
    assert np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(error.rotation()))) < 1.0
    assert "height" in learner.note("camera")


def test_a_wrong_start_is_overcome() -> None:
    wrong = gtsam.Pose3(gtsam.Rot3.Yaw(np.radians(30.0)), np.array([0.3, 0.0, 0.0])).compose(MOUNT)
    learner = MountLearner(wrong)
    drive(learner, 120, 0.4)
    assert learner.T_base_camera is not None
    assert np.abs(learner.T_base_camera.translation() - MOUNT.translation())[:2].max() < 0.03


def test_a_third_of_the_motions_may_be_false() -> None:
    learner = MountLearner(None)
    drive(learner, 120, 0.4, false=0.3)
    found = learner.T_base_camera
    assert found is not None
    assert np.degrees(np.linalg.norm(gtsam.Rot3.Logmap(MOUNT.between(found).rotation()))) < 1.0
    assert np.abs(found.translation() - MOUNT.translation())[:2].max() < 0.03


def test_mostly_false_motions_teach_nothing() -> None:
    learner = MountLearner(None)
    drive(learner, 120, 0.4, false=0.9)
    assert learner.T_base_camera is None


def test_the_height_is_that_of_the_log() -> None:
    learner = MountLearner(gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 0.4])))
    drive(learner, 120, 0.4)
    assert learner.T_base_camera is not None
    assert learner.T_base_camera.z() == 0.4


def test_driving_straight_teaches_too_little_and_says_so() -> None:
    learner = MountLearner(None)
    drive(learner, 60, 0.0)
    assert learner.T_base_camera is None
    assert "not used" in learner.note("camera")


def test_a_few_motions_are_too_few() -> None:
    learner = MountLearner(None)
    drive(learner, 5, 0.4)
    assert learner.T_base_camera is None
    assert "too few" in learner.note("camera")
    assert len(learner.steps) == 5
