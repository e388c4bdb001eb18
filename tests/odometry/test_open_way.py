"""What is claimed of a way that no cloud determines."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from slam.estimates import MotionEstimate
from slam.odometry.open_way import OpenWay

AHEAD = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
SURE = MotionEstimate(gtsam.Pose3(), 1e-6 * np.eye(6), 0.9, 0.9, 0.01, True, False, np.zeros(6))
OPEN = replace(SURE, degenerate=True, weak_direction=AHEAD)
TWIST = 8.0 * AHEAD


def along_m2(motion: MotionEstimate) -> float:
    return float(motion.covariance[3, 3])


def no_imu() -> None:
    """No covariance."""


def test_the_deviation_of_a_tunnel_grows_with_its_length() -> None:
    way, total = OpenWay(5.0), 0.0
    assert way.widened(0.0, SURE, TWIST, no_imu) is SURE
    for n in range(1, 101):
        total += along_m2(way.widened(0.1 * n, OPEN, TWIST, no_imu))
        way.add_keyframe()
    # Ten seconds at 8 m/s, evenly spread from nothing to twice that.
    assert total**0.5 == pytest.approx(80.0 / 3.0**0.5, rel=0.01)
    assert way.widened(10.1, SURE, TWIST, no_imu) is SURE


def test_across_nothing_is_widened_and_an_imu_says_how_far() -> None:
    way = OpenWay(5.0)
    way.widened(0.0, SURE, TWIST, no_imu)
    told = way.widened(1.0, OPEN, TWIST, lambda: np.diag([0, 0, 0, 0.04, 9.0, 9.0]))
    assert along_m2(told) == pytest.approx(0.04, rel=0.01)
    assert told.covariance[4, 4] == SURE.covariance[4, 4]


def test_a_match_in_part_resolves_nothing() -> None:
    way = OpenWay(5.0)
    way.widened(0.0, SURE, TWIST, no_imu)
    way.widened(1.0, OPEN, TWIST, no_imu)
    assert along_m2(way.widened(2.0, replace(SURE, converged=False), TWIST, no_imu)) > 16.0**2 / 3.1


def test_a_way_that_was_never_determined_is_as_open_as_a_robot_is_fast() -> None:
    way = OpenWay(5.0)
    way.widened(0.0, OPEN, np.zeros(6), no_imu)
    assert along_m2(way.widened(2.0, OPEN, np.zeros(6), no_imu)) == pytest.approx(100.0 / 3.0, rel=0.01)


def test_where_the_way_is_known_nobody_is_asked() -> None:
    def asked() -> np.ndarray:
        raise AssertionError("the spread is slow to tell")

    way = OpenWay(5.0)
    assert way.widened(0.0, SURE, TWIST, asked) is SURE
