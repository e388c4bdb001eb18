"""EuRoC, similar layouts (ASL, TUM-VI) and ADVIO: cameras without depth; only the ground truth is read.

Burri et al. 2016, "The EuRoC Micro Aerial Vehicle Datasets".
"""

from __future__ import annotations

from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.dataset_format import recorded
from slam.datasets.log_file import first_file
from slam.datasets.pose_files import PoseTable
from slam.datasets.recording import Contents
from slam.errors import DatasetError
from slam.estimates import Trajectory

# Nanoseconds, position and quaternion; velocities and biases after them are ignored.
POSES = PoseTable(stamp_units_s=(0.0,), order="wxyz")
_FILES = "mav0/cam0/data.csv", "cam0/data.csv", "iphone/frames.mov"  # the last of ADVIO
_TRUTHS = ("state_groundtruth_estimate0/data.csv", "mocap0/data.csv", "gt/data.csv")


def _load(path: Path, account: Account) -> Contents:
    """A sequence of which only the ground truth can be used; reading it raises DatasetError."""
    raise DatasetError(
        f"{path} holds images and an IMU (as EuRoC and ADVIO do) but neither depth nor a lidar, and "
        "nothing else is mapped; give a recording of a depth camera or of a lidar"
    )


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """Ground truth of the IMU, or of the markers on the robot."""
    file = first_file(place / name for place in (path / "mav0", path) for name in _TRUTHS)
    return POSES.read(file, account) if file else None


FORMAT = recorded(
    "EuRoC or ADVIO folder (it has no depth)",
    lambda path, head: any((path / name).is_file() for name in _FILES),
    _load,
    _groundtruth,
)
