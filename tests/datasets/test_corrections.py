"""Corrections of a log's measurements by a calibration."""

from __future__ import annotations

import math
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.config import dump_calibration, load_calibration, load_config
from slam.config.calibration import Calibration, LidarCorrection, WheelCorrection
from slam.datasets.corrections import Unwound, corrected, repeats
from slam.errors import ConfigError, DatasetError
from slam.measurements import CameraIntrinsics, LaserScan, Measurement, RgbdFrame, WheelOdometry


def scan(stamp_s: float = 0.0, ranges: tuple[float, ...] = (1.0, 2.0, 3.0)) -> LaserScan:
    return LaserScan(stamp_s, np.array(ranges, np.float32), -0.5, 0.25, 10.0, gtsam.Pose2(0.1, 0.0, 0.0))


def wheels(stamp_s: float, x: float, y: float, yaw: float) -> WheelOdometry:
    return WheelOdometry(stamp_s, gtsam.Pose2(x, y, yaw))


def of_lidar(**entries: object) -> Calibration:
    return Calibration(lidars={"laser": LidarCorrection.model_validate(entries, strict=False)})


def of_wheels(**entries: object) -> Calibration:
    return Calibration(wheels={"odometry": WheelCorrection.model_validate(entries, strict=False)})


def only(log: list[Measurement], calibration: Calibration) -> Measurement:
    (found,) = corrected(log, calibration)
    return found


def test_an_empty_calibration_leaves_the_log_as_it_is() -> None:
    log = [scan(), wheels(0.0, 1.0, 2.0, 0.5)]
    assert corrected(log, Calibration()) is log


def test_a_lidar_is_corrected_in_all_that_it_shows() -> None:
    found = only([scan()], of_lidar(upside_down=True, range_scale=0.5, T_base_laser={"yaw_deg": 90.0}))
    assert isinstance(found, LaserScan)
    assert found.ranges_m.tolist() == [1.5, 1.0, 0.5]
    assert (found.bearings_rad() == [0.0, 0.25, 0.5]).all()
    assert found.range_max_m == 5.0
    assert found.T_base_laser.equals(gtsam.Pose2(0.0, 0.0, math.pi / 2.0), 1e-9)
    again = only([found], of_lidar(upside_down=True))
    assert isinstance(again, LaserScan) and again.start_angle_rad == -0.5


def test_beams_are_left_out_and_stretched() -> None:
    given = {"blocked_beams": [[0, 1]], "start_angle_deg": -90.0, "step_deg": 90.0}
    found = only([scan()], of_lidar(**given))
    assert isinstance(found, LaserScan)
    assert np.isnan(found.ranges_m).tolist() == [True, True, False]
    assert np.degrees(found.bearings_rad()).round(6).tolist() == [-90.0, 0.0, 90.0]


@pytest.mark.parametrize(
    ("entries", "expected"),
    [
        ({"scale": 0.5}, (1.0, 1.5, 0.4)),
        ({"axes": "-y x"}, (-3.0, 2.0, 0.4)),
        ({"axes": "x -y"}, (2.0, -3.0, 0.4)),
        ({"heading_scale": -1.0}, (2.0, 3.0, -0.4)),
        ({"mirrored": True}, (2.0, -3.0, -0.4)),
    ],
)
def test_what_wheels_write_is_read_anew(
    entries: dict[str, object], expected: tuple[float, float, float]
) -> None:
    found = only([wheels(0.0, 2.0, 3.0, 0.4)], of_wheels(**entries))
    assert isinstance(found, WheelOdometry)
    assert found.T_odom_base.equals(gtsam.Pose2(*expected), 1e-9)


@given(st.floats(0.3, 3.0))
def test_scaled_turns_put_the_way_together_anew(factor: float) -> None:
    # On a circle of radius 1 every turn counted by a factor is a circle of another radius.
    angles = np.arange(0.0, 2.0, 0.1)
    radius = 1.0 / factor
    stated = [
        wheels(0.1 * n, radius * math.sin(factor * a), radius * (1.0 - math.cos(factor * a)), factor * a)
        for n, a in enumerate(angles)
    ]
    last = list(corrected(stated, of_wheels(turn_scale=1.0 / factor)))[-1]
    assert isinstance(last, WheelOdometry)
    # Chords stand for arcs: what they differ by is of second order.
    expected = gtsam.Pose2(math.sin(angles[-1]), 1.0 - math.cos(angles[-1]), angles[-1])
    assert last.T_odom_base.equals(expected, 5e-3)


def test_a_heading_in_degrees_is_unwound_and_mended() -> None:
    true_rad = np.cumsum(0.03 * np.sin(np.arange(200) / 15.0))
    stated = [wheels(0.05 * n, 0.0, 0.0, math.degrees(yaw)) for n, yaw in enumerate(true_rad)]
    found = list(corrected(stated, of_wheels(heading_scale=math.radians(1.0))))
    turned = [one.T_odom_base.theta() for one in found if isinstance(one, WheelOdometry)]
    assert np.allclose(np.unwrap(turned), true_rad, atol=1e-6)


