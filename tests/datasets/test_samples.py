"""Samples whose readers have no other test are read as they were written; damage is counted."""

from __future__ import annotations

import shutil
import struct
import sys
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest
from rgbd_files import dropped, read

import tools.layouts.all as _all_layouts  # noqa: F401  their writers put themselves on the list
from slam.datasets import open_dataset
from slam.datasets.account import Account
from slam.datasets.bags.cloud_messages import point_cloud
from slam.datasets.bags.foxglove import UNDECODED, _class_of
from slam.datasets.captures import payloads
from slam.datasets.dataset import ReadReport
from slam.datasets.nyu_dumps import T_depth_color
from slam.errors import DatasetError
from slam.measurements import LaserScan, PointCloud, WheelOdometry
from tools.layouts.cameras import nyu_to_color
from tools.layouts.foxglove import recorded
from tools.layouts.judge import problems
from tools.layouts.lidar_bags import captured
from tools.layouts.samples import LAYOUTS, Sample

NYU = "NYU Depth V2, raw dumps"
NAMES = [
    "Player log of Radish",
    "Rawseeds",
    "nuScenes, sweeps of one scene",
    "LAS clouds",
    "PointCloud of ROS 1's first years",
    NYU,
    "Velodyne packets, .pcap",
    "Foxglove, a lidar as protobuf",
    "Foxglove, a flat lidar as JSON",
    "Foxglove, a depth camera as protobuf",
]


@pytest.fixture(scope="module")
def nyu(tmp_path_factory: pytest.TempPathFactory) -> Sample:
    """A sample that takes long to write."""
    return LAYOUTS[NYU].write(tmp_path_factory.mktemp("nyu"))


