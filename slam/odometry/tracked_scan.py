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
    """Where a scan was taken, in the odometry frame.

    Attributes
    ----------
    pose
        (3,) x, y, yaw of the base.
    motion
        The lidar match; None if nothing fitted and the pose is dead reckoning.
    wheels
        Where the wheels alone say that the robot was; None without wheels.
    dispute
        (3, 3) covariance on top of the match's where wheels contradicted it and neither is likelier by far;
        zero otherwise.
    gyro
        How far the gyroscope had turned; None without one.
    """

    pose: FloatArray
    motion: MotionEstimate | None
    wheels: WheelMoment | None
    dispute: FloatArray
    gyro: GyroMoment | None = None

    @property
    def open(self) -> bool:
        """Whether the lidar matched, and left a direction open, as along a corridor."""
        return self.motion is not None and self.motion.degenerate

    @property
    def determined(self) -> bool:
        """Whether it matched in all directions."""
        return self.motion is not None and not self.open

    @property
    def confident(self) -> bool:
        """Whether the lidar matched and nothing contradicts it; the first scan is the origin, and sure."""
        return not np.count_nonzero(self.dispute) and (self.motion is not None or not self.pose.any())
