"""CARMEN logs of simulated lidars say, read by the product's own reader, what was written."""

from __future__ import annotations

import math
from pathlib import Path

import gtsam
import numpy as np
import pytest

from slam.datasets import open_dataset
from slam.measurements import LaserScan, WheelOdometry
from slam.simulation.carmen_writer import CarmenWriter, is_half_circle

MOUNT = gtsam.Pose2(0.205, -0.03, 0.4)
# Beams, first angle, step, maximum: SICK LMS 180 (1 and half a degree), URG-04LX, RPLIDAR A2.
LAYOUTS = {
    "sick": (181, -90.0, 1.0, 8.0),
    "sick-half": (361, -90.0, 0.5, 81.0),
    "urg": (682, -120.0, 240.0 / 681, 5.6),
    "rplidar": (360, -180.0, 1.0, 12.0),
    "backward": (100, 150.0, 1.0, 6.0),
}


def scan_of(layout: str, stamp_s: float, seed: int) -> LaserScan:
    beams, start_deg, step_deg, range_max_m = LAYOUTS[layout]
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.05, range_max_m, beams).astype(np.float32)
    ranges[rng.random(beams) < 0.1] = np.inf
    ranges[rng.random(beams) < 0.1] = np.nan
    ranges[7] = np.float32(range_max_m - 1e-5)  # a return just below the maximum is still a return
    return LaserScan(
        stamp_s, ranges, math.radians(start_deg), math.radians(step_deg), range_max_m, MOUNT, "lidar"
    )


@pytest.mark.parametrize("layout", LAYOUTS)
def test_scans_come_back_as_they_were(layout: str, tmp_path: Path) -> None:
    written = [scan_of(layout, 1000.123457 + index, index) for index in range(3)]
    poses = [gtsam.Pose2(0.5 * index, -0.2 * index, 0.9 * index) for index in range(3)]
    with CarmenWriter(tmp_path / "scans.log", 1000.0) as log:
        for scan, pose in zip(written, poses, strict=True):
            log.odometry(WheelOdometry(scan.stamp_s - 0.01, pose), (0.3, 0.1), scan.stamp_s)
            log.scan(scan, pose, scan.stamp_s + 0.02)
    dataset = open_dataset(tmp_path / "scans.log", strict=True)
    readings = list(dataset)
    read = [item for item in readings if isinstance(item, LaserScan)]
    assert not dataset.report.notes
    assert len(read) == 3
    for scan, back in zip(written, read, strict=True):
        assert back.stamp_s == pytest.approx(scan.stamp_s, abs=1e-7)
        assert np.allclose(back.bearings_rad(), scan.bearings_rad(), atol=2e-7)
        assert back.range_max_m == pytest.approx(scan.range_max_m)
        assert back.T_base_laser.equals(MOUNT, 3e-6)
        assert (np.isnan(back.ranges_m) == np.isnan(scan.ranges_m)).all()
        assert (np.isinf(back.ranges_m) == np.isinf(scan.ranges_m)).all()
        met = np.isfinite(scan.ranges_m)
        assert np.abs(back.ranges_m[met] - scan.ranges_m[met]).max() < 0.0011
    odometry = [item for item in readings if isinstance(item, WheelOdometry)]
    assert [item.stamp_s for item in odometry[::2]] == pytest.approx([s.stamp_s - 0.01 for s in written])
    for pose, item in zip(poses, odometry[1::2], strict=True):
        assert item.T_odom_base.equals(pose, 2e-6)


def test_only_half_circles_are_written_without_angles(tmp_path: Path) -> None:
    assert [is_half_circle(scan_of(layout, 0.0, 0)) for layout in LAYOUTS] == [
        True,
        True,
        False,
        False,
        False,
    ]
    for layout, word in (("sick", "FLASER"), ("urg", "ROBOTLASER1")):
        with CarmenWriter(tmp_path / layout, 0.0) as log:
            log.scan(scan_of(layout, 1.0, 0), gtsam.Pose2(), 1.0)
        assert f"\n{word} " in (tmp_path / layout).read_text()


def test_a_drive_without_lidar_is_a_log_of_odometry(tmp_path: Path) -> None:
    with CarmenWriter(tmp_path / "scans.log", 0.0) as log:
        log.odometry(WheelOdometry(1.0, gtsam.Pose2(1.0, 2.0, 0.5)), (0.1, 0.0), 1.0)
    (only,) = open_dataset(tmp_path / "scans.log", strict=True)
    assert isinstance(only, WheelOdometry)
