"""Applies a calibration to the measurements of a log; no other place does this."""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import gtsam
import numpy as np

from fusion.time_alignment import GAP_S
from slam.config.calibration import Calibration, LidarCorrection, SensorCorrection, WheelCorrection
from slam.datasets.corrections_in_space import corrected_cloud, corrected_fix, corrected_frame, corrected_imu
from slam.datasets.late_depth import with_depth_in_time
from slam.datasets.spinning_scans import straightened
from slam.errors import DatasetError
from slam.matching.planar import wrap
from slam.measurements import (
    FloatArray,
    GnssFix,
    ImuReading,
    LaserScan,
    Measurement,
    PointCloud,
    RgbdFrame,
    WheelOdometry,
)

_RECENT = 4  # readings from which a rate is estimated
_REPEATED_RAD = math.radians(1.0)  # headings within this are the same one


def corrected(log: Iterable[Measurement], calibration: Calibration) -> Iterable[Measurement]:
    """The measurements of a log, corrected by a calibration.

    They come in the order of the log; if clocks are corrected, in that of the corrected stamps.

    Raises
    ------
    DatasetError
        At the end, if the calibration names a sensor that is not in the log; or if a lidar does not have the
        beams that the calibration excludes.
    """
    if calibration == Calibration():
        return log
    stream = _corrected_one_by_one(log, calibration)
    offsets_s = [correction.clock_offset_s for correction in _by_name(calibration).values()]
    late = {name: camera.depth_clock_offset_s for name, camera in calibration.cameras.items()}
    if any(late.values()):
        stream = with_depth_in_time(stream, late)
        offsets_s += [max(late.values()) + GAP_S]
    if any(offsets_s):
        stream = _in_time_order(stream, max([0.0, *offsets_s]) - min([0.0, *offsets_s]))
    spinning = {name: lidar for name, lidar in calibration.lidars.items() if lidar.turn_s}
    return straightened(stream, spinning) if spinning else stream


def left_out(calibration: Calibration, kind: type, sensor: str) -> bool:
    """Whether a calibration excludes a sensor, by type of measurement and name."""
    correction = _by_name(calibration).get((kind, sensor))
    return correction is not None and not correction.use


def _by_name(calibration: Calibration) -> dict[tuple[type, str], SensorCorrection]:
    """All corrections by measurement type and sensor name."""
    kinds: dict[type, dict[str, Any]] = {
        WheelOdometry: calibration.wheels,
        LaserScan: calibration.lidars,
        RgbdFrame: calibration.cameras,
        PointCloud: calibration.lidars_3d,
        ImuReading: calibration.imus,
        GnssFix: calibration.gnss,
    }
    return {(kind, name): fix for kind, sensors in kinds.items() for name, fix in sensors.items()}


def _corrected_one_by_one(log: Iterable[Measurement], calibration: Calibration) -> Iterator[Measurement]:
    """Correct each measurement separately, in the order of the log."""
    by_name, sensors = _by_name(calibration), dict[tuple[type, str], None]()
    correct: dict[type, Callable[[Any, Any], Any]] = {
        LaserScan: _corrected_scan,
        RgbdFrame: corrected_frame,
        PointCloud: corrected_cloud,
        ImuReading: corrected_imu,
        GnssFix: corrected_fix,
    }
    correctors: dict[tuple[type, str], Callable[[Any], Any]] = {
        key: _Wheels(one) if isinstance(one, WheelCorrection) else partial(correct[key[0]], one)
        for key, one in by_name.items()
    }
    newest: dict[tuple[type, str], Measurement] = {}
    for measurement in log:
        key = type(measurement), measurement.sensor
        sensors[key] = None
        correction = by_name.get(key)
        if correction is None:
            yield measurement
            continue
        if not correction.use or (correction.drop_repeated and repeats(newest.get(key), measurement)):
            continue
        newest[key] = measurement
        yield replace(correctors[key](measurement), stamp_s=measurement.stamp_s - correction.clock_offset_s)
    read_images = getattr(log, "read_images", True)
    for kind, name in by_name if read_images else ():
        if (kind, name) not in sensors:
            names = ", ".join(sorted(name for of_kind, name in sensors if of_kind is kind)) or "none"
            raise DatasetError(
                f"the calibration corrects '{name}', which the log does not hold; it has: {names}"
            )


def repeats(before: Measurement | None, now: Measurement) -> bool:
    """Whether a reading is bit-identical to the one before, which never happens for a sensor with noise.

    Also true for a cloud with the same stamp, or of the same revolution by another lidar.
    """
    if isinstance(before, LaserScan) and isinstance(now, LaserScan):
        return before.ranges_m.tobytes() == now.ranges_m.tobytes()
    if isinstance(before, RgbdFrame) and isinstance(now, RgbdFrame):
        # One repeated half is enough, unless it is empty.
        halves = ((before.color, now.color), (before.depth_m, now.depth_m))
        return any(np.array_equal(*half) and bool(np.ptp(half[0])) for half in halves)
    if isinstance(before, PointCloud) and isinstance(now, PointCloud):
        is_copy = before.stamp_s == now.stamp_s or np.array_equal(before.points_lidar, now.points_lidar)
        return is_copy or begins_early(before, now)
    if isinstance(before, ImuReading) and isinstance(now, ImuReading):
        same = np.array_equal(before.gyro_rad_s, now.gyro_rad_s)
        return same and np.array_equal(before.specific_force_m_s2, now.specific_force_m_s2)
    if isinstance(before, WheelOdometry) and isinstance(now, WheelOdometry):
        return before.T_odom_base.equals(now.T_odom_base, 0.0)
    return False


