"""KITTI's raw recordings, synced or extracted, and KITTI-360: a Velodyne, GPS and IMU as ground truth.

Geiger et al. 2013, "Vision meets Robotics: The KITTI Dataset".
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.cloud_files import DAMAGED, KITTI_ROWS, Parsed
from slam.datasets.clouds_over_time import UNPAIRED, WITHOUT_CLOUD, CloudFolder
from slam.datasets.dataset import RecordFault
from slam.datasets.dataset_format import recorded
from slam.datasets.imu_files import with_imu
from slam.datasets.log_file import first_file, numbered_lines
from slam.datasets.numbered_frames import numbered_files
from slam.datasets.pose_files import numbers_of, rotation_and_shift, trajectory_of
from slam.datasets.recording import Contents, Numbered
from slam.datasets.stamped_files import BAD_POSE, StampedFile, stamp_of
from slam.estimates import Trajectory
from slam.measurements import FloatArray, ImuReading

ONCE_A_CLOUD = "one IMU reading per cloud does not resolve the motion within it; unsynced drives do"

_INSIDE, _OXTS = "velodyne_points", "oxts"
# Indices of angular rates and accelerations in the vehicle frame, from the publishers' dataformat.txt.
_RATES, _FORCES = slice(17, 20), slice(11, 14)
_EARTH_RADIUS_M = 6378137.0  # of WGS 84, as in the publishers' own tools
_MOST_TURN_S = 1.0


def _load(path: Path, account: Account) -> Contents:
    """The folder of one drive; the robot's frame is that of the lidar.

    A stamp is the time at which the lidar points forward; each point's time follows from its bearing.
    """
    for camera in sorted(path.glob("image_*")):
        account.report.ignore(camera.name, "a camera without depth")
    files = _clouds(path, account)
    clouds = CloudFolder(tuple(files), parse=_WithTimes(_turn(path)).parse).numbered(account)
    stamps = _stamps_of_oxts(path, account)
    if not stamps:
        return Contents(log=clouds)
    if len(stamps) <= len(files):
        account.report.ignore(_OXTS, ONCE_A_CLOUD, len(stamps))
        return Contents(log=clouds)
    return Contents(log=with_imu(clouds, _imu(path, stamps, account)))


class _WithTimes:
    """Reads clouds and computes point times: the lidar rotates clockwise, one revolution per cloud."""

    def __init__(self, turn_s: float) -> None:
        self._turn_s = turn_s

    def parse(self, path: Path) -> Parsed:
        """Points and their times relative to the forward direction."""
        points = KITTI_ROWS(path)[0] if path.suffix == ".bin" else _from_text(path)
        bearing = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
        return points, {"t": -bearing * (self._turn_s / (2.0 * math.pi))}


def _from_text(path: Path) -> FloatArray:
    """Four numbers per line, as in recordings that are not synced."""
    try:
        rows = np.array(path.read_bytes().split(), dtype=np.float64)
        return rows.reshape(-1, 4)[:, :3]
    except (OSError, ValueError) as error:
        raise RecordFault(DAMAGED, f"{path.name}: {error}") from error


def _clouds(path: Path, account: Account) -> list[StampedFile]:
    """Clouds by number: line N of the stamps, from 0, belongs to cloud N."""
    inside = path / _INSIDE
    stamps = dict(_stamps(inside / "timestamps.txt", account))
    files = numbered_files(inside / "data", r"(\d{1,10})\.(?:bin|txt)")
    for number in sorted(files.keys() ^ stamps.keys()):
        # Published drives contain lines for clouds that were never recorded.
        reason = UNPAIRED if number in files else WITHOUT_CLOUD
        account.refuse(RecordFault(reason, f"number {number}"), "timestamps.txt", number + 1)
    numbers = sorted(files.keys() & stamps.keys())
    return [StampedFile(stamps[number], files[number], number) for number in numbers]


def _stamps(path: Path, account: Account) -> Iterator[tuple[int, float]]:
    """Lines ``2011-09-26 13:02:25.951199337`` by their numbers from 0."""
    for number, line in numbered_lines(path, account):
        with account.refusing(path.name, number):
            if fields := line.split():
                yield number - 1, stamp_of(b"T".join(fields))


def _turn(path: Path) -> float:
    """Duration of a revolution in s: between its start and end stamps, or from cloud to cloud."""
    quiet = Account.quiet(path)
    first, last = (
        dict(_stamps(file, quiet)) if (file := path / _INSIDE / name).is_file() else {}
        for name in ("timestamps_start.txt", "timestamps_end.txt")
    )
    turns = [last[number] - first[number] for number in first.keys() & last.keys()]
    turns = (
        turns
        or np.diff([stamp_s for _, stamp_s in _stamps(path / _INSIDE / "timestamps.txt", quiet)]).tolist()
    )
    turn_s = float(np.median(turns)) if turns else 0.0
    return turn_s if 0.0 < turn_s < _MOST_TURN_S else 0.0


def _stamps_of_oxts(path: Path, account: Account) -> dict[int, float]:
    """Stamps of the GPS and IMU readings by number; none if there is no such file."""
    file = path / _OXTS / "timestamps.txt"
    return dict(_stamps(file, account)) if file.is_file() else {}


def _oxts(
    path: Path, stamps: dict[int, float], least: int, account: Account
) -> Iterator[tuple[int, float, list[float]]]:
    """Number, stamp and values of each GPS and IMU reading; readings with too few values are counted."""
    for number, file in sorted(numbered_files(path / _OXTS / "data", r"(\d{1,10})\.txt").items()):
        numbers = numbers_of(file)
        if number not in stamps or numbers is None or numbers.size < least or abs(numbers[0]) >= 90.0:
            account.refuse(RecordFault(BAD_POSE, file.name), _OXTS, number)
        else:
            yield number, stamps[number], numbers.tolist()


def _imu(path: Path, stamps: dict[int, float], account: Account) -> Iterator[Numbered]:
    """Readings of the IMU, with its pose from the calibration."""
    T_velo_imu = _calibration(path, account)
    for number, stamp_s, numbers in _oxts(path, stamps, _RATES.stop, account):
        account.report.accept("IMU reading")
        rates, forces = np.array(numbers[_RATES]), np.array(numbers[_FORCES])
        yield number, ImuReading(stamp_s, rates, forces, T_velo_imu)


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """Ground truth of the lidar by latitude, longitude, height and angles, projected as published."""
    # Without a calibration, the lidar is assumed to be at the pose of the IMU.
    T_imu_velo = (_calibration(path, account) or gtsam.Pose3()).inverse()
    poses: list[tuple[float, gtsam.Pose3]] = []
    scale = None
    for _, stamp_s, numbers in _oxts(path, _stamps_of_oxts(path, account), 6, account):
        latitude, longitude, height, roll, pitch, yaw = numbers[:6]
        scale = math.cos(math.radians(latitude)) if scale is None else scale
        east = scale * _EARTH_RADIUS_M * math.radians(longitude)
        north = scale * _EARTH_RADIUS_M * math.log(math.tan(math.radians(90.0 + latitude) / 2.0))
        place_m = np.array([east, north, height])
        T_world_imu = gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, roll), place_m)
        poses.append((stamp_s, T_world_imu.compose(T_imu_velo)))
    return trajectory_of(poses)


def _calibration(path: Path, account: Account) -> gtsam.Pose3 | None:
    """``T_velo_imu`` from ``calib_imu_to_velo.txt`` next to the drive or in it; None if there is none."""
    file = first_file(folder / "calib_imu_to_velo.txt" for folder in (path, path.resolve().parent))
    return rotation_and_shift(file, account) if file else None


FORMAT = recorded(
    "KITTI raw drive",
    lambda path, head: (path / _INSIDE / "data").is_dir() and (path / _INSIDE / "timestamps.txt").is_file(),
    _load,
    _groundtruth,
)
