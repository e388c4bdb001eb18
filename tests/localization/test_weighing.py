"""Evidence: a surface counts once, doubt comes quickly, and a robot may be kidnapped."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from flat_worlds import points_at, room, sweep

from slam.config import Config
from slam.config.localization import LocalizationConfig
from slam.estimates import MotionEstimate
from slam.localization.hypotheses import Hypothesis, HypothesisSet, KeyframeLog
from slam.localization.known_map import Walls
from slam.localization.machine import LossTest
from slam.localization.planar_sensor import NovelSurfaces, PlanarSensor
from slam.localization.poses import Measured, position_sigma_m, same_place
from slam.localization.scan_view import ScanView, first_in_cells
from slam.mapper.lidar2d import PlanarRobot
from slam.mapper.mapper import Mapper
from slam.matching.local_map import OrientedPoints
from slam.measurements import FloatArray, Pose

CONFIG = LocalizationConfig()
ORIGIN = gtsam.Pose2()


@pytest.fixture(scope="module")
def sensor() -> PlanarSensor:
    """In a map of one scan."""
    mapper = Mapper(Config(), PlanarRobot(Config()))
    mapper.add(sweep(room(), [0.0, 0.0, 0.0], beams=121, fov_rad=4.7))
    return PlanarSensor(Walls(mapper.finish().map, Config()), Config())


def view_from(pose: FloatArray, stamp_s: float = 0.0) -> ScanView:
    points = points_at(room(), pose)
    return ScanView(stamp_s, points, OrientedPoints.from_scan(points), np.zeros(2))


def test_a_surface_is_novel_only_once(sensor: PlanarSensor) -> None:
    log: KeyframeLog[ScanView, NovelSurfaces] = KeyframeLog(sensor, CONFIG.window_m)
    log.add(view_from(np.zeros(3)), ORIGIN)
    first = len(log.keyframes[0].novel.points)
    assert first > 30
    for n in range(1, 6):
        pose = np.array([0.05 * n, 0.0, 0.1 * n])
        log.add(view_from(pose), gtsam.Pose2(*pose))
    assert sum(len(keyframe.novel.points) for keyframe in log.keyframes[1:]) < 0.1 * first


def test_what_has_left_the_window_is_novel_again(sensor: PlanarSensor) -> None:
    log: KeyframeLog[ScanView, NovelSurfaces] = KeyframeLog(sensor, 2.0)
    view = view_from(np.zeros(3))
    log.add(view, ORIGIN)
    first = len(log.keyframes[0].novel.points)
    # The odometry drives away and back while the laser sees the same from the same place.
    empty = ScanView(
        0.0, view.only(np.zeros(len(view.points), bool)).points, OrientedPoints.none(), view.laser
    )
    assert log.add(empty, gtsam.Pose2(1.5, 0.0, 0.0)) == 0
    assert log.add(view, ORIGIN) == 1
    assert len(log.keyframes[-1].novel.points) == first


def test_keyframes_are_due_by_travel_or_turn(sensor: PlanarSensor) -> None:
    log: KeyframeLog[ScanView, NovelSurfaces] = KeyframeLog(sensor, CONFIG.window_m)
    view = view_from(np.zeros(3))
    assert log.due(view, ORIGIN)
    log.add(view, ORIGIN)
    assert not log.due(view, gtsam.Pose2(0.9 * CONFIG.keyframe_m, 0.0, 0.0))
    assert log.due(view, gtsam.Pose2(1.1 * CONFIG.keyframe_m, 0.0, 0.0))
    assert log.due(view, gtsam.Pose2(0.0, 0.0, -1.1 * CONFIG.keyframe_rad))


def test_cells_keep_their_first_point() -> None:
    points = np.array([[0.05, 0.05], [-0.05, 0.05], [0.07, 0.02], [0.31, 0.0]])
    numbers, cells = first_in_cells(points, 0.1)
    assert numbers.tolist() == [0, 1, 3]
    assert cells.tolist() == [[0, 0], [-1, 0], [3, 0]]


@pytest.mark.parametrize(
    ("evidence", "expected"),
    [
        ([2.0, 3.0], 5.0),
        ([-5.0, 4.0, 4.0], 5.0),  # all the path 3, its end alone 8 less the 3 for being kidnapped
        ([-1.0, 4.0], 3.0),
        ([], 0.0),
    ],
)
def test_the_end_of_the_path_may_count_alone_at_a_price(evidence: list[float], expected: float) -> None:
    assert Hypothesis(ORIGIN, evidence, None).total(kidnap_nats=3.0) == pytest.approx(expected)
    assert Hypothesis(ORIGIN, evidence, None, 1.5).total(3.0) == pytest.approx(expected + 1.5)


class Places:
    """A sensor on a line that proposes places, and says of each pose what it is set to."""

    search_every_m, weighs_back, least_keyframes = 1e9, 9, 1

    def __init__(self, nats: dict[float, float], moved_m: float = 0.0) -> None:
        self._nats, self._moved_m = nats, moved_m

    def observe(self, measurement: object, known: Pose | None) -> None:
        return None

    def sees_new(self, view: int, before: Pose | None, pose: Pose) -> bool:
        return True

    def novel(self, view: int, pose: Pose, before: object) -> None:
        return None

    def align(self, view: int, guess: Pose) -> MotionEstimate:
        moved = gtsam.Pose2(guess.x() + self._moved_m, 0.0, 0.0)
        return MotionEstimate(moved, np.eye(3), 1.0, 1.0, 0.01, True, False, np.zeros(3))

    def weigh(self, pose: Pose, novel: None, motion: MotionEstimate | None) -> float:
        return self._nats.get(round(pose.x(), 2), 0.0)

    def propose(self, view: int, keyframes: object, within: Measured | None) -> list[Pose]:
        return [gtsam.Pose2(x, 0.0, 0.0) for x in self._nats]


def test_doubles_the_hopeless_and_too_many_are_dropped() -> None:
    nats = {0.0: 1.0, 1.0: 9.0, 1.1: 8.0, 5.0: -7.0}
    for most, kept in ((9, [1.0, 0.0]), (1, [1.0])):
        config = LocalizationConfig(hypotheses=most)
        hypotheses: HypothesisSet[int, None] = HypothesisSet(Places(nats), config)
        hypotheses.add_keyframe(0, ORIGIN, None)
        assert [member.pose.x() for member in hypotheses.members] == kept


@pytest.mark.parametrize(("moved_m", "found"), [(0.29, 2.29), (0.31, 2.0)])
def test_an_alignment_that_moves_far_is_another_place(moved_m: float, found: float) -> None:
    hypotheses: HypothesisSet[int, None] = HypothesisSet(Places({2.0: 0.0}, moved_m), CONFIG)
    hypotheses.add_keyframe(0, ORIGIN, None)
    assert hypotheses.members[0].pose.x() == pytest.approx(found)
    assert same_place(ORIGIN, gtsam.Pose2(0.0, 0.0, 0.14))
    assert not same_place(ORIGIN, gtsam.Pose2(0.0, 0.0, 0.16))


def test_hypotheses_move_with_the_odometry_and_one_reading_is_not_all() -> None:
    sensor = Places({0.0: 50.0, 1.0: 50.0})
    hypotheses: HypothesisSet[int, None] = HypothesisSet(sensor, CONFIG)
    sensor.least_keyframes = 3
    hypotheses.add_keyframe(0, ORIGIN, Measured(gtsam.Pose2(7.0, 0.0, 0.0), np.eye(3)))
    assert hypotheses.winner() is None, "two places are alike"
    assert hypotheses.probabilities().sum() < 0.9, "and it may be neither"
    hypotheses.add_keyframe(0, gtsam.Pose2(1.0, 0.0, 0.0), None)
    best = hypotheses.members[0]
    assert best.pose.x() == pytest.approx(1.0) and best.evidence == [CONFIG.lost_nats / 3] * 2


def test_dead_reckoning_holds_the_hypotheses_that_are_in_its_covariance() -> None:
    """Places elsewhere are none, however well they look; the others are weighed by how far they are."""
    known = Measured(ORIGIN, np.diag([0.5, 0.05, 0.05]) ** 2)
    sensor = Places({-1.0: 6.0, 0.0: 0.0, 1.0: 6.0, 40.0: 50.0})
    hypotheses: HypothesisSet[int, None] = HypothesisSet(sensor, CONFIG)
    hypotheses.add_keyframe(0, ORIGIN, known, bound=True)
    assert sorted(member.pose.x() for member in hypotheses.members) == [-1.0, 0.0, 1.0]
    assert hypotheses.winner() is None, "two places are alike"
    together = hypotheses.together()
    assert together is not None and together.pose.x() == pytest.approx(0.0, abs=0.01)
    assert together.covariance[0, 0] == pytest.approx(1.0 + 1.0, rel=0.02)  # between them, and of each
    free: HypothesisSet[int, None] = HypothesisSet(sensor, CONFIG)
    free.add_keyframe(0, ORIGIN, known)
    best = free.winner()
    assert best is not None and best.pose.x() == 40.0 and free.together() is None


def test_together_they_are_as_wide_as_each_is_and_show_nothing_where_room_is_short() -> None:
    known = Measured(ORIGIN, np.diag([0.4, 0.05, 0.05]) ** 2)
    hypotheses: HypothesisSet[int, None] = HypothesisSet(Places({0.0: 9.0}), CONFIG)
    hypotheses.add_keyframe(0, ORIGIN, known, bound=True)
    (member,) = hypotheses.members
    assert member.motion is not None
    for degenerate, sigma_m in ((False, 1.0), (True, 0.1)):
        member.motion = replace(member.motion, degenerate=degenerate)
        together = hypotheses.together()
        assert together is not None and position_sigma_m(together) == pytest.approx(sigma_m)
    crowded: HypothesisSet[int, None] = HypothesisSet(Places({0.0: 9.0}), LocalizationConfig(hypotheses=1))
    crowded.add_keyframe(0, ORIGIN, known, bound=True)
    assert crowded.together() is None


class SlowPlaces(Places):
    """Proposes one place a reading, the rivals last."""

    def propose(self, view: int, keyframes: object, within: Measured | None) -> Iterator[Pose | None]:  # type: ignore[override]
        for pose in super().propose(view, keyframes, within):
            yield pose
            yield None


def test_a_search_over_several_readings_moves_with_the_robot_and_none_wins_before_its_end() -> None:
    hypotheses: HypothesisSet[int, None] = HypothesisSet(SlowPlaces({0.0: 9.0, 3.0: 9.0}), CONFIG)
    hypotheses.add_keyframe(0, ORIGIN, Measured(gtsam.Pose2(0.0, 0.0, 0.0), np.eye(3)))
    assert hypotheses.probabilities().max() > CONFIG.confident_probability and hypotheses.winner() is None
    hypotheses.add_keyframe(0, gtsam.Pose2(1.0, 0.0, 0.0), None)
    assert {round(member.pose.x(), 6) for member in hypotheses.members} == {1.0, 4.0}
    hypotheses.seek()
    assert hypotheses.winner() is None, "two places are alike"
    hypotheses.clear()
    hypotheses.seek()
    assert hypotheses.members == [], "what was begun elsewhere has ended"


def test_what_is_seen_twice_from_one_place_is_one_witness() -> None:
    """A quarter of a keyframe's way between readings that speak a little against the pose."""
    counts = []
    for anew in (1.0, 0.25):
        test, readings = LossTest(CONFIG), 0
        while not test.lost:
            readings += 1
            test.add(float(readings), -1.0, anew)
        counts.append(readings)
    assert counts == [CONFIG.lost_nats, 4 * CONFIG.lost_nats]


