"""Boreas: a car with a Velodyne Alpha Prime in all weathers.

Burnett et al. 2023, "Boreas: A Multi-Season Autonomous Driving Dataset".
"""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.cloud_files import Rows, row_of
from slam.datasets.clouds_over_time import CloudFolder, clouds_by_name
from slam.datasets.dataset_format import recorded
from slam.datasets.imu_files import ImuFile, beside_imu
from slam.datasets.log_file import first_file
from slam.datasets.pose_files import PoseTable, pose_file, trajectory_of
from slam.datasets.recording import Contents
from slam.estimates import Trajectory

_INSIDE, _POSES_FILE = "lidar", "applanix/lidar_poses.csv"
_ROWS = Rows(row_of("x f4, y f4, z f4, intensity f4, laser f4, time f4"))
# GPSTime, easting, northing, altitude, three velocities, roll, pitch, heading, three rates.
_POSES = PoseTable(stamp_units_s=(0.0,), rotation=7, order="rpy")
# From the guide to Boreas Road Trip; an IMU that is not used for the ground truth.
_DMU = ("dmu_imu.csv", "dmu_imu_infilled.csv")
# From the publishers' odometry, steam_icp: the last axis first, and their axes in the Applanix frame.
_RAW, _RAW_HEAD = "imu_raw.csv", "time,wz,wy,wx,az,ay,ax"
_R_APPLANIX_RAW = gtsam.Rot3(np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))
_SMOOTHED = "imu.csv"


def _load(path: Path, account: Account) -> Contents:
    """The folder of one drive; the robot's frame is that of the lidar."""
    files = clouds_by_name(path / _INSIDE, account)
    clouds = CloudFolder(tuple(files), parse=_ROWS).numbered(account)
    return Contents(log=beside_imu(clouds, _imu(path, account), account))


def _imu(path: Path, account: Account) -> ImuFile | None:
    """The IMU that is not used for the ground truth, else the raw one that is; pose by the calibration."""
    if (path / "applanix" / _SMOOTHED).is_file():
        account.report.ignore(_SMOOTHED, "whether its accelerations include gravity is not documented")
    T_applanix_lidar = _calibrated(path / "calib" / "T_applanix_lidar.txt", account)
    T_applanix_imu: gtsam.Pose3 | None = gtsam.Pose3(_R_APPLANIX_RAW, np.zeros(3))
    file, head = first_file(path / "imu" / name for name in _DMU), ""
    if file is not None:
        T_applanix_imu = _calibrated(path / "calib" / "T_applanix_dmu.txt", account)
    elif (path / "applanix" / _RAW).is_file():
        file, head = path / "applanix" / _RAW, _RAW_HEAD
    if file is None:
        return None
    if T_applanix_lidar is None or T_applanix_imu is None:
        return ImuFile(file, head)
    return ImuFile(file, head, T_applanix_lidar.inverse().compose(T_applanix_imu))


def _calibrated(file: Path, account: Account) -> gtsam.Pose3 | None:
    """A transform in the calibration; None if there is none."""
    with account.refusing(file.name, 1):
        return pose_file(file) if file.is_file() else None
    return None


def read_poses(path: Path, account: Account) -> Trajectory | None:
    """Poses of the sensor of a file; the published angles rotate world to sensor. None without poses."""
    rows = _POSES.rows(path, account) if path.is_file() else ()
    return trajectory_of(
        (stamp_s, gtsam.Pose3(pose.rotation().inverse(), pose.translation())) for _, stamp_s, pose in rows
    )


FORMAT = recorded(
    "Boreas drive",
    lambda path, head: (
        (path / _INSIDE).is_dir() and ((path / "applanix").is_dir() or (path / "calib").is_dir())
    ),
    _load,
    lambda path, account: read_poses(path / _POSES_FILE, account),
)
