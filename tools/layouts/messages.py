"""Bags written by the rosbags package from plain dictionaries; missing fields are zero or empty."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import gtsam
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from slam.measurements import CameraIntrinsics
from slam.storage.ros_messages import nanoseconds

ROS1, ROS2 = get_typestore(Stores.ROS1_NOETIC), get_typestore(Stores.ROS2_HUMBLE)
_OWN = {
    "livox_ros_driver{n}/msg/CustomPoint": "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\n"
    "uint8 reflectivity\nuint8 tag\nuint8 line",
    "livox_ros_driver{n}/msg/CustomMsg": "std_msgs/Header header\nuint64 timebase\nuint32 point_num\n"
    "uint8 lidar_id\nuint8[3] rsvd\nlivox_ros_driver{n}/CustomPoint[] points",
    "realsense2_camera{m}/msg/Extrinsics": "{h}float64[9] rotation\nfloat64[3] translation",
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets",
    "theora_image_transport/msg/Packet": "std_msgs/Header header\nuint8[] data",
    "ouster_sensor_msgs/msg/PacketMsg": "uint8[] buf",
    "tf/msg/tfMessage": "geometry_msgs/TransformStamped[] transforms",
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "irobot_create_msgs/msg/WheelTicks": "std_msgs/Header header\nint32 ticks_left\nint32 ticks_right",
}
for _store in (ROS1, ROS2):
    for _name, _text in _OWN.items():
        for _n, _m, _h in (("", "", "std_msgs/Header header\n"), ("2", "_msgs", "")):
            _filled = _name.replace("{n}", _n).replace("{m}", _m), _text.replace("{n}", _n).replace("{h}", _h)
            if _filled[0] not in _store.fielddefs:
                _store.register(get_types_from_msg(_filled[1], _filled[0]))

S, N, G = "sensor_msgs/msg/", "nav_msgs/msg/", "geometry_msgs/msg/"
START_S = 1_700_000_000.0


@dataclass
class Sent:
    """A message: its topic, type, stamp, fields and frame; recorded some seconds later."""

    topic: str
    kind: str
    stamp_s: float
    fields: dict[str, Any]
    frame: str = ""
    late_s: float = 0.002


def ros1(path: Path, messages: Iterable[Sent], *, packed: str = "") -> Path:
    """A ROS 1 bag."""
    path.parent.mkdir(parents=True, exist_ok=True)
    bag = Writer1(path)
    if packed:
        bag.set_compression(Writer1.CompressionFormat[packed])
    with bag:
        write(bag, ROS1, _by_time(messages))
    return path


def ros2(path: Path, messages: Iterable[Sent], *, mcap: bool = False, packed: str = "") -> Path:
    """A rosbag2 folder; packed by ``FILE`` or ``MESSAGE``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    bag = Writer2(path, version=9, storage_plugin=StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3)
    if packed:
        bag.set_compression(CompressionMode[packed], CompressionFormat.ZSTD)
    with bag:
        write(bag, ROS2, _by_time(messages))
    return path


def _by_time(messages: Iterable[Sent]) -> list[Sent]:
    return sorted(messages, key=lambda one: one.stamp_s + one.late_s)


def write(bag: Any, store: Any, messages: Iterable[Sent]) -> None:
    """Messages into an open bag, in the order given."""
    serialised = store.serialize_ros1 if store is ROS1 else store.serialize_cdr
    topics: dict[str, Any] = {}
    for sent in messages:
        if sent.topic not in topics:
            topics[sent.topic] = bag.add_connection(sent.topic, sent.kind, typestore=store)
        content = serialised(built(store, sent), sent.kind)
        bag.write(topics[sent.topic], nanoseconds(sent.stamp_s + sent.late_s), content)


def built(store: Any, sent: Sent) -> Any:
    """The message of a store's types."""
    fields = dict(sent.fields)
    if "header" in dict(store.fielddefs[sent.kind][1]):
        fields.setdefault("header", header(sent.stamp_s, sent.frame))
    return made(store, sent.kind, fields)


