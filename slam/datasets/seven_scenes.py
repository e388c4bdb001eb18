"""A sequence of the 7-Scenes dataset: numbered colour, depth and pose files in a folder.

Shotton et al. 2013, "Scene Coordinate Regression Forests for Camera Relocalization in RGB-D Images".
"""

from __future__ import annotations

from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration, read_calibration
from slam.datasets.camera_frames import Camera
from slam.datasets.numbered_frames import (
    at_rate,
    lens_of,
    numbered_camera,
    numbered_files,
    poses_of_files,
)
from slam.datasets.pose_files import square_matrix
from slam.datasets.recording import Contents, Recording
from slam.errors import DatasetError
from slam.measurements import CameraIntrinsics

ASSUMED = "intrinsics assumed (585 585 320 240 at 640 x 480); give a camera-intrinsics.txt"

_IMAGE, _POSE = r"frame-(\d{1,9})\.%s\.(?:png|jpe?g)", r"frame-(\d{1,9})\.pose\.txt"
_INTRINSICS_FILE = "camera-intrinsics.txt"
_DEFAULT = CameraIntrinsics(585.0, 585.0, 320.0, 240.0, 640, 480)
_DEPTH_STEPS_PER_M = 1000.0
_NO_READING = 65535


def looks_like_seven_scenes(path: Path, head: bytes) -> bool:
    """Whether a path is a folder with a frame of either kind."""
    return path.is_dir() and any(numbered_files(path, _IMAGE % kind) for kind in ("color", "depth"))


def open_seven_scenes(path: Path, strict: bool) -> Recording:
    """A folder of one sequence."""
    return Recording(
        path,
        lambda account: Contents([_camera(path, account)]),
        lambda account: poses_of_files(numbered_files(path, _POSE), at_rate(), account),
        strict=strict,
    )


def _camera(folder: Path, account: Account) -> Camera:
    """Colour and depth of the same number are a pair; frame N is N / 30 s old."""
    colors, depths = (numbered_files(folder, _IMAGE % kind) for kind in ("color", "depth"))
    intrinsics = _intrinsics(folder)
    assumed = ASSUMED if intrinsics is _DEFAULT else ""
    calibration = Calibration(intrinsics, _DEPTH_STEPS_PER_M, (_NO_READING,), assumed=assumed)
    return numbered_camera(colors, depths, read_calibration(folder, calibration), account, at_rate())


def _intrinsics(folder: Path) -> CameraIntrinsics:
    """The 3 x 3 matrix of the file beside the frames, of unstated size; the published ones without it."""
    path = folder / _INTRINSICS_FILE
    if not path.is_file():
        return _DEFAULT
    matrix = square_matrix(path, 3)
    try:
        if matrix is None:
            raise ValueError("no 3 x 3 camera matrix")
        return lens_of(matrix)
    except ValueError as error:
        raise DatasetError(f"{path}: {error}; correct it, or remove the file") from error
