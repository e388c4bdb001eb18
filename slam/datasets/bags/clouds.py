"""PointCloud2 messages as clouds, with the time of each point where the message has it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.datasets.bags.decoding import stamp_of
from slam.datasets.dataset import RecordFault
from slam.measurements import FloatArray, PointCloud

BAD_LAYOUT = "point cloud with a layout that cannot be"
NO_POINTS = "point cloud without a valid point"

_KINDS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField
# Ouster, Velodyne, Hesai and RoboSense, Livox, and what their users call it.
_TIME_NAMES = (
    "t",
    "time",
    "timestamp",
    "offset_time",
    "time_offset",
    "point_time_offset",
    "ts",
    "time_stamp",
)
_UNITS_S = {"seconds": 1.0, "milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
# A turn of any lidar takes longer than the first and less than the second; they lie one unit apart.
_SHORTEST_TURN_S, _LONGEST_TURN_S = 0.002, 2.0
_FIRST_CLOCK_S = 1e6  # no offset within a turn, and before any clock that was ever set
_SAME_CLOCK_S = 1.0
_MOST_POINTS = 1 << 24


@dataclass(slots=True)
class CloudReader:
    """Clouds of one topic; what was concluded of its first points' times holds for all.

    Attributes
    ----------
    topic
        The name of the sensor.
    T_base_lidar
        Its mounting.
    time_choice
        Which field and unit the times are in, for the report; empty before the first cloud.
    """

    topic: str
    T_base_lidar: gtsam.Pose3
    time_choice: str = ""
    _field: str = ""
    _unit_s: float = 0.0

    def read(self, message: Any) -> PointCloud:
        """A cloud; points that are not finite, or at the lidar itself (no return), are left out.

        Raises
        ------
        RecordFault
            No x, y and z in the layout, fewer bytes than it says, or not a valid point.
        """
        rows = _rows(message)
        stamp_s = stamp_of(message.header)
        points = np.stack([rows[name].astype(np.float32) for name in "xyz"], axis=1)
        valid = np.isfinite(points).all(axis=1) & points.any(axis=1)
        if not valid.any():
            raise RecordFault(NO_POINTS, f"{len(points)} points")
        times_s = self._times(rows[valid], stamp_s)
        kept = np.ascontiguousarray(points[valid])
        return PointCloud(stamp_s, kept, times_s, self.T_base_lidar, self.topic)

    def _times(self, rows: NDArray[Any], stamp_s: float) -> FloatArray | None:
        """Seconds after the header's stamp, (N,); None where the message does not tell them."""
        if not self._field:
            self._choose(rows)
        if not self._field or self._field not in (rows.dtype.names or ()):
            return None
        times_s: FloatArray = rows[self._field].astype(np.float64) * self._unit_s
        if not np.isfinite(times_s).all() or np.ptp(times_s) > _LONGEST_TURN_S:
            return None
        first_s = float(times_s.min())
        if abs(first_s) < _FIRST_CLOCK_S:
            return times_s
        # By another clock than the header's only the differences mean something.
        return times_s - (stamp_s if abs(first_s - stamp_s) < _SAME_CLOCK_S else first_s)

    def _choose(self, rows: NDArray[Any]) -> None:
        """The field of times, and its unit by how long a turn can take."""
        names = {str(name).lower(): str(name) for name in rows.dtype.names or ()}
        found = [names[name] for name in _TIME_NAMES if name in names]
        if not found:
            self.time_choice = "points without times"
            return
        values = rows[found[0]].astype(np.float64)
        span = float(np.ptp(values)) if np.isfinite(values).all() else 0.0
        for unit, unit_s in _UNITS_S.items():
            if _SHORTEST_TURN_S < span * unit_s <= _LONGEST_TURN_S:
                self._field, self._unit_s = found[0], unit_s
                absolute = abs(float(values.min()) * unit_s) >= _FIRST_CLOCK_S
                after = "of a clock" if absolute else "after the header's stamp"
                kind = rows.dtype[found[0]]
                self.time_choice = f"times of points from field {found[0]} ({kind}), {unit} {after}"
                return
        self.time_choice = f"times of points in field {found[0]} span {span:g}, which is no turn: not used"


def _rows(message: Any) -> NDArray[Any]:
    """(N,) structured points, the padding of rows left out."""
    order = ">" if message.is_bigendian else "<"
    step, row_step = int(message.point_step), int(message.row_step)
    height, width = int(message.height), int(message.width)
    data = np.ascontiguousarray(np.asarray(message.data, dtype=np.uint8).ravel())
    row = width * step
    if step < 1 or not 0 < height * width <= _MOST_POINTS:
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
