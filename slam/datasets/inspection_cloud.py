"""What the clouds of one 3D lidar hold."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slam.measurements import PointCloud


@dataclass(frozen=True, slots=True)
class CloudSummary:
    """The clouds of one lidar.

    Attributes
    ----------
    points_min, points_max
        Valid points a cloud.
    nearest_m, farthest_m
        Of all points, from the lidar.
    turn_s
        Longest time between the first and the last point of a cloud, None where points have no times.
    mount_m, mount_rpy_rad
        The lidar on the robot.
    """

    points_min: int
    points_max: int
    nearest_m: float
    farthest_m: float
    turn_s: float | None
    mount_m: tuple[float, float, float]
    mount_rpy_rad: tuple[float, float, float]


@dataclass(slots=True)
class CloudFigures:
    """Running figures of one lidar."""

    last: PointCloud | None = None
    points_min: int = 0
    points_max: int = 0
    nearest_m: float = math.inf
    farthest_m: float = 0.0
    turn_s: float | None = None

    def add(self, cloud: PointCloud) -> None:
        """One more cloud."""
        count = len(cloud.points_lidar)
        self.points_min = count if self.last is None else min(self.points_min, count)
        self.points_max = max(self.points_max, count)
        if count:
            ranges_m = np.linalg.norm(cloud.points_lidar, axis=1)
            self.nearest_m = min(self.nearest_m, float(ranges_m.min()))
            self.farthest_m = max(self.farthest_m, float(ranges_m.max()))
        if cloud.times_s is not None and cloud.times_s.size:
            self.turn_s = max(self.turn_s or 0.0, float(np.ptp(cloud.times_s)))
        self.last = cloud

    def summary(self) -> CloudSummary | None:
        """The figures, frozen; None before the first cloud."""
        if self.last is None:
            return None
        mount = self.last.T_base_lidar
        roll, pitch, yaw = mount.rotation().rpy().tolist()
        return CloudSummary(
            points_min=self.points_min,
            points_max=self.points_max,
            nearest_m=self.nearest_m if self.points_max else 0.0,
            farthest_m=self.farthest_m,
            turn_s=self.turn_s,
            mount_m=(mount.x(), mount.y(), mount.z()),
            mount_rpy_rad=(roll, pitch, yaw),
        )
