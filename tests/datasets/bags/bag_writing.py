"""Bags by other writers than ours: those of the packages mcap and rosbags, in ROS 1 and ROS 2."""

from __future__ import annotations

import shutil
import struct
from dataclasses import dataclass, field
from itertools import takewhile
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from slam.storage.ros_messages import nanoseconds
from tools.layouts import messages as ros
from tools.layouts.messages import ROS1, ROS2, START_S, built

WRITERS = ("mcap", "mcap_plain", "mcap_lz4", "rosbags_mcap", "db3", "db3_packed", "bag", "bag_bz2", "bag_lz4")

SCAN = "sensor_msgs/msg/LaserScan"
ECHOES = "sensor_msgs/msg/MultiEchoLaserScan"
CLOUD = "sensor_msgs/msg/PointCloud2"
IMAGE = "sensor_msgs/msg/Image"
PACKED = "sensor_msgs/msg/CompressedImage"
INFO = "sensor_msgs/msg/CameraInfo"
ODOMETRY = "nav_msgs/msg/Odometry"
TF = "tf2_msgs/msg/TFMessage"


@dataclass
class Sent(ros.Sent):
    """A message that is recorded at once; without fields all is zero or empty."""

    fields: dict[str, Any] = field(default_factory=dict)
    late_s: float = 0.0


def write_bag(path: Path, writer: str, messages: list[Sent]) -> Path:
    """A bag at ``path`` plus the writer's suffix."""
    if writer.startswith("bag"):
        return _write_bag1(path.with_suffix(".bag"), writer, messages)
    if writer in ("mcap", "mcap_plain", "mcap_lz4"):
        return _write_mcap(path.with_suffix(".mcap"), writer, messages)
    return _write_bag2(path, writer, messages)


def _write_bag1(path: Path, writer: str, messages: list[Sent]) -> Path:
    bag = Writer1(path)
    if writer != "bag":
        bag.set_compression(Writer1.CompressionFormat[writer.removeprefix("bag_").upper()])
    with bag:
        ros.write(bag, ROS1, messages)
    return path


def _write_bag2(path: Path, writer: str, messages: list[Sent]) -> Path:
    plugin = StoragePlugin.MCAP if writer == "rosbags_mcap" else StoragePlugin.SQLITE3
    bag = Writer2(path, version=9, storage_plugin=plugin)
    if writer == "db3_packed":
        bag.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with bag:
        ros.write(bag, ROS2, messages)
    return path


def _write_mcap(path: Path, writer: str, messages: list[Sent]) -> Path:
    packing = {
        "mcap": CompressionType.ZSTD,
        "mcap_plain": CompressionType.NONE,
        "mcap_lz4": CompressionType.LZ4,
    }
    with path.open("wb") as file:
        bag = McapWriter(file, chunk_size=4096, compression=packing[writer])
        bag.start(profile="ros2")
        topics: dict[str, int] = {}
        for sent in messages:
            if sent.topic not in topics:
                text = ROS2.generate_msgdef(sent.kind, ros_version=2)[0]
                schema = bag.register_schema(sent.kind, "ros2msg", text.encode())
                topics[sent.topic] = bag.register_channel(sent.topic, "cdr", schema)
            content = bytes(ROS2.serialize_cdr(built(ROS2, sent), sent.kind))
            at = nanoseconds(sent.stamp_s + sent.late_s)
            bag.add_message(topics[sent.topic], at, content, at)
        bag.finish()
    return path


def one_file(bag: Path) -> Path:
    """The file of a bag, without what lies beside it."""
    if bag.is_file():
        return bag
    (found,) = [file for file in bag.iterdir() if file.suffix in (".mcap", ".db3")]
    alone = bag.with_suffix(found.suffix)
    shutil.copyfile(found, alone)
    return alone


def scan(topic: str = "/scan", stamp_s: float = START_S, frame: str = "laser", **fields: Any) -> Sent:
    values = {
        "angle_min": -0.5,
        "angle_max": 0.5,
        "angle_increment": 0.25,
        "range_min": 0.1,
        "range_max": 8.0,
        "ranges": [1.0, 2.0, 3.0, 4.0, 5.0],
    }
    return Sent(topic, SCAN, stamp_s, {**values, **fields}, frame)


