"""ICL-NUIM in its TUM-compatible form: rendered images, with frame numbers instead of stamps.

Handa et al. 2014, "A Benchmark for RGB-D Visual Odometry, 3D Reconstruction and SLAM". The published lens
has fy = -480: y points up in the camera and in the world, which makes both left-handed. Here y points down as
in every other camera, fy is 480, and the poses are mirrored accordingly.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration
from slam.datasets.dataset_format import recorded
from slam.datasets.numbered_frames import NO_STAMPS, RATE_HZ
from slam.datasets.recording import Contents
from slam.datasets.stamped_files import read_poses
from slam.datasets.tum import DEPTH_STEPS_PER_M, has_tum_layout, listed_camera
from slam.estimates import Trajectory
from slam.measurements import CameraIntrinsics

_LENS = CameraIntrinsics(481.20, 480.0, 319.50, 239.50, 640, 480)
_TRUTHS = "*.gt.freiburg"
_NAME = "frei_png"
# Mirrors the y axis of a position, and of a rotation vector, whose sign a mirror inverts.
_MIRROR, _MIRRORED_TURN = np.array([1.0, -1.0, 1.0]), np.array([-1.0, 1.0, -1.0, 1.0])


def looks_like_icl_nuim(path: Path, head: bytes) -> bool:
    """Whether a path is a folder in TUM layout with such a ground truth or such a name."""
    named = path.is_dir() and (_NAME in path.resolve().name or next(path.glob(_TRUTHS), None) is not None)
    return bool(named) and has_tum_layout(path)


def _load(path: Path, account: Account) -> Contents:
    """The folder of one trajectory; frame N has the stamp N / 30 s."""
    account.report.note(NO_STAMPS.format(rate=RATE_HZ), 1)
    calibration = Calibration(_LENS, DEPTH_STEPS_PER_M)
    return Contents([listed_camera(path, "camera", calibration, account, RATE_HZ)])


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """The poses in or next to the folder, right-handed."""
    pose_file = next((file for place in (path, path.resolve().parent) for file in place.glob(_TRUTHS)), None)
    truth = read_poses(pose_file, account) if pose_file else None
    if truth is None:
        return None
    return Trajectory(
        truth.stamps_s / RATE_HZ, truth.positions_m * _MIRROR, truth.quaternions_xyzw * _MIRRORED_TURN
    )


FORMAT = recorded("ICL-NUIM folder", looks_like_icl_nuim, _load, _groundtruth)