def begins_early(before: PointCloud, now: PointCloud) -> bool:
    """Whether a cloud starts before half of the previous revolution is over, so it is of another lidar."""
    times_s = before.times_s
    return times_s is not None and 0.0 < 2.0 * (now.stamp_s - before.stamp_s) < float(np.ptp(times_s))


class Unwound:
    """Removes jumps by full turns from written headings; a heading in degrees wraps often.

    The turn rate is extrapolated, because it changes by less than itself between readings. But after a jump
    by nearly half a turn, this would continue with a full turn for each reading of a robot that drives
    straight ahead. So a written heading that several readings in a row repeat has not turned.
    """

    def __init__(self) -> None:
        self._recent: deque[tuple[float, float]] = deque(maxlen=_RECENT)

    def of(self, stamp_s: float, wrapped_rad: float) -> float:
        """The heading of the next reading."""
        heading_rad = wrapped_rad
        if self._recent:
            last_s, expected_rad = last = self._recent[-1]
            since_s = stamp_s - last_s
            # The last step gives the rate, unless the stamps of two readings are almost equal.
            older = (angle for angle in reversed(self._recent) if 2.0 * (last_s - angle[0]) > since_s > 0.0)
            begun = next(older, None)
            repeated = all(abs(wrap(wrapped_rad - angle[1])) < _REPEATED_RAD for angle in self._recent)
            if begun and not (repeated and len(self._recent) == _RECENT):
                expected_rad += (last[1] - begun[1]) * since_s / (last_s - begun[0])
            heading_rad = expected_rad + wrap(wrapped_rad - expected_rad)
        self._recent.append((stamp_s, heading_rad))
        return heading_rad


def _corrected_scan(fix: LidarCorrection, scan: LaserScan) -> LaserScan:
    """Correct a scan of a lidar."""
    ranges = scan.ranges_m * np.float32(fix.range_scale)
    for first, last in fix.blocked_beams:
        if last >= ranges.size:
            raise DatasetError(
                f"the calibration leaves out beams {first} to {last} of '{scan.sensor}', "
                f"which has {ranges.size}"
            )
        ranges[first : last + 1] = np.nan
    if fix.floor is not None:
        ahead = np.cos(scan.bearings_rad() - math.radians(fix.floor.bearing_deg))
        ranges[scan.ranges_m * ahead > fix.floor.from_m] = np.nan
    start_rad = scan.start_angle_rad if fix.start_angle_deg is None else math.radians(fix.start_angle_deg)
    step_rad = scan.step_rad if fix.step_deg is None else math.radians(fix.step_deg)
    if fix.upside_down:
        start_rad, ranges = -(start_rad + step_rad * (ranges.size - 1)), ranges[::-1].copy()
        scan = replace(scan, beam_s=-scan.beam_s)
    mounting = fix.T_base_laser
    return replace(
        scan,
        ranges_m=ranges,
        start_angle_rad=start_rad,
        step_rad=step_rad,
        range_max_m=scan.range_max_m * fix.range_scale,
        T_base_laser=scan.T_base_laser
        if mounting is None
        else gtsam.Pose2(mounting.x_m, mounting.y_m, math.radians(mounting.yaw_deg)),
    )


class _Wheels:
    """Corrects readings of one wheel odometry."""

    def __init__(self, correction: WheelCorrection) -> None:
        self._correction = correction
        signs = {"-": -1.0}
        self._axes = np.zeros((2, 2))
        for row, name in enumerate(correction.axes.split()):
            self._axes[row, "xy".index(name[-1])] = signs.get(name[0], 1.0)
        self._heading = Unwound()
        self._last: FloatArray | None = None
        self._pose = np.zeros(3)

    def __call__(self, reading: WheelOdometry) -> WheelOdometry:
        fix, read = self._correction, reading.T_odom_base
        x, y = self._axes @ (read.x(), read.y())
        heading_rad = fix.heading_scale * self._heading.of(reading.stamp_s, read.theta())
        heading_rad += math.radians(fix.heading_offset_deg)
        written = np.array([fix.scale * x, fix.scale * y, heading_rad])
        if fix.mirrored:
            written[1:] = -written[1:]
        if fix.turn_scale != 1.0:
            written = self._driven(written)
        return replace(reading, T_odom_base=gtsam.Pose2(*written.tolist()))

    def _driven(self, written: FloatArray) -> FloatArray:
        """The trajectory recomposed from steps with scaled rotations."""
        if self._last is not None:
            turn_rad = float(written[2] - self._last[2])
            dx, dy = (written - self._last)[:2]
            # The chord of a step points halfway between the headings at its ends.
            chord_rad = math.atan2(dy, dx) - self._last[2] - 0.5 * turn_rad
            turn_rad *= self._correction.turn_scale
            ahead_rad = self._pose[2] + 0.5 * turn_rad + chord_rad
            path_m = math.hypot(dx, dy)
            step = np.array([path_m * math.cos(ahead_rad), path_m * math.sin(ahead_rad), turn_rad])
            self._pose = self._pose + step
        else:
            self._pose = written
        self._last = written
        return self._pose


def _in_time_order(stream: Iterable[Measurement], spread_s: float) -> Iterator[Measurement]:
    """Sort by corrected stamp, each sensor in its own order, with a delay up to the clock difference."""
    waiting: list[tuple[float, int, Measurement]] = []
    reached: dict[str, float] = {}
    newest_s = -math.inf
    for number, measurement in enumerate(stream):
        at_s = max(reached.get(measurement.sensor, -math.inf), measurement.stamp_s)
        reached[measurement.sensor] = at_s
        newest_s = max(newest_s, at_s)
        heapq.heappush(waiting, (at_s, number, measurement))
        while waiting[0][0] < newest_s - spread_s:
            yield heapq.heappop(waiting)[2]
    while waiting:
        yield heapq.heappop(waiting)[2]
