"""The CARMEN reader: what lines mean, what damage costs, and that it never costs more."""

from __future__ import annotations

import gzip
import math
import tracemalloc
from pathlib import Path

import gtsam
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slam.datasets import open_dataset
from slam.datasets.carmen import NO_MESSAGE, NO_VALID_RANGE, TRUNCATED, ZERO_BEAMS, CarmenDataset
from slam.datasets.carmen_records import BAD_POSE, BAD_STAMP, NOT_A_NUMBER, WRONG_COUNT
from slam.datasets.laser_geometry import beam_layout, classify_ranges, no_return_limit_m
from slam.datasets.log_file import LINE_TOO_LONG, MAX_LINE_BYTES, STREAM_DAMAGED
from slam.errors import BadRecordError, DatasetError
from slam.measurements import LaserScan, Measurement, WheelOdometry

LIDAR2D = Path(__file__).parents[3] / "shared" / "data" / "lidar2d"


def flaser(
    ranges: str = "1.0 2.0 3.0 4.0", *, count: int | None = None, stamp: str = "10.0", name: str = "FLASER"
) -> str:
    count = len(ranges.split()) if count is None else count
    return f"{name} {count} {ranges} 1 2 0.5 1 2 0.5 {stamp} host 0.1"


def odom(x: float = 0.0, *, stamp: float = 9.0) -> str:
    return f"ODOM {x} 0 0 0 0 0 {stamp} host 0.0"


def robotlaser(
    ranges: str = "1 2 3 4", *, laser: str = "1.2 2 0", robot: str = "1 2 0", name: str = "ROBOTLASER1"
) -> str:
    count = len(ranges.split())
    tail = f"{laser} {robot} 0 0 0.3 0.3 1e6 10.0 host 0.1"
    return f"{name} 0 -1.0 2.0 0.5 25.0 0.01 0 {count} {ranges} 2 7 8 {tail}"


def write(directory: Path, *lines: str, name: str = "a.log", end: str = "\n") -> Path:
    path = directory / name
    path.write_bytes("".join(line + end for line in lines).encode())
    return path


def read(path: Path, *, strict: bool = False) -> tuple[list[Measurement], CarmenDataset]:
    dataset = open_dataset(path, strict=strict)
    assert isinstance(dataset, CarmenDataset)
    return list(dataset), dataset


def scans(measurements: list[Measurement]) -> list[LaserScan]:
    return [m for m in measurements if isinstance(m, LaserScan)]


def poses(measurements: list[Measurement]) -> list[tuple[float, float]]:
    return [(m.stamp_s, m.T_odom_base.x()) for m in measurements if isinstance(m, WheelOdometry)]


# What lines mean


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
    found, dataset = read(write(tmp_path, line))
    odometry, scan = found
    assert isinstance(odometry, WheelOdometry)
    assert isinstance(scan, LaserScan)
    assert odometry.T_odom_base.equals(robot, 1e-9)
    assert scan.T_base_laser.equals(gtsam.Pose2(0.2, 0.1, -0.3), 1e-9)
    np.testing.assert_allclose(scan.bearings_rad(), [-1.0, -0.5, 0.0, 0.5, 1.0])
    np.testing.assert_array_equal(scan.ranges_m, np.float32([1, 2, 24.9, np.inf, np.nan]))
    assert scan.range_max_m == 25.0
    assert dataset.report.invalid_ranges == 1


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


def test_a_contradicting_param_is_reported_and_the_beam_count_wins(tmp_path: Path) -> None:
    lines = (
        "PARAM laser_front_laser_fov 180 x 0",
        "PARAM laser_front_laser_resolution 1 x 0",
        flaser(" ".join(["2.0"] * 361)),
    )
    found, dataset = read(write(tmp_path, *lines))
    assert scans(found)[0].step_rad == pytest.approx(math.radians(0.5))
    assert any("361 beams" in note for note in dataset.report.notes)


