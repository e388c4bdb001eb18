"""A pair of wheel odometry and lidar to compare."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam

from fusion.estimation import half_interval
from slam.doctor.finding import Remedy
from slam.measurements import FloatArray, LaserScan

# Maximum errors of correct lengths, angles and mountings: shares and radians. The wheels of the two real logs
# have errors up to 0.044 of the distance, those of simulated drives up to 0.03.
IN_ORDER = 0.06


@dataclass(frozen=True, slots=True)
class Pair:
    """The compared sensors.

    Attributes
    ----------
    rows
        (N, 4) readings of the wheels.
    stretches
        Scans of the lidar.
    range_scale
        Factor of their ranges, to be plausible for a lidar.
    handed
        See `slam.doctor.imu.handed`; 0 without an IMU.
    """

    wheels: str
    lidar: str
    rows: FloatArray
    stretches: list[list[LaserScan]]
    range_scale: float = 1.0
    handed: float = 0.0

    @property
    def mounting(self) -> gtsam.Pose2:
        """Stated pose of the lidar."""
        return self.stretches[0][0].T_base_laser

    def of_wheels(self, **entries: Any) -> Remedy:
        """A remedy for the wheels."""
        return {"wheels": {self.wheels: entries}}

    def of_lidar(self, **entries: Any) -> Remedy:
        """A remedy for the lidar."""
        return {"lidars": {self.lidar: entries}}


def interval(value: float, sigma: float) -> tuple[float, float]:
    """95 % interval of a normal distribution."""
    half = half_interval(sigma)
    return value - half, value + half
