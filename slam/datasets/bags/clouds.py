"""PointCloud2 messages as clouds, with the time of each point where the message has it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.estimation import CONFIDENCE
from slam.datasets.bags.decoding import stamp_of
from slam.datasets.budget import LARGEST_BYTES
from slam.datasets.dataset import RecordFault
from slam.datasets.point_times import PointTimes
from slam.measurements import PointCloud

BAD_LAYOUT = "point cloud with a layout that cannot be"
NO_POINTS = "point cloud without a valid point"

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
_DIRECTIONS = 36  # of ten degrees each
_HALF_VIEW_RAD = math.radians(65.0)  # of the widest depth cameras (Azure Kinect, 120 degrees), with slack


@dataclass(slots=True)
class CloudReader:
    """Clouds of one topic.

    Attributes
    ----------
    topic
        The name of the sensor.
    T_base_lidar
        Its mounting.
    times
        Which field and unit the times of its points are in.
    """

    topic: str
    T_base_lidar: gtsam.Pose3
    times: PointTimes = field(default_factory=PointTimes)

    def read(self, message: Any) -> PointCloud:
        """A cloud; points that are not finite, or at the lidar itself (no return), are left out.

        Raises
        ------
        RecordFault
            No x, y and z in the layout, fewer bytes than it says, or not a valid point.
        """
        rows = _rows(message)
        stamp_s = stamp_of(message.header)
        with np.errstate(invalid="ignore", over="ignore"):  # a signalling NaN of a damaged message
            points = np.stack([rows[name].astype(np.float32) for name in "xyz"], axis=1)
            valid = np.isfinite(points).all(axis=1) & points.any(axis=1)
        if not valid.any():
            raise RecordFault(NO_POINTS, f"{len(points)} points")
        sound = rows[valid]
        times_s = self.times.of(sound.dtype.names or (), lambda name: sound[name], stamp_s)
        kept = np.ascontiguousarray(points[valid])
        return PointCloud(stamp_s, kept, times_s, self.T_base_lidar, self.topic)


@dataclass(frozen=True, slots=True)
class CloudView:
    """What a cloud looks like.

    Attributes
    ----------
    rows
        Rows of its points; 1 where they are not in the order of an image.
    along
        The axis, x, y or z, about which all points lie within what a camera can see; empty where they do not.
    points
        How many there are.
    around
        Share of all directions about z in which there is a point.
    timed
        Whether its points tell their times.
    """

    stamp_s: float
    rows: int
    along: str
    points: int = 0
    around: float = 0.0
    timed: bool = False


def cloud_view(message: Any) -> CloudView:
    """What a cloud looks like.

    Raises
    ------
    RecordFault
        As `CloudReader.read`.
    """
    cloud = CloudReader("", gtsam.Pose3()).read(message)
    ahead = cloud.points_lidar / np.linalg.norm(cloud.points_lidar, axis=1, keepdims=True)
    seen = (ahead > math.cos(_HALF_VIEW_RAD)).mean(axis=0)
    along = [axis for axis, share in zip("xyz", seen, strict=True) if share > CONFIDENCE]
    bearings = np.arctan2(cloud.points_lidar[:, 1], cloud.points_lidar[:, 0]) / (2.0 * math.pi)
    around = np.unique(np.floor(bearings * _DIRECTIONS)).size / _DIRECTIONS
    timed = cloud.times_s is not None
    return CloudView(
        cloud.stamp_s, int(message.height), "".join(along[:1]), len(cloud.points_lidar), around, timed
    )


def _rows(message: Any) -> NDArray[Any]:
    """(N,) structured points, the padding of rows left out."""
    order = ">" if message.is_bigendian else "<"
    step, row_step = int(message.point_step), int(message.row_step)
    height, width = int(message.height), int(message.width)
    data = np.ascontiguousarray(np.asarray(message.data, dtype=np.uint8).ravel())
    row = width * step
    if step < 1 or not 0 < height * width * step <= LARGEST_BYTES:
        raise RecordFault(BAD_LAYOUT, f"{width} x {height} points of {step} bytes")
    row_step = row if height == 1 else row_step
    if row_step < row or data.size < row_step * (height - 1) + row:
        raise RecordFault(BAD_LAYOUT, f"{width} x {height} points of {step} bytes in {data.size} bytes")
    layout = _layout(message.fields, order, step)
    if row_step == row:
        return data[: row * height].view(layout)
    packed = np.lib.stride_tricks.as_strided(data, (height, row), (row_step, 1))
    return np.ascontiguousarray(packed).reshape(-1).view(layout)


def _layout(fields: Any, order: str, step: int) -> np.dtype[Any]:
    """The structured type of a point; fields with several values a point are passed over."""
    names, kinds, offsets = [], [], []
    for item in fields:
        name, kind = str(item.name), _KINDS.get(int(item.datatype))
        if kind is None or int(item.count) > 1 or not name or name in names:
            continue
        if int(item.offset) + np.dtype(kind).itemsize > step:
            raise RecordFault(BAD_LAYOUT, f"field {name[:24]!r} beyond the {step} bytes of a point")
        names.append(name)
        kinds.append(order + kind)
        offsets.append(int(item.offset))
    if not {"x", "y", "z"} <= set(names):
        raise RecordFault(BAD_LAYOUT, f"fields {', '.join(names)[:60]} without x, y and z")
    return np.dtype({"names": names, "formats": kinds, "offsets": offsets, "itemsize": step})
