"""The CARMEN reader: what lines mean."""

from __future__ import annotations

import gzip
import math
from pathlib import Path

import gtsam
import numpy as np
import pytest
from carmen_lines import GOOD, flaser, odom, poses, read, robotlaser, scans, write
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slam.datasets import open_dataset, recording
from slam.datasets.carmen_records import _numbers
from slam.datasets.laser_geometry import RepeatedRange, beam_layout, classify_ranges
from slam.datasets.recording import read_once
from slam.errors import DatasetError
from slam.measurements import LaserScan, WheelOdometry

LIDAR2D = Path(__file__).parents[3] / "shared" / "data" / "lidar2d"
QUIET = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)


def test_a_flaser_line_gives_its_odometry_then_its_scan(tmp_path: Path) -> None:
    line = "FLASER 2 1.5 2.5 7 8 0.9 1 2 0.5 10.25 host 3.75"
    found, dataset = read(write(tmp_path, line))
    odometry, scan = found
    assert isinstance(odometry, WheelOdometry)
    assert isinstance(scan, LaserScan)
    assert odometry.T_odom_base.equals(gtsam.Pose2(1, 2, 0.5), 1e-12)
    assert odometry.stamp_s == scan.stamp_s == 10.25
    np.testing.assert_array_equal(scan.ranges_m, np.float32([1.5, 2.5]))
    assert scan.sensor == "FLASER"
    assert scan.T_base_laser.equals(gtsam.Pose2(), 1e-12)
    # The laser pose is not the robot's: an unknown mount is said, not guessed.
    assert any("laser pose" in note for note in dataset.report.notes)


@settings(QUIET, max_examples=60)
@given(
    st.lists(
        st.from_regex(r"-?([0-9]{1,17}(\.[0-9]{0,8})?|\.[0-9]{1,8})(e-?[0-9]{1,2})?", fullmatch=True),
        min_size=1,
    )
)
def test_numbers_are_read_to_the_bit_as_python_does(written: list[str]) -> None:
    found = _numbers([text.encode() for text in written])
    assert found.tobytes() == np.array([float(text) for text in written]).tobytes()


def test_every_distinct_odometry_reading_is_given_once(tmp_path: Path) -> None:
    moved = flaser(stamp="11.0")
    lines = (
        odom(1.0, stamp=10.0),
        flaser().replace("1 2 0.5 10.0", "1 0 0 10.0"),
        odom(1.0, stamp=10.0),
        moved,
    )
    found, _ = read(write(tmp_path, *lines))
    assert poses(found) == [(10.0, 1.0), (10.0, 1.0), (11.0, 1.0)]
    assert len(scans(found)) == 2


def test_file_order_is_kept_and_backward_stamps_are_counted(tmp_path: Path) -> None:
    found, dataset = read(write(tmp_path, *(odom(stamp=s) for s in (5.0, 6.0, 4.5, 4.75, 4.0))))
    assert [m.stamp_s for m in found] == [5.0, 6.0, 4.5, 4.75, 4.0]
    backward = dataset.report.backward_steps["odometry"]
    assert (backward.count, backward.largest, backward.lines) == (2, 1.5, [3, 5])
    assert "stamps of odometry go back by up to 1.5 s" in dataset.report.warnings


def test_a_jump_of_the_odometry_is_counted_and_kept(tmp_path: Path) -> None:
    found, dataset = read(write(tmp_path, odom(0.0, stamp=1.0), odom(0.2, stamp=1.1), odom(5.2, stamp=1.2)))
    assert len(found) == 3
    assert dataset.report.odometry_jumps.count == 1
    assert dataset.report.odometry_jumps.largest == pytest.approx(5.0)


def test_param_sets_mount_maximum_and_angles(tmp_path: Path) -> None:
    lines = (
        "PARAM robot_frontlaser_offset -0.04 nohost 0",
        "PARAM robot_frontlaser_side_offset 0.02 1 h 0",
        "PARAM robot_front_laser_max 20.0 1 h 0",
        "PARAM laser_front_laser_fov 90 1 h 0",
        "PARAM laser_front_laser_resolution 30 1 h 0",
        "PARAM robot_frontlaser_use on 1 h 0",
        flaser("19.99 20.0 1.0 81.91"),
    )
    found, dataset = read(write(tmp_path, *lines))
    (scan,) = scans(found)
    assert scan.T_base_laser.equals(gtsam.Pose2(-0.04, 0.02, 0.0), 1e-12)
    assert scan.range_max_m == 20.0
    np.testing.assert_array_equal(scan.ranges_m, np.float32([19.99, np.inf, 1.0, np.inf]))
    np.testing.assert_allclose(np.degrees(scan.bearings_rad()), [-45, -15, 15, 45])
    assert dataset.report.dropped_count == 0


