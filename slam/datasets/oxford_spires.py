"""Clouds with stamps in their file names: Oxford Spires, and similar exports.

Tao et al. 2025, "The Oxford Spires Dataset".
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.cloud_files import CLOUD_NAMES
from slam.datasets.clouds_over_time import CloudFolder, cloud_files, clouds_by_name
from slam.datasets.dataset_format import recorded
from slam.datasets.imu_files import beside_imu, imu_file
from slam.datasets.log_file import first_file
from slam.datasets.pose_files import trajectory_of
from slam.datasets.recording import Contents
from slam.datasets.stamped_files import numbered_poses, read_poses
from slam.estimates import Trajectory

STAMPS_IN_NAMES = "stamps from the names of the clouds in {place}"

# Seconds with a decimal fraction, seconds and nanoseconds, or an integer of any unit.
_NAME = r"(?:\w*[a-z]_)?(\d{9,19}(?:\.\d{1,9})?|\d{9,10}_\d{1,9})(?:_[a-z]\w*)?\." + CLOUD_NAMES
_FOLDER = re.compile(r"cloud|lidar|hesai|ouster|velodyne|livox|pandar|points|scans", re.IGNORECASE)
_TRUTH = "groundtruth.txt"
_OWN_TRUTH = "gt-tum.txt", "processed/trajectory/gt-tum.txt", "trajectory/gt-tum.txt"
# From the publishers' sensor.yaml: pose of the lidar in the frame of their poses.
_T_TRUTH_LIDAR = gtsam.Pose3(gtsam.Rot3.Yaw(np.pi), np.array([0.0, 0.0, 0.124]))
_LOOKED_AT = 200


def _load(path: Path, account: Account) -> Contents:
    """The clouds of one folder; the robot's frame is that of the lidar."""
    place = _place(path)
    assert place is not None
    account.report.note(STAMPS_IN_NAMES.format(place=place.name), 1)
    files = clouds_by_name(place, account, _NAME, _stamp)
    clouds, imu = CloudFolder(tuple(files)).numbered(account), imu_file(path) or imu_file(place)
    return Contents(log=beside_imu(clouds, imu, account))


def _stamp(match: re.Match[str]) -> float:
    """Stamp in seconds."""
    seconds, parted, rest = match[1].partition("_")
    return int(seconds) + int(rest) * 1e-9 if parted else float(seconds)


def _place(path: Path) -> Path | None:
    """The nearest folder with clouds."""
    name = re.compile(_NAME)
    for place in _folders(path):
        names = [file.name for file in cloud_files(place)[:_LOOKED_AT]]
        if names and all(name.fullmatch(entry) for entry in names):
            return place
    return None


def _folders(path: Path) -> Iterator[Path]:
    """The folder, and its subfolders with names of clouds or of a lidar."""
    yield path
    below = sorted(folder for folder in islice(path.iterdir(), _LOOKED_AT) if folder.is_dir())
    yield from (folder for folder in below if _FOLDER.search(folder.name))
    for folder in below:
        inner = sorted(child for child in islice(folder.iterdir(), _LOOKED_AT) if child.is_dir())
        yield from (child for child in inner if _FOLDER.search(child.name))


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """Ground truth of the lidar: the publishers' poses transformed to it, or an unchanged trajectory."""
    above = path.resolve().parents
    if (path / _TRUTH).is_file():
        return read_poses(path / _TRUTH, account)
    file = first_file(place / name for place in (path, *above[:2]) for name in _OWN_TRUTH)
    rows = numbered_poses(file, account) if file else ()
    poses = ((row[0], gtsam.Pose3(gtsam.Rot3.Quaternion(*row[[7, 4, 5, 6]]), row[1:4])) for _, row in rows)
    return trajectory_of((float(stamp_s), pose.compose(_T_TRUTH_LIDAR)) for stamp_s, pose in poses)


FORMAT = recorded(
    "clouds named by their stamps (Oxford Spires)",
    lambda path, head: path.is_dir() and _place(path) is not None,
    _load,
    _groundtruth,
)
