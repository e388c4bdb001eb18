"""A camera's clock is learned on the way: frames and loops of before are placed anew by it."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest
from room_world import SMALL, furnished, looking, prepared, render

from slam.config import Config
from slam.estimates import MotionEstimate
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.loop_candidate import LoopCandidate
from slam.mapper.camera_keyframes import CameraKeyframes
from slam.mapper.checkpoint import Checkpoint
from slam.mapper.robot_cameras import Picture, RobotCamera, RobotCameras
from slam.odometry.camera_odometry import CameraOdometry
from slam.odometry.camera_track import CameraPose
from slam.odometry.clock_learner import SensorClock
from slam.vision.camera_frame import T_BODY_CAMERA

RATE_RAD_S, LATE_S, SIGMA_S = 0.8, 0.1, 0.005
MOUNT = gtsam.Pose3(gtsam.Rot3(), np.array([0.2, 0.0, 1.0])) * T_BODY_CAMERA


def turned(yaw_rad: float) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Rz(yaw_rad), np.zeros(3))


@pytest.fixture
def cameras() -> RobotCameras:
    """A robot turns at one rate; its camera's stamps are late by a tenth of a second."""
    config = Config()
    camera = RobotCamera(CameraOdometry(config), MOUNT)
    for n in range(40):
        pose = turned(RATE_RAD_S * (0.1 * n - LATE_S)).compose(MOUNT)
        camera.odometry.track.add(0.1 * n, CameraPose(pose, np.zeros((6, 6)), 0))
    return RobotCameras(config, cameras={"eye": camera})


def yaw_seen(cameras: RobotCameras, sigmas: float = 0.0) -> float:
    """Of the camera of a frame stamped 1.0, seen from the base at 1.0, beside its mounting."""
    placed = cameras.placed_at("eye", 1.0, 1.0, sigmas)
    assert placed is not None
    return float(placed.compose(MOUNT.inverse()).rotation().yaw())


def test_a_frame_is_placed_by_the_clock_as_it_is_known(cameras: RobotCameras) -> None:
    assert yaw_seen(cameras) == pytest.approx(0.0, abs=1e-9)
    cameras.cameras["eye"].clocks.clock = SensorClock(LATE_S, SIGMA_S, 3)
    assert yaw_seen(cameras) == pytest.approx(-RATE_RAD_S * LATE_S, abs=1e-6)
    assert yaw_seen(cameras, 1.0) == pytest.approx(-RATE_RAD_S * (LATE_S + SIGMA_S), abs=1e-6)


def test_nothing_is_known_where_the_camera_was_not(cameras: RobotCameras) -> None:
    assert cameras.placed_at("eye", 1.0, 9.0) is None
    cameras.cameras["eye"].T_base_camera = None
    assert cameras.placed_at("eye", 1.0, 1.0) is None


def test_frames_and_the_loops_between_them_follow_the_clock(cameras: RobotCameras) -> None:
    """Two frames from one place, of which the robot turned at the first alone."""
    config = Config()
    keyframes = CameraKeyframes(config, Checkpoint(), {}, cameras)
    track = cameras.cameras["eye"].odometry.track
    for n in range(40):
        track.add(10.0 + 0.1 * n, CameraPose(MOUNT, np.zeros((6, 6)), 1))
    for node, stamp_s in enumerate((1.0, 12.0)):
        image = render(
            furnished(), looking(0, 0, 1.3, 0.0), SMALL, stamp_s, sensor="eye", T_base_camera=MOUNT
        )
        keyframes.add(node, stamp_s, [Picture(prepared(image), MOUNT)], places=True)
    seen = gtsam.Pose3()  # from both the same is seen
    motion = MotionEstimate(
        seen, 1e-6 * np.eye(6), 1.0, fit=1.0, residual_m=0.01, converged=True, degenerate=False,
        weak_direction=np.zeros(6),
    )  # fmt: skip
    graph = KeyframeGraph(gtsam.Pose2(), config.graph)
    graph.add_keyframe(gtsam.Pose2())
    loop = keyframes._of_nodes(LoopCandidate(0, 1, 0.0, 0.0, 1.0, motion, True, ""))
    graph.add_loop(loop)
    assert loop.edge(0).T_source_target.theta() == pytest.approx(0.0, abs=1e-9)

    cameras.cameras["eye"].clocks.clock = SensorClock(LATE_S, SIGMA_S, 3)
    keyframes.settle(graph, np.array([1.0, 12.0]))
    stated = graph.graph.edges[-1]
    assert stated.T_source_target.theta() == pytest.approx(-RATE_RAD_S * LATE_S, abs=1e-6)
    assert math.sqrt(stated.covariance[2, 2]) == pytest.approx(RATE_RAD_S * SIGMA_S, rel=0.1)
    assert graph.loops[0].motion is not None and graph.loops[0].edge(0).T_source_target.equals(
        stated.T_source_target, 1e-12
    )
    head = keyframes.frames.head(0)
    assert head.T_base_camera is not None and head.sensor == "eye"
    assert head.T_base_camera.compose(MOUNT.inverse()).rotation().yaw() == pytest.approx(-RATE_RAD_S * LATE_S)
    assert len(keyframes.frames.features(0)) > 0
