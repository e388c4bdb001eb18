"""The extracted folders of OpenLORIS-Scene: a RealSense D435i and wheel odometry on a Segway base.

Shi et al. 2020, "Are We Ready for Service Robots? The OpenLORIS-Scene Datasets for Lifelong SLAM".
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration, pose_from, pose_from_matrix, read_calibration, read_yaml
from slam.datasets.calibration_formats import numbers_in
from slam.datasets.camera_frames import Camera
from slam.datasets.dataset_format import recorded
from slam.datasets.frame_pairs import pair_images
from slam.datasets.recording import Contents, Numbered
from slam.datasets.stamped_files import numbered_poses, read_image_list
from slam.datasets.tum import read_groundtruth
from slam.errors import DatasetError
from slam.measurements import CameraIntrinsics, WheelOdometry

_COLOR = "color.txt"
_DEPTHS = ("aligned_depth.txt", "depth.txt")
_WHEELS = "odom.txt"
_SENSORS, _TRANSFORMS = "sensors.yaml", "trans_matrix.yaml"
_BASE_FRAME, _CAMERA_FRAME = "base_link", "d400_color_optical_frame"
_DEPTH_STEPS_PER_M = 1000.0

# The publishers' own calibration, from the table in their tools (openloris-scene-tools, segway_transforms).
_INTRINSICS = CameraIntrinsics(611.451, 611.4857, 433.204, 249.473, 848, 480)
_MOUNT = ((0.2264837, -0.0511419, 0.916), (-0.4967623, 0.4998796, -0.4951068, 0.5081504))

ASSUMED = "the publishers' D435i intrinsics assumed, no sensors.yaml"
ASSUMED_MOUNT = "the publishers' camera mounting assumed, no trans_matrix.yaml"
UNALIGNED = "depth assumed to be registered to colour, no aligned_depth.txt"


def _camera(folder: Path, account: Account) -> Camera:
    """The colour camera with the depth registered to it."""
    depth = next(folder / name for name in _DEPTHS if (folder / name).is_file())
    if depth.name != _DEPTHS[0]:
        account.report.note(UNALIGNED, 1)
    colors, depths = read_image_list(folder / _COLOR, account), read_image_list(depth, account)
    calibration = Calibration(_INTRINSICS, _DEPTH_STEPS_PER_M, assumed=ASSUMED)
    if (folder / _SENSORS).is_file():
        calibration = replace(calibration, intrinsics=_intrinsics(folder / _SENSORS), assumed="")
    mount = _mount(folder / _TRANSFORMS) if (folder / _TRANSFORMS).is_file() else None
    calibration = read_calibration(folder, replace(calibration, T_base_camera=mount))
    if calibration.T_base_camera is None:
        account.report.note(ASSUMED_MOUNT, 1)
        calibration = replace(calibration, T_base_camera=pose_from(*_MOUNT))
    return Camera("camera", pair_images(colors, depths, account, "camera"), calibration)


def _wheels(folder: Path, account: Account) -> Iterator[Numbered]:
    """Planar poses of the wheel odometry; velocities are not used."""
    if not (folder / _WHEELS).is_file():
        return
    for number, row in numbered_poses(folder / _WHEELS, account):
        x, y, z, w = row[4:]
        yaw = float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
        account.report.line_count += 1
        account.report.accept("odom")
        yield number, WheelOdometry(float(row[0]), gtsam.Pose2(float(row[1]), float(row[2]), yaw))


def _intrinsics(path: Path) -> CameraIntrinsics:
    """Intrinsics of the colour camera in ``sensors.yaml``, whose order is fx cx fy cy."""
    try:
        camera = read_yaml(path)[_CAMERA_FRAME]
        fx, cx, fy, cy = numbers_in(camera["intrinsics"]).tolist()
        width, height = int(camera["width"]), int(camera["height"])
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{path} gives no intrinsics of {_CAMERA_FRAME} ({error}); correct it") from error
    if not (min(fx, fy) > 0.0 and min(width, height) > 0):
        raise DatasetError(f"{path}: fx {fx}, fy {fy}, {width} x {height} are not a camera's; correct it")
    return CameraIntrinsics(fx, fy, cx, cy, width, height)


def _mount(path: Path) -> gtsam.Pose3 | None:
    """Pose of the colour camera on the base from ``trans_matrix.yaml``, None if it has no such transform."""
    try:
        for transform in read_yaml(path)["trans_matrix"]:
            frames = (transform["parent_frame"], transform["child_frame"])
            if set(frames) == {_BASE_FRAME, _CAMERA_FRAME}:
                pose = pose_from_matrix(numbers_in(transform["matrix"]).reshape(4, 4))
                return pose if frames[0] == _BASE_FRAME else pose.inverse()
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{path} holds no list of transforms ({error}); correct or remove it") from error
    return None


FORMAT = recorded(
    "OpenLORIS-Scene folder",
    lambda path, head: (path / _COLOR).is_file() and any((path / name).is_file() for name in _DEPTHS),
    lambda *folder: Contents([_camera(*folder)], _wheels(*folder)),
    read_groundtruth,
)
