"""Raw NYU Depth V2: images of a Kinect as its driver wrote them, with stamps in their names.

Silberman et al. 2012, "Indoor Segmentation and Support Inference from RGBD Images"; lenses, poses and the
depth formula from camera_params.m of its toolbox.
"""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.bags.camera import BagCamera
from slam.datasets.bags.lens import Lens
from slam.datasets.budget import Budget
from slam.datasets.calibration import Calibration, pose_from_matrix
from slam.datasets.camera_frames import Camera
from slam.datasets.dataset import RecordFault
from slam.datasets.dataset_format import recorded
from slam.datasets.frame_pairs import pair_images
from slam.datasets.image_files import FILES, NOT_16_BIT, decoded, file_content
from slam.datasets.recording import Contents
from slam.datasets.stamped_files import StampedFile, stamp_of
from slam.measurements import CameraIntrinsics, ColorImage, Float32Array

DEPTH_LENS = Lens(
    CameraIntrinsics(582.62448, 582.69103, 313.04476, 238.44390, 640, 480),
    np.array([-0.0998972, 0.3906532, 0.0019291, -0.0019292, -0.5103173]),
)
COLOR_LENS = Lens(
    CameraIntrinsics(518.85790, 519.46961, 325.58245, 253.73617, 640, 480),
    np.array([0.2079662, -0.5861383, 0.0007223, 0.0010480, 0.4985699]),
)
# Rows of the pose of the colour camera in the depth camera as published: rotation before translation.
_TURN = (
    (0.9999780, 0.0050518, 0.0043011),
    (-0.0050360, 0.9999805, -0.0036880),
    (-0.0043197, 0.0036662, 0.9999840),
)
_SHIFT_M = (0.0250319, -0.0002934, 0.0006624)
# Depth in metres is first / (second - steps); steps below the third are invalid, and so is the last.
SCALE, INFINITE, _FIRST_STEP, _NO_STEP = 351.3, 1092.5, 600, 2047
_FARTHEST_M = 10.0


def T_depth_color() -> gtsam.Pose3:
    """Pose of the colour camera."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(_TURN)
    matrix[:3, 3] = matrix[:3, :3] @ np.array(_SHIFT_M)
    return pose_from_matrix(matrix)


def _load(path: Path, account: Account) -> Contents:
    """Pairs of colour and depth that are nearest in time."""
    colors, depths = (_images(path, f"{kind}-*-*.p[gp]m", account) for kind in "rd")
    pairs = pair_images(colors, depths, account, "camera")
    return Contents([Camera("camera", pairs, Calibration(DEPTH_LENS.intrinsics, 1.0), source=_Dumps())])


def _images(path: Path, pattern: str, account: Account) -> list[StampedFile]:
    """Files sorted by the stamps in their names; empty ones are counted."""
    stamped = []
    for number, file in enumerate(sorted(path.glob(pattern)), 1):
        with account.refusing(file.name, number):
            stamped.append(StampedFile(stamp_of(file.name.split("-")[1].encode()), file, number))
    return sorted(stamped, key=lambda image: image.stamp_s)


class _Dumps:
    """Images as those of one camera without distortion; depth must be read before its colour."""

    def __init__(self) -> None:
        self._camera = BagCamera("camera", DEPTH_LENS, COLOR_LENS, T_depth_color(), None, 0.0)
        self._latest = np.zeros((0, 0), np.float32)

    def depth(self, file: StampedFile, calibration: Calibration, budget: Budget) -> Float32Array:
        """See `slam.datasets.image_files.ImageSource`."""
        steps = decoded(file_content(file.path, budget), file.path.name, budget)
        if steps.ndim != 2 or steps.dtype != np.uint16:
            raise RecordFault(NOT_16_BIT, f"{file.path.name}: {steps.dtype} {steps.shape}")
        steps = steps.byteswap()
        known = (steps >= _FIRST_STEP) & (steps < INFINITE - SCALE / _FARTHEST_M) & (steps != _NO_STEP)
        disparity = np.where(known, np.float32(INFINITE) - steps, np.float32(np.inf))
        self._latest = self._camera.flat_depth((np.float32(SCALE) / disparity).astype(np.float32))
        return self._latest

    def color(self, file: StampedFile, budget: Budget) -> ColorImage:
        """See `slam.datasets.image_files.ImageSource`."""
        height, width = self._latest.shape
        intrinsics = Calibration(DEPTH_LENS.intrinsics, 1.0).intrinsics_for(width, height)
        return self._camera.fitted(FILES.color(file, budget), self._latest, intrinsics)


FORMAT = recorded(
    "NYU raw dumps",
    lambda path, head: path.is_dir() and any(path.glob("d-*-*.pgm")) and any(path.glob("r-*-*.ppm")),
    _load,
)
