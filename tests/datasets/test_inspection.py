"""The inspection's figures against a log whose every figure is known."""

from __future__ import annotations

import json
import math
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import gtsam
import numpy as np
import pytest

from slam.datasets import ReadReport, open_dataset
from slam.datasets.inspection import inspect_dataset, render_inspection
from slam.measurements import LaserScan, Measurement, WheelOdometry

LIDAR2D = Path(__file__).parents[3] / "shared" / "data" / "lidar2d"


class Listed:
    """A dataset from a function that gives its measurements."""

    def __init__(self, measurements: list[Measurement] | Iterator[Measurement]) -> None:
        self.name, self.path, self.report = "listed", Path("listed.log"), ReadReport()
        self._measurements = measurements

    def __iter__(self) -> Iterator[Measurement]:
        for number, measurement in enumerate(self._measurements, 1):
            self.report.observe(measurement, number)
            yield measurement


def scan(stamp_s: float, ranges: list[float]) -> LaserScan:
    return LaserScan(
        stamp_s, np.float32(ranges), -0.5, 0.25, 30.0, gtsam.Pose2(0.1, 0.2, math.pi / 2), "FLASER"
    )


def wheels(stamp_s: float, x: float, yaw: float) -> WheelOdometry:
    return WheelOdometry(stamp_s, gtsam.Pose2(x, 0.0, yaw))


def test_figures_of_a_small_log() -> None:
    found = inspect_dataset(
        Listed(
            [
                wheels(100.0, 0.0, 0.0),
                scan(100.0, [1.0, 2.0, np.inf, np.nan]),
                wheels(100.5, 0.5, 0.2),
                wheels(101.0, 0.25, -0.1),
                wheels(103.0, 0.25, -0.1),
                scan(103.0, [1.0, 7.5, np.inf, np.inf, 2.0, 2.0]),
                wheels(102.25, 9.25, -0.1),
            ]
        )
    )
    laser_stream, odometry_stream = found.sensors
    assert (found.first_stamp_s, found.duration_s) == (100.0, 3.0)
    assert (laser_stream.sensor, laser_stream.count, odometry_stream.count) == ("FLASER", 2, 5)
    assert laser_stream.rate_hz == pytest.approx(1 / 3.0)
    assert odometry_stream.rate_hz == pytest.approx(2.0)
    assert (odometry_stream.longest_gap_s, odometry_stream.longest_gap_at_s) == (2.0, 1.0)
    assert (odometry_stream.clock_steps_backward, odometry_stream.largest_clock_step_s) == (1, 0.75)
    assert odometry_stream.odometry is not None
    assert odometry_stream.odometry.path_m == pytest.approx(0.5 + 0.25 + 9.0)
    assert odometry_stream.odometry.rotation_rad == pytest.approx(0.5)
    assert (found.odometry_jumps.count, found.odometry_jumps.largest) == (1, 9.0)
    laser = laser_stream.laser
    assert laser is not None
    assert (laser.beams_min, laser.beams_max, laser.longest_return_m) == (4, 6, 7.5)
    assert (laser.no_return_share, laser.invalid_share) == (0.3, 0.1)
    assert (laser.first_angle_rad, laser.last_angle_rad, laser.step_rad) == (-0.5, 0.75, 0.25)
    assert (laser.mount_x_m, laser.mount_y_m) == (0.1, 0.2)
    assert laser.mount_yaw_rad == pytest.approx(math.pi / 2)


def test_a_single_reading_has_no_rate_and_is_valid_json() -> None:
    found = inspect_dataset(Listed([scan(5.0, [np.inf])]))
    (stream,) = found.sensors
    assert stream.rate_hz is None
    assert stream.laser is not None
    assert stream.laser.longest_return_m is None
    assert json.loads(json.dumps(found.to_dict(), allow_nan=False))["duration_s"] == 0.0
    assert "rate unknown" in render_inspection(found)


def test_damage_is_told_with_reason_and_line(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text("ODOM 0 0 0 0 0 0 1 h 0\nFLASER 9 1 2\nSYNC x\nODOM 0 0 nan 0 0 0 2 h 0\n")
    found = inspect_dataset(open_dataset(path))
    text = render_inspection(found)
    assert "1 x wrong number of values (line 2)" in text
    assert "1 x pose not finite" in text
    assert "not used: 1 SYNC" in text
    plain = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert plain["dropped"]["wrong number of values"]["count"] == 1
    assert plain["records"] == {"ODOM": 1}


def test_the_median_holds_and_memory_stays_flat_on_a_long_stream() -> None:
    def stream(count: int) -> Iterator[Measurement]:
        stamp_s = 0.0
        for index in range(count):
            stamp_s += 0.1 if index % 3 else 0.25
            yield wheels(stamp_s, 0.0, 0.0)

    def peak_of(count: int) -> int:
        tracemalloc.start()
        (summary,) = inspect_dataset(Listed(stream(count))).sensors
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert summary.rate_hz == pytest.approx(10.0)
        assert summary.longest_gap_s == pytest.approx(0.25)
        return peak

    assert peak_of(60_000) < 1.5 * peak_of(6_000)


@pytest.mark.parametrize(
    ("log", "path_m", "duration_s"), [("fr079", 391.6, 1061.4), ("intel", 508.4, 2691.3)]
)
def test_real_logs(log: str, path_m: float, duration_s: float) -> None:
    path = LIDAR2D / log / f"{log}.log.gz"
    if not path.exists():
        pytest.skip(f"REAL LOG ABSENT, not tested: {path}")
    found = inspect_dataset(open_dataset(path))
    odometry = found.sensors[-1].odometry
    assert odometry is not None
    assert odometry.path_m == pytest.approx(path_m, abs=0.1)
    assert found.duration_s == pytest.approx(duration_s, abs=0.1)
    assert not found.dropped
    assert ("backward 785 times" in render_inspection(found)) == (log == "intel")
