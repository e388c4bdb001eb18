"""The clouds of the last way, each with what it saw for the first time: no surface is weighed twice."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.config_localization import LocalizationConfig
from slam.localization.cloud_match import CloudView
from slam.matching.local_cloud import moved
from slam.measurements import FloatArray

# What was seen longer ago may be seen anew: from where the map knew nothing of it, it said nothing.
_NEWS_M = 5.0
_AROUND = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.int64)
_HALF, _BITS = 1 << 20, 21


@dataclass(frozen=True, slots=True)
class CloudStation:
    """A cloud of the way.

    Attributes
    ----------
    view
        The cloud.
    pose
        ``T_odom_base``.
    way_m
        Travel up to here.
    news
        (N, 3) points on surfaces that no earlier station saw, base frame.
    keys
        The cells of those surfaces.
    """

    view: CloudView
    pose: gtsam.Pose3
    way_m: float
    news: FloatArray
    keys: NDArray[np.int64]


class CloudStations:
    """The stations of the last way, in the odometry frame."""

    def __init__(self, config: LocalizationConfig) -> None:
        self._config = config
        self.stations: list[CloudStation] = []

    def clear(self) -> None:
        """Forget the way: the odometry has begun anew, or it led elsewhere than believed."""
        self.stations.clear()

    def due(self, pose: gtsam.Pose3) -> bool:
        """Whether the robot has moved on since the last station, to ``T_odom_base``."""
        if not self.stations:
            return True
        step = self.stations[-1].pose.between(pose)
        turned = float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation())))
        way_m = float(np.linalg.norm(step.translation()))
        return way_m >= self._config.station_m or turned >= self._config.station_rad

    def add(self, view: CloudView, pose: gtsam.Pose3) -> int:
        """Take a cloud at ``T_odom_base`` for a station; how many of the oldest were dropped for it."""
        way_m = 0.0
        if self.stations:
            step = self.stations[-1].pose.between(pose)
            way_m = self.stations[-1].way_m + float(np.linalg.norm(step.translation()))
        known = [s for s in self.stations if way_m - s.way_m <= self._config.window_m]
        dropped = len(self.stations) - len(known)
        self.stations = known
        cells = np.floor(moved(view.points, pose) / self._config.news_cell_m).astype(np.int64)
        keys, first = np.unique(_keys(cells), return_index=True)
        if self.stations:
            seen = np.concatenate(
                [station.keys for station in self.stations if way_m - station.way_m <= _NEWS_M] or [keys[:0]]
            )
            # A cell beside a known one may be the same surface, a little off.
            beside = np.isin(_keys((cells[first][:, None] + _AROUND).reshape(-1, 3)), seen)
            fresh = first[~beside.reshape(-1, len(_AROUND)).any(axis=1)]
            keys = keys[~np.isin(keys, seen)]
        else:
            fresh = first
        self.stations.append(CloudStation(view, pose, way_m, view.points[fresh], keys))
        return dropped


def _keys(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """One number for each of (n, 3) cells."""
    x, y, z = (cells + _HALF).T
    return np.asarray((x << 2 * _BITS) | (y << _BITS) | z)
