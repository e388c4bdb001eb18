"""What holds a planar keyframe to the one before, as sensors come and go, and what the graph makes of it."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
import pytest
from scripted_tracker import Run, motion_at

from slam.config import Config
from slam.config.stages import GraphConfig
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph
from slam.mapper.planar_chain import PlanarChain, edges_of
from slam.mapper.robot_cameras import RobotCamera, RobotCameras
from slam.mapper.tags import TagFinder
from slam.matching.motion import Motion
from slam.measurements import FloatArray, pose2_from_row
from slam.odometry.camera_odometry import CameraOdometry
from slam.odometry.camera_track import CameraPose
from slam.odometry.clock_learner import Turns
from slam.odometry.tracked_scan import TrackedScan

CONFIG = GraphConfig()
CONFIDENT = np.eye(3) * 0.01**2
AHEAD = np.array([0.2, 0.0, 0.05])


def reported(motion: FloatArray = AHEAD, covariance: FloatArray = CONFIDENT) -> Motion:
    return Motion(motion, covariance)


def add(
    graph: KeyframeGraph,
    step: FloatArray,
    match: Motion | None,
    wheels: Motion | None,
    cameras: Sequence[Motion] = (),
    *,
    doubtful: bool = False,
) -> None:
    """The next keyframe."""
    edges = edges_of(len(graph), step, match, wheels, cameras, CONFIG, match_doubtful=doubtful)
    graph.add_keyframe(pose2_from_row(step), edges)


@pytest.mark.parametrize("led", [False, True])
@pytest.mark.parametrize("blind", [False, True])
def test_a_guess_is_bridged_only_where_it_saw_nothing(blind: bool, led: bool) -> None:
    """Otherwise the scan was matched to the one that was guessed, and knows no more than the guess."""
    tracker, config = Run(wheels=False).tracker, Config()
    cameras = RobotCameras(config, {}, tags=TagFinder(None, {}), wheel_turns=Turns())
    if led:
        mounted = gtsam.Pose3(gtsam.Rot3(), [0.0, 0.0, 1.0])
        cameras.cameras["eye"] = RobotCamera(CameraOdometry(config), mounted)
    chain, edges = PlanarChain(config, tracker, None, cameras), list[Edge]()
    for key, at_m in enumerate((0.0, 1.0, 1.3)):
        pose = np.array([at_m, 0.0, 0.0])
        seen = TrackedScan(pose, None if key == 1 else motion_at(pose), None, np.zeros((3, 3)))
        eye = CameraPose(gtsam.Pose3(gtsam.Rot3(), [at_m, 0.0, 1.0]), 1e-6 * np.eye(6), 0)
        edges += chain.add(key, 10.0 * key, seen, {"eye": eye} if led else {}, blind=blind and key == 1)[1]
    assert [one.kind for one in edges if one.target == 1] == [EdgeKind.RGBD] * led + [EdgeKind.ASSUMED]
    matches = [edge for edge in edges if edge.target == 2 and edge.kind is EdgeKind.LIDAR]
    assert [edge.source for edge in matches] == [1] + [0] * blind
    assert matches[0].covariance[0, 0] > 100.0 * matches[-1].covariance[0, 0] or not blind


class TestCamerasOnTheFloor:
    """What a planar keyframe is held by, as sensors come and go."""

    @pytest.mark.parametrize(
        ("match", "wheels", "cameras", "doubtful", "kinds"),
        [
            (True, True, 0, False, ["LIDAR+", "WHEEL-"]),
            (True, True, 2, False, ["LIDAR+", "WHEEL-", "RGBD-", "RGBD-"]),
            (True, False, 1, True, ["LIDAR-", "ASSUMED+", "RGBD-"]),
            (False, True, 1, True, ["WHEEL+", "RGBD-"]),
            (False, False, 1, True, ["RGBD-", "ASSUMED+"]),
            (False, False, 0, True, ["ASSUMED+"]),
        ],
    )
    def test_something_trusted_always_holds_the_chain(
        self, match: bool, wheels: bool, cameras: int, doubtful: bool, kinds: list[str]
    ) -> None:
        graph = KeyframeGraph(gtsam.Pose2(), CONFIG)
        seen = reported() if match else None
        add(graph, AHEAD, seen, reported() if wheels else None, [reported()] * cameras, doubtful=doubtful)
        edges = graph.graph.edges
        assert [f"{edge.kind.name}{'+' if edge.trusted else '-'}" for edge in edges] == kinds
        outcome = graph.optimize(0.99)
        assert outcome.kept.all()
        np.testing.assert_allclose(graph.rows(), [np.zeros(3), AHEAD], atol=1e-6)

    def test_a_wrong_camera_is_refused(self) -> None:
        graph = KeyframeGraph(gtsam.Pose2(), CONFIG)
        for _ in range(5):
            wrong = reported(AHEAD + np.array([0.5, 0.0, 0.0]))
            add(graph, AHEAD, reported(), reported(AHEAD, CONFIDENT * 9.0), [wrong])
        outcome = graph.optimize(0.99)
        kinds = [edge.kind for edge in graph.graph.edges]
        assert [kind for kind, kept in zip(kinds, outcome.kept, strict=True) if not kept] == [
            EdgeKind.RGBD
        ] * 5

    def test_a_lidar_that_follows_a_person_is_refused(self) -> None:
        """Two cameras and the wheels against a match that was contradicted."""
        graph = KeyframeGraph(gtsam.Pose2(), CONFIG)
        for n in range(6):
            lidar = AHEAD if n != 3 else AHEAD + np.array([-0.6, 0.4, 0.3])
            wheels, cameras = reported(AHEAD, CONFIDENT * 4.0), [reported(), reported()]
            add(graph, lidar, reported(lidar), wheels, cameras, doubtful=n == 3)
        graph.optimize(0.99)
        expected = gtsam.Pose2()
        for _ in range(6):
            expected = expected.compose(gtsam.Pose2(*AHEAD))
        np.testing.assert_allclose(
            graph.rows()[-1], [expected.x(), expected.y(), expected.theta()], atol=0.03
        )

    def test_no_corridor_is_stretched_by_more_than_a_robot_may_go(self) -> None:
        """Open matches and wheels say five metres in all, a false loop thirty."""
        graph = KeyframeGraph(gtsam.Pose2(), CONFIG)
        step, open_ = np.array([1.0, 0.0, 0.0]), np.diag([30.0, 0.01, 0.01]) ** 2
        for _ in range(5):
            edges = edges_of(
                len(graph), step, reported(step, open_), reported(step), [], CONFIG, match_open=True
            )
            assert [edge.kind for edge in edges if edge.trusted] == [EdgeKind.LIDAR, EdgeKind.ASSUMED]
            graph.add_keyframe(pose2_from_row(step), edges)
        graph.add_edge(Edge(0, 5, gtsam.Pose2(30.0, 0.0, 0.0), CONFIDENT, EdgeKind.LOOP, trusted=False))
        graph.optimize(0.99)
        assert graph.rows()[-1, 0] < 6.0

    def test_a_step_learned_later_joins_its_ends(self) -> None:
        graph = KeyframeGraph(gtsam.Pose2(), CONFIG)
        for _ in range(3):
            add(graph, AHEAD, reported(covariance=CONFIDENT * 100.0), None)
        later = gtsam.Pose2(0.24, 0.0, 0.05)
        graph.add_edge(Edge(1, 2, later, CONFIDENT * 0.01, EdgeKind.RGBD, trusted=False))
        graph.optimize(0.99)
        step = pose2_from_row(graph.rows()[1]).between(pose2_from_row(graph.rows()[2]))
        assert step.x() == pytest.approx(0.24, abs=1e-3)
