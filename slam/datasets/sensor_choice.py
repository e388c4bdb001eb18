"""Chooses the sensors of a log from its first seconds, and explains why others are not used."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import groupby

from slam.config.stages import SensorsConfig
from slam.datasets.corrections import corrected, left_out
from slam.datasets.dataset import ReadReport
from slam.measurements import (
    GnssFix,
    ImuReading,
    LaserScan,
    Measurement,
    PointCloud,
    RgbdFrame,
    WheelOdometry,
)

_LOOK_S = 3.0
_LOOK_COUNT = 1000
_LATE = f"it begins later than the first {_LOOK_S:g} s of the log, which decide what leads"
_KINDS = {
    LaserScan: "2D lidar",
    PointCloud: "3D lidar",
    RgbdFrame: "RGB-D camera",
    WheelOdometry: "wheels",
    ImuReading: "IMU",
    GnssFix: "GNSS",
}


@dataclass(frozen=True, slots=True)
class SensorUse:
    """A sensor or topic of a log, and its use.

    Attributes
    ----------
    sensor, kind
        Its name and type; the record type if it was not read.
    readings
        Number of readings in the log.
    why_not
        Why it is not used; empty if it is used.
    """

    sensor: str
    kind: str
    readings: int
    why_not: str = ""

    @property
    def text(self) -> str:
        """Name, type and count as text."""
        return f"{self.sensor} ({self.kind}, {self.readings:,})"


@dataclass(frozen=True, slots=True)
class SensorChoice:
    """How a log is mapped.

    Attributes
    ----------
    spatial
        Whether the robot is a camera that moves freely, rather than a vehicle on a floor.
    cameras
        Names of the RGB-D cameras that are used, in the order in which they appear.
    cloud
        Whether a 3D lidar is used for mapping.
    wheels
        Name of the odometry that is used (the first in the log); empty if there is none.
    imu
        Name of the IMU that is used: the first in the log, preferably one with a known mounting; empty if
        there is none.
    gnss
        Name of the GNSS receiver that georeferences the map (the first in the log); empty if there is none.
    """

    spatial: bool
    cameras: tuple[str, ...]
    cloud: bool = False
    wheels: str = ""
    imu: str = ""
    gnss: str = ""
    config: SensorsConfig = field(default_factory=SensorsConfig)

    @classmethod
    def of(cls, log: Iterable[Measurement], config: SensorsConfig) -> SensorChoice:
        """Choose by the settings, or else by the first seconds."""
        beginning = _Beginning()
        for measurement in UsedMeasurements(log, config):
            if not beginning.add(measurement):
                break
        return beginning.choice(config)

    def used(self, log: Iterable[Measurement]) -> Iterator[Measurement]:
        """The measurements of a log in order, without those of unused sensors."""
        for item in UsedMeasurements(log, self.config):
            # Excluded wheels still get poses; two mixed odometries would be useless.
            if isinstance(item, WheelOdometry) and item.sensor != (self.wheels or item.sensor):
                continue
            if not isinstance(item, ImuReading | GnssFix) or not self.why_not(type(item), item.sensor):
                yield item

    def why_not(self, kind: type, sensor: str) -> str:
        """Why a sensor of a measurement type is not used; empty if it is used."""
        if left_out(self.config.calibration, kind, sensor):
            return "the calibration leaves it out"
        if kind is RgbdFrame:
            return self._why_not_camera(sensor)
        if kind is WheelOdometry:
            return self._why_not_wheels(sensor)
        if kind is ImuReading:
            return self._why_not_imu(sensor)
        if kind is GnssFix:
            other = sensor != (self.gnss or sensor)
            return f"one receiver is used, {self.gnss}; --topics takes another" if other else ""
        if kind not in _KINDS:
            return ""
        if not self.config.lidar:
            return "sensors.lidar=false leaves it out"
        if kind is LaserScan:
            leader = "a 3D lidar" if self.cloud else "a camera" if self.spatial else ""
            return leader and f"{leader} leads in 3D; --set sensors.motion=planar maps by this scanner"
        if self.cloud:
            return ""
        if self.spatial:
            return _LATE
        return "a robot on a floor is led by its 2D lidar; --set sensors.motion=spatial maps by this 3D lidar"

    def _why_not_camera(self, sensor: str) -> str:
        """See `why_not`, for a camera."""
        if not self.config.rgbd:
            return "sensors.rgbd=false leaves it out"
        if not self.cameras:
            return _LATE
        if self.spatial and not self.cloud and sensor != self.cameras[0]:
            return f"in 3D only the first camera is used, {self.cameras[0]}; --topics takes others"
        return ""

    def _why_not_imu(self, sensor: str) -> str:
        """See `why_not`, for an IMU."""
        if not self.config.imu:
            return "sensors.imu=false leaves it out"
        if sensor != self.imu:
            return f"one IMU is used, {self.imu}; --topics takes another" if self.imu else _LATE
        return ""

    def _why_not_wheels(self, sensor: str) -> str:
        """See `why_not`, for wheel odometry."""
        if not self.config.wheels:
            return "sensors.wheels=false (--no-odometry) leaves it out"
        if self.spatial and not self.cloud:
            return "a camera leads in 3D; --set sensors.motion=planar uses wheels"
        if self.wheels and sensor != self.wheels:
            return f"one odometry is used, {self.wheels}; --topics takes another"
        return ""


@dataclass(slots=True)
class _Beginning:
    """The sensors of the first seconds of a log."""

    cameras: dict[str, None] = field(default_factory=dict)
    wheels: str = ""
    imus: dict[str, bool] = field(default_factory=dict)
    gnss: str = ""
    kinds: set[type] = field(default_factory=set)
    first_s: float | None = None
    count: int = 0

    def add(self, measurement: Measurement) -> bool:
        """Add the next measurement; returns whether later ones still belong to the first seconds."""
        self.first_s = measurement.stamp_s if self.first_s is None else self.first_s
        self.kinds.add(type(measurement))
        if isinstance(measurement, RgbdFrame):
            self.cameras[measurement.sensor] = None
        elif isinstance(measurement, WheelOdometry):
            self.wheels = self.wheels or measurement.sensor
        elif isinstance(measurement, ImuReading):
            self.imus[measurement.sensor] = measurement.T_base_imu is not None
            # IMU readings come at hundreds of hertz and would fill the buffer.
            self.count -= 1
        elif isinstance(measurement, GnssFix):
            self.gnss = self.gnss or measurement.sensor
        self.count += 1
        return measurement.stamp_s - self.first_s <= _LOOK_S and self.count <= _LOOK_COUNT

    def choice(self, config: SensorsConfig) -> SensorChoice:
        """The choice by the settings, or else by the sensors found."""
        vehicle = not self.kinds.isdisjoint({LaserScan, WheelOdometry})
        spatial = config.motion == "spatial"
        cloud = spatial
        if config.motion == "auto":
            spatial, cloud = bool(self.cameras) and not vehicle, LaserScan not in self.kinds
        imu = max(self.imus, key=self.imus.__getitem__, default="")
        cloud = cloud and PointCloud in self.kinds
        return SensorChoice(spatial, tuple(self.cameras), cloud, self.wheels, imu, self.gnss, config)


@dataclass(slots=True)
class SensorTally:
    """Counts the readings of every sensor while a log is read.

    Attributes
    ----------
    choice
        How the log is mapped; None: chosen from the first seconds by the settings.
    """

    choice: SensorChoice | None = None
    config: SensorsConfig = field(default_factory=SensorsConfig)
    counts: Counter[tuple[type, str]] = field(default_factory=Counter)

    def counted(self, log: Iterable[Measurement]) -> Iterator[Measurement]:
        """The unchanged log, while its readings are counted."""
        beginning = _Beginning() if self.choice is None else None
        try:
            for measurement in log:
                self.counts[type(measurement), measurement.sensor] += 1
                if beginning is not None and not beginning.add(measurement):
                    self.choice, beginning = beginning.choice(self.config), None
                yield measurement
        finally:
            if beginning is not None:
                self.choice = beginning.choice(self.config)

    def uses(self, report: ReadReport, unused: Mapping[str, str] | None = None) -> list[SensorUse]:
        """The use of everything in the log: sensors by name, then what was not read.

        Parameters
        ----------
        unused
            Why the run could not use a sensor that was chosen, by name.
        """
        assert self.choice is not None
        known = [
            SensorUse(
                sensor,
                _KINDS.get(kind, kind.__name__),
                count,
                self.choice.why_not(kind, sensor) or (unused or {}).get(sensor, ""),
            )
            for (kind, sensor), count in sorted(self.counts.items(), key=lambda item: item[0][1])
        ]
        why_not = {use.sensor: use.why_not for use in known}
        rest = [
            (name, count, why_not.get(report.part_of.get(name, ""), ""))
            for name, count in report.beside.items()
        ]
        rest += [
            (name, count, report.reasons.get(name, "nothing reads it"))
            for name, count in report.ignored.items()
        ]
        return known + [SensorUse(*_name_and_kind(name), count, why) for name, count, why in sorted(rest)]


@dataclass(frozen=True, slots=True)
class UsedMeasurements:
    """The corrected measurements of a log, without excluded types."""

    log: Iterable[Measurement]
    config: SensorsConfig

    def __iter__(self) -> Iterator[Measurement]:
        """Iterate from the start, each time."""
        for measurement in corrected(self.log, self.config.calibration):
            if isinstance(measurement, RgbdFrame):
                if self.config.rgbd:
                    yield measurement
            elif self.config.lidar or not isinstance(measurement, LaserScan | PointCloud):
                yield measurement


def use_lines(uses: Iterable[SensorUse]) -> list[str]:
    """The use of sensors as text: one line for the used ones, one for each reason why others are not."""
    by_reason = groupby(sorted(uses, key=lambda use: use.why_not), key=lambda use: use.why_not)
    return [
        (f"not used, because {reason}: " if reason else "used: ") + ", ".join(use.text for use in group)
        for reason, group in by_reason
    ]


def _name_and_kind(text: str) -> tuple[str, str]:
    """A topic and its type from a reader's key; a record type stands for both."""
    name, opened, kind = text.partition(" (")
    return name, kind.removesuffix(")") if opened else "record"