def header(stamp_s: float, frame: str) -> dict[str, Any]:
    """A stamp to the microsecond, and a frame."""
    seconds, rest = divmod(nanoseconds(stamp_s), 10**9)
    return {"stamp": {"sec": seconds, "nanosec": rest}, "frame_id": frame}


def made(store: Any, kind: str, fields: dict[str, Any]) -> Any:
    """A message of nested dictionaries."""
    own = {name.lower(): value for name, value in fields.items()}
    described = store.fielddefs[kind][1]
    unknown = set(own) - {name.lower() for name, _ in described}
    assert not unknown, f"{kind} has no {unknown}"
    return store.types[kind](**{name: _value(store, form, own.get(name.lower())) for name, form in described})


def _value(store: Any, form: Any, given: Any) -> Any:
    node, detail = form
    if node.name == "BASE":
        name = detail[0]
        return given if given is not None else "" if name == "string" else False if name == "bool" else 0
    if node.name == "NAME":
        return made(store, detail, given or {})
    (inner, inner_detail), count = detail
    if inner.name == "NAME":
        return [made(store, inner_detail, item) for item in given or []]
    if inner_detail[0] == "string":
        return list(given or [])
    kind = {"byte": "uint8", "char": "uint8", "octet": "uint8"}.get(inner_detail[0], inner_detail[0])
    return np.zeros(count, kind) if given is None else np.asarray(given, dtype=kind).ravel()


def _pose(pose: Any) -> dict[str, Any]:
    q: Any = gtsam.Rot3(pose[:3, :3]).toQuaternion()
    x, y, z = pose[:3, 3].tolist()
    place = {"x": x, "y": y, "z": z}
    return {"place": place, "turn": {"x": q.x(), "y": q.y(), "z": q.z(), "w": q.w()}}


def posed(pose: Any) -> dict[str, Any]:
    """geometry_msgs/Pose."""
    parts = _pose(pose)
    return {"position": parts["place"], "orientation": parts["turn"]}


def tf(
    parent: str,
    children: dict[str, Any],
    stamp_s: float = START_S,
    *,
    static: bool = True,
    topic: str = "",
    old: bool = False,
) -> Sent:
    """Frames in a parent's."""
    items = []
    for child, pose in children.items():
        parts = _pose(pose)
        transform = {"translation": parts["place"], "rotation": parts["turn"]}
        items.append({"header": header(stamp_s, parent), "child_frame_id": child, "transform": transform})
    name = topic or ("/tf_static" if static else "/tf")
    return Sent(name, "tf/msg/tfMessage" if old else "tf2_msgs/msg/TFMessage", stamp_s, {"transforms": items})


def odometry(topic: str, stamp_s: float, pose: Any, frame: str = "odom", child: str = "base_link") -> Sent:
    """Where a frame is, by an odometry."""
    return Sent(
        topic, N + "Odometry", stamp_s, {"child_frame_id": child, "pose": {"pose": posed(pose)}}, frame
    )


def path(topic: str, stamp_s: float, stamps_s: list[float], poses: list[Any], frame: str = "map") -> Sent:
    """A way as one message."""
    items = [
        {"header": header(at, frame), "pose": posed(pose)} for at, pose in zip(stamps_s, poses, strict=True)
    ]
    return Sent(topic, N + "Path", stamp_s, {"poses": items}, frame)


def imu(topic: str, stamp_s: float, frame: str = "imu", *, gyro: bool = True, force: bool = True) -> Sent:
    """One that stands still, upright."""
    fields: dict[str, Any] = {"orientation": {"w": 1.0}}
    if force:
        fields["linear_acceleration"] = {"z": 9.81}
    else:
        fields["linear_acceleration_covariance"] = [-1.0, 0, 0, 0, 0, 0, 0, 0, 0]
    if not gyro:
        fields["angular_velocity_covariance"] = [-1.0, 0, 0, 0, 0, 0, 0, 0, 0]
    return Sent(topic, S + "Imu", stamp_s, fields, frame)


