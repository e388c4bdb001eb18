"""What is claimed of a path that no cloud determines."""

from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from slam.estimates import MotionEstimate
from slam.odometry.unobserved_path import UnobservedPath

AHEAD = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
SURE = MotionEstimate(gtsam.Pose3(), 1e-6 * np.eye(6), 0.9, 0.9, 0.01, True, False, np.zeros(6))
OPEN = replace(SURE, degenerate=True, weak_direction=AHEAD)
TWIST = 8.0 * AHEAD


def along_m2(motion: MotionEstimate) -> float:
    return float(motion.covariance[3, 3])


def test_the_deviation_of_a_tunnel_grows_with_its_length() -> None:
    path, total = UnobservedPath(5.0), 0.0
    assert path.widened(0.0, SURE, TWIST) is SURE
    for n in range(1, 101):
        total += along_m2(path.widened(0.1 * n, OPEN, TWIST))
        path.add_keyframe()
    # Ten seconds at 8 m/s, evenly spread from nothing to twice that.
    assert total**0.5 == pytest.approx(80.0 / 3.0**0.5, rel=0.01)
    assert path.widened(10.1, SURE, TWIST) is SURE


def test_a_match_in_part_resolves_nothing() -> None:
    path = UnobservedPath(5.0)
    path.widened(0.0, SURE, TWIST)
    path.widened(1.0, OPEN, TWIST)
    assert along_m2(path.widened(2.0, replace(SURE, converged=False), TWIST)) > 16.0**2 / 3.1


def test_a_way_that_was_never_determined_is_as_open_as_a_robot_is_fast() -> None:
    path = UnobservedPath(5.0)
    path.widened(0.0, OPEN, np.zeros(6))
    assert along_m2(path.widened(2.0, OPEN, np.zeros(6))) == pytest.approx(100.0 / 3.0, rel=0.01)