def test_unwinding_leaves_what_does_not_wrap() -> None:
    heading = Unwound()
    turned = [0.0, 0.5, 0.2, -0.4]
    assert np.allclose([heading.of(0.1 * n, yaw) for n, yaw in enumerate(turned)], turned)


def test_a_jump_of_the_heading_is_no_rotation_that_goes_on() -> None:
    """The doctor once took a heading that had jumped by 155 degrees for ten full turns a second."""
    heading = Unwound()
    written = [*np.linspace(-1.84, -1.83, 10), *np.linspace(0.59, 0.6, 50)]
    found = [heading.of(0.1 * n - 0.04 * (n > 9), yaw) for n, yaw in enumerate(written)]
    assert np.ptp(found[20:]) < 0.02


def test_a_clock_is_corrected_and_the_log_comes_in_the_order_of_its_stamps() -> None:
    log = [one for n in range(30) for one in (wheels(0.1 * n + 0.5, n, 0.0, 0.0), scan(0.1 * n))]
    found = list(corrected(log, of_wheels(clock_offset_s=0.5)))
    assert len(found) == len(log)
    stamps = [one.stamp_s for one in found]
    assert stamps == sorted(stamps)
    at = {round(one.stamp_s, 3): one.T_odom_base.x() for one in found if isinstance(one, WheelOdometry)}
    assert at[1.0] == 10.0


def test_sensors_are_left_out_and_repeated_readings_dropped() -> None:
    log = [scan(0.0), wheels(0.0, 1.0, 0.0, 0.0), scan(0.1), scan(0.2, (1.0, 2.0, 4.0))]
    kept = list(corrected(log, Calibration.model_validate({"wheels": {"odometry": {"use": False}}})))
    assert [one.sensor for one in kept] == ["laser"] * 3
    assert [one.stamp_s for one in corrected(log[:1] + log[2:], of_lidar(drop_repeated=True))] == [0.0, 0.2]


@pytest.mark.parametrize(
    ("color", "depth_m", "again"),
    [(9, 9.0, False), (1, 9.0, True), (9, 1.0, True), (0, 9.0, False), (9, 0.0, False)],
)
def test_a_frame_repeats_where_one_half_does_and_shows_something(
    color: int, depth_m: float, again: bool
) -> None:
    lens = CameraIntrinsics(50.0, 50.0, 2.0, 2.0, 4, 4)
    shown = np.eye(4, dtype=np.uint8)

    def frame(bright: int, far_m: float) -> RgbdFrame:
        return RgbdFrame(0.0, np.dstack([bright * shown] * 3), (far_m * shown).astype(np.float32), lens)

    # Black, or without any depth, is also the frame that it is compared with.
    before = frame(min(color, 1), min(depth_m, 1.0))
    assert repeats(before, frame(color, depth_m)) == again


def test_a_calibration_of_what_is_not_there_is_refused() -> None:
    with pytest.raises(DatasetError, match="corrects 'rear', which the log does not hold; it has: laser"):
        list(corrected([scan()], Calibration(lidars={"rear": LidarCorrection(upside_down=True)})))
    with pytest.raises(DatasetError, match="beams 2 to 7 of 'laser', which has 3"):
        list(corrected([scan()], of_lidar(blocked_beams=[[2, 7]])))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("wheels: {odometry: {scal: 1.0}}", "unknown key 'wheels.odometry.scal'"),
        ("wheels: {odometry: {scale: .nan}}", "wheels.odometry.scale"),
        ("wheels: {odometry: {scale: -1}}", "greater than 0"),
        ("wheels: {odometry: {axes: x z}}", "wheels.odometry.axes"),
        ("lidars: {laser: {blocked_beams: [[5, 2]]}}", "beams 5 to 2"),
        ("cars: {}", "unknown key 'cars'"),
        ("- 1", "holds a list"),
        ("wheels: 3", "wheels = 3"),
        ("{", "cannot read"),
    ],
)
def test_a_wrong_file_is_refused_in_a_line(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_calibration(file)
    assert (
        message in str(caught.value) and "\n" not in str(caught.value) and "wrong.yaml" in str(caught.value)
    )


def test_a_missing_file_says_what_makes_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="doctor LOG --write"):
        load_config(calibration=tmp_path / "none.yaml")


def test_a_calibration_is_written_as_it_is_read(tmp_path: Path) -> None:
    known = of_wheels(scale=0.5, axes="x -y").merged({"lidars": {"laser": {"blocked_beams": [[0, 3]]}}})
    file = tmp_path / "calibration.yaml"
    file.write_text(dump_calibration(known))
    assert load_config(calibration=file).sensors.calibration == known
