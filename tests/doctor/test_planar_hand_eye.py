"""The mounting of a sensor on a robot in the plane, from the motions of both."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from slam.doctor.planar_hand_eye import PlanarHandEye, planar_hand_eye

AHEAD = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
MOUNT = gtsam.Pose3(AHEAD, np.array([0.2, -0.1, 0.5]))


def found(turn_rad: float) -> PlanarHandEye | None:
    """Of a camera that looks ahead, on a robot that turns by so much a step; with a milliradian of noise."""
    rng = np.random.default_rng(3)
    base = np.column_stack([rng.normal(0.4, 0.05, 60), np.zeros(60), rng.normal(0.0, turn_rad, 60)])
    steps = [MOUNT.between(gtsam.Pose3(gtsam.Pose2(*step)).compose(MOUNT)) for step in base]
    turns = np.array([gtsam.Rot3.Logmap(step.rotation()) for step in steps])
    shifts_m = np.array([step.translation() for step in steps])
    noise = rng.normal(0.0, 0.001, (2, 60, 3))
    return planar_hand_eye(turns + noise[0], shifts_m + noise[1], base)


def test_turns_show_where_a_camera_sits() -> None:
    result = found(0.2)
    assert result is not None
    np.testing.assert_allclose(result.up, [0.0, -1.0, 0.0], atol=0.01)
    np.testing.assert_allclose(result.ahead, [0.0, 0.0, 1.0], atol=0.01)


@pytest.mark.parametrize("turn_rad", [0.0, 0.004])
def test_a_robot_that_only_drives_ahead_shows_no_axis(turn_rad: float) -> None:
    """Its few milliradians are the noise of the sensor, or of the wheels."""
    assert found(turn_rad) is None
