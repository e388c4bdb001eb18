"""Every reading of the log gets a pose: with wheels, without, before the first scan, at backward stamps."""

import math

import gtsam
import numpy as np
import pytest

from slam.matching.planar import between, compose, wrap
from slam.measurements import FloatArray, pose2_from_row
from slam.trajectory.readings import Readings


def scan(
    readings: Readings, stamp_s: float, pose: FloatArray, wheels: FloatArray | None, *, trusted: bool = True
) -> None:
    readings.add_scan(stamp_s, pose2_from_row(pose), wheels, trusted=trusted)


def found(readings: Readings, keyframes: FloatArray) -> FloatArray:
    """(N, 3) the poses of all readings."""
    return readings.trajectory([pose2_from_row(pose) for pose in keyframes]).to_planar()


def row(x: float, y: float = 0.0, yaw: float = 0.0) -> FloatArray:
    return np.array([x, y, yaw])


def test_it_counts_scans_and_keyframes() -> None:
    readings = Readings()
    readings.add_wheel(0.5, row(0.0))
    for n in range(4):
        scan(readings, 1.0 + n, row(n), row(n))
        if n in (0, 2):
            readings.mark_keyframe()
        readings.add_wheel(1.5 + n, row(n + 0.5))
    assert readings.scan_count == 4
    np.testing.assert_array_equal(readings.keyframe_scans(), [0, 2])
    trajectory = readings.trajectory([gtsam.Pose2(), gtsam.Pose2(2.0, 0.0, 0.0)])
    np.testing.assert_array_equal(trajectory.stamps_s, [0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5])


@pytest.mark.parametrize("frame", [(0.0, 0.0, 0.0), (-20.0, 3.0, 2.2)])
def test_wheels_carry_the_poses_between_scans(frame: tuple[float, ...]) -> None:
    """Wheels in an odom frame of their own and 10 % short, keyframes in the map: all lie on the truth."""
    readings = Readings()
    odom = np.array([4.0, 4.0, -0.7])
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.uniform(0.02, 0.1, 25))
    for n in range(25):
        wheels = compose(odom, row(x[n]))
        if n % 4 == 2:
            scan(readings, 0.1 * n, row(1.1 * x[n]), wheels)
            if n % 8 == 2:
                readings.mark_keyframe()
        else:
            readings.add_wheel(0.1 * n, wheels)
    truth = np.array([compose(np.array(frame), row(1.1 * value)) for value in x])
    poses = found(readings, truth[2::8])
    np.testing.assert_allclose(poses[2:23, :2], truth[2:23, :2], atol=1e-5)
    np.testing.assert_allclose(np.cos(poses[:, 2] - frame[2]), 1.0, atol=1e-9)
    # Before the first and after the last scan only the wheels speak.
    for end, inside in ((0, 2), (24, 22)):
        assert between(poses[inside], poses[end])[0] == pytest.approx(x[end] - x[inside], abs=1e-9)


def test_scans_that_are_no_keyframe_share_the_correction() -> None:
    """Scan matching drifted by 0.4 m over four steps; the optimisation takes it back: 0.1 m a step."""
    readings = Readings()
    for n in range(5):
        scan(readings, float(n), row(1.1 * n), None)
        if n in (0, 4):
            readings.mark_keyframe()
    poses = found(readings, np.array([row(0), row(4)]))
    np.testing.assert_allclose(poses[:, 0], [0, 1, 2, 3, 4], atol=1e-5)


def test_without_wheels_readings_interpolate_in_time() -> None:
    readings = Readings()
    for stamp_s, seen in [
        (0.0, row(0.0, 1.0, 3.0)),
        (1.0, None),
        (1.5, None),
        (2.0, row(4.0, 1.0, -3.0)),
        (9.0, None),
    ]:
        if seen is None:
            readings.add_wheel(stamp_s, None)
        else:
            scan(readings, stamp_s, seen, None)
            readings.mark_keyframe()
    poses = found(readings, np.array([row(0.0, 1.0, 3.0), row(4.0, 1.0, -3.0)]))
    np.testing.assert_allclose(poses[:, 0], [0.0, 2.0, 3.0, 4.0, 4.0], atol=1e-9)
    # The short way round through pi.
    turned = np.remainder(poses[:, 2] - 3.0, 2 * math.pi)
    whole = 2 * math.pi - 6.0
    np.testing.assert_allclose(turned, np.array([0.0, 0.5, 0.75, 1.0, 1.0]) * whole, atol=1e-9)


