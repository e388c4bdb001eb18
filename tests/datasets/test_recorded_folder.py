"""A CARMEN log beside cameras: the simulator's folders, and any like them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from carmen_lines import GOOD, flaser, odom, write
from rgbd_files import dropped, frames, read, write_tum

from slam.datasets import open_dataset
from slam.datasets.image_files import MISSING
from slam.errors import BadRecordError, DatasetError
from slam.measurements import LaserScan, WheelOdometry
from slam.simulation.drive_faults import FAULT_PRESETS
from slam.simulation.home import generate_home
from slam.simulation.record import record_drive
from slam.simulation.rigs import RIGS


def order(found: list) -> list[tuple[str, float]]:
    return [(m.sensor, round(m.stamp_s, 3)) for m in found]


def test_a_frame_follows_the_first_reading_that_reaches_its_stamp(tmp_path: Path) -> None:
    stamps = (99.0, 100.05, 100.01, 100.1, 100.2, 100.15)
    write(tmp_path, *(odom(stamp=stamp) for stamp in stamps))
    write_tum(tmp_path, 4)
    assert order(read(tmp_path)[0]) == [
        ("odometry", 99.0),
        ("odometry", 100.05),
        ("camera", 100.0),
        ("odometry", 100.01),
        ("odometry", 100.1),
        ("camera", 100.1),
        ("odometry", 100.2),
        ("camera", 100.2),
        ("odometry", 100.15),
        ("camera", 100.3),
    ]


def test_several_cameras_are_merged_by_time_and_named_after_their_folders(tmp_path: Path) -> None:
    write(tmp_path, odom(stamp=99.0), flaser(stamp="200.0"))
    write_tum(tmp_path / "rgbd_1", 2)
    write_tum(tmp_path / "rgbd_left", 2, start_s=100.05)
    found, dataset = read(tmp_path)
    assert order(found)[2:-1] == [("RGBD_1", 100.0), ("left", 100.05), ("RGBD_1", 100.1), ("left", 100.15)]
    assert dataset.report.records["RGBD_1 frame"] == 2


def test_the_log_alone_stays_a_lidar_log(tmp_path: Path) -> None:
    path = write(tmp_path, *GOOD)
    write_tum(tmp_path)
    assert not frames(list(open_dataset(path)))
    assert open_dataset(path).groundtruth() is None


def test_images_that_nobody_wants_are_not_opened(tmp_path: Path) -> None:
    write(tmp_path, *GOOD)
    write_tum(tmp_path)
    for image in tmp_path.glob("*/*.png"):
        image.write_bytes(b"no image")
    dataset = open_dataset(tmp_path, images=False)
    found = list(dataset)
    assert found and not frames(found) and not dataset.report.dropped


def test_damage_of_either_part_is_in_one_report(tmp_path: Path) -> None:
    write(tmp_path, *GOOD, "FLASER 3 1")
    (write_tum(tmp_path) / "rgb/0.png").unlink()
    found, dataset = read(tmp_path)
    assert dropped(dataset) == {"wrong number of values": 1, MISSING: 1}
    assert dataset.report.measurement_count == len(found)
    assert dataset.report.line_count == len(GOOD) + 1 + 4
    with pytest.raises(BadRecordError):
        read(tmp_path, strict=True)


def test_a_folder_with_only_a_log_is_that_log_with_its_truth(tmp_path: Path) -> None:
    write(tmp_path, *GOOD)
    (tmp_path / "groundtruth.txt").write_text("1 0 0 0 0 0 0 1\n")
    dataset = open_dataset(tmp_path)
    assert {type(m) for m in dataset} == {LaserScan, WheelOdometry}
    assert dataset.groundtruth() is not None


def test_two_logs_are_not_chosen_between(tmp_path: Path) -> None:
    write(tmp_path, *GOOD)
    write(tmp_path, *GOOD, name="b.log")
    with pytest.raises(DatasetError, match=r"2 CARMEN logs \(a\.log, b\.log\); give one") as caught:
        open_dataset(tmp_path)
    assert "\n" not in str(caught.value)


# One with four cameras, in a folder each, one with a single one beside the log.
@pytest.mark.parametrize("rig", ["xu2024", "turtlebot_low"])
def test_the_simulators_folder_is_read_back(tmp_path: Path, rig: str) -> None:
    home = generate_home(3, rooms=2)
    summary = record_drive(
        home, RIGS[rig], 1, tmp_path / "log", FAULT_PRESETS["usual"], 1.0, formats=("folder",)
    )
    found, dataset = read(summary.folder, strict=True)
    counts = {name: sum(m.sensor == name for m in found) for name in {m.sensor for m in found}}
    assert sum(isinstance(m, LaserScan) for m in found) == counts.pop("ROBOTLASER1") > 5
    # Each scan line repeats the wheels' pose, at its own stamp.
    assert counts.pop("odometry") >= summary.counts["odometry"]
    cameras = {camera.name: camera for camera in RIGS[rig].cameras}
    assert counts == {name: summary.counts[name] for name in cameras}
    newest = dict.fromkeys(cameras, -np.inf)
    for frame in frames(found):
        camera = cameras[frame.sensor]
        assert frame.stamp_s > newest[frame.sensor]
        newest[frame.sensor] = frame.stamp_s
        assert frame.intrinsics == camera.model.intrinsics
        assert frame.T_base_camera is not None
        assert frame.T_base_camera.equals(camera.T_base_camera, 1e-9)
        assert 0.1 < (frame.depth_m > 0).mean() <= 1.0
        assert frame.depth_m.max() < 20.0
    truth = dataset.groundtruth()
    assert truth is not None
    assert truth.stamps_s[-1] - truth.stamps_s[0] == pytest.approx(1.0, abs=0.1)
