"""Planes that are thicker than walls are, and clouds whose ranges are noisy."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from cloud_world import CONFIG, T_BASE_LIDAR, base, error_of, points_at

from fusion.height_band import thin_to_voxels
from slam.matching import local_cloud
from slam.matching.cloud_alignment import align_cloud
from slam.matching.plane_voxels import PlaneVoxels
from slam.odometry.cloud_odometry import CloudOdometry

TURNS = CONFIG.cloud_odometry
STILL, LIDAR = np.zeros(6), T_BASE_LIDAR.translation()


def test_a_plane_thicker_than_planes_are_counts_by_its_thickness() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(0.1, 3.9, (2000, 2)), 1.5 + 0.2 * rng.standard_normal(2000)])
    planes = PlaneVoxels(1.0, 0.06, rough=1)
    planes.add(wall)
    residuals = planes.residuals(wall, np.eye(4))
    assert len(residuals.which) > 1900 and not planes.pairs(wall).found.any()
    assert np.std(residuals.distances_m) == pytest.approx(0.06, rel=0.05)
    assert planes.roughness(residuals.voxels) == pytest.approx((0.2 / 0.06) ** 2, rel=0.1)


def test_an_alignment_settles_where_its_steps_are_noise() -> None:
    """Points change their voxels, and steps stay longer than a tenth of a millimetre."""
    planes = PlaneVoxels(0.5, 0.06, rough=1)
    for seed, x in enumerate((-1.0, 0.0, 1.0)):
        at = base(x, 0.2 * x, 0.3 * x)
        planes.add(local_cloud.moved(points_at(at, 100 + seed, sigma_m=0.15), at))
    settled = 0
    for seed in range(20):
        truth = base(0.05 * seed - 0.4, -0.2, 0.2)
        scan = thin_to_voxels(points_at(truth, seed, sigma_m=0.15), 0.5)
        found = align_cloud(scan, planes, truth.compose(base(0.03, -0.02, 0.01)), 10, 0.5)
        settled += found is not None and found.converged
    assert settled > 14


def test_clouds_with_noise_thicker_than_planes_are_matched() -> None:
    made = CloudOdometry(CONFIG, 0.5)
    for seed, x in enumerate((-1.0, -0.5, 0.0, 0.5, 1.0)):
        at = base(x, 0.2 * x, 0.3 * x)
        made.add_keyframe(points_at(at, 100 + seed, sigma_m=0.15), at, LIDAR)
    squares = []
    for seed in range(8):
        truth = base(0.1 * seed - 0.4, -0.2, 0.2)
        scan = made.thinned(points_at(truth, seed, sigma_m=0.15))
        motion = made.match(scan, [truth.compose(base(0.1, -0.08, 0.02))])
        error = error_of(motion, truth)
        assert motion is not None and motion.converged and np.linalg.norm(error[3:]) < 0.06
        squares.append(error @ np.linalg.solve(motion.covariance, error) / 6.0)
    assert np.mean(squares) < 2.0


def test_planes_that_are_settled_match_as_before_in_less_room() -> None:
    """A place that is kept counts no more clouds: what is flat, and what draws from afar, stays."""
    points = points_at(gtsam.Pose3())
    counted, settled = (PlaneVoxels.build(points, 0.2, 0.06) for _ in range(2))
    settled.settle()
    away = gtsam.Pose3(gtsam.Rot3.Yaw(0.02), np.array([0.05, -0.03, 0.01]))
    first, second = (align_cloud(points, planes, away, 15, 0.2) for planes in (counted, settled))
    assert first is not None and second is not None
    assert len(settled) == len(counted) and first.pose.equals(second.pose, 0.0)
    assert np.array_equal(first.spread, second.spread)
    pulls = (planes.pulls(points, away.matrix(), 1.0) for planes in (counted, settled))
    assert all(np.array_equal(*pair) for pair in zip(*pulls, strict=True))
    assert settled._keys.size < 0.2 * counted._keys.size
