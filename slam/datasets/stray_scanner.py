"""Stray Scanner, an app for iPhones and iPads with lidar: a video, depth images, poses of ARKit.

The layout is documented with the app (strayrobots/scanner, docs/format.md).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.budget import Budget
from slam.datasets.calibration import Calibration, read_calibration
from slam.datasets.dataset import RecordFault
from slam.datasets.dataset_format import recorded
from slam.datasets.image_files import DAMAGED, ImageFiles, rgb_of
from slam.datasets.lens_files import camera_matrix, checked, median_lens
from slam.datasets.numbered_frames import numbered_camera, numbered_files
from slam.datasets.pose_files import COMPARED, T_ARKIT_OPTICAL, trajectory_of
from slam.datasets.recording import Contents
from slam.datasets.stamped_files import BAD_POSE, StampedFile, fields_of, stamp_of
from slam.errors import DatasetError
from slam.estimates import Trajectory
from slam.measurements import CameraIntrinsics, ColorImage, Float32Array

_VIDEO, _POSES, _MATRIX, _IMU = "rgb.mp4", "odometry.csv", "camera_matrix.csv", "imu.csv"


@dataclass(slots=True)
class _VideoAndDepth:
    """Frames of a video by number, and depth in files; see `slam.datasets.image_files.ImageSource`."""

    video: Path
    depths: ImageFiles
    _reader: Any = None
    _next: int = field(default=0)

    def color(self, file: StampedFile, budget: Budget) -> ColorImage:
        """See `slam.datasets.image_files.ImageSource`; frames in between are skipped."""
        if self._reader is None or file.number < self._next:
            self._reader, self._next = _opened(self.video), 0
        while self._next <= file.number:
            if not self._reader.grab():
                raise RecordFault(DAMAGED, f"{self.video.name} ends before frame {file.number}")
            self._next += 1
        decoded, image = self._reader.retrieve()
        color = rgb_of(image) if decoded else None
        if color is None:
            raise RecordFault(DAMAGED, f"{self.video.name}, frame {file.number}")
        budget.add_file(self.video, self.video.stat().st_size)
        budget.take(color.nbytes, 0)
        return color

    def depth(self, file: StampedFile, calibration: Calibration, budget: Budget) -> Float32Array:
        """See `slam.datasets.image_files.ImageSource`."""
        return self.depths.depth(file, calibration, budget)


def _load(path: Path, account: Account) -> Contents:
    """The folder of one scan, without depth in which ARKit has no confidence."""
    account.report.note(COMPARED, 1)
    if (path / _IMU).is_file():
        account.report.ignore(_IMU, "its pose relative to the camera is unknown")
    rows = _rows(path / _POSES, account)
    depths = numbered_files(path / "depth", r"(\d{1,9})\.(?:png|npy)")
    listed = {number: file for number, file in depths.items() if number in rows}
    for number in depths.keys() - rows.keys():
        account.refuse(RecordFault("depth image without a stamp", f"frame {number}"), _POSES, number)
    calibration = read_calibration(path, Calibration(_lens(path, rows, account), 1000.0))
    source = _VideoAndDepth(path / _VIDEO, ImageFiles(path / "confidence"))
    video = dict.fromkeys(listed, path / _VIDEO)
    return Contents(
        [numbered_camera(video, listed, calibration, account, lambda number: rows[number].stamp_s, source)]
    )


@dataclass(frozen=True, slots=True)
class _Row:
    """A line of the poses."""

    stamp_s: float
    T_world_optical: gtsam.Pose3
    lens: tuple[float, ...]


def _rows(path: Path, account: Account) -> dict[int, _Row]:
    """``timestamp, frame, x, y, z, qx, qy, qz, qw`` and, in later versions, ``fx, fy, cx, cy``, by frame."""
    rows = {}
    for line, fields in fields_of(path, account, 9):
        try:
            stamp_s, number = stamp_of(fields[0]), int(fields[1])
            x, y, z, qx, qy, qz, qw = (float(value) for value in fields[2:9])
            pose = gtsam.Pose3(gtsam.Rot3.Quaternion(qw, qx, qy, qz), np.array([x, y, z]))
            lens = tuple(float(value) for value in fields[9:13])
            if not np.isfinite([x, y, z, qx, qy, qz, qw, *lens]).all():
                raise ValueError("not finite")
        except (ValueError, RecordFault) as error:
            if line > 1:
                account.refuse(RecordFault(BAD_POSE, str(error)), path.name, line)
            continue
        rows[number] = _Row(stamp_s, pose.compose(T_ARKIT_OPTICAL), lens)
    return rows


def _lens(path: Path, rows: dict[int, _Row], account: Account) -> CameraIntrinsics:
    """Lens for the video's size: the median over the frames if they have lenses, else the scan's matrix."""
    import cv2

    reader = _opened(path / _VIDEO)
    size = int(reader.get(cv2.CAP_PROP_FRAME_WIDTH)), int(reader.get(cv2.CAP_PROP_FRAME_HEIGHT))
    if min(size) < 1:
        raise DatasetError(f"{path / _VIDEO} has no frames; copy the scan from the phone again")
    lenses = [row.lens for row in rows.values() if len(row.lens) == 4 and min(row.lens[:2]) > 0.0]
    if not lenses:
        return camera_matrix(path / _MATRIX, 3, *size)
    matrices = [np.array([[fx, 0.0, cx], [0.0, fy, cy]]) for fx, fy, cx, cy in lenses]
    return median_lens([checked(path / _POSES, matrix, *size) for matrix in matrices], account)


def _opened(video: Path) -> Any:
    """A reader of a video that does not rotate frames, because depth is not rotated either."""
    import cv2

    reader = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
    if not reader.isOpened():
        raise DatasetError(f"{video} cannot be read as a video; copy the scan from the phone again")
    reader.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return reader


def _truth(path: Path, account: Account) -> Trajectory | None:
    """The trajectory of ARKit."""
    return trajectory_of((row.stamp_s, row.T_world_optical) for row in _rows(path / _POSES, account).values())


FORMAT = recorded(
    "Stray Scanner scan",
    lambda path, head: (
        all((path / name).is_file() for name in (_VIDEO, _POSES)) and (path / "depth").is_dir()
    ),
    _load,
    _truth,
)
