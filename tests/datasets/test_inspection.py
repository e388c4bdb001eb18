"""The inspection's figures against a log whose every figure is known."""

from __future__ import annotations

import dataclasses
import json
import math
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gtsam
import numpy as np
import pytest
from rgbd_files import write_tum
from typer.testing import CliRunner

from slam.cli.commands import app
from slam.datasets import ReadReport, open_dataset
from slam.datasets.inspection import inspect_dataset
from slam.errors import EvaluationError
from slam.evaluation.pages import inspection_text
from slam.evaluation.score import evaluate
from slam.measurements import CameraIntrinsics, LaserScan, Measurement, RgbdFrame, WheelOdometry

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

    def groundtruth(self) -> None:
        return None


def stated(found: dict[str, Any]) -> Any:
    """What was found as JSON has it, its parts by name."""
    whole = json.dumps(found, allow_nan=False)
    return json.loads(whole, object_hook=lambda part: SimpleNamespace(**part))


def scan(stamp_s: float, ranges: list[float]) -> LaserScan:
    return LaserScan(
        stamp_s, np.float32(ranges), -0.5, 0.25, 30.0, gtsam.Pose2(0.1, 0.2, math.pi / 2), "FLASER"
    )


def wheels(stamp_s: float, x: float, yaw: float) -> WheelOdometry:
    return WheelOdometry(stamp_s, gtsam.Pose2(x, 0.0, yaw))


def test_figures_of_a_small_log() -> None:
    found = stated(
        inspect_dataset(
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
    (stream,) = stated(found).sensors
    assert stream.rate_hz is None
    assert stream.laser is not None
    assert stream.laser.longest_return_m is None
    assert json.loads(json.dumps(found, allow_nan=False))["duration_s"] == 0.0
    assert "rate unknown" in inspection_text(found)


def test_damage_is_reported_with_reason_and_line(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text("ODOM 0 0 0 0 0 0 1 h 0\nFLASER 9 1 2\nSYNC x\nODOM 0 0 nan 0 0 0 2 h 0\n")
    found = inspect_dataset(open_dataset(path))
    text = inspection_text(found)
    assert "1 x wrong number of values (line 2)" in text
    assert "1 x pose not finite" in text
    assert "not used, because records of type SYNC are not read: SYNC (record, 1)" in text
    plain = json.loads(json.dumps(found, allow_nan=False))
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
        (summary,) = inspect_dataset(Listed(stream(count)))["sensors"]
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert summary["rate_hz"] == pytest.approx(10.0)
        assert summary["longest_gap_s"] == pytest.approx(0.25)
        return peak

    assert peak_of(25_000) < 1.5 * peak_of(5_000)


@pytest.mark.parametrize(
    ("log", "path_m", "duration_s"), [("fr079", 391.6, 1061.4), ("intel", 508.4, 2691.3)]
)
def test_real_logs(log: str, path_m: float, duration_s: float) -> None:
    path = LIDAR2D / log / f"{log}.log.gz"
    if not path.exists():
        pytest.skip(f"REAL LOG ABSENT, not tested: {path}")
    found = inspect_dataset(open_dataset(path))
    odometry = stated(found).sensors[-1].odometry
    assert odometry is not None
    assert odometry.path_m == pytest.approx(path_m, abs=0.1)
    assert found["duration_s"] == pytest.approx(duration_s, abs=0.1)
    assert not found["dropped"]
    assert ("backward 785 times" in inspection_text(found)) == (log == "intel")


def frame(stamp_s: float, depth_m: float, mount: gtsam.Pose3 | None) -> RgbdFrame:
    depth = np.zeros((48, 64), np.float32)
    depth[:24] = depth_m
    depth[0, 0] = 2.5
    color = np.zeros((48, 64, 3), np.uint8)
    return RgbdFrame(stamp_s, color, depth, CameraIntrinsics(50, 51, 31, 23, 64, 48), mount, "RGBD_1")


def test_a_camera_is_reported_with_its_depth_and_mounting() -> None:
    # Looks to the left, tilted down by 0.1 rad.
    body = gtsam.Rot3.Ypr(math.pi / 2, 0.1, 0.0)
    optical = gtsam.Rot3(np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
    mount = gtsam.Pose3(body.compose(optical), np.array([0.1, 0.2, 0.9]))
    found = inspect_dataset(Listed([frame(1.0, 1.5, mount), frame(1.1, 3.5, mount)]))
    (stream,) = stated(found).sensors
    assert stream.rate_hz == pytest.approx(10.0)
    camera = stream.camera
    assert camera is not None
    assert (camera.width, camera.height, camera.fx, camera.cy) == (64, 48, 50, 23)
    assert camera.valid_depth_share == 0.5
    assert (camera.depth_min_m, camera.depth_max_m) == (1.5, 3.5)
    assert camera.mount_m == pytest.approx((0.1, 0.2, 0.9))
    assert camera.mount_rpy_rad == pytest.approx((0.0, 0.1, math.pi / 2))
    text = inspection_text(found)
    assert "depth 1.50 to 3.50 m, 50.0% of the pixels valid" in text
    assert "yaw 90.0, pitch 5.7, roll 0.0 degrees" in text
    json.dumps(found, allow_nan=False)


def test_a_camera_without_mounting_and_without_depth_is_reported_so() -> None:
    empty = dataclasses.replace(frame(1.0, 0.0, None), depth_m=np.zeros((48, 64), np.float32))
    found = inspect_dataset(Listed([empty]))
    assert "mounting not reported" in inspection_text(found)
    assert "no valid depth, 0.0%" in inspection_text(found)
    json.dumps(found, allow_nan=False)


def test_inspect_and_evaluate_take_a_folder(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / "log")
    shown = CliRunner().invoke(app, ["inspect", str(folder), "--json"])
    assert shown.exit_code == 0
    assert json.loads(shown.stdout)["sensors"][0]["camera"]["width"] == 64
    truth = str(folder / "groundtruth.txt")
    poses = [f"{100 + 0.1 * k} {k} {k * k} 0 0 0 0 1" for k in range(4)]
    Path(truth).write_text("\n".join(poses))
    for reference in (str(folder), truth):
        scored = CliRunner().invoke(
            app, ["evaluate", truth, "--groundtruth", reference, "--delta", "0.5", "--json"]
        )
        assert json.loads(scored.stdout)["ate"]["translation_m"]["rmse"] == pytest.approx(0.0, abs=1e-9)
    Path(truth).rename(tmp_path / "mine.txt")
    with pytest.raises(EvaluationError, match="has no true trajectory; give a file"):
        evaluate(tmp_path / "mine.txt", groundtruth=folder)
