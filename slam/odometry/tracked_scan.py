"""Pose of a scan, and what measured it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.estimates import MotionEstimate
from slam.measurements import FloatArray
from slam.odometry.gyro_yaw import GyroMoment
from slam.odometry.wheel_tracker import WheelMoment


@dataclass(frozen=True, slots=True)
class TrackedScan:
    """Pose of a scan in the odometry frame.

    Attributes
    ----------
    pose
        (3,) x, y, yaw of the base.
    motion
        The lidar match; None if nothing fits and the pose is dead reckoning.
    wheels
        Pose of the robot by the wheels alone; None without wheels.
    dispute
        (3, 3) covariance added to the match's if wheels contradict it and neither is much more likely; zero
        otherwise.
    gyro
        Rotation of the gyroscope so far; None without one.
    """

    pose: FloatArray
    motion: MotionEstimate | None
    wheels: WheelMoment | None
    dispute: FloatArray
    gyro: GyroMoment | None = None

    @property
    def open(self) -> bool:
        """Return whether the lidar matched with an undetermined direction, as along a corridor."""
        return self.motion is not None and self.motion.degenerate

    @property
    def determined(self) -> bool:
        """Return whether it matched in all directions."""
        return self.motion is not None and not self.open

    @property
    def confident(self) -> bool:
        """Return whether the lidar matched without contradiction; the first scan, the origin, is certain."""
        return not np.count_nonzero(self.dispute) and (self.motion is not None or not self.pose.any())
