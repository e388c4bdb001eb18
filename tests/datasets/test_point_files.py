"""Points in PCD and PLY files of every form; and files whose header lies or whose bytes are damaged."""

from __future__ import annotations

import base64
import tempfile
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from point_files import Columns, lzf, write_pcd, write_ply

from slam.datasets.cloud_files import CloudFile, is_return, read_cloud
from slam.datasets.dataset import RecordFault
from slam.datasets.pcd_points import read_pcd_points
from slam.datasets.ply_points import read_ply_points
from slam.datasets.point_times import PointTimes

RNG = np.random.default_rng(3)
POINTS = RNG.normal(size=(200, 3)).astype(np.float32)
COLUMNS: Columns = {
    "x": POINTS[:, 0],
    "intensity": np.arange(200, dtype=np.uint8),
    "y": POINTS[:, 1],
    "z": POINTS[:, 2],
    "time": 1.7e9 + 1e-6 * np.arange(200),
    "ring": np.repeat(np.arange(25, dtype=np.uint16), 8),
    "label": np.arange(-100, 100, dtype=np.int32),
}
Writer = Callable[[Path, Columns, str], Path]
FORMS: list[tuple[Writer, str]] = [
    *((write_pcd, form) for form in ("ascii", "binary", "binary_compressed")),
    *((write_ply, form) for form in ("ascii", "binary_little_endian", "binary_big_endian")),
]
every_form = pytest.mark.parametrize(("write", "form"), FORMS, ids=[form for _, form in FORMS])


def file_of(folder: Path, write: Writer) -> Path:
    return folder / ("a.pcd" if write is write_pcd else "a.ply")


@every_form
def test_points_and_fields_come_back_with_their_types(tmp_path: Path, write: Writer, form: str) -> None:
    found = read_cloud(write(file_of(tmp_path, write), COLUMNS, form))
    np.testing.assert_array_equal(found.points_lidar, POINTS)
    assert set(found.fields) == {"intensity", "time", "ring", "label"}
    for name, values in found.fields.items():
        np.testing.assert_array_equal(values, COLUMNS[name])
        assert values.dtype == COLUMNS[name].dtype and values.dtype.isnative


@every_form
def test_what_is_no_point_goes_with_its_fields(tmp_path: Path, write: Writer, form: str) -> None:
    x = np.where(np.arange(200) < 50, np.float32(np.nan), POINTS[:, 0])
    found = read_cloud(write(file_of(tmp_path, write), COLUMNS | {"x": x}, form))
    np.testing.assert_array_equal(found.points_lidar, POINTS[50:])
    np.testing.assert_array_equal(found.fields["label"], COLUMNS["label"][50:])


@pytest.mark.parametrize("form", ["ascii", "binary", "binary_compressed"])
def test_fields_of_several_numbers_and_padding_are_passed_over(tmp_path: Path, form: str) -> None:
    histogram = RNG.normal(size=(200, 33)).astype(np.float32)
    columns = {"pad": np.zeros((200, 3), np.uint8), "hist": histogram, **COLUMNS, "pax": np.ones(200, "i1")}
    path = write_pcd(tmp_path / "a.pcd", columns, form)
    path.write_bytes(path.read_bytes().replace(b"FIELDS pad", b"FIELDS _").replace(b" pax\n", b" _\n"))
    np.testing.assert_array_equal(read_cloud(path).fields["label"], COLUMNS["label"])
    columns = read_pcd_points(path)
    np.testing.assert_array_equal(columns["hist"], histogram)
    assert not any(name.startswith("_") for name in columns)


def test_what_liblzf_has_packed_is_read(tmp_path: Path) -> None:
    # Written by Open3D 0.20: x = 0, 1, 2, 3 again and again, y up by a half every four, z = -1, ring as x.
    packed = base64.b64decode(
        "SQAAAFABAAABAABAAAGAPyAFAEAgAiADQADgRw/gBABAa+ACA0Br4AMDAMAgG+ADA0CX4AMDACAgo+ADAwGAv+BVAwQBAAIAAyCC4BsHAQMA"
    )
    header = (
        "FIELDS x y z ring\nSIZE 4 4 4 2\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 24\nHEIGHT 1\nPOINTS 24\n"
        "DATA binary_compressed\n"
    )
    (tmp_path / "a.pcd").write_bytes(header.encode() + packed)
    found = read_cloud(tmp_path / "a.pcd")
    number = np.arange(24)
    wanted = np.column_stack([number % 4, number // 4 * 0.5, np.full(24, -1.0)])
    np.testing.assert_array_equal(found.points_lidar, wanted.astype(np.float32))
    np.testing.assert_array_equal(found.fields["ring"], number % 4)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.tuples(st.binary(min_size=1, max_size=40), st.integers(1, 400)), max_size=12))
