"""Scans of a 3D lidar against their map: true motion, honest covariance, weak directions, bad input."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from cloud_world import (
    CONFIG,
    ELEVATIONS,
    T_BASE_LIDAR,
    base,
    error_of,
    look,
    look_on_the_way,
    points_at,
    way_round,
)

from slam.config.clouds import CloudOdometryConfig
from slam.matching import local_cloud
from slam.matching.cloud_alignment import CloudAlignment, align_cloud, motion_of
from slam.matching.cloud_points import at_middle_of_turn, base_points, turn_known, voxel_of
from slam.matching.plane_voxels import PlaneVoxels
from slam.measurements import FloatArray, PointCloud
from slam.odometry.cloud_odometry import CloudOdometry
from slam.odometry.cloud_tracker import CloudTracker

TURNS = CONFIG.cloud_odometry
STILL, LIDAR = np.zeros(6), T_BASE_LIDAR.translation()


@pytest.fixture(scope="module")
def odometry() -> CloudOdometry:
    """Knows the room from five places."""
    made = CloudOdometry(CONFIG, 0.2)
    for seed, x in enumerate((-1.0, -0.5, 0.0, 0.5, 1.0)):
        made.add_keyframe(points_at(base(x, 0.2 * x, 0.3 * x), 100 + seed), base(x, 0.2 * x, 0.3 * x), LIDAR)
    return made


def test_a_scan_finds_its_place_from_a_guess_far_off(odometry: CloudOdometry) -> None:
    truth = base(0.3, -0.2, 0.2)
    guess = truth.compose(gtsam.Pose3(gtsam.Rot3.Ypr(0.08, 0.01, -0.01), np.array([0.2, -0.15, 0.03])))
    motion = odometry.match(odometry.thinned(points_at(truth)), [guess])
    error = error_of(motion, truth)
    assert np.linalg.norm(error[3:]) < 0.01
    assert np.linalg.norm(error[:3]) < 0.003
    assert motion is not None
    assert motion.inlier_share > 0.8
    assert not motion.degenerate
    assert 0.005 < motion.residual_m < 0.03


def test_the_error_is_what_the_covariance_shows(odometry: CloudOdometry) -> None:
    squares = []
    for seed in range(6):
        truth = base(0.2 * seed - 0.5, 0.1, 0.1 * seed)
        motion = odometry.match(odometry.thinned(points_at(truth, seed)), [truth])
        error = error_of(motion, truth)
        assert motion is not None
        squares.append(error @ np.linalg.solve(motion.covariance, error))
        assert np.sqrt(np.linalg.eigvalsh(motion.covariance[3:, 3:])[-1]) < 0.01
    # Six degrees of freedom, and caution about errors that neighbouring points share.
    assert np.mean(squares) < 9.0


def test_a_second_guess_is_tried_where_the_first_leads_nowhere(odometry: CloudOdometry) -> None:
    truth = base(0.1, 0.1, 0.0)
    motion = odometry.match(
        odometry.thinned(points_at(truth)), [base(0.0, 0.0, 0.5).compose(base(40.0, 0.0, 0.0)), truth]
    )
    assert np.abs(error_of(motion, truth)).max() < 0.01


@pytest.mark.parametrize("off", [base(1.0, 0.0, 0.0), base(0.3, 0.0, 0.5), base(0.0, 0.0, 3.14)])
def test_wheels_that_slipped_do_not_lead_to_what_fits_in_part(
    odometry: CloudOdometry, off: gtsam.Pose3
) -> None:
    truth = base(0.3, -0.2, 0.2)
    motion = odometry.match(
        odometry.thinned(points_at(truth)), [truth.compose(off), truth.compose(base(0.1, 0.05, -0.02))]
    )
    assert np.linalg.norm(error_of(motion, truth)) < 0.01
    assert motion is not None
    assert motion.converged


def test_what_fits_in_part_is_not_sure(odometry: CloudOdometry) -> None:
    truth = base(0.3, -0.2, 0.2)
    motion = odometry.match(odometry.thinned(points_at(truth)), [truth.compose(base(1.5, 0.0, 0.0))])
    assert np.linalg.norm(error_of(motion, truth)) > 0.3
    assert motion is not None
    assert motion.inlier_share > 0.6
    assert not motion.converged
    assert np.sqrt(np.linalg.eigvalsh(motion.covariance[3:, 3:])[0]) > 0.2
    assert odometry.match(odometry.thinned(points_at(truth)), [truth.compose(base(1.0, 0.0, 1.0))]) is None


def test_what_fits_in_part_is_as_unsure_as_its_guess_is_far_or_the_search_wide(
    odometry: CloudOdometry,
) -> None:
    truth = base(0.3, -0.2, 0.2)
    among = np.random.default_rng(0).uniform(-3.0, 3.0, (4000, 3))
    scan = np.vstack([points_at(truth), among])
    searched = odometry.match(scan, [], truth, turned_rad=0.6)
    led = odometry.match(scan, [truth.compose(base(0.5, 0.0, 0.0))], truth, turned_rad=0.6)
    assert searched is not None and led is not None
    assert not searched.converged and not led.converged
    assert searched.covariance[2, 2] > 0.6**2 > led.covariance[2, 2]
    assert led.covariance[3, 3] > 0.4**2 > searched.covariance[3, 3]


def test_where_the_last_cloud_leads_elsewhere_a_match_far_from_its_guess_is_unsure() -> None:
    made, aside = CloudOdometry(CONFIG, 0.2), base(0.0, 0.15, 0.0)
    for seed, x in enumerate((-0.9, -0.6, -0.3, 0.0, 0.2, 0.3)):
        made.add_keyframe(points_at(base(x, 0.0, 0.0), 100 + seed), base(x, 0.0, 0.0), LIDAR)
    truth = base(0.3, -0.2, 0.2)
    far = truth.compose(base(0.3, 0.1, 0.0))
    right = made.match(points_at(truth), [far])
    made.add_keyframe(points_at(base(0.4, 0.0, 0.0), 110), aside.compose(base(0.4, 0.0, 0.0)), LIDAR)
    wrong = made.match(points_at(truth), [far])
    assert right is not None
    assert wrong is not None
    assert wrong.converged
    sides_m = [np.sqrt(np.linalg.eigvalsh(one.covariance[3:, 3:])[-1]) for one in (right, wrong)]
    assert sides_m[1] > 0.1 > 10.0 * sides_m[0]


@pytest.mark.parametrize("ahead_m", [-0.9, 0.5, 1.0])
def test_without_a_measured_motion_places_around_are_tried(odometry: CloudOdometry, ahead_m: float) -> None:
    """From where it was the scan fits well enough there."""
    truth = base(0.3, -0.2, 0.2)
    before = truth.compose(base(-ahead_m, 0.0, 0.0))
    motion = odometry.match(odometry.thinned(points_at(truth)), [], before)
    assert np.linalg.norm(error_of(motion, truth)) < 0.01


@pytest.mark.parametrize("turned", [(0.9, 0.0, 0.0), (-1.2, 0.1, -0.1), (-0.9, 0.5, 0.0), (0.9, 0.0, 0.6)])
def test_without_a_measured_motion_turns_are_tried(
    odometry: CloudOdometry, turned: tuple[float, float, float]
) -> None:
    """About slanted axes too, for a lidar in the hand may be held in any way."""
    truth = base(0.3, -0.2, 0.2)
    before = truth.compose(gtsam.Pose3(gtsam.Rot3.Ypr(*turned), np.array([0.2, 0.1, 0.05])))
    motion = odometry.match(odometry.thinned(points_at(truth)), [before], before, turned_rad=1.3)
    assert np.linalg.norm(error_of(motion, truth)) < 0.01
    assert motion is not None
    assert motion.converged


def test_two_places_that_fit_alike_leave_the_motion_unsure() -> None:
    """A room without pillars looks the same after half a turn about its middle."""
    bare = np.zeros((0, 3, 2))
    made = CloudOdometry(CONFIG, 0.2)
    middle = base(0.5, 0.0, 0.0).compose(T_BASE_LIDAR.inverse())
    made.add_keyframe(points_at(middle, boxes=bare), middle, LIDAR)
    turned = middle.compose(T_BASE_LIDAR).compose(base(0.0, 0.0, np.pi)).compose(T_BASE_LIDAR.inverse())
    scan = points_at(middle, seed=1, boxes=bare)
    far = [pose.compose(base(0.3, 0.0, 0.0)) for pose in (turned, middle)]
    motion, alone = made.match(scan, far), made.match(scan, far[:1])
    assert motion is not None
    assert alone is not None
    assert np.sqrt(motion.covariance[2, 2]) > 3.0
    assert np.sqrt(alone.covariance[2, 2]) < 0.01


def test_rings_on_the_floor_do_not_pull_a_motion_short() -> None:
    """Two steps of 0.3 m on one keyframe; as points the floor would hold the robot back."""
    made = CloudOdometry(CONFIG, 0.2)
    made.add_keyframe(points_at(base(0.0, 0.0, 0.0), 1), base(0.0, 0.0, 0.0), LIDAR)
    truth = base(0.3, 0.0, 0.0)
    error = error_of(made.match(points_at(truth, 2), [base(0.0, 0.0, 0.0)]), truth)
    assert abs(error[3]) < 0.02


@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 3)), np.ones((5, 3)), np.tile([[1.0, 2.0, 0.5]], (200, 1))],
    ids=["empty", "five points", "one place"],
)
def test_too_little_matches_nothing(odometry: CloudOdometry, points: FloatArray) -> None:
    assert odometry.match(points, [gtsam.Pose3()]) is None


def test_one_ring_shows_no_planes() -> None:
    made = CloudOdometry(CONFIG, 0.2)
    ring = points_at(gtsam.Pose3(), elevations=ELEVATIONS[7:8])
    made.add_keyframe(ring, gtsam.Pose3(), LIDAR)
    motion = made.match(ring, [gtsam.Pose3()])
    assert motion is None or motion.degenerate


def test_a_ring_over_a_corner_is_no_plane() -> None:
    """It is as flat as a floor, but in the lidar's own plane, where nothing is seen."""
    bearing = np.linspace(-0.1, 0.1, 200) + 0.25 * np.pi
    flat = np.column_stack([np.cos(bearing), np.sin(bearing)])
    ring = np.column_stack([3.9 * flat / flat.max(axis=1)[:, None], np.zeros(len(flat))])
    ring[:, 2] = np.tan(0.1) * np.hypot(ring[:, 0], ring[:, 1])
    anyhow, within, above = (PlaneVoxels(1.0, 0.06, sine) for sine in (0.0, 0.025, 0.025))
    anyhow.add(ring)
    within.add(ring, None, np.zeros(3))
    above.add(ring, None, np.array([0.0, 0.0, 3.0]))
    assert (len(anyhow), len(within), len(above)) == (1, 0, 1)


