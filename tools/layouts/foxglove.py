"""MCAP with Foxglove's own messages, as protobuf and as JSON; fields and numbers by its published schemas."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import Writer

from tools.layouts import messages as ros
from tools.layouts.camera_bags import LENS, poses_of, shots
from tools.layouts.camera_bags import MOUNT as CAMERA
from tools.layouts.flat_logs import COUNT, FULL, STAMPS, seen
from tools.layouts.lidar_bags import COUNT as TURNS
from tools.layouts.lidar_bags import MOUNT
from tools.layouts.lidar_bags import STAMPS as TURN_STAMPS
from tools.layouts.lidar_bags import truth as cloud_truth
from tools.layouts.lidars import TURN_S, ride
from tools.layouts.messages import START_S
from tools.layouts.samples import CameraTruth, Sample, ScanTruth, layout
from tools.layouts.world import placed, way

_SOURCE = "docs.foxglove.dev/docs/visualization/message-schemas; github.com/foxglove/schemas proto/"
_TIME = "google.protobuf.Timestamp timestamp 1"
# Type, name and number of each field; a star for a list.
_SCHEMAS = {
    "Vector3": "double x 1, double y 2, double z 3",
    "Quaternion": "double x 1, double y 2, double z 3, double w 4",
    "Pose": "Vector3 position 1, Quaternion orientation 2",
    "PackedElementField": "string name 1, fixed32 offset 2, int32 type 3",
    "PointCloud": f"{_TIME}, string frame_id 2, Pose pose 3, fixed32 point_stride 4, "
    "PackedElementField* fields 5, bytes data 6",
    "LaserScan": f"{_TIME}, string frame_id 2, Pose pose 3, double start_angle 4, double end_angle 5, "
    "double* ranges 6, double* intensities 7",
    "FrameTransform": f"{_TIME}, string parent_frame_id 2, string child_frame_id 3, Vector3 translation 4, "
    "Quaternion rotation 5",
    "FrameTransforms": "FrameTransform* transforms 1",
    "PoseInFrame": f"{_TIME}, string frame_id 2, Pose pose 3",
    "RawImage": f"{_TIME}, fixed32 width 2, fixed32 height 3, string encoding 4, fixed32 step 5, "
    "bytes data 6, string frame_id 7",
    "CompressedImage": f"{_TIME}, bytes data 2, string format 3, string frame_id 4",
    "CameraCalibration": f"{_TIME}, fixed32 width 2, fixed32 height 3, string distortion_model 4, "
    "double* D 5, double* K 6, double* R 7, double* P 8, string frame_id 9",
}
_BASIC = {"double": 1, "int32": 5, "fixed32": 7, "string": 9, "bytes": 12}  # descriptor.proto, Type
_MESSAGE, _LIST = 11, 3

Message = tuple[str, str, float, dict[str, Any]]


def _definitions() -> Any:
    """The FileDescriptorSet that goes with each schema."""
    from google.protobuf import descriptor_pb2, timestamp_pb2

    files = descriptor_pb2.FileDescriptorSet()
    timestamp_pb2.DESCRIPTOR.CopyToProto(files.file.add())
    file = files.file.add(name="foxglove.proto", package="foxglove", syntax="proto3")
    file.dependency.append("google/protobuf/timestamp.proto")
    for message, fields in _SCHEMAS.items():
        made = file.message_type.add(name=message)
        for kind, name, number in (one.split() for one in fields.split(", ")):
            bare = kind.rstrip("*")
            field = made.field.add(name=name, number=int(number), label=_LIST if "*" in kind else 1)
            field.type = _BASIC.get(bare, _MESSAGE)
            if bare not in _BASIC:
                field.type_name = f".{bare}" if "." in bare else f".foxglove.{bare}"
    return files


def recorded(path: Path, messages: list[Message], *, as_json: bool = False) -> Path:
    """An MCAP file of topics, types, stamps and fields."""
    classes: Any = {}
    schema_data, encoding, wire = b"{}", "jsonschema", "json"
    if not as_json:
        from google.protobuf import message_factory

        files = _definitions()
        schema_data, encoding, wire = files.SerializeToString(), "protobuf", "protobuf"
        classes = message_factory.GetMessages(list(files.file))
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        bag = Writer(file)
        bag.start()
        channels: dict[str, int] = {}
        for topic, kind, stamp_s, fields in sorted(messages, key=lambda one: one[2]):
            if topic not in channels:
                schema = bag.register_schema(f"foxglove.{kind}", encoding, schema_data)
                channels[topic] = bag.register_channel(topic, wire, schema)
            at = round(1e6 * stamp_s) * 1000
            if as_json:
                content = json.dumps(fields, default=_in_text).encode()
            else:
                content = classes[f"foxglove.{kind}"](**fields).SerializeToString()
            bag.add_message(channels[topic], at, content, at)
        bag.finish()
    return path


def _in_text(value: Any) -> str:
    """Bytes as JSON has them."""
    return base64.b64encode(value).decode()


def _at(stamp_s: float, *, as_json: bool = False) -> dict[str, int]:
    seconds, rest = divmod(round(1e6 * stamp_s) * 1000, 10**9)
    return dict(zip(("sec", "nsec") if as_json else ("seconds", "nanos"), (seconds, rest), strict=True))


def _moved(stamp_s: float, parent: str, child: str, pose: Any, *, as_json: bool = False) -> dict[str, Any]:
    ros_pose = ros.posed(pose)
    frames = {"parent_frame_id": parent, "child_frame_id": child}
    transform = {"translation": ros_pose["position"], "rotation": ros_pose["orientation"]}
    return {"timestamp": _at(stamp_s, as_json=as_json)} | frames | transform


@layout("Foxglove, a lidar as protobuf", "new formats", _SOURCE)
def _lidar(folder: Path) -> Sample:
    """Points with times; where the lidar sits, and how the robot moves, in transforms."""
    points, parts, poses = ride(MOUNT)
    kinds = (("x", 7, "<f4"), ("y", 7, "<f4"), ("z", 7, "<f4"), ("ring", 3, "<u2"), ("t", 5, "<u4"))
    row = np.dtype([(name, kind) for name, _, kind in kinds])
    fields = [{"name": name, "offset": row.fields[name][1], "type": number} for name, number, _ in kinds]
    messages: list[Message] = []
    for k, (stamp, base) in enumerate(zip(TURN_STAMPS, way(TURNS), strict=True)):
        table = np.zeros(len(points[k]), row)
        for column, axis in enumerate("xyz"):
            table[axis] = points[k][:, column]
        table["t"] = np.rint(1e9 * TURN_S * parts[k])
        cloud = {"frame_id": "lidar", "pose": ros.posed(placed()), "point_stride": row.itemsize}
        cloud |= {"timestamp": _at(stamp), "fields": fields, "data": table.tobytes()}
        messages.append(("/points", "PointCloud", stamp, cloud))
        both = [_moved(stamp, "odom", "base_link", base), _moved(stamp, "base_link", "lidar", MOUNT)]
        messages.append(("/tf", "FrameTransforms", stamp, {"transforms": both}))
    path = recorded(folder / "drive.mcap", messages)
    return Sample(path, cloud=cloud_truth(points, parts, poses, MOUNT), wheels=TURNS)


@layout("Foxglove, a flat lidar as JSON", "new formats", _SOURCE)
def _flat(folder: Path) -> Sample:
    """Ranges, transforms one by one, and the truth as poses."""
    mount, messages = (0.1, 0.0, 0.2), []
    ranges = seen(mount, FULL)
    for stamp, base, one in zip(STAMPS, way(COUNT), ranges, strict=True):
        at = {"timestamp": _at(stamp, as_json=True)}
        scan = at | {"frame_id": "laser", "pose": ros.posed(placed()), "ranges": one.tolist()}
        scan |= {"start_angle": 0.0, "end_angle": float(FULL[-1]), "intensities": []}
        messages.append(("/scan", "LaserScan", stamp, scan))
        sits = placed(mount[0], mount[1], 0.3, mount[2])
        for parent, child, pose in (("odom", "base_link", base), ("base_link", "laser", sits)):
            messages.append(
                (
                    "/tf",
                    "FrameTransform",
                    stamp - 0.01,
                    _moved(stamp - 0.01, parent, child, pose, as_json=True),
                )
            )
        pose = at | {"frame_id": "map", "pose": ros.posed(base)}
        messages.append(("/ground_truth/pose", "PoseInFrame", stamp, pose))
    scans = (ScanTruth(STAMPS, FULL, ranges, mount),)
    path = recorded(folder / "drive.mcap", messages, as_json=True)
    return Sample(path, scans=scans, wheels=COUNT, moved=way(COUNT))


@layout("Foxglove, a depth camera as protobuf", "new formats", _SOURCE)
def _camera(folder: Path) -> Sample:
    """Colour as JPEG, depth in metres, both with a lens."""
    messages: list[Message] = []
    k = [LENS.fx, 0, LENS.cx, 0, LENS.fy, LENS.cy, 0, 0, 1]
    p = [LENS.fx, 0, LENS.cx, 0, 0, LENS.fy, LENS.cy, 0, 0, 0, 1, 0]
    size = {"width": LENS.width, "height": LENS.height}
    stamps = [START_S + k / 15.0 for k in range(16)]
    poses = poses_of(CAMERA, len(stamps))
    for stamp, base, view in zip(stamps, way(len(stamps)), shots(LENS, poses), strict=True):
        at = {"timestamp": _at(stamp), "frame_id": "optical"}
        packed = {"format": "jpeg", "data": ros.coded(view.color, ".jpg", 1, 95)}
        messages.append(("/camera/color", "CompressedImage", stamp, at | packed))
        depth = {"encoding": "32FC1", "step": 4 * LENS.width, "data": view.depth_m.astype("<f4").tobytes()}
        messages.append(("/camera/depth", "RawImage", stamp, at | size | depth))
        lens = {"distortion_model": "plumb_bob", "D": [0.0] * 5, "K": k, "R": np.eye(3).ravel(), "P": p}
        messages.append(("/camera/camera_info", "CameraCalibration", stamp, at | size | lens))
        both = [_moved(stamp, "odom", "base_link", base), _moved(stamp, "base_link", "optical", CAMERA)]
        messages.append(("/tf", "FrameTransforms", stamp, {"transforms": both}))
    path = recorded(folder / "camera.mcap", messages)
    return Sample(path, (CameraTruth(LENS, stamps, poses, CAMERA),), wheels=len(stamps))