def test_a_contradicted_pose_is_lost_and_a_passer_by_is_not_enough() -> None:
    test = LossTest(CONFIG)
    for n in range(50):
        test.add(0.1 * n, 5.0)
    assert not test.lost and test.confidence > 0.99
    before = test.confidence
    for n in range(50, 56):  # six scans in half a second
        test.add(0.1 * n, -5.0)
    assert not test.lost and test.confidence < before
    for n in range(56, 65):
        test.add(0.1 * n, -5.0)
    assert test.lost and test.confidence <= 0.5


def test_one_scan_is_enough_to_doubt() -> None:
    test = LossTest(CONFIG)
    test.add(0.0, 5.0)
    test.add(0.1, -6.0)
    assert test.confidence < 0.1 and not test.lost
    test.add(0.2, 5.0)
    assert test.confidence > 0.99


def test_long_soundness_does_not_delay_the_loss() -> None:
    counts = []
    for sound in (10, 10_000):
        test = LossTest(CONFIG)
        for n in range(sound):
            test.add(float(n), 1.0)
        bad = 0
        while not test.lost:
            bad += 1
            test.add(sound + 0.4 * bad, -2.0)
        counts.append(bad)
    assert counts[0] == counts[1] == math.ceil(CONFIG.lost_nats / 2.0)
