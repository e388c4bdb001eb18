"""Both scan matchers on one drive, and on what they must refuse."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from flat_worlds import corridor, points_at, room

from slam.comparison.methods import ODOMETRIES
from slam.config import load_config
from slam.matching.local_map import OrientedPoints
from slam.matching.motion import Motion
from slam.matching.planar import between, compose
from slam.matching.scan_points import ScanPoints
from slam.matching.visibility import RangeImage
from slam.measurements import FloatArray, row_from_pose2
from slam.odometry import STANDARD
from slam.odometry.lidar_odometry import LidarOdometry
from slam.odometry.surfel_odometry import SurfelOdometry
from slam.simulation.floor_plan import walls
from slam.simulation.synthetic_log import SyntheticLogConfig, drive_tour

METHODS = ["surfel", "kiss_matching"]
HOME = np.array([0.3, -0.2, 0.1])
NOTHING = ScanPoints(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32))


def make(method: str, *settings: str) -> LidarOdometry:
    return ODOMETRIES.get(method, STANDARD).lidar(load_config(None, settings))


def guess_at(pose: FloatArray) -> Motion:
    return Motion(pose, np.diag([0.05, 0.05, 0.05]) ** 2)


def at_home(method: str, *settings: str) -> LidarOdometry:
    """An odometry whose first keyframe was taken at HOME in the room."""
    odometry = make(method, *settings)
    odometry.add_keyframe(points_at(room(), HOME, beams=721), HOME)
    return odometry


@pytest.fixture(scope="module")
def drive() -> FloatArray:
    """Poses at 5 Hz through a corridor and into a room, (N, 3)."""
    return drive_tour(SyntheticLogConfig(), 24.0)[::2]


@pytest.mark.parametrize(
    ("method", "bound_m", "bound_rad"), [("surfel", 0.03, 0.01), ("kiss_matching", 0.08, 0.03)]
)
def test_a_drive_stays_near_the_truth(
    method: str, bound_m: float, bound_rad: float, drive: FloatArray
) -> None:
    """By constant velocity alone, 12 m with a keyframe every 20 cm."""
    odometry = make(method)
    rng = np.random.default_rng(5)
    poses, key = [np.zeros(3)], None
    for n, truth in enumerate(drive):
        points = points_at(walls(), truth, fov_rad=math.pi, sigma_m=0.01, seed=rng)
        if n:
            step = between(poses[-2], poses[-1]) if n > 1 else np.zeros(3)
            motion = odometry.match(points, [guess_at(compose(poses[-1], step))])
            assert motion is not None
            assert motion.inlier_share > 0.7
            poses.append(row_from_pose2(motion.T_reference_base))
        if key is None or np.abs(between(key, poses[-1])).max() > 0.2:
            key = poses[-1]
            odometry.add_keyframe(points, key)
    errors = np.array(
        [between(between(drive[0], true), pose) for true, pose in zip(drive, poses, strict=True)]
    )
    assert np.hypot(errors[:, 0], errors[:, 1]).max() < bound_m
    assert np.abs(errors[:, 2]).max() < bound_rad


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("frame", [(0.0, 0.0, 0.0), (50.0, -20.0, 2.4)])
def test_the_pose_is_in_the_odometry_frame(method: str, frame: tuple[float, ...]) -> None:
    """The first keyframe's pose sets the frame, wherever the room may be."""
    odometry = make(method)
    start = np.array(frame)
    odometry.add_keyframe(points_at(room(), HOME, beams=721), start)
    truth = np.array([0.12, -0.05, 0.06])
    motion = odometry.match(points_at(room(), compose(HOME, truth)), [guess_at(start)])
    assert motion is not None
    error = between(truth, between(start, row_from_pose2(motion.T_reference_base)))
    assert np.hypot(error[0], error[1]) < 0.01
    assert abs(error[2]) < 0.005
    assert np.linalg.eigvalsh(motion.covariance)[0] > 0.0
    assert not motion.degenerate


