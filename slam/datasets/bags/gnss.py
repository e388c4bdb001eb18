"""Converts NavSatFix messages to fixes of a GNSS receiver."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from slam.datasets.bags.decoding import stamp_of
from slam.datasets.dataset import RecordFault
from slam.measurements import GnssFix, Measurement

NO_FIX = "GNSS message without a fix"


def gnss_reader(topic: str, T_base_antenna: gtsam.Pose3 | None) -> Callable[[Any], Measurement]:
    """A function that reads messages of a topic.

    Parameters
    ----------
    T_base_antenna
        Pose by tf; None if tf does not contain it.
    """
    antenna_m = None if T_base_antenna is None else np.asarray(T_base_antenna.translation())

    def read(message: Any) -> GnssFix:
        """A fix; RecordFault if there is none, as in a tunnel."""
        position = float(message.latitude), float(message.longitude), float(message.altitude)
        on_earth = np.isfinite(position).all() and abs(position[0]) <= 90.0 and abs(position[1]) <= 360.0
        if message.status.status < 0 or not on_earth or position[:2] == (0.0, 0.0):
            raise RecordFault(NO_FIX, f"status {message.status.status}, {position}")
        covariance = np.array(message.position_covariance, dtype=np.float64).reshape(3, 3)
        # Type 0 means unknown (sensor_msgs).
        is_stated = message.position_covariance_type > 0 and np.isfinite(covariance).all()
        is_valid = bool(is_stated) and np.linalg.eigvalsh(covariance)[0] > 0.0
        stamp_s = stamp_of(message.header)
        return GnssFix(stamp_s, *position, covariance if is_valid else None, antenna_m, topic)

    return read
