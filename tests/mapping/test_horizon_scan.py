"""The ring nearest the horizon: what a flat lidar there would see; repairs only bring obstacles nearer."""

from __future__ import annotations

import math
from dataclasses import replace

import gtsam
import numpy as np
from cloud_world import T_BASE_LIDAR, base, cast, look

from slam.config.clouds import CloudMapConfig
from slam.mapping.band_scan import horizon_scan, with_repairs
from slam.measurements import FloatArray, LaserScan

CONFIG = CloudMapConfig(bearings=180)


def points_base(pose: gtsam.Pose3) -> FloatArray:
    points = look(pose, sigma_m=0.0).points_lidar.astype(np.float64)
    return np.asarray(points @ T_BASE_LIDAR.rotation().matrix().T + T_BASE_LIDAR.translation())


def test_it_sees_what_stands_at_the_lidars_height() -> None:
    pose = base(0.2, 0.3, 0.7)
    scan = horizon_scan(points_base(pose), 2.0, T_BASE_LIDAR, CONFIG)
    assert scan is not None and scan.stamp_s == 2.0
    lidar, bearing = pose.compose(T_BASE_LIDAR), scan.bearings_rad()
    rays = np.column_stack([np.cos(bearing), np.sin(bearing), np.zeros(len(bearing))])
    expected = cast(lidar.translation(), rays @ lidar.rotation().matrix().T)
    off = np.abs(scan.ranges_m - expected)
    assert np.mean(off < 0.15) > 0.9  # within a bearing a wall at a slant is not at one distance
    np.testing.assert_allclose(np.median(off), 0.0, atol=0.05)


def test_no_ring_near_the_horizon() -> None:
    steep = np.array([[1.0, 0.0, T_BASE_LIDAR.z() + 1.0]])
    assert horizon_scan(steep, 0.0, T_BASE_LIDAR, CONFIG) is None
    assert horizon_scan(np.zeros((0, 3)), 0.0, T_BASE_LIDAR, CONFIG) is None


def test_only_what_was_repaired_and_is_nearer_enters_the_plan() -> None:
    def scan(*ranges_m: float) -> LaserScan:
        return LaserScan(0.0, np.array(ranges_m, np.float32), -math.pi, 1.0, 15.0)

    measured, repaired = scan(np.inf, 4.0, 4.0, np.inf, np.inf), scan(2.0, 4.0, 1.0, 3.0, 20.0)
    plan = scan(np.nan, np.nan, 3.0, 2.0, np.nan)
    found = with_repairs(plan, measured, repaired)
    np.testing.assert_array_equal(found.ranges_m, np.array([2.0, np.nan, 1.0, 2.0, np.nan], np.float32))
    untouched = with_repairs(plan, measured, replace(measured))
    np.testing.assert_array_equal(untouched.ranges_m, plan.ranges_m)
