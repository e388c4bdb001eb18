"""Wheels and a lidar that are compared."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam

from fusion.estimation import half_interval
from slam.doctor.finding import Remedy
from slam.measurements import FloatArray, LaserScan

# Lengths, angles and mountings in order are off by no more: shares and radians. The wheels of the two real
# logs are off by up to 0.044 of the way, those of simulated drives by up to 0.03.
IN_ORDER = 0.06


@dataclass(frozen=True, slots=True)
class Pair:
    """What is compared.

    Attributes
    ----------
    wheels, lidar
        Names of the sensors.
    rows
        (N, 4) readings of the wheels.
    stretches
        Scans of the lidar.
    range_scale
        What their ranges have been multiplied by to be a lidar's at all.
    handed
        As `slam.doctor.imu.handed`; 0 without an IMU.
    """

    wheels: str
    lidar: str
    rows: FloatArray
    stretches: list[list[LaserScan]]
    range_scale: float = 1.0
    handed: float = 0.0

    @property
    def mounting(self) -> gtsam.Pose2:
        """Of the lidar, as stated."""
        return self.stretches[0][0].T_base_laser

    def of_wheels(self, **entries: Any) -> Remedy:
        """A remedy for the wheels."""
        return {"wheels": {self.wheels: entries}}

    def of_lidar(self, **entries: Any) -> Remedy:
        """A remedy for the lidar."""
        return {"lidars": {self.lidar: entries}}


def interval(value: float, sigma: float) -> tuple[float, float]:
    """95 % of a normal distribution."""
    half = half_interval(sigma)
    return value - half, value + half
