"""Folders of point clouds: KITTI odometry sequences, and any clouds with a list of their stamps."""

from __future__ import annotations

from pathlib import Path

import gtsam

from slam.datasets.account import Account
from slam.datasets.calibration import read_mounting
from slam.datasets.cloud_files import CLOUD_NAMES
from slam.datasets.clouds_over_time import CloudFolder, cloud_files, stamped_clouds, times_of
from slam.datasets.dataset_format import recorded
from slam.datasets.imu_files import beside_imu, imu_file
from slam.datasets.log_file import first_file, numbered_lines
from slam.datasets.numbered_frames import NO_STAMPS, numbered_files
from slam.datasets.pose_files import pose_lines, pose_of_row, trajectory_of
from slam.datasets.recording import Contents
from slam.datasets.stamped_files import StampedFile, read_poses
from slam.errors import DatasetError
from slam.estimates import Trajectory

LIDAR_CALIBRATION = "calibration.yaml"

_INSIDE = ("velodyne", "points", "clouds")  # of KITTI, of the simulator, of others
_KITTI_CALIBRATION = "calib.txt"
_GROUNDTRUTH = "groundtruth.txt"
_NUMBERED = r"[a-z_-]*(\d{1,8})\." + CLOUD_NAMES
_RATE_HZ = 10.0  # of most lidars; used for numbered clouds without stamps


def has_clouds(path: Path) -> bool:
    """Whether a robot's folder contains clouds with a list of stamps."""
    return times_of(path) is not None and bool(_cloud_places(path))


def read_clouds(path: Path, account: Account) -> CloudFolder:
    """The clouds of a folder and the pose of their lidar."""
    times = times_of(path)
    places = _cloud_places(path)
    if times is None and (files := _numbered(path)):
        if above := times_of(path.resolve().parent):  # as of a folder velodyne/ that is given alone
            return CloudFolder(tuple(stamped_clouds(above, path, account)), _mount(path))
        account.report.note(NO_STAMPS.format(rate=_RATE_HZ), 1)
        counted = [StampedFile(number / _RATE_HZ, file, number) for number, file in sorted(files.items())]
        return CloudFolder(tuple(counted), _mount(path), stamped=False)
    if times is None or not places:
        raise DatasetError(f"{path} holds no clouds with a list of stamps; give a folder with times.txt")
    return CloudFolder(tuple(stamped_clouds(times, places[0], account)), _mount(places[0]))


def _numbered(path: Path) -> dict[int, Path]:
    """Return the clouds of a folder by the numbers in their names."""
    clouds = {*cloud_files(path)} if path.is_dir() else ()
    return {number: file for number, file in numbered_files(path, _NUMBERED).items() if file in clouds}


def _cloud_places(path: Path) -> list[Path]:
    """The folders with clouds: subfolders by their names, or the folder itself."""
    inside = [path / name for name in _INSIDE if (path / name).is_dir()]
    return [place for place in [*inside, path] if cloud_files(place)]


def _mount(folder: Path) -> gtsam.Pose3:
    """``T_base_lidar`` by ``calibration.yaml`` next to the clouds, else the identity."""
    return read_mounting(folder / LIDAR_CALIBRATION, "T_base_lidar") or gtsam.Pose3()


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """``groundtruth.txt``, or KITTI's poses of its left camera, transformed to the lidar."""
    if (path / _GROUNDTRUTH).is_file():
        return read_poses(path / _GROUNDTRUTH, account)
    place = path.resolve()
    pose_file = first_file((path / "poses.txt", place.parent.parent / "poses" / f"{place.name}.txt"))
    times = times_of(path)
    calibration = path / _KITTI_CALIBRATION
    if pose_file is None or times is None or not calibration.is_file():
        return None
    T_camera_lidar = _kitti_rows(calibration, account).get("Tr")
    if T_camera_lidar is None:
        return None
    stamps = [file.stamp_s for file in stamped_clouds(times, _cloud_places(path)[0], account)]
    poses = zip(stamps, pose_lines(pose_file, account), strict=False)
    T_lidar_camera = T_camera_lidar.inverse()
    return trajectory_of(
        (stamp_s, T_lidar_camera.compose(pose).compose(T_camera_lidar)) for stamp_s, pose in poses if pose
    )


def _kitti_rows(path: Path, account: Account) -> dict[str, gtsam.Pose3]:
    """The transforms of ``calib.txt`` by name, without the projections."""
    poses = {}
    for _, line in numbered_lines(path, account):
        name, _, numbers = line.partition(b":")
        try:
            poses[name.decode("ascii", "replace").strip()] = pose_of_row(numbers.split())
        except ValueError:
            continue
    return poses


FORMAT = recorded(
    "folder of point clouds (KITTI odometry; .bin, .pcd, .ply, .las, .xyz or .npy with a list of stamps)",
    lambda path, head: path.is_dir() and (has_clouds(path) or len(_numbered(path)) > 1),
    # The lidar's frame is the robot's unless ``calibration.yaml`` says where it sits.
    lambda path, account: Contents(
        log=beside_imu(read_clouds(path, account).numbered(account), imu_file(path), account)
    ),
    _groundtruth,
)
