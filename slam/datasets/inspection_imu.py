"""What the readings of one IMU hold."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slam.measurements import FloatArray, ImuReading


@dataclass(slots=True)
class ImuFigures:
    """Running figures of one IMU."""

    last: ImuReading | None = None
    count: int = 0
    force_sum: FloatArray = field(default_factory=lambda: np.zeros(3))
    greatest_gyro_rad_s: float = 0.0
    greatest_force_m_s2: float = 0.0

    def add(self, reading: ImuReading) -> None:
        """One more reading."""
        self.count += 1
        self.force_sum = self.force_sum + reading.specific_force_m_s2
        self.greatest_gyro_rad_s = max(self.greatest_gyro_rad_s, float(np.abs(reading.gyro_rad_s).max()))
        force_m_s2 = float(np.abs(reading.specific_force_m_s2).max())
        self.greatest_force_m_s2 = max(self.greatest_force_m_s2, force_m_s2)
        self.last = reading

    def facts(self) -> dict[str, Any] | None:
        """Mean specific force in its frame, greatest readings of an axis, mounting; None before the first."""
        if self.last is None:
            return None
        mount = self.last.T_base_imu
        return {
            "mean_force_m_s2": (self.force_sum / self.count).tolist(),
            "greatest_gyro_rad_s": self.greatest_gyro_rad_s,
            "greatest_force_m_s2": self.greatest_force_m_s2,
            "mount_m": None if mount is None else mount.translation().tolist(),
            "mount_rpy_rad": None if mount is None else mount.rotation().rpy().tolist(),
        }