def test_a_rear_laser_looks_backward_from_its_own_offset(tmp_path: Path) -> None:
    lines = (
        "PARAM robot_frontlaser_offset 0.3 x 0",
        "PARAM robot_rearlaser_offset -0.2 x 0",
        flaser(name="RLASER"),
    )
    (scan,) = scans(read(write(tmp_path, *lines))[0])
    assert scan.T_base_laser.equals(gtsam.Pose2(-0.2, 0.0, math.pi), 1e-12)


def test_a_robotlaser_line_brings_its_own_angles_maximum_and_mount(tmp_path: Path) -> None:
    robot = gtsam.Pose2(3.0, -2.0, 0.7)
    laser = robot.compose(gtsam.Pose2(0.2, 0.1, -0.3))
    line = robotlaser(
        "1 2 24.9 25.0 0",
        laser=f"{laser.x()} {laser.y()} {laser.theta()}",
        robot=f"{robot.x()} {robot.y()} {robot.theta()}",
    )
    found, _ = read(write(tmp_path, line))
    odometry, scan = found
    assert isinstance(odometry, WheelOdometry)
    assert isinstance(scan, LaserScan)
    assert odometry.T_odom_base.equals(robot, 1e-9)
    assert scan.T_base_laser.equals(gtsam.Pose2(0.2, 0.1, -0.3), 1e-9)
    np.testing.assert_allclose(scan.bearings_rad(), [-1.0, -0.5, 0.0, 0.5, 1.0])
    np.testing.assert_array_equal(scan.ranges_m, np.float32([1, 2, 24.9, np.inf, np.nan]))
    assert scan.range_max_m == 25.0


def test_beams_that_go_clockwise_are_turned_round(tmp_path: Path) -> None:
    line = robotlaser("1 2 3 4 5").replace(" -1.0 2.0 0.5 ", " 1.0 2.0 -0.5 ")
    (scan,) = scans(read(write(tmp_path, line))[0])
    np.testing.assert_allclose(scan.bearings_rad(), [-1.0, -0.5, 0.0, 0.5, 1.0])
    np.testing.assert_array_equal(scan.ranges_m, np.float32([5, 4, 3, 2, 1]))


def test_the_mount_is_rigid_and_a_straying_laser_pose_is_noted(tmp_path: Path) -> None:
    lines = (robotlaser(), robotlaser(laser="4 2 0"))
    found, dataset = read(write(tmp_path, *lines))
    assert all(scan.T_base_laser.equals(gtsam.Pose2(0.2, 0, 0), 1e-9) for scan in scans(found))
    (note,) = dataset.report.notes.values()
    assert (note.count, note.lines) == (1, [2])
    assert note.largest == pytest.approx(2.8)


def test_one_sweep_logged_in_two_forms_is_read_once(tmp_path: Path) -> None:
    raw = "RAWLASER1 0 -1.0 2.0 0.5 25.0 0.01 0 5 1 2 3 4 5 0 10.0 host 0.1"
    found, dataset = read(write(tmp_path, raw, robotlaser("1 2 3 4 5")))
    assert [scan.sensor for scan in scans(found)] == ["ROBOTLASER1"]
    assert dataset.report.ignored == {"RAWLASER1": 1}
    (alone,) = read(write(tmp_path, raw))[0]
    assert isinstance(alone, LaserScan)
    np.testing.assert_allclose(alone.bearings_rad(), [-1.0, -0.5, 0.0, 0.5, 1.0])


# Angles and maxima


@pytest.mark.parametrize(
    ("count", "fov_deg", "step_deg", "first", "last", "contradiction"),
    [
        (181, None, None, -90, 90, False),
        (361, None, None, -90, 90, False),
        (180, None, None, -90, 89, False),
        (360, None, None, -90, 89.5, False),
        (401, None, None, -50, 50, False),
        (1081, None, None, -135, 135, False),
        (180, 180, 1.0, -90, 89, False),
        (181, 180, 1.0, -90, 90, False),
        (360, 180, 0.5, -90, 89.5, False),
        (540, 270, 0.5, -135, 134.5, False),
        (682, 239.765625, 0.3515625, -119.8828125, 119.53125, False),
        (361, 180, 1.0, -90, 90, True),
        (180, 180, 0.5, -90, 89, True),
        (181, 100, None, -50, 50, False),
        (181, None, 0.5, -45, 45, False),
        (720, None, 1.0, -90, 89.75, True),
        (361, -5, float("nan"), -90, 90, False),
    ],
)
def test_beam_layout(
    count: int, fov_deg: float | None, step_deg: float | None, first: float, last: float, contradiction: bool
) -> None:
    layout = beam_layout(
        count,
        None if fov_deg is None else math.radians(fov_deg),
        None if step_deg is None else math.radians(step_deg),
    )
    bearings = np.degrees(layout.start_rad + layout.step_rad * np.arange(count))
    assert bearings[0] == pytest.approx(first)
    assert bearings[-1] == pytest.approx(last)
    assert layout.contradiction is contradiction


