"""What the doctor keeps of a log: all that the wheels tell, and short stretches of scans spread over it."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from fusion.estimation import FEWEST
from slam.datasets.corrections import Unwound
from slam.datasets.dataset import Thinned
from slam.doctor.camera_samples import CameraSamples
from slam.doctor.cloud_samples import CloudSamples
from slam.doctor.floor import LEVER_M
from slam.doctor.imu import ImuSamples, rising
from slam.doctor.repeats import Repeats
from slam.measurements import (
    FloatArray,
    ImuReading,
    LaserScan,
    Measurement,
    PointCloud,
    RgbdFrame,
    WheelOdometry,
)

# Scans of a stretch lie no nearer: a robot hardly moves between.
SPACING_S = 0.1
_STRETCHES = 2 * FEWEST


@dataclass(slots=True)
class WheelSamples:
    """One set of wheels: every reading, stamps as they came."""

    _rows: array[float] = field(default_factory=lambda: array("d"))
    count: int = 0
    _heading: Unwound = field(default_factory=Unwound)

    def add(self, reading: WheelOdometry) -> None:
        """Take the next reading."""
        pose = reading.T_odom_base
        self.count += 1
        self._rows.extend(
            (reading.stamp_s, pose.x(), pose.y(), self._heading.of(reading.stamp_s, pose.theta()))
        )

    def rows(self) -> FloatArray:
        """(N, 4) stamp, x, y, heading unwound; stamps rise, a reading older than one before is left out."""
        return rising(np.array(self._rows).reshape(-1, 4))


@dataclass(slots=True)
class LidarSamples:
    """One lidar: stretches of scans spread evenly over the log, and how often a scan was the one before.

    Attributes
    ----------
    stretches
        Lists of scans, each within a few seconds.
    count, repeats, undated
        Scans in all, those that are the one before to the bit, and others that are stamped no later than it.
    interval_s
        From scan to scan.
    """

    stretches: list[list[LaserScan]] = field(default_factory=list)
    count: int = 0
    repeats: Repeats = field(default_factory=Repeats)
    undated: int = 0
    interval_s: Thinned = field(default_factory=Thinned)
    _open: list[LaserScan] = field(default_factory=list)
    _stride: int = 1
    _begun: int = 0
    _newest: LaserScan | None = None

    def add(self, scan: LaserScan) -> None:
        """Take the next scan."""
        self.count += 1
        # Few beams may well meet the same again, as those of a robot that a post goes along with.
        sees = 2 * np.count_nonzero(np.isfinite(scan.ranges_m)) > scan.ranges_m.size
        if sees and self.repeats.take(self._newest, scan):
            return
        if self._newest is not None:
            self.interval_s.add(scan.stamp_s - self._newest.stamp_s)
            self.undated += scan.stamp_s <= self._newest.stamp_s
        self._newest = scan
        if self._open:
            since_s = scan.stamp_s - self._open[-1].stamp_s
            if 0.0 <= since_s < SPACING_S:
                return
            if not 0.0 <= since_s < FEWEST * SPACING_S or len(self._open) >= FEWEST:
                self.close()
        self._open.append(scan)

    def close(self) -> None:
        """End a stretch: every so many of them are kept, so that they are spread over the log."""
        if self._begun % self._stride == 0 and len(self._open) > 1:
            self.stretches.append(self._open)
        self._begun += 1
        self._open = []
        if len(self.stretches) > _STRETCHES:
            del self.stretches[1::2]
            self._stride *= 2


@dataclass(frozen=True, slots=True)
class Samples:
    """All of a log, by the sensors' names."""

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
            compared = samples.wheels or samples.imus or clouds.T_base_lidar.z() > LEVER_M
            clouds.close(compared=bool(compared))
        return samples
