"""A sequence of the 7-Scenes dataset: numbered colour, depth and pose files in a folder.

Shotton et al. 2013, "Scene Coordinate Regression Forests for Camera Relocalization in RGB-D Images".
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration, pose_from_matrix, read_calibration
from slam.datasets.camera_frames import Camera
from slam.datasets.dataset import RecordFault
from slam.datasets.frame_pairs import NO_COLOR, NO_DEPTH, FramePair
from slam.datasets.recording import Contents, Recording
from slam.datasets.stamped_files import StampedFile
from slam.errors import DatasetError
from slam.measurements import CameraIntrinsics, FloatArray, Trajectory

RATE_HZ = 30.0  # the files have no stamps
BAD_POSE = "pose file without a 4 x 4 rigid transform"
ASSUMED = "intrinsics assumed (585 585 320 240 at 640 x 480); give a camera-intrinsics.txt"

_FILE = re.compile(r"frame-(\d{1,9})\.(color|depth|pose)\.(png|jpe?g|txt)", re.IGNORECASE)
_INTRINSICS_FILE = "camera-intrinsics.txt"
_DEFAULT = CameraIntrinsics(585.0, 585.0, 320.0, 240.0, 640, 480)
_DEPTH_STEPS_PER_M = 1000.0
_NO_READING = 65535


def looks_like_seven_scenes(path: Path, head: bytes) -> bool:
    """Whether a path is a folder with a frame of either kind."""
    return path.is_dir() and any(_FILE.fullmatch(entry.name) for entry in path.iterdir())


def open_seven_scenes(path: Path, strict: bool) -> Recording:
    """A folder of one sequence."""
    return Recording(
        path,
        lambda account: Contents([_camera(path, account)]),
        lambda account: _groundtruth(path, account),
        strict=strict,
    )


def _camera(folder: Path, account: Account) -> Camera:
    """Colour and depth of the same number are a pair; frame N is N / 30 s old."""
    colors, depths = _files(folder, "color"), _files(folder, "depth")
    pairs = []
    for number in sorted(colors.keys() | depths.keys()):
        stamp_s = number / RATE_HZ
        if number in colors and number in depths:
            color, depth = (StampedFile(stamp_s, files[number], number) for files in (colors, depths))
            pairs.append(FramePair(stamp_s, color, depth))
        else:
            fault = RecordFault(NO_DEPTH if number in colors else NO_COLOR, f"frame {number}")
            account.refuse(fault, "camera", number)
    default = Calibration(_intrinsics(folder), _DEPTH_STEPS_PER_M, (_NO_READING,))
    if default.intrinsics is _DEFAULT:
        default = Calibration(_DEFAULT, _DEPTH_STEPS_PER_M, (_NO_READING,), assumed=ASSUMED)
    return Camera("camera", pairs, read_calibration(folder, default))


def _files(folder: Path, kind: str) -> dict[int, Path]:
    """The files of one kind by frame number."""
    found = {}
    for entry in folder.iterdir():
        match = _FILE.fullmatch(entry.name)
        if match and match[2].lower() == kind and (match[3].lower() == "txt") == (kind == "pose"):
            found[int(match[1])] = entry
    return found


def _intrinsics(folder: Path) -> CameraIntrinsics:
    """The 3 x 3 matrix of the file beside the frames, of unstated size; the published ones without it."""
    path = folder / _INTRINSICS_FILE
    if not path.is_file():
        return _DEFAULT
    matrix = _matrix(path, 3)
    if matrix is None or min(matrix[0, 0], matrix[1, 1]) <= 0.0:
        raise DatasetError(f"{path} holds no 3 x 3 camera matrix; correct it, or remove the file")
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return CameraIntrinsics(fx, fy, cx, cy, 0, 0)


def _groundtruth(folder: Path, account: Account) -> Trajectory | None:
    """Camera to world, of the frames that have a pose."""
    stamps, positions, quaternions = [], [], []
    for number, path in sorted(_files(folder, "pose").items()):
        try:
            pose = _pose(path)
        except RecordFault as fault:
            account.refuse(fault, path.name, number)
            continue
        rotation: Any = pose.rotation().toQuaternion()
        stamps.append(number / RATE_HZ)
        positions.append(pose.translation())
        quaternions.append([rotation.x(), rotation.y(), rotation.z(), rotation.w()])
    if not stamps:
        return None
    return Trajectory(np.array(stamps), np.array(positions), np.array(quaternions))


def _pose(path: Path) -> gtsam.Pose3:
    """The transform in a pose file, its rotation replaced by the nearest true one.

    Raises
    ------
    RecordFault
        No 4 x 4 finite numbers, or no rotation.
    """
    matrix = _matrix(path, 4)
    if matrix is None:
        raise RecordFault(BAD_POSE, path.name)
    try:
        return pose_from_matrix(matrix)
    except ValueError as error:
        raise RecordFault(BAD_POSE, f"{path.name}: {error}") from error


def _matrix(path: Path, size: int) -> FloatArray | None:
    """Square matrix of finite numbers in a text file, None where it holds anything else."""
    try:
        numbers = np.array([float(field) for field in path.read_bytes().split()])
    except (OSError, ValueError):
        return None
    if numbers.size != size * size or not np.isfinite(numbers).all():
        return None
    return numbers.reshape(size, size)
