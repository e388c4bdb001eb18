"""Data of a log for the doctor: all wheel readings, and short stretches of scans spread over the log."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from fusion.estimation import FEWEST
from slam.datasets.corrections import Unwound
from slam.datasets.dataset import Thinned
from slam.doctor.camera_samples import CameraSamples
from slam.doctor.cloud_samples import CloudSamples
from slam.doctor.finding import Finding
from slam.doctor.floor import LEVER_M
from slam.doctor.imu import ImuSamples, rising
from slam.doctor.stretches import Repeats
from slam.measurements import (
    FloatArray,
    ImuReading,
    LaserScan,
    Measurement,
    PointCloud,
    RgbdFrame,
    WheelOdometry,
)

# Minimum interval of scans in a stretch: a robot hardly moves within it.
SPACING_S = 0.1
_STRETCHES = 2 * FEWEST


@dataclass(slots=True)
class WheelSamples:
    """All readings of one wheel odometry, with their original stamps."""

    _rows: array[float] = field(default_factory=lambda: array("d"))
    count: int = 0
    _heading: Unwound = field(default_factory=Unwound)

    def add(self, reading: WheelOdometry) -> None:
        """Add the next reading."""
        pose = reading.T_odom_base
        self.count += 1
        self._rows.extend(
            (reading.stamp_s, pose.x(), pose.y(), self._heading.of(reading.stamp_s, pose.theta()))
        )

    def rows(self) -> FloatArray:
        """(N, 4) stamp, x, y, unwrapped heading, with increasing stamps; older readings are skipped."""
        return rising(np.array(self._rows).reshape(-1, 4))


@dataclass(slots=True)
class LidarSamples:
    """Samples of one lidar: stretches of scans spread evenly over the log, and the number of repeats.

    Attributes
    ----------
    stretches
        Lists of scans of a few seconds each.
    count, repeats, undated, alternating
        Numbers of scans, of bit-identical repeats, of other scans whose stamp is not later, and of those
        among the first that resemble the last but one, not the last.
    """

    stretches: list[list[LaserScan]] = field(default_factory=list)
    count: int = 0
    repeats: Repeats = field(default_factory=Repeats)
    undated: int = 0
    alternating: int = 0
    interval_s: Thinned = field(default_factory=Thinned)
    _open: list[LaserScan] = field(default_factory=list)
    _stride: int = 1
    _begun: int = 0
    _newest: LaserScan | None = None
    _before: LaserScan | None = None

    def add(self, scan: LaserScan) -> None:
        """Add the next scan."""
        self.count += 1
        # With few returns, equal scans are no repeat: these may come from the robot's own parts.
        sees = 2 * np.count_nonzero(np.isfinite(scan.ranges_m)) > scan.ranges_m.size
        if sees and self.repeats.take(self._newest, scan):
            return
        if self._newest is not None:
            self.interval_s.add(scan.stamp_s - self._newest.stamp_s)
            self.undated += scan.stamp_s <= self._newest.stamp_s
        if self._before is not None and self.count <= _STRETCHES:
            last_m, before_m = _apart_m(scan, self._newest), _apart_m(scan, self._before)
            self.alternating += 2.0 * before_m < last_m
        self._before, self._newest = self._newest, scan
        if self._open:
            since_s = scan.stamp_s - self._open[-1].stamp_s
            if 0.0 <= since_s < SPACING_S:
                return
            if not 0.0 <= since_s < FEWEST * SPACING_S or len(self._open) >= FEWEST:
                self.close()
        self._open.append(scan)

    def close(self) -> None:
        """End a stretch; stretches are thinned so that they are spread over the log."""
        if self._begun % self._stride == 0 and len(self._open) > 1:
            self.stretches.append(self._open)
        self._begun += 1
        self._open = []
        if len(self.stretches) > _STRETCHES:
            del self.stretches[1::2]
            self._stride *= 2

    def mixed(self, name: str) -> list[Finding]:
        """Report it if two scanners take turns under one name."""
        if self.alternating < FEWEST:
            return []
        text = "two scanners share its name: every second scan resembles the last but one, not the last"
        effect = "the map mixes their views; write each with a name and a mounting of its own"
        return [Finding(name, "two scanners", text, effect)]


def _apart_m(scan: LaserScan, other: LaserScan | None) -> float:
    """Median difference of the ranges that two scans have; infinite if they differ in their beams."""
    if other is None or scan.ranges_m.size != other.ranges_m.size:
        return math.inf
    both = np.isfinite(scan.ranges_m) & np.isfinite(other.ranges_m)
    return float(np.median(np.abs(scan.ranges_m[both] - other.ranges_m[both]))) if both.any() else math.inf


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples of a whole log, by sensor name."""

    wheels: dict[str, WheelSamples]
    lidars: dict[str, LidarSamples]
    cameras: dict[str, CameraSamples]
    clouds: dict[str, CloudSamples]
    imus: dict[str, ImuSamples]

    @classmethod
    def of(cls, log: Iterable[Measurement]) -> Samples:
        """Read a log once."""
        samples = cls({}, {}, {}, {}, {})
        for measurement in log:
            if isinstance(measurement, LaserScan):
                samples.lidars.setdefault(measurement.sensor, LidarSamples()).add(measurement)
            elif isinstance(measurement, WheelOdometry):
                samples.wheels.setdefault(measurement.sensor, WheelSamples()).add(measurement)
            elif isinstance(measurement, RgbdFrame):
                camera = samples.cameras.setdefault(measurement.sensor, CameraSamples())
                camera.add(measurement, compared=bool(samples.wheels))
            elif isinstance(measurement, PointCloud):
                clouds = samples.clouds.setdefault(measurement.sensor, CloudSamples())
                clouds.add(measurement)
            elif isinstance(measurement, ImuReading):
                samples.imus.setdefault(measurement.sensor, ImuSamples()).add(measurement)
        for lidar in samples.lidars.values():
            lidar.close()
        for clouds in samples.clouds.values():
            tilted = clouds.T_base_lidar.z() > LEVER_M and not clouds.stands
            clouds.close(compared=bool(samples.wheels or samples.imus or tilted))
        return samples