@pytest.mark.parametrize("method", METHODS)
def test_what_fits_nowhere_is_refused(method: str) -> None:
    odometry = at_home(method)
    rng = np.random.default_rng(0)
    clutter = rng.uniform(-2.0, 2.0, (60, 2))
    clutter = np.hstack([clutter, clutter + rng.uniform(-0.5, 0.5, (60, 2))])
    assert odometry.match(points_at(clutter, np.zeros(3)), [guess_at(HOME)]) is None


@pytest.mark.parametrize("method", METHODS)
def test_few_points_and_no_map_are_refused(method: str) -> None:
    scan = points_at(room(), HOME)
    few = ScanPoints(scan.points_base[:9], scan.normals_base[:9])
    empty, ready = make(method), at_home(method)
    assert empty.match(scan, [guess_at(HOME)]) is None
    assert empty.match_near(scan, HOME) is None
    for points in (NOTHING, few, ScanPoints(scan.points_base, np.zeros_like(scan.normals_base))):
        assert ready.match(points, [guess_at(HOME)]) is None
        assert ready.match_near(points, HOME) is None


@pytest.mark.parametrize("method", METHODS)
def test_a_first_keyframe_without_points_matches_nothing(method: str) -> None:
    odometry = make(method)
    odometry.add_keyframe(NOTHING, HOME)
    assert odometry.match(points_at(room(), HOME), [guess_at(HOME)]) is None


@pytest.mark.parametrize("method", METHODS)
def test_the_next_guess_is_tried_where_the_first_fails(method: str) -> None:
    odometry = at_home(method)
    far, truth = compose(HOME, np.array([25.0, 0.0, 1.0])), compose(HOME, np.array([0.04, 0.03, 0.02]))
    motion = odometry.match(points_at(room(), truth), [guess_at(far), guess_at(HOME)])
    assert motion is not None
    np.testing.assert_allclose(row_from_pose2(motion.T_reference_base), truth, atol=0.01)


def test_the_search_finds_a_scan_that_every_guess_misses() -> None:
    """Half a metre and 30 degrees off: too far to align, within the window of the search."""
    guess = guess_at(compose(HOME, np.array([0.45, -0.35, math.radians(30.0)])))
    scan = points_at(room(), HOME)
    found = at_home("surfel").match(scan, [guess])
    assert found is not None
    np.testing.assert_allclose(row_from_pose2(found.T_reference_base), HOME, atol=0.01)
    narrow = at_home("surfel", "match.search_half_yaw_rad=0.05").match(scan, [guess])
    assert narrow is None or not np.allclose(row_from_pose2(narrow.T_reference_base), HOME, atol=0.05)


@pytest.mark.parametrize("method", METHODS)
def test_match_near_stays_near(method: str) -> None:
    odometry = at_home(method)
    beside = compose(HOME, np.array([0.15, 0.0, 0.0]))
    scan = points_at(room(), HOME)
    near, best = odometry.match_near(scan, beside), odometry.match(scan, [guess_at(HOME)])
    assert near is not None
    assert best is not None
    assert np.hypot(*between(beside, row_from_pose2(near.T_reference_base))[:2]) < 0.08
    assert near.fit < best.fit


@pytest.mark.parametrize("method", METHODS)
def test_a_corridor_is_flagged(method: str) -> None:
    odometry = make(method)
    start = np.array([0.0, 0.2, 0.0])
    odometry.add_keyframe(points_at(corridor(), start), start)
    motion = odometry.match(points_at(corridor(), start), [guess_at(start)])
    assert motion is not None
    assert motion.degenerate
    assert abs(motion.weak_direction[0]) > 0.99
    assert motion.covariance[0, 0] > 0.4**2


@pytest.mark.parametrize("method", METHODS)
def test_old_keyframes_leave_the_surfels(method: str) -> None:
    """A local map of two keyframes forgets the first room once two scans of another have come."""
    odometry = at_home(method, "match.local_map_keyframes=2")
    scan = points_at(room(), HOME)
    assert odometry.match(scan, [guess_at(HOME)]) is not None
    for _ in range(2):
        odometry.add_keyframe(points_at(corridor(), np.zeros(3)), np.array([500.0, 0.0, 0.0]))
    assert odometry.match(scan, [guess_at(HOME)]) is None


