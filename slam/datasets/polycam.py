"""Polycam's raw data of a scan with lidar: keyframes of an iPhone or iPad with depth and lenses."""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration, pose_from_matrix, read_calibration
from slam.datasets.dataset_format import recorded
from slam.datasets.image_files import ImageFiles
from slam.datasets.lens_files import json_object, lens_of_json, median_lens
from slam.datasets.numbered_frames import at_rate, numbered_camera, numbered_files
from slam.datasets.pose_files import BAD_MATRIX, COMPARED, T_ARKIT_OPTICAL, trajectory_of
from slam.datasets.recording import Contents
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.measurements import CameraIntrinsics

_stamp = at_rate(1e6)  # file names are microseconds since the phone started
_STAMPED = r"(\d{1,18})\.%s"


def _check(path: Path) -> None:
    """Reject a scan without depth."""
    if not (_keyframes(path) / "depth").is_dir():
        raise DatasetError(
            f"{path} is a scan from photographs, without depth; scan in LiDAR mode and export the raw data"
        )


def _load(path: Path, account: Account) -> Contents:
    """The folder of one scan, without depth in which the phone has no confidence."""
    account.report.note(COMPARED, 1)
    inside = _keyframes(path)
    images, cameras = _images_and_cameras(inside)
    calibration = read_calibration(path, Calibration(_lens(cameras, account), 1000.0))
    colors = numbered_files(images, _STAMPED % "(?:jpe?g|png)")
    depths = numbered_files(inside / "depth", _STAMPED % "png")
    source = ImageFiles(inside / "confidence")
    return Contents([numbered_camera(colors, depths, calibration, account, _stamp, source)])


def _keyframes(path: Path) -> Path:
    """The folder of the images."""
    inside = path / "keyframes"
    return inside if (inside / "cameras").is_dir() and (inside / "images").is_dir() else path


def _images_and_cameras(inside: Path) -> tuple[Path, Path]:
    """Images and cameras from the app's bundle adjustment if it was done, else those of the phone."""
    corrected = inside / "corrected_images", inside / "corrected_cameras"
    return (
        corrected if all(place.is_dir() for place in corrected) else (inside / "images", inside / "cameras")
    )


def _lens(cameras: Path, account: Account) -> CameraIntrinsics:
    """The median lens of the keyframes."""
    files = numbered_files(cameras, _STAMPED % "json").values()
    lenses = [lens_of_json(file, json_object(file)) for file in files]
    if not lenses:
        raise DatasetError(f"{cameras} holds no cameras; export the raw data again")
    return median_lens(lenses, account)


def _truth(path: Path, account: Account) -> Trajectory | None:
    """The poses of the app."""
    poses: list[tuple[float, gtsam.Pose3]] = []
    _, cameras = _images_and_cameras(_keyframes(path))
    for number, file in sorted(numbered_files(cameras, _STAMPED % "json").items()):
        fields = json_object(file)
        damages = (KeyError, TypeError, ValueError, OverflowError)
        with account.refusing(file.name, number, BAD_MATRIX, *damages):
            rows = [[float(fields[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]
            pose = pose_from_matrix(np.array([*rows, [0.0, 0.0, 0.0, 1.0]]))
            poses.append((_stamp(number), pose.compose(T_ARKIT_OPTICAL)))
    return trajectory_of(poses)


FORMAT = recorded(
    "Polycam raw data",
    lambda path, head: all((_keyframes(path) / name).is_dir() for name in ("cameras", "images")),
    _load,
    _truth,
    _check,
)
