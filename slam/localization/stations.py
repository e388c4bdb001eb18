"""The scans of the last way, each with what it saw for the first time: no surface is weighed twice."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slam.config.localization import LocalizationConfig
from slam.localization.scan_view import ScanView, cell_keys, first_in_cells
from slam.matching.local_map import OrientedPoints
from slam.matching.planar import between, transform_points
from slam.measurements import FloatArray

_AROUND = np.array([(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1)], np.int64)


@dataclass(frozen=True, slots=True)
class Station:
    """A scan of the way.

    Attributes
    ----------
    view
        The scan.
    pose
        (3,) in the odometry frame.
    way_m
        Travel up to here.
    news
        Points on surfaces that no earlier station saw, base frame.
    keys
        The cells of those surfaces.
    """

    view: ScanView
    pose: FloatArray
    way_m: float
    news: OrientedPoints
    keys: frozenset[int]


class StationLog:
    """The stations of the last way, in the odometry frame."""

    def __init__(self, config: LocalizationConfig) -> None:
        self._config = config
        self._seen: set[int] = set()
        self.stations: list[Station] = []

    def clear(self) -> None:
        """Forget the way: the odometry has begun anew, or it led elsewhere than believed."""
        self._seen.clear()
        self.stations.clear()

    def due(self, pose: FloatArray) -> bool:
        """Whether the robot has moved on since the last station, to a pose (3,) in the odometry frame."""
        if not self.stations:
            return True
        step = between(self.stations[-1].pose, pose)
        return bool(
            math.hypot(step[0], step[1]) >= self._config.station_m or abs(step[2]) >= self._config.station_rad
        )

    def add(self, view: ScanView, pose: FloatArray) -> int:
        """Take a scan at a pose (3,) for a station; how many of the oldest stations were dropped for it."""
        way_m = 0.0
        if self.stations:
            step = between(self.stations[-1].pose, pose)
            way_m = self.stations[-1].way_m + math.hypot(step[0], step[1])
        dropped = 0
        while self.stations and way_m - self.stations[0].way_m > self._config.window_m:
            self._seen -= self.stations.pop(0).keys
            dropped += 1
        first, cells = first_in_cells(transform_points(view.oriented.points, pose), self._config.news_cell_m)
        # A cell beside a known one may be the same surface, a little off.
        beside = (cells[:, None, :] + _AROUND).reshape(-1, 2)
        known = np.array([key in self._seen for key in cell_keys(beside).tolist()], np.bool_)
        new = ~known.reshape(-1, len(_AROUND)).any(axis=1)
        fresh = frozenset(cell_keys(cells).tolist()) - self._seen
        self._seen |= fresh
        self.stations.append(Station(view, pose, way_m, view.where(first[new]), fresh))
        return dropped

    def recent_points(self, way_m: float) -> FloatArray:
        """What the stations of the last ``way_m`` saw, (M, 2) in the base frame of the newest: all of it."""
        newest = self.stations[-1]
        before = [
            transform_points(station.news.points, between(newest.pose, station.pose))
            for station in self.stations[:-1]
            if newest.way_m - station.way_m < way_m
        ]
        return np.concatenate([newest.view.points.points_base.astype(np.float64), *before])
