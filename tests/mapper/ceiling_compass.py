"""A ceiling compass: stripes overhead show the robot's heading in the building. A sensor in one file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import gtsam
import numpy as np

from slam.config import Config
from slam.graph.edge import Edge

KIND = "ceiling compass"
LONGEST_WAIT_S = 0.2
NOTHING_M = 1e3  # sigma of a position, of which it knows nothing


@dataclass(frozen=True, slots=True)
class Heading:
    """What it measures: the heading of the base, in a frame of its own."""

    stamp_s: float
    yaw_rad: float
    sigma_rad: float = 0.01
    sensor: str = KIND


class CeilingCompass:
    """Joins every keyframe to the first by the turn between them; see `slam.mapper.protocol.Sensor`."""

    def __init__(self, config: Config) -> None:
        self._newest: Heading | None = None
        self._first: tuple[int, Heading] | None = None
        self._factors = 0

    def observe(self, measurement: Heading) -> None:
        """Take the next heading."""
        self._newest = measurement

    def factors(self, key: int, stamp_s: float) -> Iterable[Edge]:
        """The turn since the first keyframe, where the heading is of this moment."""
        now = self._newest
        if now is None or abs(stamp_s - now.stamp_s) > LONGEST_WAIT_S:
            return []
        if self._first is None:
            self._first = key, now
            return []
        source, first = self._first
        self._factors += 1
        turn = gtsam.Pose2(0.0, 0.0, now.yaw_rad - first.yaw_rad)
        covariance = np.diag([NOTHING_M**2, NOTHING_M**2, now.sigma_rad**2 + first.sigma_rad**2])
        return [Edge(source, key, turn, covariance, KIND, trusted=False)]

    def notes(self) -> list[str]:
        """One line, for people."""
        return [f"{KIND}: {self._factors} headings"]
