"""Newer College 2020 as folders: clouds of a hand-held Ouster OS1-64.

Ramezani et al. 2020, "The Newer College Dataset: Handheld LiDAR, Inertial and Vision with Ground Truth".
"""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.cloud_files import read_fields, with_column_times
from slam.datasets.clouds_over_time import CloudFolder, clouds_by_name
from slam.datasets.dataset_format import recorded
from slam.datasets.imu_files import ImuFile, beside_imu
from slam.datasets.log_file import first_file
from slam.datasets.pose_files import PoseTable, trajectory_of
from slam.datasets.recording import Contents
from slam.estimates import Trajectory

_CLOUDS = r"cloud_(\d{1,10})_(\d{1,9})\.(?:pcd|ply)"
_PLACES = ("raw_format/ouster_scan", "ouster_scan", "")
_IMU, _IMU_HEAD = "ouster_imu", "counter,sec,nsec,wx,wy,wz,ax,ay,az"
_TRUTH = "registered_poses.csv"
_POSES = PoseTable(stamp_units_s=(1.0, 1e-9), position=2, rotation=5)
# Pose of the lidar in the frame of the published poses: rotated by 135 degrees about z.
_T_TRUTH_LIDAR = gtsam.Pose3(
    gtsam.Rot3.Quaternion(0.382683, 0.0, 0.0, 0.923880), np.array([-0.084, -0.025, 0.050])
)


def _load(path: Path, account: Account) -> Contents:
    """The folder of one walk; the robot's frame is that of the lidar."""
    folder = _clouds_folder(path)
    assert folder is not None
    files = clouds_by_name(folder, account, _CLOUDS, lambda match: int(match[1]) + int(match[2]) * 1e-9)
    clouds = CloudFolder(tuple(files), parse=with_column_times(read_fields))
    candidates = [*sorted((folder.parent / _IMU).glob("*.csv")), folder.parent / f"{_IMU}.csv"]
    file = first_file([*candidates, folder / f"{_IMU}.csv"])
    imu = ImuFile(file, _IMU_HEAD) if file else None
    return Contents(log=beside_imu(clouds.numbered(account), imu, account))


def _clouds_folder(path: Path) -> Path | None:
    """The folder of the clouds."""
    places = (path / inside for inside in _PLACES)
    return next((place for place in places if next(place.glob("cloud_*_*.p*"), None)), None)


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """Ground truth of the lidar from the poses in the folder or near it."""
    above = path.resolve().parents
    places = (path, *above[:2])
    file = first_file(place / inside / _TRUTH for place in places for inside in ("", "ground_truth"))
    return read_poses(file, account) if file else None


def read_poses(file: Path, account: Account) -> Trajectory | None:
    """Read lines with seconds, nanoseconds, position and quaternion as lidar poses; None without poses."""
    rows = _POSES.rows(file, account)
    return trajectory_of((stamp_s, pose.compose(_T_TRUTH_LIDAR)) for _, stamp_s, pose in rows)


FORMAT = recorded(
    "Newer College walk (folders)",
    lambda path, head: path.is_dir() and _clouds_folder(path) is not None,
    _load,
    _groundtruth,
)
