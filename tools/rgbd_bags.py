"""RGB-D frames packed into bags as drivers of cameras record them: same pixels, lens and stamps in each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from slam.measurements import RgbdFrame

AFTER_S = 1000.0  # a bag's first stamp may not be zero
PACKINGS = ("realsense.bag", "ros2.db3", "compressed.mcap", "native.bag")
_TYPES = "sensor_msgs/msg/"


def write_rgbd_bag(folder: Path, packing: str, frames: list[RgbdFrame]) -> Path:
    """A bag of frames.

    Parameters
    ----------
    packing
        ``realsense.bag``: a ROS 1 bag of raw images; ``ros2.db3``: depth in metres; ``compressed.mcap``: PNG
        and compressedDepth; ``native.bag``: as librealsense records.
    """
    path, ros1 = folder / packing.partition(".")[0], packing.endswith(".bag")
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:
        writer: Any = Writer1(path.with_suffix(".bag"))
    else:
        plugin = StoragePlugin.MCAP if packing.endswith("mcap") else StoragePlugin.SQLITE3
        writer = Writer2(path, version=9, storage_plugin=plugin)
    message = _Messages(store, ros1=ros1)
    connections: dict[str, Any] = {}
    serialised = store.serialize_ros1 if ros1 else store.serialize_cdr
    with writer:
        for number, frame in enumerate(frames):
            at_ns = round((frame.stamp_s + AFTER_S) * 1e9)
            for topic, kind, content in message.of(frame, packing, first=number == 0):
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(connections[topic], at_ns, serialised(content, kind))
    return path.with_suffix(".bag") if ros1 else path


class _Messages:
    """The messages of a frame."""

    def __init__(self, store: Any, *, ros1: bool) -> None:
        self._types, self._ros1 = store.types, ros1

    def of(self, frame: RgbdFrame, packing: str, *, first: bool) -> list[tuple[str, str, Any]]:
        """Topic, type and content of each."""
        steps = np.rint(frame.depth_m * 1000.0).astype(np.uint16)
        info = [self._info(frame, topic) for topic in _info_topics(packing)] if first else []
        if packing == "compressed.mcap":
            color = cv2.imencode(".png", frame.color[..., ::-1])[1].tobytes()
            depth = b"\0" * 12 + cv2.imencode(".png", steps)[1].tobytes()
            return [
                *info,
                self._packed(frame, "/camera/color/image_raw/compressed", "rgb8; png compressed bgr8", color),
                self._packed(
                    frame,
                    "/camera/aligned_depth_to_color/image_raw/compressedDepth",
                    "16UC1; compressedDepth png",
                    depth,
                ),
            ]
        native = packing == "native.bag"
        topics = (
            ("/device_0/sensor_1/Color_0/image/data", "/device_0/sensor_0/Depth_0/image/data")
            if native
            else ("/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw")
        )
        told = [self._unit()] if native and first else []
        if native:
            images = [("rgb8", frame.color), ("mono16", steps)]
        elif packing == "ros2.db3":
            images = [("bgr8", frame.color[..., ::-1]), ("32FC1", frame.depth_m)]
        else:
            images = [("rgb8", frame.color), ("16UC1", steps)]
        return [*info, *told, *(self._image(frame, t, *one) for t, one in zip(topics, images, strict=True))]

    def _header(self, frame: RgbdFrame) -> Any:
        at_ns = round((frame.stamp_s + AFTER_S) * 1e9)
        stamp = self._types["builtin_interfaces/msg/Time"](sec=at_ns // 10**9, nanosec=at_ns % 10**9)
        beside = {"seq": 0} if self._ros1 else {}
        return self._types["std_msgs/msg/Header"](
            stamp=stamp, frame_id="camera_color_optical_frame", **beside
        )

    def _image(self, frame: RgbdFrame, topic: str, encoding: str, pixels: Any) -> tuple[str, str, Any]:
        rows = np.ascontiguousarray(pixels)
        content = self._types[f"{_TYPES}Image"](
            header=self._header(frame),
            height=rows.shape[0],
            width=rows.shape[1],
            encoding=encoding,
            is_bigendian=0,
            step=rows.nbytes // rows.shape[0],
            data=rows.view(np.uint8).ravel(),
        )
        return topic, f"{_TYPES}Image", content

    def _packed(self, frame: RgbdFrame, topic: str, form: str, data: bytes) -> tuple[str, str, Any]:
        kind = f"{_TYPES}CompressedImage"
        content = self._types[kind](
            header=self._header(frame), format=form, data=np.frombuffer(data, np.uint8)
        )
        return topic, kind, content

    def _unit(self) -> tuple[str, str, Any]:
        kind = "std_msgs/msg/Float32"
        return "/device_0/sensor_0/option/Depth_Units/value", kind, self._types[kind](data=0.001)

    def _info(self, frame: RgbdFrame, topic: str) -> tuple[str, str, Any]:
        lens = frame.intrinsics
        k = np.array([lens.fx, 0, lens.cx, 0, lens.fy, lens.cy, 0, 0, 1])
        p = np.array([lens.fx, 0, lens.cx, 0, 0, lens.fy, lens.cy, 0, 0, 0, 1, 0])
        named = {"d": np.zeros(5), "k": k, "r": np.eye(3).ravel(), "p": p}
        roi = self._types[f"{_TYPES}RegionOfInterest"](
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        content = self._types[f"{_TYPES}CameraInfo"](
            header=self._header(frame),
            height=lens.height,
            width=lens.width,
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **({name.upper(): value for name, value in named.items()} if self._ros1 else named),
        )
        return topic, f"{_TYPES}CameraInfo", content


def _info_topics(packing: str) -> tuple[str, ...]:
    """Where the lens is told."""
    if packing == "native.bag":
        return tuple(
            f"/device_0/sensor_{n}/{name}_0/info/camera_info" for n, name in ((0, "Depth"), (1, "Color"))
        )
    return "/camera/color/camera_info", "/camera/aligned_depth_to_color/camera_info"
