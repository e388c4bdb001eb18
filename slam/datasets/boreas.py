"""Boreas: a car with a Velodyne Alpha Prime in all weathers.

Burnett et al. 2023, "Boreas: A Multi-Season Autonomous Driving Dataset".
"""

from __future__ import annotations

from pathlib import Path

import gtsam

from slam.datasets.account import Account
from slam.datasets.cloud_files import Rows, row_of
from slam.datasets.clouds_over_time import CloudFolder, clouds_by_name
from slam.datasets.dataset_format import DatasetFormat
from slam.datasets.mulran import NAMED_BY_CLOCK, stamp_of_clock
from slam.datasets.pose_files import PoseTable, trajectory_of
from slam.datasets.recording import Contents, Recording
from slam.measurements import Trajectory

_INSIDE, _POSES_FILE = "lidar", "applanix/lidar_poses.csv"
_ROWS = Rows(row_of("x f4, y f4, z f4, intensity f4, laser f4, time f4"))
# GPSTime, easting, northing, altitude, three velocities, roll, pitch, heading, three rates.
_POSES = PoseTable(stamp_units_s=(0.0,), rotation=7, order="rpy")


def looks_like_boreas(path: Path, head: bytes) -> bool:
    """Whether a path is the folder of one drive with clouds."""
    return (path / _INSIDE).is_dir() and ((path / "applanix").is_dir() or (path / "calib").is_dir())


def open_boreas(path: Path, strict: bool) -> Recording:
    """A folder of one drive; the lidar is the robot's frame."""

    def load(account: Account) -> Contents:
        files = clouds_by_name(path / _INSIDE, NAMED_BY_CLOCK, account, stamp_of_clock)
        return Contents(log=CloudFolder(tuple(files), parse=_ROWS).numbered(account))

    return Recording(path, load, lambda account: read_poses(path / _POSES_FILE, account), strict=strict)


def read_poses(path: Path, account: Account) -> Trajectory | None:
    """Of the sensor that a file is of; the publishers' angles turn the world into it. None without a pose."""
    rows = _POSES.rows(path, account) if path.is_file() else ()
    return trajectory_of(
        (stamp_s, gtsam.Pose3(pose.rotation().inverse(), pose.translation())) for _, stamp_s, pose in rows
    )


FORMAT = DatasetFormat("Boreas drive", looks_like_boreas, open_boreas)
