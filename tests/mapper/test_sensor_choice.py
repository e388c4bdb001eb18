"""Which sensors of a log are used, and whether the robot is a camera in space or a vehicle on a floor."""

from __future__ import annotations

from collections.abc import Iterator

import gtsam
import numpy as np
import pytest

from slam.config.stages import SensorsConfig
from slam.mapper.sensor_choice import SensorChoice, used_measurements
from slam.measurements import CameraIntrinsics, LaserScan, Measurement, RgbdFrame, WheelOdometry

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
    found = used_measurements(ALL, SensorsConfig(**settings))  # type: ignore[arg-type]
    assert "".join(letters[type(measurement)] for measurement in found) == kinds