def scan(
    topic: str, stamp_s: float, ranges: Any, first_rad: float, step_rad: float, frame: str, **more: Any
) -> Sent:
    """A LaserScan."""
    count = len(ranges)
    fields = {
        "angle_min": first_rad,
        "angle_max": first_rad + (count - 1) * step_rad,
        "angle_increment": step_rad,
        "range_min": 0.1,
        "range_max": 25.0,
        "scan_time": 0.1,
        "ranges": ranges,
    }
    return Sent(topic, S + "LaserScan", stamp_s, fields | more, frame)


_NUMBERS = {"<i1": 1, "|i1": 1, "|u1": 2, "<i2": 3, "<u2": 4, "<i4": 5, "<u4": 6, "<f4": 7, "<f8": 8}


def cloud(
    topic: str,
    stamp_s: float,
    points: Any,
    frame: str,
    fields: dict[str, Any] | None = None,
    *,
    gap: int = 0,
    rows: int = 1,
) -> Sent:
    """PointCloud2 of x, y, z and further fields; ``gap`` bytes after z, as PCL pads."""
    columns = {axis: points[:, k].astype("<f4") for k, axis in enumerate("xyz")} | (fields or {})
    point_fields, offset, kinds, offsets = [], 0, [], []
    for name, values in columns.items():
        kind = values.dtype
        point_fields.append({"name": name, "offset": offset, "datatype": _NUMBERS[kind.str], "count": 1})
        kinds.append(kind)
        offsets.append(offset)
        offset += kind.itemsize + (gap if name == "z" else 0)
    table = np.zeros(
        len(points),
        np.dtype({"names": list(columns), "formats": kinds, "offsets": offsets, "itemsize": offset}),
    )
    for name, values in columns.items():
        table[name] = values
    content = {
        "height": rows,
        "width": len(points) // rows,
        "fields": point_fields,
        "point_step": offset,
        "row_step": offset * len(points) // rows,
        "data": np.frombuffer(table.tobytes(), np.uint8),
        "is_dense": True,
    }
    return Sent(topic, S + "PointCloud2", stamp_s, content, frame)


def image(
    topic: str, stamp_s: float, pixels: Any, encoding: str, frame: str, width: int = 0, height: int = 0
) -> Sent:
    """A raw image; width and height where the pixels are stored in another shape."""
    rows = np.ascontiguousarray(pixels)
    height, width = height or rows.shape[0], width or rows.shape[1]
    flat = rows.view(np.uint8).ravel()
    step = flat.size // height if encoding not in ("nv12", "nv21") else width
    fields = {"height": height, "width": width, "encoding": encoding, "step": step, "data": flat}
    return Sent(topic, S + "Image", stamp_s, fields, frame)


def squeezed(topic: str, stamp_s: float, content: bytes, form: str, frame: str) -> Sent:
    """A CompressedImage."""
    return Sent(
        topic,
        S + "CompressedImage",
        stamp_s,
        {"format": form, "data": np.frombuffer(content, np.uint8)},
        frame,
    )


def coded(pixels: Any, suffix: str, *more: int) -> bytes:
    """An image as a file; colour is RGB."""
    turned = pixels[..., ::-1] if pixels.ndim == 3 else pixels
    return bytes(cv2.imencode(suffix, turned, list(more))[1])


def info(
    topic: str,
    stamp_s: float,
    lens: CameraIntrinsics,
    frame: str,
    distortion: Any = (0.0,) * 5,
    model: str = "plumb_bob",
    projection: Any = None,
) -> Sent:
    """CameraInfo."""
    k = [lens.fx, 0.0, lens.cx, 0.0, lens.fy, lens.cy, 0.0, 0.0, 1.0]
    p = (
        [lens.fx, 0.0, lens.cx, 0.0, 0.0, lens.fy, lens.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
        if projection is None
        else projection
    )
    fields = {
        "height": lens.height,
        "width": lens.width,
        "distortion_model": model,
        "d": list(distortion),
        "k": k,
        "r": np.eye(3),
        "p": p,
    }
    return Sent(topic, S + "CameraInfo", stamp_s, fields, frame)