@pytest.mark.parametrize(("direction", "degenerate"), [(1, False), (3, True)], ids=["pitch", "way"])
def test_few_points_show_a_turn_but_no_way(direction: int, degenerate: bool) -> None:
    """Ground shows pitch by few of a street's points; as little of the way is what normals err by."""
    information = np.full(6, 1000.0)
    information[direction] = 5.0
    arms = np.eye(3)
    sure = CloudAlignment(
        gtsam.Pose3(),
        np.diag(information),
        np.diag(information),
        1000.0,
        arms,
        1000,
        1.0,
        1.0,
        1.0,
        0.02,
        True,
        1.0,
        1.0,
    )
    assert motion_of(sure, CONFIG, gtsam.Pose3()).degenerate == degenerate


def test_points_that_are_no_readings_are_left_out() -> None:
    cloud = look(gtsam.Pose3())
    points = np.vstack([cloud.points_lidar, [[np.nan] * 3, [np.inf, 0.0, 0.0], [0.1, 0.1, 0.1], [500, 0, 0]]])
    dirty = PointCloud(0.0, points.astype(np.float32), None, T_BASE_LIDAR)
    np.testing.assert_array_equal(base_points(dirty, STILL, TURNS), base_points(cloud, STILL, TURNS))


def test_a_turn_is_deskewed_by_the_times_of_its_points() -> None:
    """Points of a wall, each seen from where a robot at 2 m/s was then."""
    times_s = np.linspace(-0.1, 0.0, 500)
    true_points = np.column_stack([np.full(500, 4.0), np.linspace(-3.0, 3.0, 500), np.full(500, 0.4)])
    seen = true_points - np.column_stack([2.0 * times_s, 0.0 * times_s, 0.0 * times_s])
    cloud = PointCloud(1.0, seen.astype(np.float32), times_s)
    twist = np.array([0.0, 0.0, 0.0, 2.0, 0.0, 0.0])
    np.testing.assert_allclose(base_points(cloud, twist, TURNS), true_points, atol=0.003)
    off = TURNS.model_copy(update={"deskew": False})
    np.testing.assert_allclose(base_points(cloud, twist, off), seen, atol=1e-5)


