"""KITTI's raw recordings, synced or as extracted, and KITTI-360: a Velodyne, GPS and IMU as truth.

Geiger et al. 2013, "Vision meets Robotics: The KITTI Dataset".
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.cloud_files import DAMAGED, KITTI_ROWS, Parsed
from slam.datasets.clouds_over_time import UNPAIRED, WITHOUT_CLOUD, CloudFolder
from slam.datasets.dataset import RecordFault
from slam.datasets.dataset_format import DatasetFormat
from slam.datasets.log_file import numbered_lines
from slam.datasets.numbered_frames import numbered_files
from slam.datasets.pose_files import BAD_MATRIX, numbers_of, pose_of_row, trajectory_of
from slam.datasets.recording import Contents, Recording
from slam.datasets.stamped_files import BAD_POSE, BAD_STAMP, StampedFile
from slam.measurements import FloatArray, Trajectory

_INSIDE = "velodyne_points"
_EARTH_RADIUS_M = 6378137.0  # of WGS 84, as in the publishers' own tools
_MOST_TURN_S = 1.0


def looks_like_kitti_raw(path: Path, head: bytes) -> bool:
    """Whether a path is the folder of one drive with clouds."""
    inside = path / _INSIDE
    return (inside / "data").is_dir() and (inside / "timestamps.txt").is_file()


def open_kitti_raw(path: Path, strict: bool) -> Recording:
    """A folder of one drive; the lidar is the robot's frame.

    A stamp is when the lidar looked ahead; each point is as old as its bearing tells.
    """

    def load(account: Account) -> Contents:
        for camera in sorted(path.glob("image_*")):
            account.report.ignore(camera.name, "a camera without depth")
        clouds = CloudFolder(tuple(_clouds(path, account)), parse=_WithTimes(_turn(path)).parse)
        return Contents(log=clouds.numbered(account))

    return Recording(path, load, lambda account: _groundtruth(path, account), strict=strict)


class _WithTimes:
    """Reads clouds and works out when each point was seen: the lidar turns clockwise, once a turn."""

    def __init__(self, turn_s: float) -> None:
        self._turn_s = turn_s

    def parse(self, path: Path) -> Parsed:
        """Points and their times after they were ahead."""
        points = KITTI_ROWS(path)[0] if path.suffix == ".bin" else _from_text(path)
        bearing = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
        return points, {"t": -bearing * (self._turn_s / (2.0 * math.pi))}


def _from_text(path: Path) -> FloatArray:
    """Four numbers a line, as the recordings that are not synced have them."""
    try:
        rows = np.array(path.read_bytes().split(), dtype=np.float64)
        return rows.reshape(-1, 4)[:, :3]
    except (OSError, ValueError) as error:
        raise RecordFault(DAMAGED, f"{path.name}: {error}") from error


def _clouds(path: Path, account: Account) -> list[StampedFile]:
    """Clouds by their numbers: line N of the stamps, from 0, is of cloud N."""
    inside = path / _INSIDE
    stamps = dict(_stamps(inside / "timestamps.txt", account))
    files = numbered_files(inside / "data", r"(\d{1,10})\.(?:bin|txt)")
    for number in sorted(files.keys() ^ stamps.keys()):
        # Clouds that were never recorded leave a line behind; that is how drives are published.
        reason = UNPAIRED if number in files else WITHOUT_CLOUD
        account.refuse(RecordFault(reason, f"number {number}"), "timestamps.txt", number + 1)
    both = sorted(files.keys() & stamps.keys())
    return [StampedFile(stamps[number], files[number], number) for number in both]


def _stamps(path: Path, account: Account) -> Iterator[tuple[int, float]]:
    """Lines ``2011-09-26 13:02:25.951199337`` by their numbers from 0."""
    for number, line in numbered_lines(path, lambda fault, at: account.refuse(fault, path.name, at)):
        text = line.decode("ascii", "replace").strip()
        try:
            moment, _, fraction = text.partition(".")
            whole = datetime.strptime(moment, "%Y-%m-%d %H:%M:%S").replace(tzinfo=UTC).timestamp()
            yield number - 1, whole + float(f"0.{fraction or 0}")
        except ValueError as error:
            if text:
                account.refuse(RecordFault(BAD_STAMP, str(error)), path.name, number)


def _turn(path: Path) -> float:
    """Seconds of a turn: between the stamps of its begin and end, or from cloud to cloud."""
    quiet = Account(path.name, Recording(path, lambda _: Contents(), lambda _: None).report, strict=False)
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


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """Of the lidar, by latitude, longitude, height and angles in ``oxts``, projected as published."""
    place = path / "oxts"
    stamps_file = place / "timestamps.txt"
    if not stamps_file.is_file():
        return None
    stamps = dict(_stamps(stamps_file, account))
    T_velo_imu = _calibration(path, account)
    T_imu_velo = T_velo_imu.inverse()
    found: list[tuple[float, gtsam.Pose3]] = []
    scale = None
    for number, file in sorted(numbered_files(place / "data", r"(\d{1,10})\.txt").items()):
        numbers = numbers_of(file)
        if number not in stamps or numbers is None or numbers.size < 6 or abs(numbers[0]) >= 90.0:
            account.refuse(RecordFault(BAD_POSE, file.name), "oxts", number)
            continue
        latitude, longitude, height, roll, pitch, yaw = numbers[:6].tolist()
        scale = math.cos(math.radians(latitude)) if scale is None else scale
        east = scale * _EARTH_RADIUS_M * math.radians(longitude)
        north = scale * _EARTH_RADIUS_M * math.log(math.tan(math.radians(90.0 + latitude) / 2.0))
        place_m = np.array([east, north, height])
        T_world_imu = gtsam.Pose3(gtsam.Rot3.Ypr(yaw, pitch, roll), place_m)
        found.append((stamps[number], T_world_imu.compose(T_imu_velo)))
    return trajectory_of(found)


def _calibration(path: Path, account: Account) -> gtsam.Pose3:
    """``calib_imu_to_velo.txt`` beside the drive or in it; without one the lidar is where the IMU is."""
    places = (path, path.resolve().parent)
    file = next(
        (one / "calib_imu_to_velo.txt" for one in places if (one / "calib_imu_to_velo.txt").is_file()), None
    )
    if file is None:
        return gtsam.Pose3()
    rows: dict[bytes, list[bytes]] = {}
    for _, line in numbered_lines(file, lambda fault, at: account.refuse(fault, file.name, at)):
        name, _, numbers = line.partition(b":")
        rows[name.strip()] = numbers.split()
    turn, shift = rows.get(b"R", []), rows.get(b"T", [])
    try:
        if len(turn) != 9 or len(shift) != 3:
            raise ValueError(f"{len(turn)} and {len(shift)} numbers")
        return pose_of_row([*turn[:3], shift[0], *turn[3:6], shift[1], *turn[6:], shift[2]])
    except ValueError as error:
        account.refuse(RecordFault(BAD_MATRIX, str(error)), file.name, 1)
        return gtsam.Pose3()


FORMAT = DatasetFormat("KITTI raw drive", looks_like_kitti_raw, open_kitti_raw)
