"""ARKitScenes: the low-resolution images and depth of an iPad, and the poses of ARKit.

Baruch et al. 2021, "ARKitScenes: A Diverse Real-World Dataset For 3D Indoor Scene Understanding Using Mobile
RGB-D Data".
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration, read_calibration
from slam.datasets.camera_frames import Camera
from slam.datasets.dataset import RecordFault
from slam.datasets.dataset_format import recorded
from slam.datasets.frame_pairs import pair_images
from slam.datasets.image_files import ImageFiles
from slam.datasets.lens_files import checked, median_lens
from slam.datasets.pose_files import COMPARED, PoseTable, numbers_of, trajectory_of
from slam.datasets.recording import Contents
from slam.datasets.stamped_files import StampedFile
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.measurements import CameraIntrinsics

_COLORS, _DEPTHS = "lowres_wide", "lowres_depth"
_LENSES, _POSES = "lowres_wide_intrinsics", "lowres_wide.traj"
_TABLE = PoseTable(position=4, rotation=1, order="xyz")
_NAME = re.compile(r"(?:.*_)?(\d+\.\d+)\.(?:png|pincam)")  # VIDEO_SECONDS.png


def _load(path: Path, account: Account) -> Contents:
    """The folder of one video, without depth in which ARKit has no confidence."""
    account.report.note(COMPARED, 1)
    calibration = read_calibration(path, Calibration(_lens(path, account), 1000.0))
    pairs = pair_images(_stamped(path / _COLORS), _stamped(path / _DEPTHS), account, "camera")
    return Contents([Camera("camera", pairs, calibration, source=ImageFiles(path / "confidence"))])


def _stamped(folder: Path) -> list[StampedFile]:
    """Files in the order of the stamps in their names."""
    entries = [
        (match, entry)
        for entry in (folder.iterdir() if folder.is_dir() else ())
        if (match := _NAME.fullmatch(entry.name))
    ]
    entries.sort(key=lambda item: (float(item[0][1]), item[1].name))
    return [StampedFile(float(match[1]), entry, number) for number, (match, entry) in enumerate(entries, 1)]


def _lens(path: Path, account: Account) -> CameraIntrinsics:
    """The median over the frames, each with a file of width, height, fx, fy, cx, cy."""
    lenses = []
    for file in _stamped(path / _LENSES):
        numbers = numbers_of(file.path)
        if numbers is None or numbers.size != 6:
            account.refuse(RecordFault("lens file without six numbers", file.path.name), _LENSES, file.number)
            continue
        width, height, fx, fy, cx, cy = numbers.tolist()
        matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy]])
        lenses.append(checked(file.path, matrix, int(width), int(height)))
    if not lenses:
        raise DatasetError(f"{path} has no lens: {_LENSES} is missing or empty; download it, too")
    return median_lens(lenses, account)


def _groundtruth(folder: Path, account: Account) -> Trajectory | None:
    """Lines with a stamp, and the rotation and translation from world to camera."""
    rows = _TABLE.rows(folder / _POSES, account) if (folder / _POSES).is_file() else ()
    return trajectory_of((stamp_s, pose.inverse()) for _, stamp_s, pose in rows)


FORMAT = recorded(
    "ARKitScenes video",
    lambda path, head: (path / _COLORS).is_dir() and (path / _DEPTHS).is_dir(),
    _load,
    _groundtruth,
)
