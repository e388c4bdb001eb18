"""Motion from sensor readings, each with a covariance."""

from __future__ import annotations

from slam.config.stages import LidarOdometryConfig, MatchConfig
from slam.odometry.lidar_odometry import LidarOdometry
from slam.odometry.surfel_odometry import SurfelOdometry


def make_lidar_odometry(config: LidarOdometryConfig, match: MatchConfig) -> LidarOdometry:
    """The odometry that the configuration names."""
    if config.method == "kiss_icp":
        from slam.odometry.kiss_odometry import KissOdometry

        return KissOdometry(config, match)
    return SurfelOdometry(config, match)