@pytest.mark.parametrize(
    "times_s",
    [np.zeros(0), np.zeros(10), np.full(10, np.nan), np.array([0.0, 50.0]), np.array([1e9, 1e9 + 0.1])],
)
def test_times_that_are_no_turn_deskew_nothing(times_s: FloatArray) -> None:
    assert not turn_known(times_s)


def test_the_voxel_follows_the_scene() -> None:
    free = CloudOdometryConfig()
    room, street = (points_at(gtsam.Pose3()) * scale for scale in (1.0, 5.0))
    assert voxel_of(street, free) == pytest.approx(min(5.0 * voxel_of(room, free), 0.6))
    assert voxel_of(room, TURNS) == 0.2


def test_a_drive_is_tracked_and_a_gap_is_reported() -> None:
    tracker = CloudTracker(CONFIG, None)
    errors, motions = [], []
    poses = way_round(41)[:12]
    for number, pose in enumerate(poses):
        cloud = look(pose, 0.1 * number, seed=number)
        if number == 6:
            cloud = PointCloud(cloud.stamp_s, np.zeros((0, 3), np.float32), None, T_BASE_LIDAR)
        tracked = tracker.track(cloud)
        if tracked.new_keyframe:
            tracker.add_keyframe(tracked)
        errors.append(np.linalg.norm(poses[0].between(pose).between(tracked.pose).translation()))
        motions.append(tracked.motion)
    assert motions[0] is None
    assert motions[6] is None
    assert all(motion is not None for motion in motions[7:])
    assert max(errors[:6] + errors[7:]) < 0.02
    assert errors[6] < 0.1


