"""What the main loop feeds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from slam.mapper.map_result import MapResult
from slam.mapper.mount_learner import LearnedMounting
from slam.measurements import LaserScan, PointCloud, WheelOdometry
from slam.vision.color_registration import ColorRegistration
from slam.vision.prepared_frame import PreparedFrame


class Mapper(Protocol):
    """State of a run: measurements in log order, then the result."""

    @property
    def scan_count(self) -> int:
        """Scans and frames so far that were given a pose."""
        ...

    def note_registrations(self, registrations: Mapping[str, ColorRegistration]) -> None:
        """Take down where colour cameras sit that are not registered to depth."""
        ...

    def learned_mountings(self) -> dict[str, LearnedMounting]:
        """Where cameras sit that the log does not tell, as far as this run has shown."""
        ...

    def add_odometry(self, reading: WheelOdometry) -> None:
        """Take a wheel odometry reading."""
        ...

    def add_scan(self, scan: LaserScan) -> None:
        """Take a lidar scan."""
        ...

    def add_cloud(self, cloud: PointCloud) -> None:
        """Take a turn of a 3D lidar."""
        ...

    def add_frame(self, frame: PreparedFrame) -> None:
        """Take an RGB-D frame."""
        ...

    def finish(self) -> MapResult:
        """Optimise everything and hand on what was made."""
        ...
