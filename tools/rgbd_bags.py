"""Write RGB-D frames to bags in the formats of camera drivers, with the same pixels, lens and stamps."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from slam.measurements import RgbdFrame
from tools.layouts import messages as ros
from tools.layouts.messages import Sent

AFTER_S = 1000.0  # a bag's first stamp may not be zero
PACKINGS = ("realsense.bag", "ros2.db3", "compressed.mcap", "native.bag")
_FRAME = "camera_color_optical_frame"
_COLOR, _DEPTH = "/camera/color", "/camera/aligned_depth_to_color"
_NATIVE_COLOR, _NATIVE_DEPTH = "/device_0/sensor_1/Color_0", "/device_0/sensor_0/Depth_0"


def write_rgbd_bag(folder: Path, packing: str, frames: list[RgbdFrame]) -> Path:
    """A bag of frames.

    Parameters
    ----------
    packing
        ``realsense.bag``: a ROS 1 bag of raw images; ``ros2.db3``: depth in metres; ``compressed.mcap``: PNG
        and compressedDepth; ``native.bag``: as librealsense records.
    """
    path = folder / packing.partition(".")[0]
    sent = [one for frame in frames for one in _of(frame, packing, first=frame is frames[0])]
    if packing.endswith(".bag"):
        return ros.ros1(path.with_suffix(".bag"), sent)
    return ros.ros2(path, sent, mcap=packing.endswith("mcap"))


def _of(frame: RgbdFrame, packing: str, *, first: bool) -> Iterator[Sent]:
    """The messages of a frame; the lens comes with the first."""
    at_s, native = frame.stamp_s + AFTER_S, packing == "native.bag"
    color, depth = (_NATIVE_COLOR, _NATIVE_DEPTH) if native else (_COLOR, _DEPTH)
    if first:
        for topic in (color, depth):
            name = f"{topic}/info/camera_info" if native else f"{topic}/camera_info"
            yield ros.info(name, at_s, frame.intrinsics, _FRAME)
    if native and first:
        yield Sent(
            "/device_0/sensor_0/option/Depth_Units/value", "std_msgs/msg/Float32", at_s, {"data": 0.001}
        )
    steps = np.rint(frame.depth_m * 1000.0).astype(np.uint16)
    if packing == "compressed.mcap":
        packed = "rgb8; png compressed bgr8", "16UC1; compressedDepth png"
        yield ros.squeezed(
            f"{color}/image_raw/compressed", at_s, ros.coded(frame.color, ".png"), packed[0], _FRAME
        )
        content = b"\0" * 12 + ros.coded(steps, ".png")
        yield ros.squeezed(f"{depth}/image_raw/compressedDepth", at_s, content, packed[1], _FRAME)
        return
    images = {
        "native.bag": [("rgb8", frame.color), ("mono16", steps)],
        "ros2.db3": [("bgr8", frame.color[..., ::-1]), ("32FC1", frame.depth_m)],
        "realsense.bag": [("rgb8", frame.color), ("16UC1", steps)],
    }
    for topic, (encoding, pixels) in zip((color, depth), images[packing], strict=True):
        yield ros.image(f"{topic}/{'image/data' if native else 'image_raw'}", at_s, pixels, encoding, _FRAME)
