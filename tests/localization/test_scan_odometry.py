"""How the robot moved between two scans: through gaps by the wheels, along a corridor past their slips."""

import gtsam
import numpy as np
import pytest

from slam.config import Config, load_config
from slam.localization.odometry import OdometryStep, ScanOdometry
from slam.localization.scan_view import ScanView
from slam.measurements import FloatArray, LaserScan, WheelOdometry

ANGLES = np.linspace(-np.pi / 2.0, np.pi / 2.0, 181)
SPEED_M_S = 0.5


def scan_of(stamp_s: float, ranges_m: FloatArray) -> LaserScan:
    return LaserScan(stamp_s, ranges_m.astype(np.float32), ANGLES[0], ANGLES[1] - ANGLES[0], 30.0)


def corridor_scan(stamp_s: float) -> LaserScan:
    """Between two bare walls, 1.5 m to each side, from which nothing shows how far it is."""
    ranges = 1.5 / np.maximum(np.abs(np.sin(ANGLES)), 0.15)
    ranges[np.abs(np.sin(ANGLES)) < 0.15] = np.inf
    return scan_of(stamp_s, ranges)


def driven(odometry: ScanOdometry, begin_s: float, end_s: float) -> None:
    """The wheels measure, ten times a second, that it goes straight on."""
    for stamp_s in np.arange(begin_s, end_s, 0.1).tolist():
        odometry.add_wheels(WheelOdometry(stamp_s, gtsam.Pose2(SPEED_M_S * stamp_s, 0.0, 0.0)))


def add(odometry: ScanOdometry, stamp_s: float) -> OdometryStep:
    return odometry.add(ScanView.of(corridor_scan(stamp_s), Config()))


def begun() -> ScanOdometry:
    """Ten seconds of scans, one a second."""
    odometry = ScanOdometry(Config())
    for n in range(10):
        driven(odometry, float(n), n + 0.95)
        add(odometry, n + 0.95)
    return odometry


@pytest.mark.parametrize(("silent_s", "sigma_m"), [(0.0, 0.2), (20.0, None), (8.0, 4.0)])
def test_wheels_lead_on_where_no_scan_comes_for_long(silent_s: float, sigma_m: float | None) -> None:
    """Nobody does where they are silent too, unless they left a way out: it is a guess."""
    odometry = begun()
    driven(odometry, 10.0, 29.95 - silent_s)
    if silent_s == 8.0:
        odometry.add_wheels(WheelOdometry(29.95, gtsam.Pose2(SPEED_M_S * 21.9, 0.0, 0.0)))
    elif silent_s:
        odometry.add_wheels(WheelOdometry(29.95, gtsam.Pose2(SPEED_M_S * 29.95, 0.0, 0.0)))
    empty = scan_of(29.95, np.full(181, np.inf))
    moved = odometry.add(ScanView.of(empty, Config())).moved
    assert (moved is None) == (sigma_m is None)
    if moved is not None:
        assert moved.pose.x() == pytest.approx(SPEED_M_S * 20.0, rel=0.02)
        assert np.sqrt(moved.covariance[0, 0]) > sigma_m


def test_past_a_gap_a_match_that_the_wheels_contradict_is_none() -> None:
    """The corridor looks the same after a right angle that only the wheels show."""
    odometry = begun()
    for stamp_s in np.arange(10.0, 29.95, 0.1).tolist():
        turn = min((stamp_s - 10.0) / 10.0, 1.0) * np.pi / 2.0
        odometry.add_wheels(WheelOdometry(stamp_s, gtsam.Pose2(SPEED_M_S * 9.9, 0.0, turn)))
    moved = add(odometry, 29.95).moved
    assert moved is not None and moved.pose.theta() == pytest.approx(np.pi / 2.0, abs=0.05)


def test_a_heading_that_slips_does_not_leave_the_corridor_open() -> None:
    odometry = begun()
    for n, yaw_rad in enumerate([0.5, 1.0, *[1.5] * 8]):
        way_m = 0.1 * SPEED_M_S * n
        wheels = gtsam.Pose2(SPEED_M_S * 10.0, 0.0, yaw_rad) * gtsam.Pose2(way_m, 0.0, 0.0)
        odometry.add_wheels(WheelOdometry(10.0 + 0.1 * n, wheels))
    moved = add(odometry, 10.95).moved
    assert moved is not None and abs(moved.pose.theta()) < 0.02
    assert moved.pose.x() == pytest.approx(SPEED_M_S, abs=0.1)
    assert np.sqrt(moved.covariance[0, 0]) < 0.5


def test_without_wheels_who_stands_may_go_where_nothing_shows_it() -> None:
    """As fast as before; and how fast it goes then, the next scan of a bare corridor does not show either."""
    odometry = ScanOdometry(load_config(None, ["sensors.wheels=false"]))
    for n in range(25):
        ahead_m = 4.0 - 0.2 * SPEED_M_S * min(n, 18)
        ranges = np.minimum(corridor_scan(0.0).ranges_m, ahead_m / np.maximum(np.cos(ANGLES), 1e-3))
        odometry.add(ScanView.of(scan_of(0.2 * n, ranges), Config()))
    steps = [add(odometry, 0.2 * n).moved for n in (25, 26)]
    sigmas = [np.sqrt(step.covariance[0, 0]) for step in steps if step is not None]
    usual_m = 0.2 * SPEED_M_S * np.sqrt(18.0 / 24.0)
    assert sigmas == pytest.approx(np.sqrt([1.0, 2.0]) * np.hypot(usual_m, 0.05), rel=0.1)
