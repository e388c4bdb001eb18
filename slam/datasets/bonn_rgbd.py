"""Bonn RGB-D Dynamic: the layout of TUM, the lens as its publishers give it for all sequences.

Palazzolo et al. 2019, "ReFusion: 3D Reconstruction in Dynamic Environments for RGB-D Cameras Exploiting
Residuals".
"""

from __future__ import annotations

from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration
from slam.datasets.dataset_format import DatasetFormat
from slam.datasets.recording import Contents, Recording
from slam.datasets.tum import DEPTH_STEPS_PER_M, has_tum_layout, listed_camera, read_groundtruth
from slam.measurements import CameraIntrinsics

_NAME = "rgbd_bonn"  # of every folder that is published
# The publishers' calibration of the colour image, its distortion left aside as with TUM's: depth is
# registered to the image as it is.
_LENS = CameraIntrinsics(542.822841, 542.576870, 315.593520, 237.756098, 640, 480)


def looks_like_bonn_rgbd(path: Path, head: bytes) -> bool:
    """Whether a path is a folder of this name in the layout of TUM."""
    return path.is_dir() and path.resolve().name.startswith(_NAME) and has_tum_layout(path)


def open_bonn_rgbd(path: Path, strict: bool) -> Recording:
    """A folder of one sequence."""

    def load(account: Account) -> Contents:
        return Contents([listed_camera(path, "camera", Calibration(_LENS, DEPTH_STEPS_PER_M), account)])

    return Recording(path, load, lambda account: read_groundtruth(path, account), strict=strict)


FORMAT = DatasetFormat("Bonn RGB-D Dynamic folder", looks_like_bonn_rgbd, open_bonn_rgbd)
