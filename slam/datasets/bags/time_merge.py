"""Sorts readings and frames by stamp, and interpolates wheel odometry at each scan.

The recorder writes messages as they arrive; wheels (by radio) and images arrive later than a scan of the same
time. So readings wait a little for earlier ones, as `slam.datasets.recording` does for folders.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Iterator
from typing import Generic, TypeVar

from slam.datasets.wheels_between import WHEELS_KEPT, wheels_at
from slam.measurements import LaserScan, Measurement, PointCloud, WheelOdometry

_HOLD_S = 0.5  # by the recorder's clock; a frame that arrives later is out of order
_LONGEST_S = 2.0  # a frame waits for the readings around it, if more are expected
_MOST_BYTES = 1 << 28  # of waiting images
_MOST_READINGS = 20_000
_BACKWARD_S = 1.0  # a stamp this much older than the newest means a clock step, not a late image

_Frame = TypeVar("_Frame")


class TimeMerge(Generic[_Frame]):
    """Takes readings and frames as recorded, and returns them in order."""

    def __init__(self) -> None:
        self._readings: list[tuple[float, int, int, Measurement, float]] = []
        self._newest_reading_s: dict[str, float] = {}
        self._frames: list[tuple[float, int, int, _Frame, int, float]] = []
        self._newest_frame_s: dict[int, float] = {}
        self._wheels: deque[WheelOdometry] = deque(maxlen=WHEELS_KEPT)
        self._newest_s = -math.inf
        self._bytes = 0
        self._count = 0

    def add_reading(self, number: int, reading: Measurement, recorded_s: float) -> None:
        """Add a scan, a cloud or odometry with its index in the bag; the order of a sensor is kept."""
        if isinstance(reading, WheelOdometry):
            self._wheels.append(reading)
        key_s = max(reading.stamp_s, self._newest_reading_s.get(reading.sensor, -math.inf))
        self._newest_reading_s[reading.sensor] = key_s
        self._count += 1
        heapq.heappush(self._readings, (key_s, self._count, number, reading, recorded_s))

    def add_frame(self, place: int, stamp_s: float, frame: _Frame, size: int, recorded_s: float) -> None:
        """Add a frame of the camera with an index among the cameras; ``size`` is in bytes."""
        newest_s = self._newest_frame_s.get(place, -math.inf)
        key_s = stamp_s if stamp_s > newest_s - _BACKWARD_S else newest_s
        self._newest_frame_s[place] = max(newest_s, stamp_s)
        self._count += 1
        self._bytes += size
        heapq.heappush(self._frames, (key_s, place, self._count, frame, size, recorded_s))

    def due(self, now_s: float) -> Iterator[tuple[int, Measurement] | _Frame]:
        """What need not wait any longer at a time of the recorder's clock."""
        while self._readings and (
            now_s - self._readings[0][-1] > _HOLD_S or len(self._readings) > _MOST_READINGS
        ):
            yield from self._next_reading()
        while self._frames and (
            self._bytes > _MOST_BYTES
            or now_s - self._frames[0][-1] > (_LONGEST_S if self._readings else _HOLD_S)
        ):
            yield self._next_frame()

    def rest(self) -> Iterator[tuple[int, Measurement] | _Frame]:
        """Everything that still waits at the end of the bag."""
        while self._readings:
            yield from self._next_reading()
        while self._frames:
            yield self._next_frame()

    def _next_reading(self) -> Iterator[tuple[int, Measurement] | _Frame]:
        """The oldest reading, wheel odometry before a scan, and the frames up to its stamp."""
        number, reading = heapq.heappop(self._readings)[2:4]
        if isinstance(reading, LaserScan | PointCloud):
            wheels = wheels_at(self._wheels, reading.stamp_s)
            if wheels is not None:
                yield number, wheels
                yield from self._frames_up_to(reading.stamp_s)
        yield number, reading
        yield from self._frames_up_to(reading.stamp_s)

    def _frames_up_to(self, stamp_s: float) -> Iterator[_Frame]:
        """The frames after a reading with this stamp."""
        self._newest_s = max(self._newest_s, stamp_s)
        while self._frames and self._frames[0][0] <= self._newest_s:
            yield self._next_frame()

    def _next_frame(self) -> _Frame:
        """The frame with the oldest stamp."""
        *_, frame, size, _ = heapq.heappop(self._frames)
        self._bytes -= size
        return frame
