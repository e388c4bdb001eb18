"""Converts Foxglove's own messages in MCAP (protobuf or JSON) to equivalent ROS messages.

Their fields are those of docs.foxglove.dev/docs/visualization/message-schemas. Google's library (the extra
'foxglove') decodes protobuf with the definition in the file.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np

from slam.datasets.budget import LARGEST_BYTES
from slam.datasets.dataset import RecordFault
from slam.foreign import from_json

NO_PROTOBUF = "messages in protobuf; to read them: pip install 'scanweave[foxglove]'"
UNDECODED = "message of Foxglove that does not decode as its type"
WIRES = frozenset({"protobuf", "json"})
_NUMBERS = (0, 2, 1, 4, 3, 6, 5, 7, 8)  # PackedElementField types as sensor_msgs/PointField types
_SAME = 1e-9  # metres, and quaternion components
_LONGEST_JSON = LARGEST_BYTES // 8  # in memory, its values take many times the text


def _stamp(stamp: Any) -> SimpleNamespace:
    """A time from protobuf or JSON."""
    seconds, fraction = ("seconds", "nanos") if hasattr(stamp, "seconds") else ("sec", "nsec")
    return SimpleNamespace(sec=int(getattr(stamp, seconds)), nanosec=int(getattr(stamp, fraction)))


def _header(message: Any, frame: str = "frame_id") -> SimpleNamespace:
    """A header with stamp and frame."""
    return SimpleNamespace(stamp=_stamp(message.timestamp), frame_id=str(getattr(message, frame, "")))


def _bytes(data: Any) -> Any:
    """Bytes, decoded if they come from JSON."""
    return np.frombuffer(base64.b64decode(data) if isinstance(data, str) else bytes(data), np.uint8)


def _check_frame(message: Any) -> None:
    """Reject a reading whose origin is not that of its frame; missing values are zero."""
    pose = getattr(message, "pose", None)
    parts = (getattr(pose, name, None) for name in ("position", "orientation"))
    if any(abs(getattr(part, axis, 0.0)) > _SAME for part in parts for axis in "xyz"):
        raise ValueError("a pose of its own beside its frame")


def _cloud(message: Any) -> SimpleNamespace:
    """Convert to a PointCloud2."""
    step, data = int(message.point_stride), _bytes(message.data)
    _check_frame(message)
    count = data.size // step
    fields = [
        SimpleNamespace(
            name=item.name, offset=int(getattr(item, "offset", 0)), datatype=_NUMBERS[int(item.type)], count=1
        )
        for item in message.fields
    ]
    content = {"height": 1, "width": count, "fields": fields, "is_bigendian": False, "data": data}
    return SimpleNamespace(header=_header(message), point_step=step, row_step=count * step, **content)


def _scan(message: Any) -> SimpleNamespace:
    """Convert to a LaserScan; the end angle is that of the last beam."""
    ranges = np.array([np.nan if r_m is None else r_m for r_m in message.ranges], dtype=np.float32)
    _check_frame(message)
    first, last = float(message.start_angle), float(message.end_angle)
    return SimpleNamespace(
        header=_header(message),
        angle_min=first,
        angle_max=last,
        angle_increment=(last - first) / max(len(ranges) - 1, 1),
        time_increment=0.0,
        scan_time=0.0,
        range_min=0.0,
        range_max=math.inf,
        ranges=ranges,
        intensities=np.zeros(0, np.float32),
    )


def _image(message: Any) -> SimpleNamespace:
    """Convert to an Image."""
    size = {name: int(getattr(message, name)) for name in ("width", "height", "step")}
    content = {"encoding": str(message.encoding), "is_bigendian": 0, "data": _bytes(message.data)}
    return SimpleNamespace(header=_header(message), **size, **content)


def _lens(message: Any) -> SimpleNamespace:
    """Convert to a CameraInfo."""
    numbers = {name.lower(): np.array(list(getattr(message, name, ())), np.float64) for name in "DKRP"}
    model = str(getattr(message, "distortion_model", ""))
    size = {name: int(getattr(message, name)) for name in ("width", "height")}
    return SimpleNamespace(header=_header(message), distortion_model=model, **size, **numbers)


def _transforms(message: Any) -> SimpleNamespace:
    """Convert one or many transforms to a TFMessage."""
    return SimpleNamespace(
        transforms=[
            SimpleNamespace(
                header=_header(item, "parent_frame_id"),
                child_frame_id=str(item.child_frame_id),
                transform=SimpleNamespace(translation=item.translation, rotation=item.rotation),
            )
            for item in getattr(message, "transforms", None) or [message]
        ]
    )


_AS: dict[str, tuple[str, Callable[[Any], SimpleNamespace]]] = {
    "PointCloud": ("sensor_msgs/msg/PointCloud2", _cloud),
    "LaserScan": ("sensor_msgs/msg/LaserScan", _scan),
    "RawImage": ("sensor_msgs/msg/Image", _image),
    "CompressedImage": (
        "sensor_msgs/msg/CompressedImage",
        lambda one: SimpleNamespace(header=_header(one), format=str(one.format), data=_bytes(one.data)),
    ),
    "CameraCalibration": ("sensor_msgs/msg/CameraInfo", _lens),
    "FrameTransform": ("tf2_msgs/msg/TFMessage", _transforms),
    "FrameTransforms": ("tf2_msgs/msg/TFMessage", _transforms),
    "PoseInFrame": (
        "geometry_msgs/msg/PoseStamped",
        lambda one: SimpleNamespace(header=_header(one), pose=one.pose),
    ),
}


def as_ros(kind: str, wire: str) -> str:
    """The ROS type that a message is converted to; its own type if there is none."""
    known = (
        _AS.get(kind.removeprefix("foxglove.")) if wire in WIRES and kind.startswith("foxglove.") else None
    )
    return known[0] if known else kind


def message_of(content: bytes, own_kind: str, wire: str, definition: str) -> SimpleNamespace:
    """Return a message as that of ROS; RecordFault if it is damaged or the extra is not installed."""
    try:
        if wire == "json":
            if len(content) > _LONGEST_JSON:
                raise ValueError(f"{len(content)} characters of JSON")
            message = _named(from_json(content))
        else:
            message = _class_of(definition, own_kind)()
            message.ParseFromString(content)
        return _AS[own_kind.removeprefix("foxglove.")][1](message)
    except RecordFault:
        raise
    # Generated code and unknown fields can raise any exception.
    except Exception as error:
        raise RecordFault(UNDECODED, f"{own_kind}: {error}") from error


def _named(value: Any) -> Any:
    """JSON objects with their fields as attributes."""
    if isinstance(value, dict):
        return SimpleNamespace(**{str(name): _named(inner) for name, inner in value.items()})
    return (
        [_named(item) for item in value]
        if isinstance(value, list) and any(isinstance(item, dict) for item in value[:1])
        else value
    )


@lru_cache(maxsize=64)
def _class_of(definition: str, kind: str) -> Any:
    """The message class from the FileDescriptorSet of its schema."""
    try:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
    except ImportError as error:
        raise RecordFault(NO_PROTOBUF, "not installed") from error
    files = descriptor_pb2.FileDescriptorSet()
    files.ParseFromString(definition.encode("latin-1"))
    pool, waiting = descriptor_pool.DescriptorPool(), {one.name: one for one in files.file}

    def add(name: str) -> None:
        if (file := waiting.pop(name, None)) is not None:
            for other in file.dependency:
                add(other)
            pool.Add(file)

    for one in files.file:
        add(one.name)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(kind))
