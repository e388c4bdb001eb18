"""The stream of a simulated drive: order, rates, faults, and independence of the sensors."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import gtsam
import numpy as np
import pytest
from small_drive import SECONDS, fake_sensors, small_rig

from slam.errors import ConfigError
from slam.simulation.drive import FIRST_STAMP_S, Drive, prepare_drive, simulate_drive
from slam.simulation.drive_faults import FAULT_PRESETS, DriveFaults
from slam.simulation.events import DriveEvent, ImageEvent, OdometryEvent, ScanEvent, TruthEvent
from slam.simulation.home import generate_home
from slam.simulation.wheel_odometry import WheelModel

HOME = generate_home(0)


@pytest.fixture(autouse=True)
def _cheap_sensors(monkeypatch: pytest.MonkeyPatch) -> None:
    fake_sensors(monkeypatch)


def drive_of(faults: DriveFaults | None = None, cameras: int = 2, seconds: float = SECONDS) -> Drive:
    return prepare_drive(HOME, small_rig(cameras), 7, faults, seconds)


def sensor_of(event: DriveEvent) -> str:
    if isinstance(event, ScanEvent):
        return event.scan.sensor
    if isinstance(event, ImageEvent):
        return event.frame.sensor
    return type(event).__name__


def arrays_of(event: Any) -> Iterator[bytes]:
    """Everything in an event, as bytes."""
    for value in vars_of(event):
        if isinstance(value, np.ndarray):
            yield value.tobytes()
        elif isinstance(value, gtsam.Pose2 | gtsam.Pose3):
            yield value.matrix().tobytes()
        elif dataclasses.is_dataclass(value):
            yield from arrays_of(value)
        else:
            yield repr(value).encode()


def vars_of(event: Any) -> list[Any]:
    return [getattr(event, item.name) for item in dataclasses.fields(event)]


def stream(events: Iterator[DriveEvent]) -> list[tuple[str, bytes]]:
    return [(sensor_of(event), b"|".join(arrays_of(event))) for event in events]


def test_every_sensor_fires_at_its_rate_and_all_come_in_order_of_true_time() -> None:
    drive = drive_of()
    events = list(drive.events())
    times = [event.true_stamp_s for event in events]
    assert times == sorted(times)
    counts = Counter(map(sensor_of, events))
    rig = drive.rig
    assert rig.lidar is not None
    expected = {"lidar": rig.lidar.model.rate_hz, "OdometryEvent": 20.0, "TruthEvent": 50.0}
    expected |= {camera.name: camera.model.rate_hz for camera in rig.cameras}
    assert set(counts) == set(expected)
    for name, rate_hz in expected.items():
        assert abs(counts[name] - SECONDS * rate_hz) <= 1.0, name


def test_each_reading_is_taken_where_the_robot_truly_was() -> None:
    drive = drive_of(FAULT_PRESETS["usual"])
    for event in drive.events():
        if isinstance(event, ScanEvent | ImageEvent | TruthEvent):
            x, y, yaw = drive.tour.pose_at(event.true_stamp_s - FIRST_STAMP_S)
            assert event.T_map_base.equals(gtsam.Pose2(x, y, yaw), 1e-9)
        if isinstance(event, ScanEvent):
            laser = event.T_map_base.compose(event.scan.T_base_laser)
            assert event.true_ranges_m[0] == pytest.approx(1.0 + abs(laser.x()), abs=1e-6)


def test_the_same_seed_gives_the_same_bits() -> None:
    first = stream(simulate_drive(HOME, small_rig(), 7, FAULT_PRESETS["harsh"], SECONDS))
    drive = drive_of(FAULT_PRESETS["harsh"])
    assert (
        first == stream(drive.events()) == stream(drive.events(threads=1)) == stream(drive.events(threads=3))
    )
    assert first != stream(simulate_drive(HOME, small_rig(), 8, FAULT_PRESETS["harsh"], SECONDS))


def test_a_sensor_less_changes_nothing_in_the_others() -> None:
    faults = dataclasses.replace(FAULT_PRESETS["harsh"], dying_sensor="")
    all_sensors = stream(drive_of(faults).events())
    dropped = small_rig().cameras[1].name
    fewer = stream(drive_of(faults, cameras=1).events())
    assert fewer == [item for item in all_sensors if item[0] != dropped]
    lossless = dataclasses.replace(faults, dropped_frame_share=0.0, dropped_scan_share=0.0)
    assert set(all_sensors) < set(stream(drive_of(lossless).events()))


def test_two_cameras_never_share_their_noise() -> None:
    images = [event.frame.color.tobytes() for event in drive_of().events() if isinstance(event, ImageEvent)]
    assert len(set(images)) == len(images)


def test_clocks_are_off_as_asked_and_the_truth_is_distinguished() -> None:
    faults = DriveFaults(lidar_clock_offset_s=-0.5, camera_clock_offset_s=0.2, camera_clock_spread_s=0.05)
    off: dict[str, list[float]] = {}
    for event in drive_of(faults).events():
        if isinstance(event, ScanEvent | ImageEvent):
            stamp_s = event.scan.stamp_s if isinstance(event, ScanEvent) else event.frame.stamp_s
            off.setdefault(sensor_of(event), []).append(stamp_s - event.true_stamp_s)
        elif isinstance(event, OdometryEvent):
            assert event.reading.stamp_s == pytest.approx(event.true_stamp_s, abs=1e-6)
    assert all(np.ptp(wrong) < 2e-6 for wrong in off.values())
    assert off.pop("lidar")[0] == pytest.approx(-0.5, abs=1e-6)
    first, second = (wrong[0] for wrong in off.values())
    assert abs(first - second) > 1e-3
    assert 0.0 < first < 0.4


def test_a_dying_sensor_falls_silent_and_comes_back() -> None:
    faults = DriveFaults(dying_sensor="lidar", dies_at_share=0.3, returns_at_share=0.7)
    shares = [
        (event.true_stamp_s - FIRST_STAMP_S) / SECONDS
        for event in drive_of(faults).events()
        if isinstance(event, ScanEvent)
    ]
    assert max(after - before for before, after in itertools.pairwise(shares)) > 0.39
    assert not any(0.3 <= share < 0.7 for share in shares)
    assert min(shares) < 0.05
    assert max(shares) > 0.95
    for name in (small_rig().cameras[0].name, "lidar"):
        silent = drive_of(DriveFaults(dying_sensor=name, dies_at_share=0.0))
        assert name not in map(sensor_of, silent.events())


def test_the_wheels_drift_and_say_where_they_slipped() -> None:
    slippery = DriveFaults(wheels=WheelModel(slips_per_s=2.0))
    events = [event for event in drive_of(slippery).events() if isinstance(event, OdometryEvent)]
    assert events[0].reading.T_odom_base.equals(gtsam.Pose2(), 1e-12)
    assert any(event.slipping.any() for event in events)
    clean = DriveFaults(wheels=WheelModel(scale_sigma=0.0, wheel_base_sigma=0.0, noise=0.0, slips_per_s=0.0))
    drive = drive_of(clean)
    start = drive.base_at(0.0)
    for event in drive.events():
        if isinstance(event, OdometryEvent):
            true = start.between(drive.base_at(event.true_stamp_s - FIRST_STAMP_S))
            assert event.reading.T_odom_base.equals(true, 2e-3)
    # Between two readings the wheels are asked by interpolation.
    time_s = 4.025
    assert drive.odometry_at(FIRST_STAMP_S + time_s).equals(start.between(drive.base_at(time_s)), 3e-3)
    assert drive.odometry_at(0.0).equals(gtsam.Pose2(), 1e-12)


def test_a_person_walks_about_and_keeps_out_of_the_robots_way() -> None:
    drive = drive_of(DriveFaults(person=True), seconds=60.0)
    assert drive.walk is not None
    times = np.arange(0.0, 60.0, 0.25)
    places = [drive.walk.at(float(time_s)) for time_s in times]
    seen = [(time_s, place) for time_s, place in zip(times, places, strict=True) if place is not None]
    assert len(seen) > 0.8 * len(times)
    nearest = min(math.dist(place, drive.tour.pose_at(float(time_s))[:2]) for time_s, place in seen)
    assert nearest > 0.5
    steps = np.linalg.norm(np.diff([place for _, place in seen], axis=0), axis=1)
    assert steps.sum() > 10.0


@pytest.mark.parametrize(
    "fields",
    [
        {"dropped_frame_share": 1.5},
        {"dropped_scan_share": -0.1},
        {"dies_at_share": math.nan},
        {"dies_at_share": 0.6, "returns_at_share": 0.5},
        {"stamp_jitter_s": -1.0},
        {"period_jitter_s": math.inf},
        {"lidar_clock_offset_s": math.nan},
    ],
)
def test_faults_that_cannot_be_are_refused(fields: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=next(iter(fields)).split("_")[0]):
        DriveFaults(**fields)  # type: ignore[arg-type]


def test_a_dying_sensor_must_be_on_the_rig() -> None:
    with pytest.raises(ConfigError, match=r"'radar'.*lidar"):
        drive_of(DriveFaults(dying_sensor="radar"))
