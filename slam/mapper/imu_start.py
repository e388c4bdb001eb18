"""How a robot with an IMU moves at its first cloud, found out before the map is begun.

Clouds that are seen on the way are straightened by the velocity, and that is known once some of them were
matched. So the first seconds are read twice.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

from slam.config import Config
from slam.matching.cloud_points import at_middle_of_turn
from slam.measurements import ImuReading, Measurement, PointCloud
from slam.odometry.cloud_tracker import CloudTracker
from slam.odometry.imu_tracker import ImuStart, ImuTracker

# While all of it is within the smoother's lag the first state is improved, too.
_LOOK_S = 2.5


def start_of(log: Iterable[Measurement], config: Config) -> ImuStart | None:
    """The state at the first cloud; None where the first seconds do not tell it."""
    imu = ImuTracker()
    tracker, first_s = CloudTracker(config, None, imu=imu), math.inf
    for measurement in log:
        if isinstance(measurement, ImuReading):
            imu.add(measurement)
        elif isinstance(measurement, PointCloud):
            cloud = at_middle_of_turn(measurement, config.cloud_odometry)
            first_s = min(first_s, cloud.stamp_s)
            if cloud.stamp_s - first_s > _LOOK_S:
                break
            tracker.follow(cloud)
    start = imu.start()
    return start if start is not None and start.state.stamp_s == first_s else None
