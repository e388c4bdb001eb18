"""What of a log is used: its first seconds are looked at before the run decides."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from slam.config.stages import SensorsConfig
from slam.datasets.corrections import corrected
from slam.measurements import LaserScan, Measurement, PointCloud, RgbdFrame, WheelOdometry

_LOOK_S = 3.0
_LOOK_COUNT = 1000


@dataclass(frozen=True, slots=True)
class SensorChoice:
    """How a log is mapped.

    Attributes
    ----------
    spatial
        Whether the robot is a camera that moves freely, not a vehicle on a floor.
    cameras
        Names of the RGB-D cameras that are used, in the order in which they appear.
    cloud
        Whether a 3D lidar makes the map.
    """

    spatial: bool
    cameras: tuple[str, ...]
    cloud: bool = False

    @classmethod
    def of(cls, log: Iterable[Measurement], config: SensorsConfig) -> SensorChoice:
        """Choose by configuration, and else by what the first seconds hold."""
        cameras: dict[str, None] = {}
        vehicle = scans = clouds = False
        first_s: float | None = None
        for count, measurement in enumerate(used_measurements(log, config)):
            first_s = measurement.stamp_s if first_s is None else first_s
            if isinstance(measurement, RgbdFrame):
                cameras[measurement.sensor] = None
            vehicle |= isinstance(measurement, LaserScan | WheelOdometry)
            scans |= isinstance(measurement, LaserScan)
            clouds |= isinstance(measurement, PointCloud)
            if measurement.stamp_s - first_s > _LOOK_S or count > _LOOK_COUNT:
                break
        spatial = bool(cameras) and not vehicle if config.motion == "auto" else config.motion == "spatial"
        cloud = clouds and (config.motion == "spatial" or (config.motion == "auto" and not scans))
        return cls(spatial, tuple(cameras), cloud)


def used_measurements(log: Iterable[Measurement], config: SensorsConfig) -> Iterator[Measurement]:
    """The measurements of a log as they are corrected, without those of sensors that are not used."""
    for measurement in corrected(log, config.calibration):
        if isinstance(measurement, RgbdFrame):
            if config.rgbd:
                yield measurement
        elif config.lidar or not isinstance(measurement, LaserScan | PointCloud):
            yield measurement
