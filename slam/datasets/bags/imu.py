"""Imu messages as readings of an inertial measurement unit."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np

from slam.datasets.bags.decoding import stamp_of
from slam.datasets.dataset import RecordFault
from slam.datasets.imu_units import ForceUnit
from slam.measurements import ImuReading

NOT_BOTH = "IMU message without turn rate or without acceleration"


@dataclass(slots=True)
class ImuReader:
    """Readings of one topic.

    Attributes
    ----------
    topic
        The name of the sensor.
    T_base_imu
        Its mounting; None where tf does not tell it.
    unit
        In which unit its accelerations are.
    """

    topic: str
    T_base_imu: gtsam.Pose3 | None
    unit: ForceUnit = field(default_factory=ForceUnit)

    def read(self, message: Any) -> ImuReading:
        """A reading.

        Raises
        ------
        RecordFault
            A number that is not finite, or one of the two sensors is missing: it reads zero on every axis,
            or its covariance begins with -1 (sensor_msgs).
        """
        gyro, force = (
            np.array([vector.x, vector.y, vector.z], dtype=np.float64)
            for vector in (message.angular_velocity, message.linear_acceleration)
        )
        missing = -1.0 in (message.angular_velocity_covariance[0], message.linear_acceleration_covariance[0])
        if missing or not np.isfinite([gyro, force]).all() or not force.any():
            raise RecordFault(NOT_BOTH, f"{gyro}, {force}")
        return ImuReading(stamp_of(message.header), gyro, self.unit.m_s2(force), self.T_base_imu, self.topic)