@pytest.mark.parametrize("fov", [("PARAM laser_front_laser_fov 3.14159 x 0",), ()])
def test_angles_in_radians_are_known_by_their_size(tmp_path: Path, fov: tuple[str, ...]) -> None:
    lines = (*fov, "PARAM laser_front_laser_resolution 0.0174533 x 0", flaser(" ".join(["2.0"] * 181)))
    (scan,) = scans(read(write(tmp_path, *lines))[0])
    np.testing.assert_allclose(np.degrees([scan.start_angle_rad, scan.step_rad]), [-90.0, 1.0], rtol=1e-4)


def test_a_contradicting_param_is_reported_and_the_beam_count_wins(tmp_path: Path) -> None:
    lines = (
        "PARAM laser_front_laser_fov 180 x 0",
        "PARAM laser_front_laser_resolution 1 x 0",
        flaser(" ".join(["2.0"] * 361)),
    )
    found, dataset = read(write(tmp_path, *lines))
    assert scans(found)[0].step_rad == pytest.approx(math.radians(0.5))
    assert any("361 beams" in note for note in dataset.report.notes)


@pytest.mark.parametrize(("stated", "limit"), [(81.91, 81.83), (50.0, 50.0), (0.0, 80.0)])
def test_no_return_limit(tmp_path: Path, stated: float, limit: float) -> None:
    found, _ = read(write(tmp_path, f"PARAM frontlaser_max {stated} nohost 0", *GOOD))
    assert [scan.range_max_m for scan in scans(found)] == [limit]


def test_a_code_of_few_beams_is_known_by_scan_after_scan() -> None:
    repeated, rng = RepeatedRange(), np.random.default_rng(0)
    for number in range(20):
        seen = rng.uniform(0.5, 7.5, 180)
        codes = [8.183, 8.183, 8.183] + ([8.191] if number % 2 else [])
        found, limit = classify_ranges(np.append(seen, codes), 80.0, repeated)
    assert limit == 8.183
    np.testing.assert_array_equal(found, np.float32([*seen, *[math.inf] * len(codes)]))
    beyond = rng.uniform(7.0, 30.0, 180)
    np.testing.assert_array_equal(classify_ranges(beyond, 80.0, repeated)[0], np.float32(beyond))


def test_the_shortest_range_that_many_beams_show_once_more_is_invalid() -> None:
    repeated, seen = RepeatedRange(), np.linspace(0.5, 4.5, 200)
    ranges = np.append(seen, np.full(60, 0.1))
    assert np.isfinite(classify_ranges(ranges, 30.0, repeated)[0]).all()
    found, limit = classify_ranges(ranges, 30.0, repeated)
    assert limit == 30.0
    np.testing.assert_array_equal(found, np.float32([*seen, *[math.nan] * 60]))


def test_classify_ranges() -> None:
    raw = np.array([0.0, -1.0, np.nan, -np.inf, 0.01, 81.82, 81.83, 81.91, np.inf])
    expected = np.float32([np.nan, np.nan, np.nan, np.nan, 0.01, 81.82, np.inf, np.inf, np.inf])
    np.testing.assert_array_equal(classify_ranges(raw, 81.83, RepeatedRange())[0], expected)


@pytest.mark.parametrize(("unit", "limit"), [(1000.0, 12000.0), (100.0, 1200.0), (1.0, 12.0)])
def test_a_maximum_in_another_unit_than_the_ranges_is_raised(unit: float, limit: float) -> None:
    ranges = unit * np.append(np.linspace(1.0, 9.0, 90), np.full(30, 12.0))
    found, found_limit = classify_ranges(ranges, 12.0, RepeatedRange())
    assert found_limit == limit
    np.testing.assert_array_equal(found, np.float32([*ranges[:90], *[math.inf] * 30]))


def test_the_longest_range_that_many_beams_show_to_the_bit_is_no_return() -> None:
    seen = np.linspace(0.5, 4.5, 200)
    found, limit = classify_ranges(np.append(seen, np.full(60, 5.0)), 30.0, RepeatedRange())
    assert limit == 5.0
    np.testing.assert_array_equal(found, np.float32([*seen, *[math.inf] * 60]))


@pytest.mark.parametrize("step_m", [0.001, 0.01, 0.1])
def test_beams_on_a_wall_in_whole_steps_are_no_code(step_m: float) -> None:
    wall = np.round(1.0 / np.cos(np.linspace(-1.4, 1.4, 361)) / step_m) * step_m
    np.testing.assert_array_equal(classify_ranges(wall, 30.0, RepeatedRange())[0], np.float32(wall))


