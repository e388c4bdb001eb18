"""PnP without a guess: the true pose among outliers, and none where the points do not show it."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from room_world import SMALL, error_of, looking

from slam.measurements import FloatArray
from slam.vision.feature_pose import FeaturePose, pose_from_features

POSES = [looking(-0.3, 0.2, 1.5, -0.7, 0.35), looking(40.0, -20.0, 9.0, 2.9, -0.4, 1.0)]


def project(points: FloatArray, pose: gtsam.Pose3) -> FloatArray:
    camera = (points - pose.translation()) @ pose.rotation().matrix()
    return camera[:, :2] / camera[:, 2:] * [SMALL.fx, SMALL.fy] + [SMALL.cx, SMALL.cy]


def before(pose: gtsam.Pose3, count: int, seed: int = 0) -> FloatArray:
    camera = np.random.default_rng(seed).uniform([-1.0, -0.8, 1.0], [1.0, 0.8, 3.0], (count, 3))
    return camera @ pose.rotation().matrix().T + pose.translation()


def found(points: FloatArray, pixels: FloatArray, least_inliers: int = 15) -> FeaturePose | None:
    return pose_from_features(points, pixels, SMALL, 3.0, least_inliers)


@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("wrong", [0, 20, 60])
def test_the_pose_among_outliers(pose: gtsam.Pose3, wrong: int) -> None:
    points = before(pose, 100)
    pixels = project(points, pose)
    pixels[:wrong] = np.random.default_rng(1).uniform([0, 0], [160, 120], (wrong, 2))
    result = found(points, pixels)
    assert result is not None
    assert np.abs(error_of(result.T_reference_camera, pose)).max() < 0.01
    assert result.inliers[wrong:].all()
    assert result.inliers[:wrong].mean() < 0.2 if wrong else True


def test_noise_is_averaged() -> None:
    points = before(POSES[0], 300)
    pixels = project(points, POSES[0]) + 0.5 * np.random.default_rng(2).standard_normal((300, 2))
    result = found(points, pixels)
    assert result is not None
    error = error_of(result.T_reference_camera, POSES[0])
    assert np.abs(error[:3]).max() < 0.003
    assert np.abs(error[3:]).max() < 0.006


@pytest.mark.parametrize("seed", range(5))
def test_all_that_agree_are_counted_though_most_do_not(seed: int) -> None:
    """By the pose of three points alone 3 of 100 that agree with the true one are left out."""
    rng = np.random.default_rng(seed)
    points = before(POSES[0], 300, seed)
    pixels = project(points, POSES[0]) + 0.7 * rng.standard_normal((300, 2))
    pixels[:180] = rng.uniform([0, 0], [160, 120], (180, 2))
    result = found(points, pixels)
    assert result is not None
    assert result.inliers[180:].mean() > 0.99
    assert np.abs(error_of(result.T_reference_camera, POSES[0])).max() < 0.01


def test_the_same_features_give_the_same_pose() -> None:
    points = before(POSES[0], 60)
    pixels = project(points, POSES[0]) + np.random.default_rng(2).standard_normal((60, 2))
    one, other = found(points, pixels), found(points, pixels)
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one.T_reference_camera.matrix(), other.T_reference_camera.matrix())


@pytest.mark.parametrize("count", [0, 1, 3, 4, 14])
def test_too_few_points_show_nothing(count: int) -> None:
    points = before(POSES[0], count)
    assert found(points, project(points, POSES[0])) is None


def test_pixels_by_chance_show_nothing() -> None:
    points = before(POSES[0], 80)
    assert found(points, np.random.default_rng(1).uniform([0, 0], [160, 120], (80, 2))) is None


@pytest.mark.parametrize("kind", ["line", "point"])
def test_degenerate_points_give_none_or_a_finite_pose(kind: str) -> None:
    """Points on a line leave a turn around it open; many times one point leaves nearly all."""
    along = np.linspace(0.0, 1.0, 40)[:, None] if kind == "line" else np.zeros((40, 1))
    camera = np.array([0.1, -0.2, 2.0]) + along * [0.5, 0.3, 0.4]
    points = camera @ POSES[0].rotation().matrix().T + POSES[0].translation()
    pixels = project(points, POSES[0])
    result = found(points, pixels)
    if result is not None:
        assert np.isfinite(result.T_reference_camera.matrix()).all()


def test_points_on_a_wall_are_enough() -> None:
    """Coplanar points show the pose all the same."""
    rng = np.random.default_rng(4)
    camera = np.column_stack([rng.uniform(-0.9, 0.9, 80), rng.uniform(-0.7, 0.7, 80), np.zeros(80)])
    camera[:, 2] = 2.0 + 0.3 * camera[:, 0]
    points = camera @ POSES[0].rotation().matrix().T + POSES[0].translation()
    result = found(points, project(points, POSES[0]))
    assert result is not None
    assert np.abs(error_of(result.T_reference_camera, POSES[0])).max() < 0.01
