"""What a recorded drive leaves on disk, read by other means than it was written."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from small_drive import INTRINSICS, SECONDS, fake_sensors, small_rig

from slam.datasets import open_dataset
from slam.errors import ConfigError, DatasetError
from slam.measurements import LaserScan, WheelOdometry
from slam.simulation import record
from slam.simulation.drive import FIRST_STAMP_S, Drive, prepare_drive
from slam.simulation.drive_faults import FAULT_PRESETS
from slam.simulation.events import CloudEvent, ImageEvent, OdometryEvent, ScanEvent, TruthEvent
from slam.simulation.home import generate_home
from slam.simulation.record import DriveSummary, record_drive
from slam.simulation.rigs import RIGS
from slam.simulation.sensors import SimulatedCloud
from slam.temporary import held

HOME = generate_home(0)
FAULTS = FAULT_PRESETS["usual"]


@pytest.fixture(scope="module")
def drive() -> Drive:
    """The drive that is recorded, to be driven again beside its files."""
    return prepare_drive(HOME, small_rig(), 7, FAULTS, SECONDS)


@pytest.fixture(autouse=True, scope="module")
def _cheap_sensors() -> Any:
    with pytest.MonkeyPatch.context() as patch:
        fake_sensors(patch)
        yield


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, _cheap_sensors: None) -> DriveSummary:
    return record_drive(HOME, small_rig(), 7, tmp_path_factory.mktemp("sim") / "drive", FAULTS, SECONDS)


def digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_the_same_seed_gives_the_same_bytes(recorded: DriveSummary, tmp_path: Path) -> None:
    again = record_drive(HOME, small_rig(), 7, tmp_path / "again", FAULTS, SECONDS)
    assert digests(again.folder) == digests(recorded.folder)
    other = record_drive(HOME, small_rig(), 8, tmp_path / "other", FAULTS, SECONDS)
    assert digests(other.folder)["log.mcap"] != digests(recorded.folder)["log.mcap"]


def test_each_format_alone_is_the_same_as_beside_the_other(recorded: DriveSummary, tmp_path: Path) -> None:
    both = digests(recorded.folder)
    for form in record.FORMATS:
        record_drive(HOME, small_rig(), 7, tmp_path / form, FAULTS, SECONDS, formats=(form,))
    folder, mcap = digests(tmp_path / "folder"), digests(tmp_path / "mcap")
    assert folder | mcap == both
    assert "scans.log" not in mcap
    assert "log.mcap" not in folder
    assert "groundtruth.txt" in mcap


def test_scans_log_says_what_the_lidar_said(recorded: DriveSummary, drive: Drive) -> None:
    events = [event for event in drive.events() if isinstance(event, ScanEvent | OdometryEvent)]
    readings = list(open_dataset(recorded.folder / "scans.log", strict=True))
    scans = [item for item in readings if isinstance(item, LaserScan)]
    sent = [event.scan for event in events if isinstance(event, ScanEvent)]
    assert len(scans) == len(sent) == recorded.counts["lidar"]
    for scan, back in zip(sent, scans, strict=True):
        assert back.stamp_s == pytest.approx(scan.stamp_s, abs=1e-7)
        assert back.T_base_laser.equals(scan.T_base_laser, 3e-6)
        assert np.allclose(back.bearings_rad(), scan.bearings_rad(), atol=1e-9)
        assert np.allclose(back.ranges_m, scan.ranges_m, atol=0.0011, equal_nan=True)
    # The robot's pose in a scan line is what the wheels said at the stamp in that line.
    wheels = [item for item in readings if isinstance(item, WheelOdometry)]
    assert len(wheels) == recorded.counts["odometry"] + recorded.counts["lidar"]
    for item in wheels:
        assert item.T_odom_base.equals(drive.odometry_at(item.stamp_s), 3e-6)


def test_images_are_a_tum_folder_for_each_camera(recorded: DriveSummary, drive: Drive) -> None:
    for camera in drive.rig.cameras:
        folder = recorded.folder / camera.name.lower()
        frames = [
            e.frame for e in drive.events() if isinstance(e, ImageEvent) and e.frame.sensor == camera.name
        ]
        assert len(frames) == recorded.counts[camera.name]
        for kind in ("rgb", "depth"):
            lines = [
                line.split() for line in (folder / f"{kind}.txt").read_text().splitlines() if line[0] != "#"
            ]
            assert [float(stamp) for stamp, _ in lines] == [frame.stamp_s for frame in frames]
            assert all(path == f"{kind}/{stamp}.png" for stamp, path in lines)
            assert len(list((folder / kind).iterdir())) == len(frames)
        for frame in frames[::5]:
            color = cv2.imread(str(folder / f"rgb/{frame.stamp_s:.6f}.png"))
            assert (color[..., ::-1] == frame.color).all()
            depth = cv2.imread(str(folder / f"depth/{frame.stamp_s:.6f}.png"), cv2.IMREAD_UNCHANGED)
            assert depth.dtype == np.uint16
            assert ((depth == 0) == (frame.depth_m == 0.0)).all()
            assert np.abs(depth / 5000.0 - frame.depth_m).max() < 1.01e-4
        calibration = yaml.safe_load((folder / "calibration.yaml").read_text())
        assert calibration["intrinsics"]["fx"] == INTRINSICS.fx
        assert calibration["intrinsics"]["height"] == INTRINSICS.height
        assert np.allclose(calibration["T_base_camera"]["translation_m"], camera.T_base_camera.translation())


def test_a_single_camera_lies_at_the_root_as_in_the_benchmark(tmp_path: Path) -> None:
    done = record_drive(HOME, small_rig(1), 7, tmp_path / "one", None, 1.0, formats=("folder",))
    assert (done.folder / "rgb.txt").is_file()
    assert len(list((done.folder / "depth").iterdir())) == done.counts[small_rig(1).cameras[0].name]


def bag_messages(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """All messages by topic, read with the `mcap` package and decoded by hand where it matters."""
    from mcap.reader import make_reader

    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert channel.message_encoding == "cdr"
            found.setdefault(channel.topic, []).append((message.log_time, (schema.name, message.data)))
        assert summary.statistics.message_count == sum(map(len, found.values()))
        by_topic = {
            c.topic: summary.statistics.channel_message_counts[c.id] for c in summary.channels.values()
        }
        assert by_topic == {topic: len(messages) for topic, messages in found.items()}
    return found


def test_the_bag_opens_in_another_reader_with_what_was_written(recorded: DriveSummary, drive: Drive) -> None:
    found = bag_messages(recorded.folder / "log.mcap")
    counts = recorded.counts
    expected = {
        "/tf_static": 1,
        "/tf": counts["odometry"],
        "/odom": counts["odometry"],
        "/scan": counts["lidar"],
    }
    for camera in drive.rig.cameras:
        for kind, what in itertools.product(("color", "depth"), ("image_raw", "camera_info")):
            expected[f"/camera_{camera.name[-1]}/{kind}/{what}"] = counts[camera.name]
    assert {topic: len(messages) for topic, messages in found.items()} == expected
    assert found["/scan"][0][1][0] == "sensor_msgs/msg/LaserScan"
    for messages in found.values():
        times = [time_ns for time_ns, _ in messages]
        assert times == sorted(times)


def test_fields_in_the_bag_are_those_of_the_drive(recorded: DriveSummary, drive: Drive) -> None:
    found = bag_messages(recorded.folder / "log.mcap")
    events = list(drive.events())
    scan = next(event for event in events if isinstance(event, ScanEvent))
    time_ns, (_, data) = found["/scan"][0]
    assert time_ns == pytest.approx(scan.true_stamp_s * 1e9, abs=1000)
    # CDR by hand: 4 bytes of header, sec, nanosec, length and text of the frame, floats aligned to 4.
    sec, nanosec, length = np.frombuffer(data, "<u4", 3, 4)
    assert sec + nanosec * 1e-9 == pytest.approx(scan.scan.stamp_s, abs=1e-6)
    assert data[16 : 16 + length - 1] == b"laser"
    floats = 16 + (int(length) + 3) // 4 * 4
    angles = np.frombuffer(data, "<f4", 7, floats)
    assert angles[0] == pytest.approx(scan.scan.start_angle_rad)
    assert angles[2] == pytest.approx(scan.scan.step_rad)
    assert angles[6] == pytest.approx(scan.scan.range_max_m)
    ranges = np.frombuffer(data, "<f4", scan.scan.ranges_m.size, floats + 32)
    assert np.allclose(ranges, scan.scan.ranges_m, rtol=0.0, atol=0.0006, equal_nan=True)

    image = next(event for event in events if isinstance(event, ImageEvent))
    topic = f"/camera_{image.frame.sensor[-1]}"
    _, (_, data) = found[f"{topic}/color/image_raw"][0]
    assert data.endswith(image.frame.color.tobytes())
    _, (_, data) = found[f"{topic}/depth/image_raw"][0]
    depth = np.frombuffer(data[-INTRINSICS.width * INTRINSICS.height * 2 :], "<u2")
    assert np.abs(depth / 1000.0 - image.frame.depth_m.ravel()).max() < 5.1e-4
    assert b"16UC1" in data


def test_the_folder_is_a_rosbag2(recorded: DriveSummary) -> None:
    metadata = yaml.safe_load((recorded.folder / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert metadata["relative_file_paths"] == ["log.mcap"]
    assert metadata["storage_identifier"] == "mcap"
    assert metadata["starting_time"]["nanoseconds_since_epoch"] == round(FIRST_STAMP_S * 1e9)


def test_a_compressed_bag_holds_the_same_messages(recorded: DriveSummary, tmp_path: Path) -> None:
    packed = record_drive(
        HOME, small_rig(), 7, tmp_path / "packed", FAULTS, SECONDS, formats=("mcap",), compress_bag=True
    )
    assert bag_messages(packed.folder / "log.mcap") == bag_messages(recorded.folder / "log.mcap")


def test_the_truth_lies_beside(recorded: DriveSummary, drive: Drive) -> None:
    truth = recorded.folder / "truth"
    events = list(drive.events())
    lines = np.loadtxt(recorded.folder / "groundtruth.txt")
    poses = [event for event in events if isinstance(event, TruthEvent)]
    assert np.allclose(lines[:, 0], [event.true_stamp_s for event in poses], atol=1e-8)
    assert np.allclose(lines[:, 1:3], [(e.T_map_base.x(), e.T_map_base.y()) for e in poses], atol=1e-12)
    for name in drive.schedules:
        mine = [e for e in events if isinstance(e, ScanEvent | ImageEvent) and record._name(e) == name]
        chunks = [np.load(path) for path in sorted((truth / name).iterdir())]
        faults = np.concatenate([chunk["fault"] for chunk in chunks])
        assert (faults == np.array([event.fault for event in mine])).all()
        stamps = np.concatenate([chunk["true_stamp_s"] for chunk in chunks])
        assert (stamps == [event.true_stamp_s for event in mine]).all()
        due = np.load(truth / f"readings_{name}.npz")
        assert due["kept"].sum() == len(mine) == recorded.counts[name]
        assert (~due["kept"]).sum() == recorded.lost[name]
    said = json.loads((truth / "faults.json").read_text())
    assert said["faults"]["person"] is True
    assert set(said["clock_offset_s"]) == set(drive.schedules)
    ids = {
        thing["id"]: thing["kind"]
        for thing in json.loads((truth / "obstacles.json").read_text())["obstacles"]
    }
    for band in ("robot", "lidar"):
        grid = np.load(truth / f"grid_{band}.npz")
        assert (grid["occupied"] == (grid["obstacle_id"] >= 0)).all()
        assert set(np.unique(grid["obstacle_id"][grid["occupied"]])) <= set(ids)
        assert grid["occupied"].any()
    mounts = yaml.safe_load((truth / "extrinsics.yaml").read_text())
    assert set(mounts) == set(drive.schedules)


def test_masks_are_packed_and_bear_no_time(tmp_path: Path) -> None:
    from slam.simulation.truth_writer import write_npz

    write_npz(tmp_path / "a.npz", fault=np.zeros((10, 240, 320), dtype=np.uint8), one=np.array(1.5))
    assert (tmp_path / "a.npz").stat().st_size < 10_000
    read = np.load(tmp_path / "a.npz")
    assert read["fault"].shape == (10, 240, 320)
    assert float(read["one"]) == 1.5
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert {entry.date_time[0] for entry in archive.infolist()} == {1980}


def test_masks_are_cut_into_files_that_fit_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from slam.simulation import truth_writer

    monkeypatch.setattr(truth_writer, "_CHUNK_BYTES", 5000)
    done = record_drive(HOME, small_rig(1), 7, tmp_path / "cut", None, 3.0, formats=("mcap",))
    files = sorted((done.folder / "truth" / small_rig(1).cameras[0].name).iterdir())
    assert len(files) > 3
    lengths = [len(np.load(path)["fault"]) for path in files]
    assert [int(path.stem) for path in files] == [0, *itertools.accumulate(lengths[:-1])]


def test_clouds_of_a_ring_lidar_are_kittis_files_and_a_topic(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def turn(scene: None, pose: Any, model: Any, rng: np.random.Generator, person: Any) -> SimulatedCloud:
        count = int(rng.integers(5, 9))  # returns differ in number from turn to turn
        points = rng.normal(size=(count, 3)).astype(np.float32)
        ring = rng.integers(0, 16, count).astype(np.uint8)
        far, fault = np.linalg.norm(points, axis=1).astype(np.float32), ring // 8
        return SimulatedCloud(points, ring, np.zeros(count, np.float32), far, fault)

    monkeypatch.setattr("slam.simulation.drive.scan_lidar_3d", turn)
    rig = replace(RIGS["lidar3d"], cameras=())
    done = record_drive(HOME, rig, 7, tmp_path / "out", FAULTS, 2.0)
    sent = [e for e in prepare_drive(HOME, rig, 7, FAULTS, 2.0).events() if isinstance(e, CloudEvent)]
    assert done.counts["lidar_3d"] == len(sent) > 15
    lines = [line.split() for line in (done.folder / "points.txt").read_text().splitlines()[3:]]
    for event, (stamp, path) in zip(sent, lines, strict=True):
        assert float(stamp) == event.stamp_s
        rows = np.fromfile(done.folder / path, "<f4").reshape(-1, 4)
        assert (rows[:, :3] == event.points_laser).all()
        assert (rows[:, 3] == event.ring).all()
    messages = bag_messages(done.folder / "log.mcap")["/points"]
    assert len(messages) == len(sent)
    for (_, (kind, data)), event in zip(messages, sent, strict=True):
        assert kind == "sensor_msgs/msg/PointCloud2"
        rows = np.frombuffer(data[-1 - 14 * len(event.ring) : -1], "<f4,<f4,<f4,<u2")  # is_dense comes last
        assert (rows["f1"] == event.points_laser[:, 1]).all()
        assert (rows["f3"] == event.ring).all()
    (chunk,) = (np.load(path) for path in (done.folder / "truth" / "lidar_3d").iterdir())
    assert chunk["lengths"].tolist() == [len(event.ring) for event in sent]
    assert (chunk["fault"] == np.concatenate([event.fault for event in sent])).all()


class Stop(Exception):
    """An interruption."""


def test_an_interrupted_run_leaves_nothing(tmp_path: Path) -> None:
    def stop(done_s: float, all_s: float) -> None:
        assert all_s == SECONDS
        if done_s > 2.0:
            raise Stop

    with pytest.raises(Stop):
        record_drive(HOME, small_rig(), 7, tmp_path / "out", FAULTS, SECONDS, stop)
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_run_has_left_is_removed(tmp_path: Path) -> None:
    left, living = tmp_path / ".drive.123.part", tmp_path / ".drive.124.part"
    left.mkdir()
    (left / "scans.log").write_text("half")
    with held(living, folder=True):
        for folder in (left, living):
            os.utime(folder, (1.0, 1.0))
        with record.appearing_whole(tmp_path / "drive"):
            pass
        assert sorted(one.name for one in tmp_path.iterdir()) == [living.name, "drive"]


def test_two_runs_into_one_folder_name_the_problem(tmp_path: Path) -> None:
    refused = pytest.raises(DatasetError, match="exists and is not an empty folder")
    with refused, record.appearing_whole(tmp_path / "drive"):
        (tmp_path / "drive").mkdir()
        (tmp_path / "drive" / "scans.log").write_text("of the other run")


def test_what_is_there_is_never_overwritten(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "precious").write_text("x")
    with pytest.raises(DatasetError, match="not an empty folder"):
        record_drive(HOME, small_rig(), 7, tmp_path / "mine", None, 1.0)
    (tmp_path / "empty").mkdir()
    assert record_drive(HOME, small_rig(), 7, tmp_path / "empty", None, 1.0).folder == tmp_path / "empty"
    (tmp_path / "file").write_text("x")
    with pytest.raises(DatasetError, match="file"):
        record_drive(HOME, small_rig(), 7, tmp_path / "file" / "out", None, 1.0)
    with pytest.raises(ConfigError, match="rosbag1"):
        record_drive(HOME, small_rig(), 7, tmp_path / "bag", None, 1.0, formats=("rosbag1",))
