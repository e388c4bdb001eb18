"""Bags of every container and writer give the same measurements, field by field."""

from __future__ import annotations

import math
import shutil
import struct
from pathlib import Path

import gtsam
import numpy as np
import pytest
from bag_writing import (
    START_S,
    WRITERS,
    Sent,
    cloud,
    image,
    info,
    odometry,
    one_file,
    scan,
    transforms,
    write_bag,
)
from mcap.writer import Writer as McapWriter

from slam.datasets import open_dataset
from slam.datasets.dataset import Dataset
from slam.errors import DatasetError
from slam.measurements import LaserScan, Measurement, PointCloud, RgbdFrame, WheelOdometry

LASER = gtsam.Pose3(gtsam.Rot3.Yaw(0.3), np.array([0.1, -0.2, 0.4]))
OPTICAL = gtsam.Pose3(gtsam.Rot3.Ypr(-1.5, 0.0, -1.6), np.array([0.2, 0.0, 0.9]))
LIDAR = gtsam.Pose3(gtsam.Rot3.Pitch(0.1), np.array([0.0, 0.0, 0.7]))
RNG = np.random.default_rng(5)
COLOR = RNG.integers(0, 256, (4, 6, 3), dtype=np.uint8)
DEPTH = RNG.integers(400, 4000, (4, 6), dtype=np.uint16)
POINTS = {name: RNG.normal(size=7).astype("<f4") for name in "xyz"}


def robot() -> list[Sent]:
    """One of everything."""
    return [
        transforms({"laser": LASER, "optical": OPTICAL, "lidar": LIDAR}),
        info("/camera/depth/camera_info", 6, 4),
        info("/camera/color/camera_info", 6, 4),
        odometry(START_S, 1.0, 0.2),
        scan(stamp_s=START_S + 0.01),
        cloud(POINTS | {"t": np.arange(7, dtype="<u4") * 10_000_000}, START_S + 0.015),
        image("/camera/color/image_raw", COLOR, "rgb8", START_S + 0.02),
        image("/camera/depth/image_raw", DEPTH, "16UC1", START_S + 0.02),
        odometry(START_S + 0.1, 1.1, 0.2),
    ]


def read(path: Path) -> tuple[list[Measurement], Dataset]:
    dataset = open_dataset(path)
    return list(dataset), dataset


def is_robot(found: list[Measurement]) -> None:
    kinds = [WheelOdometry, WheelOdometry, LaserScan, WheelOdometry, PointCloud, WheelOdometry, RgbdFrame]
    assert [type(m) for m in found] == kinds
    _, at_scan, laser, _, points, last, frame = found
    assert isinstance(at_scan, WheelOdometry) and isinstance(last, WheelOdometry)
    assert isinstance(laser, LaserScan) and isinstance(points, PointCloud) and isinstance(frame, RgbdFrame)
    assert last.stamp_s == pytest.approx(START_S + 0.1, abs=1e-6)
    assert last.T_odom_base.equals(gtsam.Pose2(1.1, 0.0, 0.2), 1e-9)
    assert at_scan.stamp_s == laser.stamp_s == pytest.approx(START_S + 0.01, abs=1e-6)
    assert at_scan.T_odom_base.equals(gtsam.Pose2(1.01, 0.0, 0.2), 1e-6)
    assert laser.ranges_m.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert (laser.start_angle_rad, laser.step_rad, laser.range_max_m) == (-0.5, 0.25, 8.0)
    assert laser.T_base_laser.equals(gtsam.Pose2(0.1, -0.2, 0.3), 1e-9)
    assert (points.points_lidar == np.stack([POINTS[name] for name in "xyz"], axis=1)).all()
    assert points.times_s == pytest.approx(np.arange(7) * 0.01)
    assert points.T_base_lidar.equals(LIDAR, 1e-9)
    assert frame.stamp_s == pytest.approx(START_S + 0.02, abs=1e-6)
    assert (frame.color == COLOR).all()
    assert frame.depth_m == pytest.approx(DEPTH / 1000.0)
    assert (frame.intrinsics.fx, frame.intrinsics.cy) == (50.0, 2.0)
    assert frame.T_base_camera is not None and frame.T_base_camera.equals(OPTICAL, 1e-9)