@pytest.mark.parametrize(
    ("stated", "ranges", "seen", "limit"),
    [
        (81.91, [1.0], 0.0, 81.83),
        (50.0, [1.0], 0.0, 50.0),
        (None, [81.9], 0.0, 80.0),
        (0.0, [3.0], 0.0, 80.0),
        (None, [1.0, 8.191], 2.0, 8.183),
        (None, [1.0, 8.191], 12.0, 80.0),
        (None, [1.0, 8.19], 2.0, 80.0),
        (None, [float("nan"), 8.187], 2.0, 8.183),
    ],
)
def test_no_return_limit(stated: float | None, ranges: list[float], seen: float, limit: float) -> None:
    assert no_return_limit_m(stated, np.array(ranges), seen) == limit


def test_classify_ranges() -> None:
    raw = np.array([0.0, -1.0, np.nan, -np.inf, 0.01, 81.82, 81.83, 81.91, np.inf])
    expected = np.float32([np.nan, np.nan, np.nan, np.nan, 0.01, 81.82, np.inf, np.inf, np.inf])
    np.testing.assert_array_equal(classify_ranges(raw, 81.83), expected)


# Damage

GOOD = (odom(0.0, stamp=1.0), flaser(stamp="2.0"), odom(0.1, stamp=3.0))
DAMAGED = [
    (flaser(count=3), WRONG_COUNT),
    (flaser(count=5), WRONG_COUNT),
    (flaser(count=10**8), WRONG_COUNT),
    (flaser().replace("FLASER 4", "FLASER -4"), WRONG_COUNT),
    (flaser().replace("FLASER 4", "FLASER " + "9" * 5000), WRONG_COUNT),
    (flaser().replace("FLASER 4", "FLASER four"), WRONG_COUNT),
    ("FLASER", WRONG_COUNT),
    ("FLASER 0", WRONG_COUNT),
    ("ODOM 1 2 3", WRONG_COUNT),
    (odom() + " 1 2 3", WRONG_COUNT),
    ("PARAM", WRONG_COUNT),
    (flaser(count=6), WRONG_COUNT),
    ("ROBOTLASER2 0 -1.57", WRONG_COUNT),
    (robotlaser(name="ROBOTLASER2").replace(" 2 7 8 ", " 3 7 8 "), WRONG_COUNT),
    (flaser("1.0 x.0 3.0"), NOT_A_NUMBER),
    (flaser("1.0 2_0 3.0"), NOT_A_NUMBER),
    (odom().replace("ODOM 0.0", "ODOM 0.0.0"), NOT_A_NUMBER),
    ("PARAM robot_frontlaser_offset wide 1 h 0", NOT_A_NUMBER),
    (odom(math.nan), BAD_POSE),
    (odom(math.inf), BAD_POSE),
    (odom(1e300), BAD_POSE),
    (odom(stamp=math.nan), BAD_STAMP),
    (flaser(stamp="1e400"), BAD_STAMP),
    (flaser(""), ZERO_BEAMS),
    (flaser("0 nan -1"), NO_VALID_RANGE),
    ("\x00\x01 1 2 3", NO_MESSAGE),
    ("1.5 1.5 1.5", NO_MESSAGE),
]


@pytest.mark.parametrize(("line", "reason"), DAMAGED)
def test_a_damaged_line_is_counted_and_costs_only_itself(tmp_path: Path, line: str, reason: str) -> None:
    path = write(tmp_path, GOOD[0], line, *GOOD[1:])
    found, dataset = read(path)
    assert {key: (tally.count, tally.lines) for key, tally in dataset.report.dropped.items()} == {
        reason: (1, [2])
    }
    assert [m.stamp_s for m in found if m.stamp_s in (1.0, 3.0) or isinstance(m, LaserScan)] == [
        1.0,
        2.0,
        3.0,
    ]
    with pytest.raises(BadRecordError, match=r"a\.log, line 2: .*--strict"):
        read(path, strict=True)


def test_harmless_lines_are_no_damage_even_when_strict(tmp_path: Path) -> None:
    lines = (
        "# comment",
        "",
        "   ",
        "SYNC tag 1 h 0",
        "GPSDATA \xe9\xff 1",
        "# \udcff".encode("utf-8", "replace").decode(),
    )
    found, dataset = read(write(tmp_path, *lines, *GOOD, end="\r\n"), strict=True)
    assert len(scans(found)) == 1
    assert dataset.report.ignored == {"SYNC": 1, "GPSDATA": 1}
    assert dataset.report.line_count == len(lines) + len(GOOD)