@pytest.mark.parametrize("wheels", [False, True])
def test_readings_before_the_first_scan_have_its_pose(wheels: bool) -> None:
    """With wheels that come late, too: before their first reading they had not turned."""
    readings = Readings()
    readings.add_wheel(0.0, None)
    scan(readings, 1.0, row(0.0), None)
    readings.mark_keyframe()
    readings.add_wheel(2.0, row(7.0) if wheels else None)
    scan(readings, 3.0, row(1.0), row(8.0) if wheels else None)
    readings.mark_keyframe()
    poses = found(readings, np.array([row(5.0, 5.0), row(6.0, 5.0)]))
    np.testing.assert_allclose(poses[[0, 1, 3]], [[5, 5, 0], [5, 5, 0], [6, 5, 0]], atol=1e-5)
    assert 5.0 - 1e-5 <= poses[2, 0] <= 6.0


@pytest.mark.parametrize("wheels", [False, True])
@pytest.mark.parametrize(
    "stamps_s", [[0.0, 1.0, 0.5, 0.2, 3.0], [5.0, 4.0, 3.0, 2.0, 1.0], [2.0] * 5, [0.0, 1e9, 1.0, 2.0, 3.0]]
)
def test_stamps_in_any_order_survive(stamps_s: list[float], wheels: bool) -> None:
    """The log's order is the true order: scans keep their poses, what lies between stays between."""
    readings = Readings()
    for n, stamp_s in enumerate(stamps_s):
        wheel_pose = row(n) if wheels else None
        if n % 2 == 0:
            scan(readings, stamp_s, row(n), wheel_pose)
            readings.mark_keyframe()
        else:
            readings.add_wheel(stamp_s, wheel_pose)
    trajectory = readings.trajectory([gtsam.Pose2(float(x), 0.0, 0.0) for x in (0, 2, 4)])
    np.testing.assert_array_equal(trajectory.stamps_s, stamps_s)
    x = trajectory.to_planar()[:, 0]
    np.testing.assert_allclose(x[::2], [0, 2, 4], atol=1e-9)
    assert 0.0 <= x[1] <= 2.0 + 1e-9
    assert 2.0 - 1e-9 <= x[3] <= 4.0 + 1e-9
    if wheels:
        np.testing.assert_allclose(x, [0, 1, 2, 3, 4], atol=1e-5)


def test_a_single_scan() -> None:
    readings = Readings()
    scan(readings, 3.0, row(0.0), None)
    readings.mark_keyframe()
    np.testing.assert_allclose(found(readings, np.array([row(1.0, 2.0, 0.5)])), [[1.0, 2.0, 0.5]])


@pytest.mark.parametrize("wheels", [False, True])
def test_a_scan_that_is_not_sure_is_no_anchor(wheels: bool) -> None:
    """A match that is 3 m off, and known to be in doubt: its scan lies where its neighbours say."""
    readings = Readings()
    for n in range(5):
        pose = row(n, 3.0 if n == 2 else 0.0)
        scan(readings, float(n), pose, row(n) if wheels else None, trusted=n != 2)
        if n in (0, 4):
            readings.mark_keyframe()
    poses = found(readings, np.array([row(0), row(4)]))
    np.testing.assert_allclose(poses[:, 1], 0.0, atol=1e-6)
    np.testing.assert_allclose(poses[2, 0], 2.0, atol=0.5)
    assert len(poses) == 5


