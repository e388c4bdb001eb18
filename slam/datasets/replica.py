"""Replica as rendered by NICE-SLAM and iMAP: images in ``results/``, and a trajectory.

Zhu et al. 2022, "NICE-SLAM: Neural Implicit Scalable Encoding for SLAM".
"""

from __future__ import annotations

from pathlib import Path

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration, read_calibration
from slam.datasets.dataset_format import recorded
from slam.datasets.lens_files import json_object, lens_of_json
from slam.datasets.log_file import first_file
from slam.datasets.numbered_frames import NO_STAMPS, RATE_HZ, at_rate, numbered_camera, numbered_files
from slam.datasets.pose_files import pose_lines, trajectory_of
from slam.datasets.recording import Contents
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.measurements import CameraIntrinsics

_LENS_FILE = "cam_params.json"
# From cam_params.json, which is published with the rooms and applies to all of them.
_PUBLISHED = Calibration(CameraIntrinsics(600.0, 600.0, 599.5, 339.5, 1200, 680), 6553.5)


def _load(path: Path, account: Account) -> Contents:
    """The folder of one room; frame N has the stamp N / 30 s."""
    account.report.note(NO_STAMPS.format(rate=RATE_HZ), 1)
    colors = numbered_files(path / "results", r"frame(\d{1,9})\.(?:jpe?g|png)")
    calibration = read_calibration(path, _calibration(path))
    return Contents([numbered_camera(colors, _depths(path), calibration, account, at_rate())])


def _depths(path: Path) -> dict[int, Path]:
    return numbered_files(path / "results", r"depth(\d{1,9})\.png")


def _calibration(path: Path) -> Calibration:
    """Calibration from the file in the folder or above, else as published."""
    file = first_file((path / _LENS_FILE, path.resolve().parent / _LENS_FILE))
    if file is None:
        return _PUBLISHED
    fields = json_object(file).get("camera")
    if not isinstance(fields, dict):
        raise DatasetError(f"{file} describes no camera; correct it, or remove the file")
    try:
        scale = float(fields.get("scale", 0.0))
    except (TypeError, ValueError):
        scale = 0.0
    if not 0.0 < scale < 1e9:
        raise DatasetError(f"{file}: scale {str(fields.get('scale'))[:24]} is none; correct the file")
    return Calibration(lens_of_json(file, fields, "w", "h"), scale)


def _groundtruth(path: Path, account: Account) -> Trajectory | None:
    """Camera to world, line N for frame N."""
    file = path / "traj.txt"
    poses = enumerate(pose_lines(file, account)) if file.is_file() else ()
    return trajectory_of((number / RATE_HZ, pose) for number, pose in poses if pose)


FORMAT = recorded("Replica room as in NICE-SLAM", lambda path, head: bool(_depths(path)), _load, _groundtruth)