@pytest.mark.parametrize("cut", range(1, 36))
def test_a_cut_last_line_never_gives_a_wrong_value(tmp_path: Path, cut: int) -> None:
    last = flaser("1.25 2.25", stamp="1234.5678")
    path = tmp_path / "a.log"
    path.write_bytes((GOOD[0] + "\n" + last[:-cut]).encode())
    found, dataset = read(path)
    whole = cut < len("0.1")  # nothing is lost but digits of the logger's stamp, which is not used
    assert [s.stamp_s for s in scans(found)] == ([1234.5678] if whole else [])
    assert set(dataset.report.dropped) <= {TRUNCATED}
    assert dataset.report.dropped_count == (0 if whole else 1)


def test_a_cut_gzip_keeps_what_could_be_read(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    lines = [flaser(" ".join(f"{r:.3f}" for r in rng.uniform(1, 9, 50)), stamp=f"{i}.5") for i in range(3000)]
    data = gzip.compress("".join(line + "\n" for line in lines).encode())
    path = tmp_path / "a.log.gz"
    path.write_bytes(data[: len(data) // 2])
    found, dataset = read(path)
    assert 1200 < len(scans(found)) < 1800
    assert dataset.report.dropped[STREAM_DAMAGED].count == 1
    with pytest.raises(BadRecordError, match=STREAM_DAMAGED):
        read(path, strict=True)
    middle = len(data) // 2
    path.write_bytes(data[:middle] + bytes(64) + data[middle + 64 :])
    found, dataset = read(path)
    assert 1200 < len(scans(found)) <= 3000
    assert STREAM_DAMAGED in dataset.report.dropped


def test_an_endless_line_is_skipped_in_bounded_memory(tmp_path: Path) -> None:
    path = tmp_path / "a.log.gz"
    with gzip.open(path, "wb", compresslevel=1) as out:
        out.write((GOOD[0] + "\nFLASER 9 ").encode())
        for _ in range(40):
            out.write(b"1.0 " * (MAX_LINE_BYTES // 4))
        out.write(("\n" + "\n".join(GOOD[1:]) + "\n").encode())
    tracemalloc.start()
    found, dataset = read(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert dataset.report.dropped[LINE_TOO_LONG].lines == [2]
    assert len(scans(found)) == 1
    assert peak < 12 * MAX_LINE_BYTES


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    def peak_of(repeats: int) -> int:
        path = tmp_path / f"{repeats}.log"
        with path.open("w") as out:
            for i in range(repeats):
                out.write(odom(0.01 * i, stamp=float(i)) + "\n" + flaser("2.5 " * 90, stamp=f"{i}.5") + "\n")
                out.write(f"KIND{i} x\njunk{i}! 1\n")
        dataset = open_dataset(path)
        tracemalloc.start()
        count = sum(1 for _ in dataset)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert count == 3 * repeats
        return peak

    short, long = peak_of(400), peak_of(8000)
    assert long < 1.3 * short + 50_000


# Opening


def test_a_stray_line_does_not_decide_which_form_is_read(tmp_path: Path) -> None:
    found, dataset = read(write(tmp_path, robotlaser(), *GOOD, *GOOD, *GOOD))
    assert [scan.sensor for scan in scans(found)] == ["FLASER"] * 3
    assert dataset.report.ignored == {"ROBOTLASER1": 1}


def test_what_cannot_be_a_log_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "empty.log").write_bytes(b"")
    (tmp_path / "cut.log.gz").write_bytes(gzip.compress(b"ODOM")[:5])
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n" + bytes(range(256)))
    (tmp_path / "syslog.log").write_bytes(b"Jan 1 kernel: hello\n" * 9)
    for path in (tmp_path / "absent.log", tmp_path, *tmp_path.iterdir()):
        with pytest.raises(DatasetError, match=r"CARMEN log \(\.log") as caught:
            open_dataset(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("lines", [("# only a comment",), ("PARAM a 1 x 0",), ("FLASER 3 1 2",), ("SYNC x",)])
def test_a_log_without_measurements_is_an_error(tmp_path: Path, lines: tuple[str, ...]) -> None:
    with pytest.raises(DatasetError, match="no odometry and no scan"):
        read(write(tmp_path, *lines))


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
    report = dataset.report.to_dict()
    assert [m.stamp_s for m in dataset] == first
    assert dataset.report.to_dict() == report


# Random damage

DAMAGES = st.lists(
    st.tuples(
        st.sampled_from(["flip", "delete", "insert", "cut"]), st.integers(0, 10**6), st.binary(max_size=5)
    ),
    max_size=8,
)
BASE = "\n".join(
    ("PARAM robot_front_laser_max 30 x 0", *GOOD, flaser(name="RLASER"), robotlaser(), *GOOD, "")
).encode()
QUIET = settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=300)


def damage(data: bytes, damages: list[tuple[str, int, bytes]]) -> bytes:
    for kind, where, junk in damages:
        at = where % max(1, len(data))
        if kind == "flip":
            data = data[:at] + junk + data[at + len(junk) :]
        elif kind == "delete":
            data = data[:at] + data[at + 1 + where % 40 :]
        elif kind == "insert":
            data = data[:at] + junk + data[at:]
        else:
            data = data[: max(at, len(data) // 2)]
    return data


def check_sound(path: Path) -> None:
    """Every measurement that comes out is one that later stages may use."""
    try:
        dataset = open_dataset(path)
        for m in dataset:
            assert math.isfinite(m.stamp_s)
            if isinstance(m, LaserScan):
                assert m.ranges_m.dtype == np.float32
                assert m.ranges_m.size > 0
                assert not np.isnan(m.ranges_m).all()
                assert not (m.ranges_m <= 0).any()
                assert math.isfinite(m.start_angle_rad)
                assert 0.0 < m.step_rad < 7.0
                assert 0.0 < m.range_max_m <= 81.83
            else:
                assert np.isfinite(m.T_odom_base.matrix()).all()
    except DatasetError as error:
        assert not isinstance(error, BadRecordError)
        return
    report = dataset.report
    assert report.line_count >= sum(report.records.values()) + sum(report.ignored.values())


@QUIET
@given(damages=DAMAGES)
def test_random_damage_of_a_plain_log_is_survived(
    tmp_path: Path, damages: list[tuple[str, int, bytes]]
) -> None:
    path = tmp_path / "a.log"
    path.write_bytes(damage(BASE, damages))
    check_sound(path)


@QUIET
@given(damages=DAMAGES)
def test_random_damage_of_a_packed_log_is_survived(
    tmp_path: Path, damages: list[tuple[str, int, bytes]]
) -> None:
    path = tmp_path / "a.log.gz"
    path.write_bytes(damage(gzip.compress(BASE, mtime=0), damages))
    check_sound(path)


@QUIET
@given(
    tokens=st.lists(
        st.one_of(
            st.sampled_from(["nan", "inf", "-1", "0", "3", "1e999", "_", "1_0", "FLASER", "é", "#"]),
            st.floats().map(repr),
        ),
        max_size=14,
    ),
    name=st.sampled_from(["FLASER", "RLASER", "ODOM", "PARAM", "ROBOTLASER1", "RAWLASER2"]),
)
def test_random_lines_are_survived(tmp_path: Path, tokens: list[str], name: str) -> None:
    check_sound(write(tmp_path, GOOD[0], " ".join([name, *tokens])))


@QUIET
@given(ranges=st.lists(st.floats(0.01, 79.0), min_size=1, max_size=20), x=st.floats(-1e3, 1e3))
def test_what_is_written_is_read(tmp_path: Path, ranges: list[float], x: float) -> None:
    line = f"FLASER {len(ranges)} {' '.join(map(repr, ranges))} {x!r} 0 0 {x!r} 0 0 5.5 h 0"
    odometry, scan = read(write(tmp_path, line))[0]
    assert isinstance(odometry, WheelOdometry)
    assert isinstance(scan, LaserScan)
    assert odometry.T_odom_base.x() == x
    if all(abs(r - code) > 1e-6 for r in ranges for code in (8.183, 8.187, 8.191)):
        np.testing.assert_array_equal(scan.ranges_m, np.float32(ranges))


# The real logs


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
