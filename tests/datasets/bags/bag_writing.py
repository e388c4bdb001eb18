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
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
ROS1.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
for _store in (ROS1, ROS2):
    for _name, _text in {
        "livox_ros_driver2/msg/CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\n"
        "uint8 reflectivity\nuint8 tag\nuint8 line",
        "livox_ros_driver2/msg/CustomMsg": "std_msgs/Header header\nuint64 timebase\nuint32 point_num\n"
        "uint8 lidar_id\nuint8[3] rsvd\nlivox_ros_driver2/CustomPoint[] points",
        "realsense2_camera_msgs/msg/Extrinsics": "float64[9] rotation\nfloat64[3] translation",
        "ouster_sensor_msgs/msg/PacketMsg": "uint8[] buf",
        "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data",
        "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets",
    }.items():
        _store.register(get_types_from_msg(_text, _name))
START_S = 1_700_000_000.0
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
class Sent:
    """A message with its fields as nested dictionaries; fields that are left out are zero or empty."""

    topic: str
    kind: str
    stamp_s: float
    fields: dict[str, Any] = field(default_factory=dict)
    frame: str = ""
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
        topics: dict[str, Any] = {}
        for sent in messages:
            if sent.topic not in topics:
                topics[sent.topic] = bag.add_connection(sent.topic, sent.kind, typestore=ROS1)
            content = ROS1.serialize_ros1(built(ROS1, sent), sent.kind)
            bag.write(topics[sent.topic], _ns(sent.stamp_s + sent.late_s), content)
    return path


def _write_bag2(path: Path, writer: str, messages: list[Sent]) -> Path:
    plugin = StoragePlugin.MCAP if writer == "rosbags_mcap" else StoragePlugin.SQLITE3
    bag = Writer2(path, version=9, storage_plugin=plugin)
    if writer == "db3_packed":
        bag.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with bag:
        topics: dict[str, Any] = {}
        for sent in messages:
            if sent.topic not in topics:
                topics[sent.topic] = bag.add_connection(sent.topic, sent.kind, typestore=ROS2)
            content = ROS2.serialize_cdr(built(ROS2, sent), sent.kind)
            bag.write(topics[sent.topic], _ns(sent.stamp_s + sent.late_s), content)
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
            at = _ns(sent.stamp_s + sent.late_s)
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


def built(store: Any, sent: Sent) -> Any:
    """The message of a store's types."""
    fields = dict(sent.fields)
    if "header" in dict(store.fielddefs[sent.kind][1]):
        fields["header"] = header(sent.stamp_s, sent.frame)
    return _made(store, sent.kind, fields)


def header(stamp_s: float, frame: str) -> dict[str, Any]:
    seconds, rest = divmod(_ns(stamp_s), 1_000_000_000)
    return {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": frame}


def _made(store: Any, kind: str, fields: dict[str, Any]) -> Any:
    """An object of a message type from nested dictionaries."""
    own = {name.lower(): value for name, value in fields.items()}
    _, described = store.fielddefs[kind]
    unknown = set(own) - {name.lower() for name, _ in described}
    assert not unknown, f"{kind} has no {unknown}"
    values = {name: _value(store, form, own.get(name.lower())) for name, form in described}
    return store.types[kind](**values)


def _value(store: Any, form: Any, given: Any) -> Any:
    """The value of a field, zero or empty where none is given."""
    node, detail = form
    if node.name == "BASE":
        name = detail[0]
        return given if given is not None else "" if name == "string" else False if name == "bool" else 0
    if node.name == "NAME":
        return _made(store, detail, given or {})
    (inner, inner_detail), count = detail
    if inner.name == "NAME":
        return [_made(store, inner_detail, item) for item in given or []]
    if inner_detail[0] == "string":
        return list(given or [])
    kind = {"byte": "uint8", "char": "uint8", "octet": "uint8"}.get(inner_detail[0], inner_detail[0])
    return np.zeros(count, kind) if given is None else np.asarray(given, dtype=kind).ravel()


def _ns(stamp_s: float) -> int:
    return round(stamp_s * 1e6) * 1000


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
    items = []
    for child, pose in mounts.items():
        x, y, z = pose.translation()
        q = pose.rotation().toQuaternion()
        rotation = {"x": q.x(), "y": q.y(), "z": q.z(), "w": q.w()}
        transform = {"translation": {"x": x, "y": y, "z": z}, "rotation": rotation}
        items.append({"header": header(stamp_s, parent), "child_frame_id": child, "transform": transform})
    return Sent(topic, TF, stamp_s, {"transforms": items})


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