def test_packed_bytes_come_back(parts: list[tuple[bytes, int]]) -> None:
    plain = b"".join(part * times for part, times in parts)
    plain += bytes(-len(plain) % 12) + np.float32([1, 2, 3]).tobytes()
    table = np.frombuffer(plain, "<u4").reshape(3, -1)
    with tempfile.TemporaryDirectory() as folder:
        path = write_pcd(Path(folder) / "a.pcd", dict(zip("xyz", table, strict=True)), "binary_compressed")
        found = read_pcd_points(path)
    for axis, values in zip("xyz", table, strict=True):
        np.testing.assert_array_equal(found[axis], values)


@every_form
@pytest.mark.parametrize("kept", [0.02, 0.3, 0.9])
def test_a_file_that_is_cut_off_is_refused(tmp_path: Path, write: Writer, form: str, kept: float) -> None:
    path = write(file_of(tmp_path, write), COLUMNS, form)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(kept * len(whole))])
    with pytest.raises(RecordFault, match="truncated or damaged"):
        read_cloud(path)


def outcome(path: Path) -> CloudFile | RecordFault:
    """What reading gives; anything but a cloud or a fault is the test's failure."""
    try:
        return read_cloud(path)
    except RecordFault as fault:
        assert "\n" not in str(fault)
        return fault


@settings(deadline=None, max_examples=150)
@given(data=st.data(), case=st.sampled_from(FORMS))
def test_a_damaged_file_gives_a_cloud_or_a_fault_and_takes_no_memory(
    data: st.DataObject, case: tuple[Writer, str]
) -> None:
    write, form = case
    with tempfile.TemporaryDirectory() as folder:
        path = write(file_of(Path(folder), write), COLUMNS, form)
        content = bytearray(path.read_bytes())
        if data.draw(st.booleans()):  # a word of the header is another
            lines = content.split(b"\n")
            line = data.draw(st.integers(0, 20))
            words = lines[line].split(b" ")
            strange = [
                "-1",
                "0",
                "3",
                "99999999999",
                "9" * 5000,
                "1e3",
                "nan",
                "",
                "x",
                "vertex",
                "list",
                "F",
                "é",
            ]
            words[data.draw(st.integers(0, len(words) - 1))] = data.draw(st.sampled_from(strange)).encode()
            lines[line] = b" ".join(words)
            content = bytearray(b"\n".join(lines))
        for _ in range(data.draw(st.integers(0, 4))):
            content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
        path.write_bytes(
            content[: data.draw(st.integers(1, len(content)))] if data.draw(st.booleans()) else content
        )
        tracemalloc.start()
        try:
            found = outcome(path)
            most = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
    assert most < 20e6
    if isinstance(found, CloudFile):
        assert len(found.points_lidar) <= 200
        assert all(values.shape == (len(found.points_lidar),) for values in found.fields.values())


