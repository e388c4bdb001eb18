"""Converts LaserScan and MultiEchoLaserScan messages to scans."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from fusion.time_alignment import GAP_S
from slam.datasets.bags.decoding import stamp_of
from slam.datasets.dataset import RecordFault
from slam.datasets.laser_geometry import (
    DEFAULT_NO_RETURN_M,
    NO_VALID_RANGE,
    ZERO_BEAMS,
    RepeatedRange,
    classify_ranges,
)
from slam.measurements import FloatArray, LaserScan

BAD_ANGLES = "angles of the scan are impossible (in degrees, or without an increment)"
UPRIGHT = "laser not level: its plane is nearly vertical"

_LEVEL = math.cos(math.radians(45.0))
_TURN_RAD = 2.0 * math.pi
ANGLE_TOLERANCE_RAD = 0.1


@dataclass(frozen=True, slots=True)
class LaserMount:
    """Pose of a laser in the robot's plane, whether it is mounted upside down, and its tilt."""

    T_base_laser: gtsam.Pose2
    inverted: bool = False
    tilt_rad: float = 0.0

    @classmethod
    def of(cls, pose: gtsam.Pose3) -> LaserMount:
        """Return the mount in the plane, a tilt below 45 degrees projected; RecordFault beyond it."""
        axes = pose.rotation().matrix()
        if abs(axes[2, 2]) < _LEVEL:
            raise RecordFault(UPRIGHT, f"tilted by {math.degrees(math.acos(abs(axes[2, 2]))):.0f} degrees")
        flat = gtsam.Pose2(pose.x(), pose.y(), math.atan2(axes[1, 0], axes[0, 0]))
        return cls(flat, bool(axes[2, 2] < 0.0), math.acos(min(abs(axes[2, 2]), 1.0)))


def scan_from(
    message: Any, mount: LaserMount, topic: str, repeated: RepeatedRange, unit: float = 1.0
) -> LaserScan:
    """A scan with counter-clockwise beams, as seen from above the robot.

    Of a MultiEchoLaserScan, the nearest valid echo of each beam is used, because glass is an obstacle. NaN
    and ranges below ``range_min`` are invalid, if ``range_min`` is below ``range_max``; ranges from
    ``range_max`` on and ``inf`` hit nothing (REP-117). The stamp is that of the first beam. Times are divided
    by ``unit``.

    Raises
    ------
    RecordFault
        There are no beams or no valid ones, or the angles are impossible.
    """
    ranges_m = _ranges(message)
    start_rad, step_rad = float(message.angle_min), float(message.angle_increment)
    beam_s = float(message.time_increment) / unit
    if not ranges_m.size:
        raise RecordFault(ZERO_BEAMS, topic)
    span = abs(step_rad) * (ranges_m.size - 1)
    wide = span <= _TURN_RAD + ANGLE_TOLERANCE_RAD and (span > 0.0 or ranges_m.size == 1)
    if not (abs(start_rad) <= 2.0 * _TURN_RAD and wide):
        raise RecordFault(BAD_ANGLES, f"{start_rad} and {step_rad} for {ranges_m.size} beams")
    stated_m, least_m = _shortest_decimal(message.range_max), _shortest_decimal(message.range_min)
    limit_m = stated_m if 0.0 < stated_m < math.inf else DEFAULT_NO_RETURN_M
    ranges_m = np.where(ranges_m < least_m, np.nan, ranges_m) if 0.0 < least_m < limit_m else ranges_m
    classified, limit_m = classify_ranges(ranges_m, limit_m, repeated)
    if np.isnan(classified).all():
        raise RecordFault(NO_VALID_RANGE, f"{classified.size} beams")
    if mount.inverted:
        start_rad, step_rad = -start_rad, -step_rad
    if step_rad < 0.0:
        start_rad, step_rad = start_rad + step_rad * (classified.size - 1), -step_rad
        beam_s = -beam_s
        classified = np.ascontiguousarray(classified[::-1])
    return LaserScan(
        stamp_s=stamp_of(message.header),
        ranges_m=classified,
        start_angle_rad=start_rad,
        step_rad=step_rad,
        range_max_m=limit_m,
        T_base_laser=mount.T_base_laser,
        sensor=topic,
        beam_s=beam_s if abs(beam_s) * classified.size <= GAP_S else 0.0,
    )


def _ranges(message: Any) -> FloatArray:
    """(N,) ranges; of several echoes the nearest valid one, NaN for a beam without any."""
    ranges = message.ranges
    if len(ranges) and hasattr(ranges[0], "echoes"):
        return np.array([min((one for one in beam.echoes if one > 0.0), default=math.nan) for beam in ranges])
    with np.errstate(invalid="ignore"):  # a signalling NaN of a damaged message
        wide: FloatArray = np.asarray(ranges, dtype=np.float64)
    return wide


def _shortest_decimal(single: Any) -> float:
    """The shortest decimal equal to a single-precision number: 5.6, not 5.599999904632568."""
    return float(str(np.float32(single)))
