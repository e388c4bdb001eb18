"""Motion from sensor readings, each with a covariance."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from slam.config import Config
from slam.odometry.lidar_odometry import LidarOdometry
from slam.odometry.rgbd_odometry import RgbdOdometry
from slam.odometry.surfel_odometry import SurfelOdometry
from slam.vision.frame_matcher import FrameMatcher


@dataclass(frozen=True)
class Odometries:
    """Factories of a run's odometries; a comparison replaces them by other methods."""

    lidar: Callable[[Config], LidarOdometry] = SurfelOdometry
    rgbd: Callable[[Config], RgbdOdometry] = FrameMatcher


STANDARD = Odometries()
