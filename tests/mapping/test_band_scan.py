"""The plan cut by height out of clouds, and the height of the ground."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from cloud_world import T_BASE_LIDAR, base, look

from fusion.height_band import HeightBand
from slam.config.clouds import CloudMapConfig, CloudOdometryConfig
from slam.mapping.band_scan import band_scan, ground_height
from slam.matching.cloud_points import base_points
from slam.measurements import FloatArray

CONFIG = CloudMapConfig()
BAND = HeightBand(0.0, 0.7, 0.03)


def bar(x: float, low_m: float, high_m: float) -> FloatArray:
    """A board across the way."""
    y, z = np.meshgrid(np.linspace(-0.5, 0.5, 60), np.linspace(low_m, high_m, 8))
    return np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()])


def ahead(points: FloatArray, ground_m: float = 0.0) -> float:
    """Range of the bearing ahead."""
    scan = band_scan(points, 1.0, gtsam.Pose3(), BAND, ground_m, CONFIG)
    return float(scan.ranges_m[np.argmin(np.abs(scan.bearings_rad()))])


@pytest.mark.parametrize(
    ("points", "range_m"),
    [
        (bar(2.0, 0.1, 0.5), 2.0),
        (bar(2.0, 0.9, 1.5), np.nan),  # passed under
        (bar(2.0, -0.02, 0.01), np.nan),  # the floor and what is driven over
        (np.vstack([bar(3.0, 0.1, 0.5), bar(2.0, 0.1, 0.5)]), 2.0),
        (np.vstack([bar(3.0, 0.1, 0.5), [[1.0, 0.001, 0.4]]]), 3.0),  # one stray point stops nothing
        (bar(20.0, 0.1, 0.5), np.nan),
        (np.zeros((0, 3)), np.nan),
    ],
    ids=["board", "shelf", "floor", "nearest", "stray", "far", "nothing"],
)
def test_what_stops_the_robot(points: FloatArray, range_m: float) -> None:
    assert ahead(points) == pytest.approx(range_m, abs=0.01, nan_ok=True)


def test_ground_clears_what_it_covers_up_to_an_obstacle() -> None:
    floor = np.column_stack([np.linspace(1.0, 6.0, 200), np.full(200, 0.005), np.zeros(200)])
    for points, range_m in ((floor, -6.0), (np.vstack([floor, bar(4.0, 0.1, 0.5)]), 4.0)):
        scan = band_scan(points, 1.0, gtsam.Pose3(), BAND, np.zeros(len(points)), CONFIG, clears=True)
        assert np.nanmin(scan.ranges_m[np.abs(scan.bearings_rad()) < 0.006]) == pytest.approx(
            range_m, abs=0.01
        )
        assert np.isnan(scan.ranges_m[0])


def test_heights_are_above_the_ground() -> None:
    assert np.isnan(ahead(bar(2.0, 0.1, 0.5), ground_m=-1.0))
    assert ahead(bar(2.0, -0.9, -0.5), ground_m=-1.0) == pytest.approx(2.0, abs=0.01)


@pytest.mark.parametrize("shift_m", [0.0, -0.4])
def test_the_ground_is_found(shift_m: float) -> None:
    clouds = [
        base_points(look(base(0.3 * n, 0.2, n), seed=n), np.zeros(6), CloudOdometryConfig()) for n in range(3)
    ]
    moved = [cloud + np.array([0.0, 0.0, shift_m]) for cloud in clouds]
    found = ground_height(moved, T_BASE_LIDAR.z() + shift_m, 0.2, 0.06)
    assert found == pytest.approx(shift_m, abs=0.02)


def test_no_ground_where_nothing_is_level() -> None:
    assert ground_height([bar(2.0, -0.5, 1.0)], 0.7, 0.2, 0.06) is None
    assert ground_height([], 0.7, 0.2, 0.06) is None
