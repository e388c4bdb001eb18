"""Converts PointCloud2 messages to clouds, with the time of each point if the message contains it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.estimation import CONFIDENCE
from slam.datasets.bags.decoding import stamp_of
from slam.datasets.budget import LARGEST_BYTES
from slam.datasets.cloud_files import is_return
from slam.datasets.dataset import RecordFault
from slam.datasets.point_times import LONGEST_TURN_S, PointTimes, intensities_of
from slam.measurements import Float32Array, Measurement, PointCloud

BAD_LAYOUT = "point cloud with an impossible layout"
NO_POINTS = "point cloud without a valid point"

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
LEAST_POINTS = _DIRECTIONS = 36  # of ten degrees each
_HALF_VIEW_RAD = math.radians(65.0)  # the widest depth camera (Azure Kinect, 120 degrees) and a margin


@dataclass(slots=True)
class CloudReader:
    """Reads the clouds of one topic.

    Attributes
    ----------
    times
        Field and unit of the point times.
    """

    topic: str
    T_base_lidar: gtsam.Pose3
    times: PointTimes = field(default_factory=PointTimes)

    def read(self, message: Any) -> PointCloud:
        """A cloud without points that are not finite or lie at the lidar itself (no return).

        Raises
        ------
        RecordFault
            The layout has no x, y and z, bytes are missing, or no point is valid.
        """
        rows = _rows(message)
        stamp_s = stamp_of(message.header)
        with np.errstate(invalid="ignore", over="ignore"):  # a signalling NaN of a damaged message
            points = np.stack([rows[name].astype(np.float32) for name in "xyz"], axis=1)
            valid = is_return(points)
        if not valid.any():
            raise RecordFault(NO_POINTS, f"{len(points)} points")
        chosen = slice(None) if valid.all() else valid
        names = rows.dtype.names or ()
        times_s = self.times.of(names, lambda name: rows[name][chosen], stamp_s)
        intensities = intensities_of(names, lambda name: rows[name][chosen])
        kept = np.ascontiguousarray(points[chosen])
        return PointCloud(stamp_s, kept, times_s, self.T_base_lidar, self.topic, intensities)


@dataclass(slots=True)
class TurnReader:
    """Assembles the clouds of a topic whose messages are parts of a revolution, such as packets."""

    reader: CloudReader
    _pieces: list[PointCloud] = field(default_factory=list)
    _ahead_rad: float = 0.0
    _turned_rad: float = 0.0

    def read(self, message: Any) -> list[Measurement]:
        """The revolution that this part completes, with the stamp of its first part; else nothing."""
        newest = self.reader.read(message)
        ahead_rad = direction_rad(newest.points_lidar)
        if self._pieces and not 0.0 <= newest.stamp_s - self._pieces[0].stamp_s < LONGEST_TURN_S:
            self._pieces = []
        if self._pieces:
            self._turned_rad += math.remainder(ahead_rad - self._ahead_rad, 2.0 * math.pi)
        else:
            self._turned_rad = 0.0
        self._pieces.append(newest)
        self._ahead_rad = ahead_rad
        steps = len(self._pieces) - 1
        # Each part is as wide as a step; the tolerance is half a step.
        if not steps or abs(self._turned_rad) * (steps + 1.5) < 2.0 * math.pi * steps:
            return []
        parts, self._pieces = self._pieces, []
        at_s = parts[0].stamp_s
        times_s = [
            part.stamp_s - at_s + (np.zeros(len(part.points_lidar)) if part.times_s is None else part.times_s)
            for part in parts
        ]
        points = np.concatenate([part.points_lidar for part in parts])
        known_intensities = [part.intensities for part in parts if part.intensities is not None]
        intensities = np.concatenate(known_intensities) if len(known_intensities) == len(parts) else None
        return [
            replace(parts[0], points_lidar=points, times_s=np.concatenate(times_s), intensities=intensities)
        ]


def direction_rad(points: Float32Array) -> float:
    """Mean bearing about z of (N, 3) points."""
    bearings = np.arctan2(points[:, 1], points[:, 0])
    return math.atan2(float(np.sin(bearings).mean()), float(np.cos(bearings).mean()))


@dataclass(frozen=True, slots=True)
class CloudView:
    """Properties of a cloud.

    Attributes
    ----------
    rows
        Number of point rows; 1 if the points are not ordered like an image.
    along
        The axis, x, y or z, around which all points are in a camera's field of view; else empty.
    around
        Fraction of the directions about z that contain a point.
    timed, ends_s
        Whether its points have timestamps, and the last of them after that of the cloud.
    ahead_rad, width_rad
        Mean bearing of the points about z, and the width of their spread, if it is uniform.
    """

    stamp_s: float
    rows: int
    along: str
    points: int = 0
    around: float = 0.0
    timed: bool = False
    ends_s: float = 0.0
    ahead_rad: float = 0.0
    width_rad: float = 0.0

    def turns_to(self, next_one: CloudView) -> bool:
        """Whether both are parts of a revolution, the next one adjacent to this one."""
        turned_rad = abs(math.remainder(next_one.ahead_rad - self.ahead_rad, 2.0 * math.pi))
        width_rad = max(self.width_rad, next_one.width_rad)
        return width_rad < math.pi and 0.5 * width_rad < turned_rad < 1.5 * width_rad


def cloud_view(message: Any) -> CloudView:
    """What a cloud looks like; RecordFault as in `CloudReader.read`."""
    cloud = CloudReader("", gtsam.Pose3()).read(message)
    points = cloud.points_lidar.astype(np.float64)  # a damaged value can exceed single precision
    ahead = points / np.linalg.norm(points, axis=1, keepdims=True)
    share_ahead = (ahead > math.cos(_HALF_VIEW_RAD)).mean(axis=0)
    along = [axis for axis, share in zip("xyz", share_ahead, strict=True) if share > CONFIDENCE]
    bearings = np.arctan2(cloud.points_lidar[:, 1], cloud.points_lidar[:, 0]) / (2.0 * math.pi)
    around = np.unique(np.floor(bearings * _DIRECTIONS)).size / _DIRECTIONS
    ahead_rad = direction_rad(cloud.points_lidar)
    offsets = bearings - ahead_rad / (2.0 * math.pi)
    # The standard deviation of a uniform distribution is its width divided by sqrt(12).
    width_rad = 2.0 * math.pi * math.sqrt(12.0) * float((offsets - np.rint(offsets)).std())
    kind = int(message.height), "".join(along[:1]), len(cloud.points_lidar), around, cloud.times_s is not None
    ends_s = 0.0 if cloud.times_s is None else float(cloud.times_s.max())
    return CloudView(cloud.stamp_s, *kind, ends_s, ahead_rad, width_rad)


def _rows(message: Any) -> NDArray[Any]:
    """(N,) structured points, without the padding of rows."""
    order = ">" if message.is_bigendian else "<"
    step, row_step = int(message.point_step), int(message.row_step)
    height, width = int(message.height), int(message.width)
    data = np.ascontiguousarray(np.asarray(message.data, dtype=np.uint8).ravel())
    row = width * step
    if step < 1 or not 0 < height * width * step <= LARGEST_BYTES:
        raise RecordFault(BAD_LAYOUT, f"{width} x {height} points of {step} bytes")
    # If no byte is between rows, a wrong row step (0, or that of the whole cloud) does no harm.
    row_step = row if height == 1 or data.size == height * row else row_step
    if row_step < row or data.size < row_step * (height - 1) + row:
        raise RecordFault(BAD_LAYOUT, f"{width} x {height} points of {step} bytes in {data.size} bytes")
    layout = _layout(message.fields, order, step)
    if row_step == row:
        return data[: row * height].view(layout)
    packed = np.lib.stride_tricks.as_strided(data, (height, row), (row_step, 1))
    return np.ascontiguousarray(packed).reshape(-1).view(layout)


def _layout(fields: Any, order: str, step: int) -> np.dtype[Any]:
    """The structured type of a point; fields with several values per point are skipped."""
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