def test_where_no_scan_is_sure_the_first_anchors_all() -> None:
    readings = Readings()
    for n in range(3):
        scan(readings, float(n), row(0.1 * n), row(n), trusted=False)
        if n == 0:
            readings.mark_keyframe()
    poses = found(readings, np.array([row(5.0)]))
    np.testing.assert_allclose(poses[:, 0], [5.0, 6.0, 7.0], atol=1e-9)


def test_a_keyframe_is_an_anchor_though_its_match_was_in_doubt() -> None:
    """Cameras and loops have mended it: the reading at its stamp is where the keyframe is."""
    readings = Readings()
    for n in range(5):
        scan(readings, float(n), row(n), row(0.9 * n), trusted=n != 2)
        if n % 2 == 0:
            readings.mark_keyframe()
    keyframes = np.array([row(0.0), row(2.0, 0.3), row(4.0)])
    np.testing.assert_allclose(found(readings, keyframes)[[0, 2, 4]], keyframes, atol=1e-9)


def test_scans_that_were_taken_at_other_times_are_moved_there() -> None:
    """Frames whose stamps are late: only they are asked for anew, and lie where the wheels were then."""
    readings = Readings()
    for n in range(9):
        readings.add_wheel(float(n), row(0.1 * n * n))
        if n % 3 == 2:
            scan(readings, n + 0.25, row(0.1 * n * n), row(7.0))
            readings.mark_keyframe()
    scans = np.array([0, 2])
    readings.restamp(scans, np.array([2.0, 7.5]))
    readings.read_wheels_at(0.0, scans)
    np.testing.assert_array_equal(readings.scan_stamps_s(), [2.0, 5.25, 7.5])
    np.testing.assert_allclose(readings.keyframe_wheels(), [row(0.4), row(7.0), row(5.65)])
    poses = readings.trajectory([gtsam.Pose2(), gtsam.Pose2(1.0, 0.0, 0.0), gtsam.Pose2(2.0, 0.0, 0.0)])
    np.testing.assert_array_equal(poses.stamps_s[[3, 7, 11]], [2.0, 5.25, 7.5])


def test_wheels_are_read_anew_when_their_clock_is_known() -> None:
    readings = Readings()

    def where(true_s: float) -> FloatArray:
        return row(true_s, 0.0, wrap(3.0 + 0.2 * true_s))

    scans = [0.1 * n - 0.05 for n in range(2, 40, 5)]
    for n in range(40):
        # The wheels' stamps are ahead by 0.3 s; in the middle both clocks begin anew.
        stamp_s = 0.1 * n - (100.0 if n >= 20 else 0.0)
        if n % 5 == 2:
            scan(readings, stamp_s - 0.05, where(0.1 * n - 0.05), row(7.0))
            readings.mark_keyframe()
        readings.add_wheel(stamp_s, where(0.1 * n - 0.3))
    keyframes = [where(true_s) for true_s in scans]
    before = found(readings, keyframes)
    readings.read_wheels_at(0.3)
    after = found(readings, keyframes)
    stamps_s = readings.trajectory([pose2_from_row(pose) for pose in keyframes]).stamps_s
    true_s = np.where(stamps_s < -50.0, stamps_s + 100.0, stamps_s)
    # Where readings end, at the log's end and where the clock begins anew, none shows the last moments.
    stated = (true_s < 1.16) | ((true_s > 2.16) & (true_s < 3.16))
    expected = np.array([where(one_s) for one_s in true_s])
    np.testing.assert_allclose(after[stated], expected[stated], atol=1e-6)
    assert np.abs(before - expected)[stated].max() > 0.1


@pytest.mark.parametrize("wheels", [False, True])
def test_without_wheels_a_scan_that_leaves_a_direction_open_fixes_nothing(wheels: bool) -> None:
    readings = Readings()
    for n, sigma_m in enumerate([0.01, 20.0, 0.01]):
        covariance = np.diag([sigma_m, 0.01, 0.01]) ** 2
        readings.add_scan(1.0 + n, gtsam.Pose2(), row(n) if wheels else None, covariance=covariance)
    assert readings.placed().tolist() == [0, 1, 2]
    assert readings.fixed(1.0).tolist() == ([0, 1, 2] if wheels else [0, 2])