@pytest.mark.parametrize("name", NAMES)
def test_a_sample_is_read_as_it_was_written(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    for word, library in (
        ("LAS", "laspy"),
        ("Velodyne", "velodyne_decoder"),
        ("protobuf", "google.protobuf"),
    ):
        if word in name:
            pytest.importorskip(library)
    sample = request.getfixturevalue("nyu") if name == NYU else LAYOUTS[name].write(tmp_path)
    dataset = open_dataset(sample.path, strict=True)
    assert problems(dataset, sample) == []


def test_a_log_of_player_by_its_other_versions(tmp_path: Path) -> None:
    old = (
        "## Player version 1.6\n## File version 0.1.0\n"
        "100.5 robot 6665 position 00 100.25 +01.000 -00.500 +0.100 +0 +0 +0 0\n"
        "100.5 robot 6665 laser 00 100.25 -0.1000 +0.1000 +0.10000000 0003 1.000 1 2.000 1 3.000 1\n"
        "100.5 robot 6665 sync 00 100.25\n"
    )
    posed = (
        "## Player version 3.0\n## File version 0.3.0\n"
        "7.0 16777343 6665 laser 02 001 002 0001 +1 +2 +3 -0.1000 +0.1000 +0.1 +8.0 0003 1.0 0 9.0 0 3.0 0\n"
        "7.1 16777343 6665 laser 01 001 001 0001 -0.1000 +0.1000 +0.1 +8.0 0003 1.0 0 2.0 0 3.0 0\n"
    )
    wheels, scan = read(_put(tmp_path / "old.log", old))[0]
    assert isinstance(wheels, WheelOdometry) and wheels.T_odom_base.equals(gtsam.Pose2(1.0, -0.5, 0.1), 1e-9)
    assert isinstance(scan, LaserScan) and scan.stamp_s == 100.25 and scan.step_rad == pytest.approx(0.1)
    np.testing.assert_allclose(scan.ranges_m, [1.0, 2.0, 3.0])
    (found,), dataset = read(_put(tmp_path / "new.log", posed))
    np.testing.assert_allclose(found.ranges_m, [1.0, np.inf, 3.0])
    assert list(dataset.report.ignored) == ["laser 01"]


def test_damaged_lines_of_player_and_rawseeds_are_counted(tmp_path: Path) -> None:
    log = LAYOUTS["Player log of Radish"].write(tmp_path / "a").path
    folder = LAYOUTS["Rawseeds"].write(tmp_path / "b").path
    for file in (log, *folder.glob("*FRONT.csv"), *folder.glob("*XYT.csv")):
        lines = file.read_text().splitlines()
        lines[6], lines[9] = lines[6][: len(lines[6]) // 2], "1235578000.5, nothing"
        _put(file, "\n".join(lines) + "\n")
    for path, lost in ((log, 2), (folder, 4)):
        found, dataset = read(path)
        assert sum(dropped(dataset).values()) == lost and len(found) > 30


def test_of_several_drives_of_nuscenes_one_is_read_and_reported(tmp_path: Path) -> None:
    path = LAYOUTS["nuScenes, sweeps of one scene"].write(tmp_path).path
    for file in sorted(path.iterdir())[:4]:
        (path / file.name.replace("n015-2018", "n015-2019")).write_bytes(file.read_bytes())
    found, dataset = read(path)
    assert len(found) == 10 and all(isinstance(one, PointCloud) for one in found)
    assert ["2 drives" in warning for warning in dataset.report.warnings] == [True]


def test_a_laz_cloud_is_read_and_a_cut_one_counted(tmp_path: Path) -> None:
    pytest.importorskip("lazrs")
    laspy = pytest.importorskip("laspy")
    path = LAYOUTS["LAS clouds"].write(tmp_path).path
    for file in sorted(path.iterdir()):
        laspy.read(file).write(file.with_suffix(".laz"))
        file.unlink()
    cut = max(path.iterdir())
    cut.write_bytes(cut.read_bytes()[:3000])
    # A table of chunks that says to be gigabytes, for which lazrs would end the process.
    first = min(path.iterdir())
    content = bytearray(first.read_bytes())
    (begins,) = struct.unpack_from("<I", content, 96)
    (table,) = struct.unpack_from("<q", content, begins)
    struct.pack_into("<I", content, table + 4, 2**31)
    first.write_bytes(content)
    found, dataset = read(path)
    assert len(found) == 8 and sum(dropped(dataset).values()) == 2


def test_a_capture_in_fragments_out_of_order_and_cut(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    data = [bytes([k]) * (1200 + k) for k in range(4)]
    whole = captured([(100.0 + k, one, 2368) for k, one in enumerate(data)], most=400)
    head, size = whole[:24], 0
    records = []
    while 24 + size < len(whole):
        (length,) = struct.unpack_from("<I", whole, 24 + size + 8)
        records.append(whole[24 + size : 24 + size + 16 + length])
        size += 16 + length
    shuffled = [records[k] for k in (2, 0, 3, 1)] + records[4:]
    report = ReadReport()
    path = tmp_path / "a.pcap"
    path.write_bytes(head + b"".join(shuffled)[:-5])
    import dpkt

    found = [one for *_, one in payloads(path, Account("a", report, False), dpkt)]
    assert found == data[:3] and sum(tally.count for tally in report.dropped.values()) <= 1
    path.write_bytes(whole[:32] + b"\xff\xff\xff\x7f" * 2 + whole[40:])
    huge = ReadReport()
    assert list(payloads(path, Account("a", huge, False), dpkt)) == [] and huge.dropped_count == 1
    path.write_bytes(b"\x0a\x0d\x0d\x0a" + bytes(60))
    assert list(payloads(path, Account("a", report, False), dpkt)) == [] and report.dropped


def test_a_capture_without_the_extra_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "dpkt", None)
    path = tmp_path / "a.pcap"
    path.write_bytes(captured([(1.0, b"x", 2368)]))
    with pytest.raises(DatasetError, match=r"pip install 'scanweave\[velodyne\]'"):
        read(path)


def test_depth_of_a_kinect_in_steps(nyu: Sample, tmp_path: Path) -> None:
    path = Path(shutil.copytree(nyu.path, tmp_path / nyu.path.name))
    first, second, *_ = sorted(path.glob("d-*.pgm"))
    cv2.imwrite(
        str(first), np.full((480, 640), 1092.5 - 351.3 / 2.0, np.float64).astype(np.uint16).byteswap()
    )
    second.write_bytes(second.read_bytes()[:999])
    # Half a patch of colour: too little to show in the sample.
    np.testing.assert_allclose(T_depth_color().inverse().matrix(), nyu_to_color(), atol=2e-6)
    found, dataset = read(path)
    assert len(found) == 5 and sum(dropped(dataset).values()) == 1
    np.testing.assert_allclose(np.median(found[0].depth_m), 351.3 / (1092.5 - 916), rtol=1e-6)


def test_foxglove_without_the_extra_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("google.protobuf")
    path = LAYOUTS["Foxglove, a lidar as protobuf"].write(tmp_path).path
    _class_of.cache_clear()
    monkeypatch.setitem(sys.modules, "google.protobuf", None)
    with pytest.raises(DatasetError, match=r"pip install 'scanweave\[foxglove\]'"):
        read(path)


def test_damaged_messages_of_foxglove_are_counted(tmp_path: Path) -> None:
    stated = [("/scan", "LaserScan", 100.0 + k, _scan(100 + k)) for k in range(4)]
    stated[1][3]["pose"]["position"]["z"] = 0.5
    stated[2][3]["ranges"] = "none"
    found, dataset = read(recorded(tmp_path / "a.mcap", stated, as_json=True))
    assert [one.stamp_s for one in found] == [100.0, 103.0] and dropped(dataset) == {UNDECODED: 2}


def test_numbers_of_fields_are_foxgloves(tmp_path: Path) -> None:
    row = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u2")])
    table = np.ones(4, row)
    table["t"] = (0, 10_000, 20_000, 40_000)
    numbers = {"x": 7, "y": 7, "z": 7, "t": 3}
    fields = [{"name": name, "offset": row.fields[name][1], "type": numbers[name]} for name in row.names]
    stated = _scan(100) | {"point_stride": row.itemsize, "fields": fields, "data": table.tobytes()}
    (found,), _ = read(
        recorded(tmp_path / "a.mcap", [("/points", "PointCloud", 100.0, stated)], as_json=True)
    )
    np.testing.assert_allclose(found.times_s, [0.0, 0.01, 0.02, 0.04])


def _scan(stamp_s: int) -> dict[str, Any]:
    zero = dict.fromkeys("xyz", 0.0)
    stated = {"timestamp": {"sec": stamp_s, "nsec": 0}, "frame_id": "laser", "ranges": [1.0, None, 3.0]}
    return stated | {
        "pose": {"position": zero, "orientation": zero | {"w": 1.0}},
        "start_angle": 0,
        "end_angle": 1,
    }


def test_bytes_that_are_no_point_cloud_are_refused() -> None:
    for content in (b"", bytes(8), bytes(20) + b"\xff" * 4, b"\0\1\0\0" + b"\xff" * 40):
        for wire in ("ros1", "cdr"):
            with pytest.raises((ValueError, IndexError, struct.error)):
                _ = point_cloud(content, wire).data[0]


def _put(path: Path, text: str) -> Path:
    path.write_text(text)
    return path
