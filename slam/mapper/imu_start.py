"""Estimate the state of an IMU at the first cloud of a robot, before mapping starts.

Clouds in motion are deskewed with the velocity, which is known only after some clouds are matched. So the
first seconds are read twice.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import suppress

from slam.config import Config
from slam.matching.cloud_points import at_middle_of_turn
from slam.measurements import ImuReading, Measurement, PointCloud
from slam.odometry.cloud_tracker import NO_MAP, CloudTracker, FirstMap
from slam.odometry.cloud_velocity import LONGEST_STEP_S
from slam.odometry.imu_tracker import ImuStart, ImuTracker, UnfitImuError

# As long as the lag of the smoother covers all of it, the first state is improved, too.
_LOOK_S = 2.5


def after_readings(log: Iterable[Measurement]) -> Iterator[Measurement]:
    """Yield a log in its order, with readings before the clouds of their time, however late they arrive."""
    waiting, newest_s = deque[tuple[float, Measurement]](), -math.inf
    for item in log:
        if isinstance(item, ImuReading):
            newest_s = max(newest_s, item.stamp_s)
            yield item
        else:
            times_s = item.times_s if isinstance(item, PointCloud) else None
            waiting.append((item.stamp_s if times_s is None else item.stamp_s + float(times_s.max()), item))
        while waiting and (waiting[0][0] <= newest_s or item.stamp_s - waiting[0][0] > LONGEST_STEP_S):
            yield waiting.popleft()[1]
    yield from (item for _, item in waiting)


def start_of(log: Iterable[Measurement], config: Config, first: FirstMap = NO_MAP) -> ImuStart | None:
    """Return the state at the first cloud; None if the first seconds do not determine it."""
    imu = ImuTracker()
    tracker, first_s = CloudTracker(config, None, imu=imu, first=first), math.inf
    for measurement in log:
        if isinstance(measurement, ImuReading):
            imu.add(measurement)
        elif isinstance(measurement, PointCloud):
            cloud = at_middle_of_turn(measurement, config.cloud_odometry)
            first_s = min(first_s, cloud.stamp_s)
            if cloud.stamp_s - first_s > _LOOK_S:
                break
            with suppress(UnfitImuError):  # gravity is still a guess: the second pass judges it
                tracker.follow(cloud)
    start = imu.start()
    return start if start is not None and start.state.stamp_s == first_s else None
