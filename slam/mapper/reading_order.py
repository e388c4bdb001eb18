"""The order of a log in which readings of an IMU come before the clouds of their time."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator

from slam.measurements import ImuReading, Measurement, PointCloud
from slam.odometry.cloud_velocity import LONGEST_STEP_S


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