@pytest.mark.parametrize("writer", WRITERS)
def test_every_container_gives_every_field(tmp_path: Path, writer: str) -> None:
    found, dataset = read(write_bag(tmp_path / "log", writer, robot()))
    is_robot(found)
    assert not dataset.report.dropped
    assert sum(dataset.report.records.values()) == 5


@pytest.mark.parametrize("writer", ["rosbags_mcap", "db3", "db3_packed"])
def test_the_file_alone_is_enough(tmp_path: Path, writer: str) -> None:
    is_robot(read(one_file(write_bag(tmp_path / "log", writer, robot())))[0])


def test_a_second_pass_gives_the_same(tmp_path: Path) -> None:
    dataset = open_dataset(write_bag(tmp_path / "log", "mcap", robot()))
    is_robot(list(dataset))
    is_robot(list(dataset))


def test_parts_of_a_recording_are_read_in_their_order(tmp_path: Path) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    for number in (0, 1, 2, 10):
        times = [START_S + number + 0.1 * k for k in range(3)]
        part = write_bag(tmp_path / f"part{number}", "db3", [odometry(time_s) for time_s in times])
        shutil.copyfile(one_file(part), folder / f"drive_{number}.db3")
    stamps = [m.stamp_s for m in open_dataset(folder)]
    assert len(stamps) == 12 and stamps == sorted(stamps)
    names = "\n".join(f"  - drive_{number}.db3" for number in (10, 0))
    (folder / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}\n")
    assert [round(m.stamp_s - START_S) for m in open_dataset(folder)] == [10, 10, 10, 0, 0, 0]


def test_several_bags_in_a_folder_and_missing_parts_are_reported(tmp_path: Path) -> None:
    for name in ("kitchen", "hall"):
        write_bag(tmp_path / name, "mcap", [scan()])
    with pytest.raises(DatasetError, match=r"2 bags \(hall.mcap, kitchen.mcap\); give one"):
        open_dataset(tmp_path).__iter__().__next__()
    (tmp_path / "metadata.yaml").write_text(
        "rosbag2_bagfile_information:\n  relative_file_paths: [hall.mcap, gone.mcap]\n"
    )
    with pytest.raises(DatasetError, match=r"gone\.mcap, which"):
        list(open_dataset(tmp_path))


def test_stamps_are_those_of_the_headers(tmp_path: Path) -> None:
    late = [odometry(START_S + 0.1 * k) for k in range(5)]
    for k, sent in enumerate(late):
        sent.late_s = 0.3 + 0.01 * k
    stamps = [m.stamp_s for m in open_dataset(write_bag(tmp_path / "log", "mcap", late))]
    assert stamps == pytest.approx([START_S + 0.1 * k for k in range(5)], abs=1e-6)


def test_a_message_serialised_by_hand_is_read(tmp_path: Path) -> None:
    """CDR and the definition as ROS 2 writes them, by none of the libraries under test."""
    text = "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\nfloat32 angle_increment\n"
    text += "float32 time_increment\nfloat32 scan_time\nfloat32 range_min\nfloat32 range_max\n"
    text += "float32[] ranges\nfloat32[] intensities\n"
    text += f"{'=' * 80}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    text += f"{'=' * 80}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    content = b"\0\1\0\0" + struct.pack("<iII6s2x", 1700000000, 250_000_000, 6, b"laser\0")
    content += struct.pack("<7f", -1.0, 1.0, 1.0, 0.0, 0.1, 0.05, 10.0)
    content += struct.pack("<I3fI", 3, 2.5, math.inf, math.nan, 0)
    path = tmp_path / "hand.mcap"
    with path.open("wb") as file:
        bag = McapWriter(file)
        bag.start()
        schema = bag.register_schema("sensor_msgs/msg/LaserScan", "ros2msg", text.encode())
        bag.add_message(bag.register_channel("/hand", "cdr", schema), 5, content, 5)
        bag.finish()
    (found,) = open_dataset(path)
    assert isinstance(found, LaserScan)
    assert (found.stamp_s, found.sensor, found.range_max_m) == (1700000000.25, "/hand", 10.0)
    assert found.ranges_m[0] == 2.5 and np.isinf(found.ranges_m[1]) and np.isnan(found.ranges_m[2])