def test_codes_beyond_the_maximum_are_no_other_unit() -> None:
    codes = np.resize([81.83, 81.87, 81.9, 81.91], 180)
    assert np.isposinf(classify_ranges(codes, 50.0, RepeatedRange())[0]).all()


def test_a_stray_line_does_not_decide_which_form_is_read(tmp_path: Path) -> None:
    found, dataset = read(write(tmp_path, robotlaser(), *GOOD, *GOOD, *GOOD))
    assert [scan.sensor for scan in scans(found)] == ["FLASER"] * 3
    assert dataset.report.ignored == {"ROBOTLASER1": 1}


def test_the_content_decides_whatever_the_name(tmp_path: Path) -> None:
    plain = write(tmp_path, *GOOD, name="plain.gz")
    packed = tmp_path / "packed.clf"
    packed.write_bytes(gzip.compress(b"\xef\xbb\xbf" + plain.read_bytes()))
    odd = write(tmp_path, *GOOD, name="no_suffix")
    counts = {len(read(path)[0]) for path in (plain, packed, odd)}
    assert counts == {4}


def test_a_second_pass_is_the_first_again(tmp_path: Path) -> None:
    dataset = open_dataset(write(tmp_path, *GOOD, "FLASER 3"))
    first = [m.stamp_s for m in dataset]
    report = repr(dataset.report)
    assert [m.stamp_s for m in dataset] == first
    assert repr(dataset.report) == report


def test_a_log_is_decoded_once_and_the_pass_after_frees_it(tmp_path: Path) -> None:
    path = write(tmp_path, *GOOD, "0 nonsense", *GOOD)
    dataset = open_dataset(path)
    fresh = [one.stamp_s for one in dataset]
    with read_once(dataset):
        next(iter(dataset))  # a pass that was given up is none
        first = list(dataset)
        path.unlink()
        again = list(dataset)
        assert dataset.report.dropped_count == 1 and dataset.report.share == 1.0
    last = list(dataset)
    assert [one.stamp_s for one in first] == fresh
    assert all(a is b is c for a, b, c in zip(first, again, last, strict=True))
    with pytest.raises(DatasetError, match="cannot open"):
        list(dataset)


def test_a_log_that_is_too_large_is_decoded_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "_MOST_KEPT_BYTES", 12)
    dataset = open_dataset(write(tmp_path, *GOOD))
    with read_once(dataset):
        first, again = list(dataset), list(dataset)
    assert not any(a is b for a, b in zip(first, again, strict=True))


@QUIET
@given(ranges=st.lists(st.floats(0.01, 79.0), min_size=1, max_size=20), x=st.floats(-1e3, 1e3))
def test_what_is_written_is_read(tmp_path: Path, ranges: list[float], x: float) -> None:
    line = f"FLASER {len(ranges)} {' '.join(map(repr, ranges))} {x!r} 0 0 {x!r} 0 0 5.5 h 0"
    odometry, scan = read(write(tmp_path, line))[0]
    assert isinstance(odometry, WheelOdometry)
    assert isinstance(scan, LaserScan)
    assert odometry.T_odom_base.x() == x
    if len(ranges) == len(set(ranges)):
        np.testing.assert_array_equal(scan.ranges_m, np.float32(ranges))


@pytest.mark.parametrize(
    ("log", "odometry", "scan_count", "beams", "backward", "mount_x"),
    [("fr079", 4934, 4791, 360, 0, -0.04), ("intel", 13631, 3461, 180, 785, 0.0)],
)
def test_real_logs(
    log: str, odometry: int, scan_count: int, beams: int, backward: int, mount_x: float
) -> None:
    path = LIDAR2D / log / f"{log}.log.gz"
    if not path.exists():
        pytest.skip(f"REAL LOG ABSENT, not tested: {path}")
    dataset = open_dataset(path, strict=True)
    counts = {LaserScan: 0, WheelOdometry: 0}
    for m in dataset:
        counts[type(m)] += 1
        if isinstance(m, LaserScan):
            assert m.ranges_m.size == beams
            assert m.start_angle_rad == pytest.approx(-math.pi / 2)
            assert m.step_rad == pytest.approx(math.pi / beams)
            assert m.T_base_laser.equals(gtsam.Pose2(mount_x, 0, 0), 1e-9)
            assert not np.isnan(m.ranges_m).any()
            assert m.ranges_m[np.isfinite(m.ranges_m)].max() < 60.0
    assert counts == {LaserScan: scan_count, WheelOdometry: odometry}
    steps = dataset.report.backward_steps
    assert (steps["odometry"].count if steps else 0) == backward
    assert dataset.name == log
