"""Reads images of a camera with numbers or stamps in their file names."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration, read_calibration
from slam.datasets.camera_frames import Camera
from slam.datasets.dataset import RecordFault
from slam.datasets.frame_pairs import NO_COLOR, NO_DEPTH, FramePair
from slam.datasets.image_files import FILES, ImageSource
from slam.datasets.pose_files import pose_file, trajectory_of
from slam.datasets.stamped_files import StampedFile
from slam.estimates import Trajectory
from slam.measurements import CameraIntrinsics, FloatArray

RATE_HZ = 30.0  # for cameras whose files have no stamps
NO_STAMPS = "no stamps: frame N taken as N / {rate:g} s old"
IMAGES = r"png|jpe?g|pgm|ppm|bmp"


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """Files of a folder by the integer that is the first group of a pattern of their names."""
    name = re.compile(pattern, re.IGNORECASE)
    try:
        matches = [(name.fullmatch(entry.name), entry) for entry in folder.iterdir()]
    except OSError:
        return {}
    # Sorted by name, so that of two files with one number the same one wins on every system.
    return {int(match[1]): entry for match, entry in sorted(matches, key=lambda pair: pair[1].name) if match}


def at_rate(rate_hz: float = RATE_HZ) -> Callable[[int], float]:
    """Stamps of numbered frames."""
    return lambda number: number / rate_hz


def numbered_camera(
    colors: dict[int, Path],
    depths: dict[int, Path],
    calibration: Calibration,
    account: Account,
    stamp_of: Callable[[int], float],
    source: ImageSource = FILES,
) -> Camera:
    """A camera of image pairs with the same number; images without partner are counted.

    A ``calibration.yaml`` next to the images overrides the calibration.
    """
    pairs = []
    for number in sorted(colors.keys() | depths.keys()):
        if number in colors and number in depths:
            stamp_s = stamp_of(number)
            color, depth = (StampedFile(stamp_s, files[number], number) for files in (colors, depths))
            pairs.append(FramePair(stamp_s, color, depth))
        else:
            fault = RecordFault(NO_DEPTH if number in colors else NO_COLOR, f"frame {number}")
            account.refuse(fault, "camera", number)
    return Camera("camera", pairs, calibration, source=source)


def with_own_calibration(folder: Path, calibration: Calibration) -> Calibration:
    """Like `read_calibration`; new intrinsics also remove a separate colour lens."""
    own = read_calibration(folder, calibration)
    return own if own.intrinsics == calibration.intrinsics else replace(own, color_lens=None)


def lens_of(matrix: FloatArray, width: int = 0, height: int = 0) -> CameraIntrinsics:
    """Return the lens of a camera matrix; ValueError if not finite or without focal lengths."""
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not np.isfinite([fx, fy, cx, cy]).all() or min(fx, fy) <= 0.0 or min(width, height) < 0:
        raise ValueError(f"fx {fx}, fy {fy}, cx {cx}, cy {cy}, {width} x {height}")
    return CameraIntrinsics(fx, fy, cx, cy, width, height)


def poses_of_files(
    files: dict[int, Path], stamp_of: Callable[[int], float], account: Account
) -> Trajectory | None:
    """The trajectory from files with one matrix each; files without a matrix are counted."""

    def good() -> Iterable[tuple[float, gtsam.Pose3]]:
        for number, path in sorted(files.items()):
            with account.refusing(path.name, number):
                yield stamp_of(number), pose_file(path)

    return trajectory_of(good())
