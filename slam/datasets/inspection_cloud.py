"""What the clouds of one 3D lidar hold."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam.measurements import PointCloud


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

    def facts(self) -> dict[str, Any] | None:
        """Points a cloud, ranges from the lidar, longest turn, the mounting; None before the first cloud."""
        if self.last is None:
            return None
        mount = self.last.T_base_lidar
        return {
            "points_min": self.points_min,
            "points_max": self.points_max,
            "nearest_m": self.nearest_m if self.points_max else 0.0,
            "farthest_m": self.farthest_m,
            "turn_s": self.turn_s,
            "mount_m": mount.translation().tolist(),
            "mount_rpy_rad": mount.rotation().rpy().tolist(),
        }