def odometry(stamp_s: float, x: float = 0.0, yaw: float = 0.0, topic: str = "/odom") -> Sent:
    pose = {"position": {"x": x}, "orientation": {"z": np.sin(0.5 * yaw), "w": np.cos(0.5 * yaw)}}
    return Sent(topic, ODOMETRY, stamp_s, {"child_frame_id": "base_link", "pose": {"pose": pose}}, "odom")


def transforms(
    mounts: dict[str, gtsam.Pose3],
    parent: str = "base_link",
    topic: str = "/tf_static",
    stamp_s: float = START_S,
) -> Sent:
    poses = {child: pose.matrix() for child, pose in mounts.items()}
    return Sent(topic, TF, stamp_s, ros.tf(parent, poses, stamp_s).fields)


def image(topic: str, pixels: NDArray[Any], encoding: str, stamp_s: float = START_S, **more: Any) -> Sent:
    """A raw image whose rows are padded by three bytes."""
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(pixels.shape[0], -1)
    padded = np.pad(rows, ((0, 0), (0, 3)), constant_values=7)
    fields = {
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": encoding,
        "step": padded.shape[1],
        "data": padded,
    }
    return Sent(topic, IMAGE, stamp_s, fields, more.pop("frame", "optical"), **more)


def packed_image(topic: str, content: bytes, form: str, stamp_s: float = START_S) -> Sent:
    return Sent(topic, PACKED, stamp_s, {"format": form, "data": np.frombuffer(content, np.uint8)}, "optical")


def png(pixels: NDArray[Any]) -> bytes:
    done, content = cv2.imencode(".png", pixels)
    assert done
    return content.tobytes()


def rvl(pixels: NDArray[Any]) -> bytes:
    """Width, height, and the runs of a depth image (Wilson 2017)."""
    groups: list[int] = []

    def write(value: int) -> None:
        while value > 7:
            groups.append(8 | value & 7)
            value >>= 3
        groups.append(value)

    flat, at, before = [int(value) for value in pixels.ravel()], 0, 0
    while at < len(flat):
        empty = sum(1 for _ in takewhile(lambda value: value == 0, flat[at:]))
        readings = list(takewhile(bool, flat[at + empty :]))
        at += empty + len(readings)
        write(empty)
        write(len(readings))
        for value in readings:
            step, before = value - before, value
            write(2 * step if step >= 0 else -2 * step - 1)
    groups += [0] * (-len(groups) % 8)
    words = [int("".join(f"{group:x}" for group in groups[n : n + 8]), 16) for n in range(0, len(groups), 8)]
    return struct.pack(f"<II{len(words)}I", pixels.shape[1], pixels.shape[0], *words)


def info(
    topic: str, width: int, height: int, focal: float = 50.0, stamp_s: float = START_S, **fields: Any
) -> Sent:
    k = [focal, 0, width / 2, 0, focal, height / 2, 0, 0, 1]
    p = [focal, 0, width / 2, 0, 0, focal, height / 2, 0, 0, 0, 1, 0]
    values = {"width": width, "height": height, "k": k, "p": p, "r": np.eye(3), "d": np.zeros(5)}
    frame = fields.pop("frame", "optical")
    return Sent(topic, INFO, stamp_s, {"distortion_model": "plumb_bob", **values, **fields}, frame)


def cloud(
    columns: dict[str, NDArray[Any]], stamp_s: float = START_S, topic: str = "/points", **fields: Any
) -> Sent:
    """A cloud of the columns in their order; y is not where it would be without the gap before it."""
    codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    offsets, at = [], 0
    for name, values in columns.items():
        at += 2 if name == "y" else 0
        offsets.append(at)
        at += values.dtype.itemsize
    kinds = [values.dtype for values in columns.values()]
    layout = np.dtype(
        {
            "names": list(columns),
            "formats": kinds,
            "offsets": offsets,
            "itemsize": at + 3,
        }  # padding at the end
    )
    rows = np.zeros(len(columns["x"]), layout)
    for name, values in columns.items():
        rows[name] = values
    described = [
        {"name": name, "offset": offset, "datatype": codes[values.dtype.str[1:]], "count": 1}
        for (name, values), offset in zip(columns.items(), offsets, strict=True)
    ]
    values = {
        "height": 1,
        "width": len(rows),
        "fields": described,
        "is_bigendian": columns["x"].dtype.byteorder == ">",
        "point_step": layout.itemsize,
        "row_step": layout.itemsize * len(rows),
        "data": rows.view(np.uint8),
    }
    return Sent(topic, CLOUD, stamp_s, {**values, **fields}, "lidar")
