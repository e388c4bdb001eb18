"""A camera's motion as its robot's: any mounting, a tilt that costs trust, and a vote of cameras."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from room_world import T_BODY_CAMERA

from slam.vision.planar_motion import planar_motion

CONFIDENT = np.diag([1e-6, 1e-6, 1e-6, 1e-5, 1e-5, 1e-5])
MOUNTINGS = [
    T_BODY_CAMERA,
    gtsam.Pose3(gtsam.Rot3.Rz(1.2), np.array([0.3, -0.2, 0.9])) * T_BODY_CAMERA,
    gtsam.Pose3(gtsam.Rot3.RzRyRx(0.0, 0.5, -2.5), np.array([-0.4, 0.1, 1.2])) * T_BODY_CAMERA,
]


def of_camera(base: gtsam.Pose3, mounting: gtsam.Pose3) -> gtsam.Pose3:
    """What the camera sees of a motion of its base."""
    return mounting.inverse() * base * mounting


def on_floor(x: float, y: float, yaw: float) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Rz(yaw), np.array([x, y, 0.0]))


@pytest.mark.parametrize("mounting", MOUNTINGS)
@pytest.mark.parametrize("motion", [(0.0, 0.0, 0.0), (0.2, 0.05, 0.3), (-0.1, 0.3, -2.0), (0.0, 0.0, 3.1)])
def test_a_motion_on_the_floor_is_that_motion(
    mounting: gtsam.Pose3, motion: tuple[float, float, float]
) -> None:
    found = planar_motion(of_camera(on_floor(*motion), mounting), CONFIDENT, mounting)
    np.testing.assert_allclose(found.motion, motion, atol=1e-9)
    assert found.excess == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_the_covariance_is_that_of_samples(mounting: gtsam.Pose3) -> None:
    """Errors of the camera, by hand: x, y, yaw of the base after the motion, in its frame then."""
    rng = np.random.default_rng(0)
    root = rng.normal(0.0, 0.002, (6, 6))
    covariance = root @ root.T + 1e-8 * np.eye(6)
    base = on_floor(0.2, 0.05, 0.3)
    camera = of_camera(base, mounting)
    errors = []
    for sample in rng.multivariate_normal(np.zeros(6), covariance, 4000):
        seen = mounting * camera * gtsam.Pose3.Expmap(sample) * mounting.inverse()
        step = base.between(seen)
        errors.append([step.x(), step.y(), step.rotation().yaw()])
    expected = np.cov(np.array(errors).T)
    found = planar_motion(camera, covariance, mounting)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found.covariance / scale, expected / scale, atol=0.08)


@pytest.mark.parametrize(
    "leaves",
    [gtsam.Pose3(gtsam.Rot3.Rx(0.1), np.zeros(3)), gtsam.Pose3(gtsam.Rot3.Ry(-0.1), np.zeros(3)),
     gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 0.1]))],
    ids=["roll", "pitch", "lift"],
)  # fmt: skip
@pytest.mark.parametrize("mounting", MOUNTINGS)
def test_what_leaves_the_floor_is_reported(leaves: gtsam.Pose3, mounting: gtsam.Pose3) -> None:
    base = on_floor(0.2, 0.0, 0.1)
    tilted = planar_motion(of_camera(base * leaves, mounting), CONFIDENT, mounting)
    assert tilted.excess > 16.0


def test_a_little_sway_is_harmless() -> None:
    sway = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.008, -0.008, 0.0), np.array([0.0, 0.0, 0.008]))
    found = planar_motion(of_camera(on_floor(0.2, 0, 0.1) * sway, MOUNTINGS[1]), CONFIDENT, MOUNTINGS[1])
    assert found.excess < 2.0
