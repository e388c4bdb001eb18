"""Which sensors of a log are used, and whether the robot is a camera in space or a vehicle on a floor."""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np
import pytest

from slam.config.stages import SensorsConfig
from slam.datasets.dataset import ReadReport
from slam.datasets.sensor_choice import SensorChoice, SensorTally, SensorUse, UsedMeasurements, use_lines
from slam.measurements import CameraIntrinsics, LaserScan, Measurement, PointCloud, RgbdFrame, WheelOdometry

CAMERA = CameraIntrinsics(10.0, 10.0, 2.0, 2.0, 4, 4)


def frame(stamp_s: float, sensor: str = "camera") -> RgbdFrame:
    image = np.zeros((4, 4, 3), np.uint8)
    return RgbdFrame(stamp_s, image, np.zeros((4, 4), np.float32), CAMERA, sensor=sensor)


def scan(stamp_s: float) -> LaserScan:
    return LaserScan(stamp_s, np.ones(3, np.float32), 0.0, 0.1, 10.0)


def wheels(stamp_s: float) -> WheelOdometry:
    return WheelOdometry(stamp_s, gtsam.Pose2())


ALL: list[Measurement] = [wheels(0.0), frame(0.0, "left"), scan(0.1), frame(0.2, "right"), wheels(0.2)]


@pytest.mark.parametrize(
    ("log", "settings", "spatial", "cameras"),
    [
        (ALL, {}, False, ("left", "right")),
        (ALL, {"rgbd": False}, False, ()),
        (ALL, {"lidar": False}, False, ("left", "right")),  # wheels make a vehicle
        ([frame(0.0), scan(0.1)], {}, False, ("camera",)),
        ([frame(0.0), scan(0.1)], {"lidar": False}, True, ("camera",)),
        ([frame(0.0)], {}, True, ("camera",)),
        ([frame(0.0)], {"rgbd": False}, False, ()),
        ([frame(0.0)], {"motion": "planar"}, False, ("camera",)),
        (ALL, {"motion": "spatial"}, True, ("left", "right")),
        ([scan(0.0), wheels(0.1)], {}, False, ()),
        ([], {}, False, ()),
    ],
)
def test_the_choice(
    log: list[Measurement], settings: dict[str, object], spatial: bool, cameras: tuple[str, ...]
) -> None:
    choice = SensorChoice.of(log, SensorsConfig(**settings))  # type: ignore[arg-type]
    assert (choice.spatial, choice.cameras) == (spatial, cameras)


def test_only_the_first_seconds_are_looked_at() -> None:
    read: list[float] = []

    def log() -> Iterator[Measurement]:
        for n in range(10000):
            read.append(n * 0.1)
            yield frame(100.0 + n * 0.1)

    assert SensorChoice.of(log(), SensorsConfig()).spatial
    assert max(read) < 4.0


def test_a_log_whose_clock_stands_still_is_not_read_to_its_end() -> None:
    read = []

    def log() -> Iterator[Measurement]:
        for n in range(10000):
            read.append(n)
            yield wheels(5.0)

    SensorChoice.of(log(), SensorsConfig())
    assert len(read) < 2000


@pytest.mark.parametrize(
    ("settings", "kinds"),
    [
        ({}, "WFSFW"),
        ({"lidar": False}, "WFFW"),
        ({"rgbd": False}, "WSW"),
        ({"rgbd": False, "lidar": False}, "WW"),
    ],
)
def test_what_is_used_keeps_its_order(settings: dict[str, bool], kinds: str) -> None:
    letters = {WheelOdometry: "W", RgbdFrame: "F", LaserScan: "S"}
    found = UsedMeasurements(ALL, SensorsConfig(**settings))  # type: ignore[arg-type]
    assert "".join(letters[type(measurement)] for measurement in found) == kinds


def cloud(stamp_s: float) -> PointCloud:
    return PointCloud(stamp_s, np.ones((3, 3), np.float32))


def not_used(log: list[Measurement], settings: dict[str, object]) -> dict[str, str]:
    choice = SensorChoice.of(log, SensorsConfig(**settings))  # type: ignore[arg-type]
    tally = SensorTally(choice)
    assert len(list(tally.counted(log))) == len(log)
    found = tally.uses(ReadReport())
    assert sum(use.readings for use in found) == len(log)
    return {use.sensor: use.why_not for use in found if use.why_not}


@pytest.mark.parametrize(
    ("log", "settings", "sensor", "because"),
    [
        ([scan(0.0), cloud(0.1), wheels(0.2)], {}, "lidar", "sensors.motion=spatial"),
        ([scan(0.0), cloud(0.1)], {"motion": "spatial"}, "laser", "sensors.motion=planar"),
        ([frame(0.0), frame(4.0), cloud(9.0)], {}, "lidar", "later than the first"),
        ([scan(0.0), scan(4.0), frame(9.0)], {}, "camera", "later than the first"),
        ([frame(0.0), frame(4.0), wheels(9.0)], {}, "odometry", "sensors.motion=planar"),
        ([frame(0.0, "left"), frame(0.0, "right")], {}, "right", "only the first camera is used, left"),
        ([scan(0.0), frame(0.1)], {"rgbd": False}, "camera", "sensors.rgbd=false"),
        ([frame(0.0), scan(0.1)], {"lidar": False}, "laser", "sensors.lidar=false"),
        ([scan(0.0), wheels(0.1)], {"wheels": False}, "odometry", "sensors.wheels=false"),
    ],
)
def test_what_is_not_used_is_reported_with_the_remedy(
    log: list[Measurement], settings: dict[str, object], sensor: str, because: str
) -> None:
    (found,) = not_used(log, settings).items()
    assert found[0] == sensor and because in found[1]


def test_of_two_odometries_the_first_is_used_alone() -> None:
    log = [wheels(0.0), WheelOdometry(0.1, gtsam.Pose2(5.0, 0.0, 0.0), "filtered"), scan(0.1), wheels(0.2)]
    choice = SensorChoice.of(log, SensorsConfig())
    assert [one.sensor for one in choice.used(log)] == ["odometry", "laser", "odometry"]
    assert "odometry" in not_used(log, {})["filtered"]


def test_one_line_reports_all_that_share_a_reason() -> None:
    found = [
        SensorUse("/a", "Imu", 3, "no IMU"),
        SensorUse("/b", "2D lidar", 1200),
        SensorUse("/c", "Imu", 4, "no IMU"),
    ]
    assert use_lines(found) == [
        "used: /b (2D lidar, 1,200)",
        "not used, because no IMU: /a (Imu, 3), /c (Imu, 4)",
    ]
