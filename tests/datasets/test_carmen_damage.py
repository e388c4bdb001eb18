"""The CARMEN reader: what damage costs, and that it never costs more."""

from __future__ import annotations

import gzip
import math
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from carmen_lines import GOOD, flaser, odom, read, robotlaser, scans, write
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from slam.datasets import open_dataset
from slam.datasets.carmen import NO_MESSAGE, NO_VALID_RANGE, TRUNCATED, ZERO_BEAMS
from slam.datasets.carmen_records import BAD_POSE, BAD_STAMP, NOT_A_NUMBER, WRONG_COUNT
from slam.datasets.log_file import LINE_TOO_LONG, MAX_LINE_BYTES, STREAM_DAMAGED
from slam.errors import BadRecordError, DatasetError
from slam.measurements import LaserScan, WheelOdometry

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
    with pytest.raises(BadRecordError, match=r"a\.log, record 2: .*--strict"):
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

    short, long = peak_of(400), peak_of(3000)
    assert long < 1.3 * short + 50_000


# Opening


def test_what_cannot_be_a_log_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "empty.log").write_bytes(b"")
    (tmp_path / "cut.log.gz").write_bytes(gzip.compress(b"ODOM")[:5])
    (tmp_path / "picture.png").write_bytes(b"\x89PNG\r\n" + bytes(range(256)))
    (tmp_path / "syslog.log").write_bytes(b"Jan 1 kernel: hello\n" * 9)
    remedies = dict.fromkeys(("empty.log", "cut.log.gz"), "copy it again") | {"absent.log": "did you mean"}
    for path in (tmp_path / "absent.log", tmp_path, *tmp_path.iterdir()):
        with pytest.raises(DatasetError, match=remedies.get(path.name, "CARMEN logs")) as caught:
            open_dataset(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("lines", [("# only a comment",), ("PARAM a 1 x 0",), ("FLASER 3 1 2",), ("SYNC x",)])
def test_a_log_without_measurements_is_an_error(tmp_path: Path, lines: tuple[str, ...]) -> None:
    with pytest.raises(DatasetError, match="no usable frame, scan or odometry"):
        read(write(tmp_path, *lines))


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
                assert isinstance(m, WheelOdometry)
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
