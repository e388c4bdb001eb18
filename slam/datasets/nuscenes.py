"""Sweeps of nuScenes: a car with a lidar of 32 rings.

Caesar et al. 2020, "nuScenes: A Multimodal Dataset for Autonomous Driving". Stamps: end of a sweep.
"""

from __future__ import annotations

import re
from itertools import islice
from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.cloud_files import Rows, row_of
from slam.datasets.clouds_over_time import CloudFolder, clouds_by_name
from slam.datasets.dataset import WARNING
from slam.datasets.dataset_format import recorded
from slam.datasets.recording import Contents
from slam.datasets.stamped_files import StampedFile

_LIDAR, _LOOKED_AT = "LIDAR_TOP", 8
_DRIVE = rf"([\w+-]{{1,60}})__{_LIDAR}__"
_NAME = rf"{_DRIVE}(\d{{16}})\.pcd\.bin"
_ROWS = Rows(row_of("x f4, y f4, z f4, intensity f4, ring f4"))


def _places(path: Path) -> list[Path]:
    """Folders of clouds: one for the keyframes, one for all others."""
    inside = (path, *(path / kind / _LIDAR for kind in ("samples", "sweeps")), path / _LIDAR)
    name = re.compile(_NAME)
    return [
        place
        for place in inside
        if place.is_dir() and any(name.fullmatch(file.name) for file in islice(place.iterdir(), _LOOKED_AT))
    ]


def _load(path: Path, account: Account) -> Contents:
    """The clouds of the first drive by name; the robot's frame is that of the lidar."""
    files: list[StampedFile] = []
    for place in _places(path):
        files += clouds_by_name(place, account, _NAME, lambda match: float(match[2]))
    files.sort(key=lambda file: file.stamp_s)
    drives = sorted({_drive(file) for file in files})
    if len(drives) > 1:
        others = ", ".join(drives[1:4])
        account.report.note(f"{WARNING}{len(drives)} drives: {drives[0]} is read; move {others} elsewhere", 1)
    chosen = tuple(file for file in files if _drive(file) == drives[0])
    return Contents(log=CloudFolder(chosen, parse=_ROWS).numbered(account))


def _drive(file: StampedFile) -> str:
    """The name of a cloud's drive."""
    return file.path.name.partition("__")[0]


FORMAT = recorded("nuScenes sweeps", lambda path, head: path.is_dir() and bool(_places(path)), _load)