PCD = (
    "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT {count} 1 1\n"
    "WIDTH {width}\nHEIGHT 1\nPOINTS {width}\nDATA {form}\n"
)
PLY = "ply\nformat {form} 1.0\nelement vertex {width}\nproperty float x\n{more}end_header\n"
XYZ = "property float y\nproperty float z\n"
LISTS = "property list uchar int y\nproperty float z\n"
BOMB = "\x40\0\0\0\0\x8c\x86\x47" + "\0" * 64  # 64 bytes that promise 1.2 GB


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.pcd", PCD.format(count=1, width=10**15, form="binary") + "0" * 100),
        ("a.pcd", PCD.format(count=10**15, width=1, form="binary") + "0" * 100),
        ("a.pcd", PCD.format(count=10**30, width=0, form="binary") + "0" * 100),
        ("a.pcd", PCD.format(count=1, width=10**9, form="ascii") + "1 2 3\n"),
        ("a.pcd", PCD.format(count=1, width=10**8, form="binary_compressed") + BOMB),
        ("a.pcd", PCD.format(count=1, width=2, form="zipped") + "0" * 100),
        ("a.pcd", "FIELDS x y z\nDATA ascii\n1 2 3\n"),
        ("a.pcd", "#" * 70000 + "\n" + PCD.format(count=1, width=1, form="ascii") + "1 2 3\n"),
        ("a.ply", PLY.format(form="binary_little_endian", width=10**15, more=XYZ) + "0" * 100),
        ("a.ply", PLY.format(form="ascii", width=10**9, more=XYZ) + "1 2 3\n"),
        ("a.ply", PLY.format(form="ascii", width=2, more=XYZ) + "1 2 3\n1 2\n"),
        ("a.ply", PLY.format(form="ascii", width=2, more=XYZ) + "\n" * 100),
        ("a.ply", PLY.format(form="ascii", width=2, more=XYZ) + "1 2 3\n1 2 three\n"),
        ("a.ply", PLY.format(form="ascii", width=1, more=LISTS) + "1 1 1 2\n"),
        ("a.ply", PLY.format(form="ascii", width=1, more=XYZ.replace("z", "y")) + "1 2 3\n"),
        ("a.ply", PLY.format(form="ascii", width=1, more="") + "1\n"),
        ("a.ply", PLY.format(form="ascii", width=1, more=XYZ).replace("vertex", "corner") + "1 2 3\n"),
        ("a.ply", "ply\nelement vertex 1\nproperty float x\n" + XYZ + "end_header\n1 2 3\n"),
    ],
)  # fmt: skip
def test_headers_that_lie_are_refused_before_memory_is_taken(tmp_path: Path, name: str, content: str) -> None:
    (tmp_path / name).write_bytes(content.encode("latin-1"))
    tracemalloc.start()
    try:
        with pytest.raises(RecordFault, match="truncated or damaged"):
            read_cloud(tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 5e6
    finally:
        tracemalloc.stop()


def test_a_reference_to_before_the_beginning_is_damage(tmp_path: Path) -> None:
    plain = POINTS.T.tobytes()
    header = PCD.format(count=1, width=200, form="binary_compressed").encode()
    for start, length in ((b"\x20\x05", 3), (b"\xe0\x00\x05", 9)):  # so many bytes from where nothing is yet
        packed = start + lzf(plain[length:])
        sizes = np.array([len(packed), len(plain)], "<u4").tobytes()
        (tmp_path / "a.pcd").write_bytes(header + sizes + packed)
        with pytest.raises(RecordFault, match="damaged compression"):
            read_cloud(tmp_path / "a.pcd")


def test_windows_lines_and_old_names_are_read(tmp_path: Path) -> None:
    ply = PLY.format(form="ascii", width=1, more=XYZ).replace("float x", "float32 x").replace("\n", "\r\n")
    (tmp_path / "a.ply").write_bytes(ply.encode() + b"1 2 3\r\n")
    pcd = PCD.format(count=1, width=1, form="ascii").replace("FIELDS", "COLUMNS").replace("COUNT 1 1 1\n", "")
    (tmp_path / "a.pcd").write_bytes(pcd.encode() + b"1 2 3\n")
    for found in (read_ply_points(tmp_path / "a.ply"), read_pcd_points(tmp_path / "a.pcd")):
        assert {name: values.tolist() for name, values in found.items()} == {"x": [1], "y": [2], "z": [3]}


def test_a_sphere_that_many_points_lie_on_is_no_return() -> None:
    """Rings on a level floor are recognised alike, too, by a lidar without noise."""
    rng = np.random.default_rng(4)
    ways = rng.normal(size=(9000, 3))
    ways /= np.linalg.norm(ways, axis=1)[:, None]
    ranges_m = rng.uniform(1.0, 90.0, 9000)
    ranges_m[:900], ranges_m[-1] = 60.0, 1e30  # damaged: no float32 holds its square
    assert np.array_equal(is_return((ways * ranges_m[:, None]).astype(np.float32)), np.arange(9000) >= 900)
    ranges_m[:900] = rng.normal(60.0, 0.01, 900)
    assert is_return((ways * ranges_m[:, None]).astype(np.float32)).all()
    ranges_m[:4000] = np.repeat([5.0, 7.0, 9.0, 12.0], 1000)
    assert is_return((ways * ranges_m[:, None]).astype(np.float32)).all()
    assert is_return(ways.astype(np.float32)).all()


def test_points_that_show_no_time_have_that_of_their_neighbours() -> None:
    right, times = np.arange(1000) * 1e5, PointTimes()
    stated = np.where(np.arange(1000) % 2, right, 0.0)
    found = times.of(["t"], lambda _: stated, 5.0)
    assert found is not None and np.abs(found - 1e-9 * right).max() < 2e-4
    assert times.notes("/points")[1].startswith("warning: /points: many points have no time")
    sound = PointTimes()
    sound.of(["t"], lambda _: right, 5.0)
    assert len(sound.notes("/points")) == 1


def test_a_plane_with_rounded_heights_is_a_cloud_and_swapped_bytes_are_none() -> None:
    angles = np.linspace(0.0, 6.0, 400)
    plane = np.column_stack([5.0 * np.cos(angles), 4.0 * np.sin(angles), 3e-17 * np.cos(angles)])
    assert is_return(plane.astype(np.float32)).all()
    assert not is_return(plane.astype(">f4").view("<f4").astype(np.float32)).any()
