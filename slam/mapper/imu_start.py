"""Estimate the motion of a robot at its first cloud, before mapping starts.

Clouds in motion are deskewed with the velocity, which is known only after some clouds are matched. So the
first seconds are read twice.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import suppress
from itertools import islice, pairwise

import gtsam
import numpy as np

from slam.config import Config
from slam.matching.cloud_points import at_middle_of_turn, deskewed
from slam.measurements import FloatArray, ImuReading, Measurement, PointCloud
from slam.odometry.cloud_tracker import CloudTracker
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


def start_of(log: Iterable[Measurement], config: Config) -> ImuStart | None:
    """Return the state at the first cloud; None if the first seconds do not determine it."""
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
            with suppress(UnfitImuError):  # gravity is still a guess: the second pass judges it
                tracker.follow(cloud)
    start = imu.start()
    return start if start is not None and start.state.stamp_s == first_s else None


def first_twist(log: Iterable[Measurement], config: Config) -> FloatArray | None:
    """Return the twist (6,) of the base at the first cloud, by the first three; None if they do not show it.

    Otherwise the first cloud is deskewed as if the robot stood still, and all later poses differ from the
    first by the error of its match.
    """
    clouds = list(islice((item for item in log if isinstance(item, PointCloud)), 3))
    clouds = [at_middle_of_turn(item, config.cloud_odometry) for item in clouds]
    stamps_s, twist = np.array([item.stamp_s for item in clouds]), None
    if len(clouds) < 3 or not all(deskewed(item, config.cloud_odometry) for item in clouds):
        return None
    if not all(0.0 < step_s < LONGEST_STEP_S for step_s in np.diff(stamps_s)):
        return None
    for _ in clouds:
        tracker = CloudTracker(config, None, twist=twist)
        tracked = [tracker.follow(item) for item in clouds]
        matches = [item.motion for item in tracked[1:]]
        if not all(item and item.converged and not item.degenerate for item in matches):
            return None
        motions = np.array([gtsam.Pose3.Logmap(a.pose.between(b.pose)) for a, b in pairwise(tracked)])
        first, second = motions / np.diff(stamps_s)[:, None]
        # Half a step before the middle of the first step, by constant acceleration.
        twist = first + (first - second) * (stamps_s[1] - stamps_s[0]) / (stamps_s[2] - stamps_s[0])
    return twist
