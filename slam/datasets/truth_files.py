"""Reads separate ground truth files in the formats of public data sets."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import gtsam

from slam.datasets import boreas, euroc, mulran, nclt, newer_college
from slam.datasets.account import Account
from slam.datasets.log_file import first_file, read_head
from slam.datasets.numbered_frames import RATE_HZ
from slam.datasets.pose_files import numbers_of, pose_blocks, pose_lines, trajectory_of
from slam.datasets.stamped_files import fields_of
from slam.errors import DatasetError
from slam.estimates import Trajectory

_HEAD_BYTES = 4096
_TUM_FIELDS = 8
_KITTI, _MULRAN, _NEWER, _NCLT, _BLOCK = 12, 13, 9, 7, 3


def read_truth(path: Path) -> Trajectory | None:
    """A trajectory in another format than TUM's; None if it is TUM's or unknown.

    Known formats are EuRoC's and TUM-VI's ``data.csv``, KITTI's poses with ``times.txt`` in the folder or in
    that of the sequence, the tables of Newer College, NCLT, Boreas and MulRan, and Redwood's ``.log``. Poses
    are those in the file, of the robot, camera or lidar frame that it defines. Invalid lines are skipped.

    Raises
    ------
    DatasetError
        The file contains no pose, or KITTI's poses have no times.
    """
    head = read_head(path, _HEAD_BYTES).decode("ascii", "replace")
    account = Account.quiet(path)
    lines = list(islice(fields_of(path, account, 1), 2))
    counts = [len(fields) for _, fields in lines]
    if not counts:
        raise DatasetError(f"{path} holds no pose; give a trajectory")
    # Count the numbers in poses, because comments may contain numbers, too.
    commas = any("," in line for line in head.splitlines() if not line.lstrip().startswith("#"))
    truth: Trajectory | None
    if "GPSTime" in head:
        truth = boreas.read_poses(path, account)
    elif counts[0] == _MULRAN:
        truth = mulran.read_poses(path, account)
    elif counts[0] == _KITTI:
        truth = _kitti(path, account)
    elif counts[0] == _NCLT and commas:
        truth = nclt.read_poses(path, account)
    elif counts[0] == _NEWER and commas:
        truth = newer_college.read_poses(path, account)
    elif counts[0] >= _TUM_FIELDS and commas:
        truth = euroc.POSES.read(path, account)
    elif counts == [_BLOCK, 4]:
        blocks = sorted(pose_blocks(path, account).items())
        truth = trajectory_of((number / RATE_HZ, pose) for number, pose in blocks)
    else:
        return None
    if truth is None:
        raise DatasetError(f"{path} holds no pose that can be read; give a trajectory")
    return truth


def _kitti(path: Path, account: Account) -> Trajectory | None:
    """Read lines of twelve numbers, with the times of their sequence."""
    places = (path.parent, path.resolve().parent.parent / "sequences" / path.stem)
    file = first_file(place / "times.txt" for place in places)
    stamps_s = None if file is None else numbers_of(file)
    if stamps_s is None:
        raise DatasetError(f"{path} has poses without stamps; put the times.txt of its sequence beside it")

    def placed() -> Iterator[tuple[float, gtsam.Pose3]]:
        for stamp_s, pose in zip(stamps_s.tolist(), pose_lines(path, account), strict=False):
            if pose is not None:
                yield stamp_s, pose

    return trajectory_of(placed())
