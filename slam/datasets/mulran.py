"""MulRan, a car with an Ouster OS1-64 on its roof; and Complex Urban, with two tilted VLP-16.

Kim et al. 2020, "MulRan: Multimodal Range Dataset for Urban Place Recognition"; Jeong et al. 2019, "Complex
Urban Dataset with Multi-level Sensors from Highly Diverse Urban Environments".
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.cloud_files import KITTI_ROWS, with_column_times
from slam.datasets.clouds_over_time import CloudFolder, clouds_by_name
from slam.datasets.dataset_format import recorded
from slam.datasets.imu_files import ImuFile, beside_imu
from slam.datasets.log_file import first_file
from slam.datasets.pose_files import BAD_MATRIX, by_its_size, pose_of_row, rotation_and_shift, trajectory_of
from slam.datasets.recording import Contents
from slam.datasets.stamped_files import fields_of
from slam.errors import DatasetError
from slam.estimates import Trajectory

_LIDARS, _POSES, _SENSORS = ("Ouster", "VLP_left"), "global_pose.csv", "sensor_data"
_OTHER_LIDAR, _MOUNT_FILE = "VLP_right", "calibration/Vehicle2LeftVLP.txt"
# From the publishers' file player; lines of the first recordings end after the angles.
_XSENS = "time [ns],qx,qy,qz,qw,roll,pitch,yaw,gx,gy,gz,ax,ay,az,magnetic x,magnetic y,magnetic z"
# calib_base2ouster.txt, published with all sequences: metres, then roll, pitch and yaw in degrees.
_SHIFT_M, _TURN_DEG = (1.7042, -0.021, 1.8047), (0.0001, 0.0003, 179.6654)


def _load(path: Path, account: Account) -> Contents:
    """The folder of one sequence; the lidar's pose is the published one."""
    place = _clouds_folder(path)
    assert place is not None
    files = clouds_by_name(place, account)
    roll, pitch, yaw = np.radians(_TURN_DEG).tolist()
    mounting = gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, roll), np.array(_SHIFT_M))
    if place.name != _LIDARS[0]:
        mount = rotation_and_shift(path / _MOUNT_FILE, account) if (path / _MOUNT_FILE).is_file() else None
        if mount is None:
            raise DatasetError(f"{path} has no {_MOUNT_FILE}, which contains the tilt of its lidars; add it")
        mounting = mount
        account.report.ignore(_OTHER_LIDAR, "one 3D lidar is read")
    clouds = CloudFolder(tuple(files), mounting, with_column_times(KITTI_ROWS))
    return Contents(log=beside_imu(clouds.numbered(account), xsens((path / "sensor_data", path)), account))


def _clouds_folder(path: Path) -> Path | None:
    """The folder of the clouds: the file player expects them one level deeper than the archives."""
    places = (place / name for name in _LIDARS for place in (path / _SENSORS, path))
    return next((folder for folder in places if folder.is_dir()), None)


def xsens(folders: Iterable[Path]) -> ImuFile | None:
    """The IMU whose file is in one of several folders; its pose is not published."""
    file = first_file(folder / "xsens_imu.csv" for folder in folders)
    return ImuFile(file, _XSENS) if file else None


def read_poses(path: Path, account: Account) -> Trajectory | None:
    """Read lines with nanoseconds and the twelve numbers of the car's pose; None without poses."""

    def good() -> Iterator[tuple[float, gtsam.Pose3]]:
        for number, fields in fields_of(path, account, 13):
            with account.refusing(path.name, number, BAD_MATRIX, ValueError):
                yield by_its_size(float(fields[0])), pose_of_row(fields[1:13])

    return trajectory_of(good()) if path.is_file() else None


FORMAT = recorded(
    "MulRan or Complex Urban sequence",
    lambda path, head: (
        ((path / _POSES).is_file() or (path / _SENSORS).is_dir()) and _clouds_folder(path) is not None
    ),
    _load,
    lambda path, account: read_poses(path / _POSES, account),
)
