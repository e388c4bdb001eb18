"""Camera facts from messages of their drivers, and registration of colour to depth.

librealsense records a camera in topics ``/device_0/sensor_0/Depth_0/...`` with the depth unit as an option,
and transforms of streams from the first; drivers of RealSense and Orbbec for ROS send Extrinsics messages.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.datasets.bags.transforms import pose_of
from slam.datasets.calibration import pose_from_matrix
from slam.measurements import CameraIntrinsics, ColorImage, Float32Array

EXTRINSICS = re.compile(r"(realsense|orbbec).*/Extrinsics$")
_UNIT = re.compile(r"(/device_\d+/sensor_\d+)/option/Depth[_ ]Units/value")
_STREAM = re.compile(r"(/device_\d+/sensor_\d+/\w+)/tf/\d+")
_FARTHEST_M = 1.0  # between the lenses of one camera; larger translations are in millimetres
_SMALLEST_M, _LARGEST_M = 1e-6, 1e-1  # units of depth
_FAR_M = 1e3  # from here on, the baseline of two cameras is not visible in the image


@dataclass(slots=True)
class CameraFacts:
    """What drivers report about their cameras.

    Attributes
    ----------
    units_m
        Metres per depth step, by the namespace of the sensor.
    streams
        Pose of the reference stream in each stream of a recording by librealsense, by the stream's namespace.
    extrinsics
        ``T_to_from`` of each topic of Extrinsics.
    fact_topics
        The topics that contain these facts.
    """

    units_m: dict[str, float] = field(default_factory=dict)
    streams: dict[str, gtsam.Pose3] = field(default_factory=dict)
    extrinsics: dict[str, gtsam.Pose3] = field(default_factory=dict)
    fact_topics: set[str] = field(default_factory=set)

    def describes_camera(self, topic: str, kind: str) -> bool:
        """Whether a topic contains such facts."""
        return bool(EXTRINSICS.search(kind) or _UNIT.fullmatch(topic) or _STREAM.fullmatch(topic))

    def add(self, topic: str, kind: str, message: Any) -> None:
        """Use a message of such a topic; ValueError if its content is invalid."""
        if unit := _UNIT.fullmatch(topic):
            value = float(str(np.float32(message.data)))  # 0.001, not its nearest value in single precision
            if not _SMALLEST_M <= value <= _LARGEST_M:
                raise ValueError(f"a depth unit of {value} m")
            self.units_m[unit[1]] = value
        elif stream := _STREAM.fullmatch(topic):
            self.streams[stream[1]] = pose_of(message.translation, message.rotation)
        else:
            self.extrinsics[topic] = _pose_of_extrinsics(message, by_columns="realsense" in kind)
        self.fact_topics.add(topic)

    def unit_m(self, topic: str) -> float | None:
        """Metres per depth step of an image topic; None if unknown."""
        return next((unit for space, unit in self.units_m.items() if topic.startswith(f"{space}/")), None)

    def color_in_depth(self, color: str, depth: str) -> tuple[gtsam.Pose3, str] | None:
        """Pose of the colour camera in the depth camera by their topics, and its source topic."""
        places = [
            next((pose for space, pose in self.streams.items() if topic.startswith(f"{space}/")), None)
            for topic in (depth, color)
        ]
        if any(places):
            # The reference is a stream, too; it has no transform, or the identity.
            T_depth_reference, T_color_reference = (place or gtsam.Pose3() for place in places)
            source = f"{color.rpartition('/image/')[0]}/tf"
            return T_depth_reference.compose(T_color_reference.inverse()), source
        if "depth" not in depth or "color" not in color:
            return None
        for topic, T_to_from in self.extrinsics.items():
            name = topic.rpartition("/")[2]
            space = topic.rpartition("/")[0].removesuffix("/extrinsics")
            own = depth.startswith(f"{space}/") and color.startswith(f"{space}/")
            if own and name in ("depth_to_color", "depth_to_rgb"):
                return T_to_from.inverse(), topic
            if own and name in ("color_to_depth", "rgb_to_depth"):
                return T_to_from, topic
        return None


def _pose_of_extrinsics(message: Any, *, by_columns: bool) -> gtsam.Pose3:
    """The pose in an Extrinsics message, which maps points of the first camera to the second."""
    matrix = np.eye(4)
    rotation = np.asarray(message.rotation, dtype=np.float64).reshape(3, 3)
    matrix[:3, :3] = rotation.T if by_columns else rotation
    translation = np.asarray(message.translation, dtype=np.float64)
    length = float(np.linalg.norm(translation))
    matrix[:3, 3] = translation if length < _FARTHEST_M else translation / 1000.0
    if not math.isfinite(length):
        raise ValueError(f"translation {translation}")
    return pose_from_matrix(matrix)


class ColorView:
    """Looks up the colour of each pixel of a depth image by the pixel's depth.

    Parameters
    ----------
    depth, color
        The two pinhole models, each for its images.
    """

    def __init__(self, depth: CameraIntrinsics, color: CameraIntrinsics, T_depth_color: gtsam.Pose3) -> None:
        T_color_depth = T_depth_color.inverse()
        turn = np.asarray(T_color_depth.rotation().matrix())
        columns, rows = np.meshgrid(np.arange(depth.width), np.arange(depth.height))
        rays = np.stack(
            [(columns - depth.cx) / depth.fx, (rows - depth.cy) / depth.fy, np.ones(columns.shape)]
        )
        self._rays = np.einsum("ij,jhw->ihw", turn, rays).astype(np.float32)
        self._shift = T_color_depth.translation().astype(np.float32)
        self._lens = color

    def of(self, color: ColorImage, depth_m: Float32Array) -> ColorImage:
        """(H, W, 3) at the depth image's size; black outside the colour camera's view."""
        import cv2

        known_m: NDArray[np.float32] = np.where(depth_m > 0.0, depth_m, np.float32(_FAR_M))
        x, y, z = (ray * known_m + shift for ray, shift in zip(self._rays, self._shift, strict=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            columns = np.where(z > 0.0, np.float32(self._lens.fx) * x / z + np.float32(self._lens.cx), -1.0)
            rows = np.where(z > 0.0, np.float32(self._lens.fy) * y / z + np.float32(self._lens.cy), -1.0)
        maps = columns.astype(np.float32), rows.astype(np.float32)
        return np.asarray(cv2.remap(color, *maps, cv2.INTER_LINEAR))