@pytest.mark.parametrize(("turn_rad_s", "speed_m_s"), [(1.5, 2.0), (2.5, 1.0)])
def test_a_robot_that_moves_while_the_lidar_turns_is_followed(turn_rad_s: float, speed_m_s: float) -> None:
    """Without wheels; it starts and stops turning at once."""
    tracker, pose, errors = CloudTracker(CONFIG, None), base(-1.5, -1.0, 0.0), []
    first = pose
    for number in range(24):
        moving = number > 1
        twist = np.array([0.0, 0.0, turn_rad_s * (8 < number < 16), speed_m_s * moving, 0.0, 0.0])
        cloud = at_middle_of_turn(look_on_the_way(pose, twist, 0.1 * number, seed=number), TURNS)
        assert cloud.stamp_s == pytest.approx(0.1 * number + 0.05, abs=0.001)
        tracked = tracker.track(cloud)
        if tracked.new_keyframe:
            tracker.add_keyframe(tracked)
        middle = pose.compose(gtsam.Pose3.Expmap(twist * (cloud.stamp_s - 0.1 * number)))
        errors.append(gtsam.Pose3.Logmap(first.between(middle).between(tracked.pose)))
        pose = pose.compose(gtsam.Pose3.Expmap(0.1 * twist))
    assert np.abs(np.array(errors)[:, 3:]).max() < 0.03
    assert np.abs(np.array(errors)[:, :3]).max() < 0.01


