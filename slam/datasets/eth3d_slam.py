"""ETH3D SLAM benchmark: the layout of TUM, and the lens in a file of its own.

Schöps et al. 2019, "BAD SLAM: Bundle Adjusted Direct RGB-D SLAM".
"""

from __future__ import annotations

from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration
from slam.datasets.dataset_format import DatasetFormat
from slam.datasets.lens_files import four_numbers
from slam.datasets.recording import Contents, Recording
from slam.datasets.tum import DEPTH_STEPS_PER_M, has_tum_layout, listed_camera, read_groundtruth

_LENS = "calibration.txt"


def looks_like_eth3d_slam(path: Path, head: bytes) -> bool:
    """Whether a path is a folder in the layout of TUM with a lens beside the lists."""
    return path.is_dir() and (path / _LENS).is_file() and has_tum_layout(path)


def open_eth3d_slam(path: Path, strict: bool) -> Recording:
    """A folder of one sequence; images are free of distortion."""

    def load(account: Account) -> Contents:
        calibration = Calibration(four_numbers(path / _LENS), DEPTH_STEPS_PER_M)
        return Contents([listed_camera(path, "camera", calibration, account)])

    return Recording(path, load, lambda account: read_groundtruth(path, account), strict=strict)


FORMAT = DatasetFormat("ETH3D SLAM folder", looks_like_eth3d_slam, open_eth3d_slam)
