"""Deskews scans of a 2D lidar that spins while the robot moves."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import gtsam
import numpy as np

from fusion.time_alignment import GAP_S
from slam.config.calibration import LidarCorrection
from slam.datasets.corrections_in_space import turn_times
from slam.datasets.wheels_between import WHEELS_KEPT
from slam.measurements import FloatArray, LaserScan, Measurement, WheelOdometry

# Neighbours that are farther apart, in steps across the beam, are not on one surface.
_STEEPEST = 10


def straightened(log: Iterable[Measurement], lidars: Mapping[str, LidarCorrection]) -> Iterator[Measurement]:
    """Deskew the scans of some lidars by wheel odometry; without wheels, they remain unchanged.

    A scan and everything after it wait for the wheel odometry at the end of its revolution.

    Parameters
    ----------
    lidars
        By name, each with its ``turn_s`` and ``cut_deg``; the stamp of a scan is the middle of its
        revolution, or its first beam if it has ``beam_s``.
    """
    wheels, waiting = deque[WheelOdometry](maxlen=WHEELS_KEPT), deque[Measurement]()

    def ready(first: Measurement) -> Measurement:
        if not isinstance(first, LaserScan) or (lidar := lidars.get(first.sensor)) is None:
            return first
        twist = _twist(wheels, first.stamp_s + middle_s(first), 0.5 * abs(lidar.turn_s))
        return first if twist is None else straight(first, twist, lidar.turn_s, math.radians(lidar.cut_deg))

    def waits(first: Measurement, now_s: float) -> bool:
        if not isinstance(first, LaserScan) or (lidar := lidars.get(first.sensor)) is None:
            return False
        covered = wheels and wheels[-1].stamp_s >= first.stamp_s + middle_s(first) + 0.5 * abs(lidar.turn_s)
        return not covered and now_s <= first.stamp_s + GAP_S and len(waiting) <= WHEELS_KEPT

    for measurement in log:
        if isinstance(measurement, WheelOdometry) and (not wheels or measurement.sensor == wheels[0].sensor):
            wheels.append(measurement)
        waiting.append(measurement)
        while waiting and not waits(waiting[0], measurement.stamp_s):
            yield ready(waiting.popleft())
    yield from map(ready, waiting)


def straight(scan: LaserScan, twist: FloatArray, turn_s: float, cut_rad: float) -> LaserScan:
    """Deskew a scan to its stamp, with unchanged bearings.

    Parameters
    ----------
    twist
        (3,) motion of the base per second, in GTSAM's tangent space.
    turn_s, cut_rad
        As for `turn_times`.
    """
    twist = scan.T_base_laser.inverse().AdjointMap() @ twist
    bearings, hit = scan.bearings_rad(), np.isfinite(scan.ranges_m)
    ranges_m = np.where(hit, scan.ranges_m, scan.range_max_m).astype(np.float64)
    times_s = turn_times(np.column_stack([np.cos(bearings), np.sin(bearings)]), turn_s, cut_rad)
    times_s += middle_s(scan)
    # As complex numbers: translated along the chord, rotated by the full angle.
    turned_rad = twist[2] * times_s
    shift = times_s * complex(twist[0], twist[1]) * np.exp(0.5j * turned_rad)
    placed = shift + ranges_m * np.exp(1j * (bearings + turned_rad))
    far_m, angles = np.abs(placed), bearings + np.angle(placed * np.exp(-1j * bearings))
    # One revolution, extended by its end before and its start after it.
    order = np.argsort(angles, kind="stable")
    angles, order = np.concatenate([angles[order] + lap * math.tau for lap in (-1, 0, 1)]), np.tile(order, 3)
    after = np.clip(np.searchsorted(angles, bearings), 1, len(angles) - 1)
    ends = np.stack([after - 1, after])
    gaps = np.abs(angles[ends] - bearings)
    near_m, other = far_m[order[ends]]
    step_rad = abs(scan.step_rad)
    on_one = hit[order[ends]].all(axis=0)
    on_one &= np.abs(other - near_m) < _STEEPEST * step_rad * np.minimum(near_m, other)
    # Interpolate inverse range linearly, as for a straight wall.
    with np.errstate(divide="ignore", invalid="ignore"):
        between_m = near_m * other * gaps.sum(axis=0) / (gaps[0] * near_m + gaps[1] * other)
    nearest = order[np.where(gaps[0] < gaps[1], after - 1, after)]
    ranges = np.where(hit, far_m, scan.ranges_m)[nearest]
    ranges = np.where(on_one & np.isfinite(between_m), between_m, ranges)
    ranges[gaps.min(axis=0) > step_rad] = np.nan
    return replace(scan, ranges_m=ranges.astype(np.float32), beam_s=0.0)


def middle_s(scan: LaserScan) -> float:
    """Time from the stamp of a scan to the middle of its revolution."""
    return 0.5 * abs(scan.beam_s) * (scan.ranges_m.size - 1)


def _twist(wheels: Iterable[WheelOdometry], stamp_s: float, half_s: float) -> FloatArray | None:
    """(3,) motion of the base per second over a revolution; None without wheel odometry at that time."""
    before = [wheel for wheel in wheels if wheel.stamp_s <= stamp_s - half_s]
    after = [wheel for wheel in wheels if wheel.stamp_s >= stamp_s + half_s]
    if not (before and after) or (span_s := after[0].stamp_s - before[-1].stamp_s) > GAP_S:
        return None
    step = before[-1].T_odom_base.between(after[0].T_odom_base)
    return np.asarray(gtsam.Pose2.Logmap(step)) / span_s
