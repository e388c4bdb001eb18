"""Motion from the first pose of a 3D lidar, in the middle of a revolution, back to its stamp in the log."""

from __future__ import annotations

import gtsam
import numpy as np

from slam.measurements import FloatArray
from slam.odometry.cloud_tracker import FirstMap
from slam.odometry.imu_readings import GYRO_UNKNOWN
from slam.odometry.imu_tracker import ImuTracker


class BeforeFirst:
    """The motion as far as it is known: there is no pose before it.

    Attributes
    ----------
    offset, off
        (6,) the motion, GTSAM's tangent, NaN where only later poses show it; how far it may be off.
    """

    def __init__(self, first: FirstMap) -> None:
        self.offset, self.off = np.full(6, np.nan), np.zeros(6)
        self._first, self._span_s, self._settled = first, (0.0, 0.0), False

    def begin(self, reported_s: float, stamp_s: float, twist: FloatArray) -> None:
        """Take stamp and pose time of the first cloud, and its twist (6,); its change may just have begun."""
        self._span_s, late_s = (reported_s, stamp_s), stamp_s - reported_s
        self.off = late_s**2 * self._first.change
        if self._first.twist is not None:
            self.offset = 0.5 * self.off - late_s * twist

    def see(self, imu: ImuTracker) -> None:
        """Take the rotation by a gyroscope, until its bias is known; an error of its scale remains."""
        if not self._settled and (turn := imu.turned_between(*self._span_s)) is not None:
            self._settled = imu.state is not None
            # Poses of clouds that a gyroscope has deskewed show more of the rest than the first twist.
            self.offset = np.append(gtsam.Rot3.Logmap(turn.inverse()), np.full(3, np.nan))
            self.off[:3] = GYRO_UNKNOWN[1, 1] * self.offset[:3]
