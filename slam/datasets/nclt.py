"""NCLT: a Segway with a Velodyne on a campus, recorded over a year.

Carlevaris-Bianco et al. 2016, "University of Michigan North Campus Long-Term Vision and Lidar Dataset". Its
frames have z down; here they are rotated about x so that z is up.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.cloud_files import Parsed, Rows, row_of
from slam.datasets.clouds_over_time import CloudFolder, clouds_by_name, merged
from slam.datasets.dataset_format import recorded
from slam.datasets.imu_files import ImuFile, beside_imu
from slam.datasets.log_file import first_file
from slam.datasets.pose_files import PoseTable, trajectory_of
from slam.datasets.recording import Contents, Numbered
from slam.estimates import Trajectory
from slam.measurements import WheelOdometry

_INSIDE = "velodyne_sync"
_ROWS = Rows(row_of("x u2, y u2, z u2, intensity u1, laser u1"))
_STEP_M, _FIRST_M = 0.005, -100.0  # of the integers in a row
_TICK_S = 1e-6
_POSES = PoseTable(stamp_units_s=(_TICK_S,), order="rpy")
_ODOMETRY = ("odometry_mu_100hz.csv", "odometry_mu.csv")
# Magnetometer, m/s², rad/s; the pose of the IMU is not in a file.
_IMU = "ms25.csv"
_IMU_HEAD = "time [us],mag x,mag y,mag z,accel_x,accel_y,accel_z,gyro_x,gyro_y,gyro_z"
_T_DOWN_UP = gtsam.Pose3(gtsam.Rot3(np.diag([1.0, -1.0, -1.0])), np.zeros(3))


def _load(path: Path, account: Account) -> Contents:
    """The folder of one day; the robot's frame is that of the clouds, which are already deskewed."""
    files = clouds_by_name(
        path / _INSIDE, account, r"(\d{10,17})\.bin", lambda match: int(match[1]) * _TICK_S
    )
    clouds = CloudFolder(tuple(files), parse=_parse).numbered(account)
    odometry = first_file(path / name for name in _ODOMETRY)
    log = merged(_wheels(odometry, account), clouds) if odometry else clouds
    imu = ImuFile(path / _IMU, _IMU_HEAD) if (path / _IMU).is_file() else None
    return Contents(log=beside_imu(log, imu, account))


def _parse(path: Path) -> Parsed:
    """Points with z up, without rows of zeros."""
    rows = _ROWS.rows(path)
    points = np.column_stack([rows[axis] for axis in "xyz"]).astype(np.float64) * _STEP_M + _FIRST_M
    return points * (1.0, -1.0, -1.0), {}


def _wheels(file: Path, account: Account) -> Iterator[Numbered]:
    """Planar odometry from wheels and gyroscope."""
    for number, stamp_s, pose in _POSES.rows(file, account):
        account.report.line_count += 1
        account.report.accept("odometry")
        yield number, WheelOdometry(stamp_s, gtsam.Pose2(pose.x(), -pose.y(), -pose.rotation().yaw()))


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """The publishers' poses, in the folder or next to it."""
    name = f"groundtruth_{path.resolve().name}.csv"
    above = path.resolve().parent
    places = path / name, above / name, above / "ground_truth" / name
    file = first_file([*places, *sorted(path.glob("groundtruth_*.csv"))])
    return read_poses(file, account) if file else None


def read_poses(file: Path, account: Account) -> Trajectory | None:
    """Read lines with microseconds, position and angles, rotated so that z is up; None without poses."""
    rows = _POSES.rows(file, account)
    turned = ((stamp_s, _T_DOWN_UP.compose(pose).compose(_T_DOWN_UP)) for _, stamp_s, pose in rows)
    return trajectory_of(turned)


FORMAT = recorded("NCLT day", lambda path, head: (path / _INSIDE).is_dir(), _load, _groundtruth)
