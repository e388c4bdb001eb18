"""TartanAir and TartanAir V2: simulated cameras, depth in metres, north-east-down poses.

Wang et al. 2020, "TartanAir: A Dataset to Push the Limits of Visual SLAM".
"""

from __future__ import annotations

from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration, read_calibration
from slam.datasets.dataset_format import recorded
from slam.datasets.image_files import ImageFiles
from slam.datasets.numbered_frames import NO_STAMPS, at_rate, numbered_camera, numbered_files
from slam.datasets.pose_files import PoseTable, trajectory_of
from slam.datasets.recording import Contents
from slam.estimates import Trajectory
from slam.measurements import CameraIntrinsics

_RATE_HZ = 10.0  # of the publishers' recordings
# The optical axes (right, down, forward) in the camera's axes (forward, right, down).
_T_NED_OPTICAL = gtsam.Pose3(gtsam.Rot3(np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])), np.zeros(3))
_POSES = PoseTable(stamp_units_s=(), position=0, rotation=3)


# The camera in the file names of both releases, and its lens with a horizontal view of 90 degrees.
_RELEASES = {
    "left": CameraIntrinsics(320.0, 320.0, 320.0, 240.0, 640, 480),
    "lcam_front": CameraIntrinsics(320.0, 320.0, 320.0, 320.0, 640, 640),
}


def _load(path: Path, account: Account) -> Contents:
    """The folder of one trajectory, left camera; frame N has the stamp N / 10 s."""
    release = _release(path)
    assert release is not None
    account.report.note(NO_STAMPS.format(rate=_RATE_HZ), 1)
    colors = numbered_files(path / f"image_{release}", r"(\d{1,9})_\w+\.(?:png|jpe?g)")
    depths = numbered_files(path / f"depth_{release}", r"(\d{1,9})_\w+\.(?:npy|png)")
    calibration = read_calibration(path, Calibration(_RELEASES[release], 1.0))
    source = ImageFiles(float_png=True)
    return Contents([numbered_camera(colors, depths, calibration, account, at_rate(_RATE_HZ), source)])


def _release(path: Path) -> str | None:
    """The release of a folder."""
    kinds = ("image", "depth")
    return next((one for one in _RELEASES if all((path / f"{kind}_{one}").is_dir() for kind in kinds)), None)


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """Ground truth of the optical frame; the world frame remains north-east-down."""
    release = _release(path)
    file = path / f"pose_{release}.txt" if release else path
    rows = _POSES.rows(file, account) if file.is_file() else ()
    return trajectory_of((k / _RATE_HZ, pose.compose(_T_NED_OPTICAL)) for k, (_, _, pose) in enumerate(rows))


FORMAT = recorded("TartanAir trajectory", lambda path, head: _release(path) is not None, _load, _groundtruth)