def test_middles_of_voxels_are_asked_only_where_the_guess_is_far(
    odometry: CloudOdometry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes most of the time, and planes find the same pose from a near guess."""
    truth, asked = base(0.3, -0.2, 0.2), []
    draw = local_cloud.drawn_near
    monkeypatch.setattr(local_cloud, "drawn_near", lambda *args: asked.append(1) or draw(*args))  # type: ignore[func-returns-value]
    near = odometry.match(odometry.thinned(points_at(truth)), [truth.compose(base(0.06, -0.04, 0.01))])
    assert not asked
    far = odometry.match(odometry.thinned(points_at(truth)), [truth.compose(base(0.4, -0.3, 0.1))])
    assert asked
    assert np.linalg.norm(error_of(near, truth) - error_of(far, truth)) < 0.002


def test_errors_that_planes_share_widen_the_covariance() -> None:
    """The same noise a point by itself, and a plane as a whole."""
    rng = np.random.default_rng(0)
    places = np.array([[x, y, 0.0] for x in (-2.0, 0.0, 2.0) for y in (-2.0, 0.0, 2.0)])
    normals = np.tile(np.eye(3), (3, 1))
    patches = []
    for place, normal in zip(places, normals, strict=True):
        flat = rng.uniform(-0.3, 0.3, (300, 3))
        patches.append(place + 0.45 + flat - np.outer(flat @ normal, normal))
    planes = PlaneVoxels.build(np.vstack(patches), 0.2, 0.06)
    own = [
        patch + 0.02 * np.outer(rng.standard_normal(300), n)
        for patch, n in zip(patches, normals, strict=True)
    ]
    shared = [patch + 0.02 * rng.standard_normal() * n for patch, n in zip(patches, normals, strict=True)]
    spreads = []
    for cloud in (own, shared):
        found = align_cloud(np.vstack(cloud), planes, gtsam.Pose3(), 15, 0.2)
        assert found is not None
        root = np.linalg.cholesky(np.linalg.inv(found.hessian))
        spreads.append(np.trace(root.T @ found.spread @ root) / found.residual_m**2)
    assert spreads[0] < 12.0  # of independent readings it is six
    assert spreads[1] > 5.0 * spreads[0]


def test_after_a_restart_nothing_is_expected_of_what_was_seen_before() -> None:
    """Keyframes show how much of the next one is known; a new place has to show that anew."""
    fresh, restarted = CloudOdometry(CONFIG, 0.2), CloudOdometry(CONFIG, 0.2)
    for seed, x in enumerate((-0.4, -0.2, 0.0, 0.2)):
        restarted.add_keyframe(points_at(base(x, 0.0, 0.0), seed), base(x, 0.0, 0.0), LIDAR)
    restarted.restart()
    for odometry in (fresh, restarted):
        odometry.add_keyframe(points_at(base(0.5, 0.0, 0.1), 7), base(0.5, 0.0, 0.1), LIDAR)
    # Of a scan whose half is nonsense, the old place would say that more of it has to fit.
    scan = points_at(base(0.6, 0.0, 0.1), 8)
    rng = np.random.default_rng(0)
    found = []
    for share in np.linspace(0.1, 0.9, 9):
        nonsense = rng.random(len(scan)) < share
        spoilt = scan + nonsense[:, None] * rng.normal(0.0, 2.0, scan.shape)
        found.append([one.match(spoilt, [base(0.6, 0.0, 0.1)]) is None for one in (fresh, restarted)])
    assert [one for one, _ in found] == [other for _, other in found]
    assert {one for one, _ in found} == {True, False}