def test_along_a_corridor_the_surest_guess_leads_though_another_finds_the_walls() -> None:
    """The first guess is turned too far to align, the second is not, and is a metre behind."""
    odometry = make("surfel")
    odometry.add_keyframe(points_at(corridor(), np.zeros(3)), np.zeros(3))
    truth = np.array([0.5, 0.1, 0.05])
    sure = Motion(np.array([0.5, 0.1, 1.2]), np.diag([0.02, 0.02, 1.0]) ** 2)
    behind = Motion(np.array([-0.5, 0.1, 0.05]), np.diag([1.0, 1.0, 1.0]) ** 2)
    motion = odometry.match(points_at(corridor(), truth), [sure, behind])
    assert motion is not None and motion.degenerate
    np.testing.assert_allclose(row_from_pose2(motion.T_reference_base), truth, atol=0.02)


def test_ground_that_nobody_saw_is_no_contradiction() -> None:
    """A room known by a third of it, seen whole; and with things where it was seen to be empty."""
    odometry = make("surfel")
    odometry.add_keyframe(points_at(room(), np.zeros(3), beams=721, fov_rad=0.66 * math.pi), np.zeros(3))
    whole = points_at(room(), np.zeros(3), beams=721)
    motion = odometry.match(whole, [guess_at(np.array([0.05, 0.03, 0.02]))])
    assert motion is not None
    assert motion.inlier_share < 0.4
    np.testing.assert_allclose(row_from_pose2(motion.T_reference_base), 0.0, atol=0.01)
    behind = whole.points_base[:, :1] < -1.0
    stands_before = np.where(behind, -0.5 * whole.points_base, whole.points_base)
    assert odometry.match(ScanPoints(stands_before, whole.normals_base), [guess_at(np.zeros(3))]) is None


def test_what_lies_farther_back_than_a_lidar_reaches_is_another_visit() -> None:
    odometry = at_home("surfel", "scan.range_max_m=10")
    far = points_at(room(), HOME, beams=721)
    for x in (4.0, 8.0):
        odometry.add_keyframe(NOTHING, np.array([x, 0.0, 0.0]))
    assert odometry.match(far, [guess_at(HOME)]) is not None
    odometry.add_keyframe(NOTHING, np.array([12.0, 0.0, 0.0]))
    assert odometry.match(far, [guess_at(HOME)]) is None


@pytest.mark.parametrize(("spacing_m", "fits"), [(0.2, False), (6.0, True)])
def test_of_scans_far_apart_less_is_known(spacing_m: float, fits: bool) -> None:
    """Two in ten points agree, and no other contradicts."""
    odometry = SurfelOdometry(load_config())
    for n in range(3):
        odometry.add_keyframe(points_at(room(), HOME), np.array([n * spacing_m, 0.0, 0.0]))
    known = SimpleNamespace(contradicted=lambda scan, pose: 0.0)
    best = SimpleNamespace(inlier_share=0.2, pose=HOME)
    assert odometry._fits_what_is_known(known, OrientedPoints.none(), best) is fits  # type: ignore[arg-type]


def test_what_scans_have_looked_through_is_drawn_where_it_is_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drawn = list[int]()
    of = SimpleNamespace(of=lambda *given: drawn.append(1) or RangeImage.of(*given))
    monkeypatch.setattr("slam.odometry.surfel_odometry.RangeImage", of)
    odometry, scan = SurfelOdometry(load_config()), points_at(room(), HOME)
    for _ in range(2):
        odometry.add_keyframe(scan, HOME)
    assert odometry.match(scan, [guess_at(HOME)]) is not None
    assert not drawn
    for _ in range(2):
        odometry.evidence(scan, HOME, guess_at(HOME + 0.5))
    assert len(drawn) == 2
