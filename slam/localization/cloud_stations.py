"""The clouds of the last way, from places far enough apart to tell something new."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from slam.config.localization import LocalizationConfig
from slam.localization.cloud_match import CloudView


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
    """

    view: CloudView
    pose: gtsam.Pose3
    way_m: float


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
        kept = [station for station in self.stations if way_m - station.way_m <= self._config.window_m]
        dropped = len(self.stations) - len(kept)
        self.stations = [*kept, CloudStation(view, pose, way_m)]
        return dropped
