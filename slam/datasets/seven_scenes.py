"""Numbered colour, depth and pose files in one folder: 7-Scenes, ScanNet as extracted, and others.

Shotton et al. 2013, "Scene Coordinate Regression Forests for Camera Relocalization in RGB-D Images";
Wald et al. 2019, "RIO: 3D Object Instance Re-Localization" (3RScan); Lai et al. 2014, "Unsupervised Feature
Learning for 3D Scene Labeling" (RGB-D Scenes v2).
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from slam.datasets.account import Account
from slam.datasets.calibration import Calibration
from slam.datasets.camera_frames import Camera
from slam.datasets.dataset_format import recorded
from slam.datasets.lens_files import camera_matrix, checked, plain_lens
from slam.datasets.log_file import first_file, numbered_lines
from slam.datasets.numbered_frames import (
    at_rate,
    numbered_camera,
    numbered_files,
    poses_of_files,
    with_own_calibration,
)
from slam.datasets.recording import Contents
from slam.errors import DatasetError
from slam.measurements import CameraIntrinsics

ASSUMED = (
    "intrinsics assumed (585 585 320 240 at 640 x 480); give a camera-intrinsics.txt, or --calibration FILE"
)

_MATRIX_FILE, _INFOS = "camera-intrinsics.txt", ("_info.txt", "info.txt")
_POSE = r"frame-(\d{1,9})\.pose\.txt"
_SEVEN = Calibration(
    CameraIntrinsics(585.0, 585.0, 320.0, 240.0, 640, 480), 1000.0, (65535,), assumed=ASSUMED
)


# The names of colour and depth files, and the published camera.
_KNOWN = {
    r"frame-(\d{1,9})\.%s\.(?:png|jpe?g|pgm)": _SEVEN,
    r"(\d{1,9})-%s\.png": Calibration(CameraIntrinsics(570.3, 570.3, 320.0, 240.0, 640, 480), 10_000.0),
}


def _names(folder: Path) -> str | None:
    """The naming scheme of the frames in a folder."""
    kinds = ("color", "depth")
    return next((name for name in _KNOWN if any(numbered_files(folder, name % kind) for kind in kinds)), None)


def _camera(folder: Path, account: Account) -> Camera:
    """Colour and depth with the same number are a pair; frame N has the stamp N / 30 s."""
    names = _names(folder)
    assert names is not None
    colors, depths = (numbered_files(folder, names % kind) for kind in ("color", "depth"))
    calibration = with_own_calibration(folder, _calibration(folder, _KNOWN[names]))
    return numbered_camera(colors, depths, calibration, account, at_rate())


def _calibration(folder: Path, published: Calibration) -> Calibration:
    """From a matrix without image size, or from both lenses of an info file; else as published."""
    if (folder / _MATRIX_FILE).is_file():
        return replace(published, intrinsics=camera_matrix(folder / _MATRIX_FILE), assumed="")
    info = first_file(folder / name for name in _INFOS)
    if info is None:
        return published
    fields = dict(line.partition(b"=")[::2] for _, line in numbered_lines(info, Account.quiet(info)))
    values = {name.strip().decode("ascii", "replace"): value.split() for name, value in fields.items()}
    try:
        depth, color = (_lens(info, values, kind) for kind in ("Depth", "Color"))
        steps = float(values["m_depthShift"][0])
        if not 0.0 < steps < math.inf:
            raise ValueError(f"m_depthShift {steps}")
    except (KeyError, IndexError, ValueError, OverflowError) as error:
        raise DatasetError(f"{info} gives no lens ({error}); correct it, or remove the file") from error
    return replace(
        published, intrinsics=depth, color_lens=plain_lens(color), depth_steps_per_m=steps, assumed=""
    )


def _lens(info: Path, values: dict[str, list[bytes]], kind: str) -> CameraIntrinsics:
    """One of the two lenses of an info file."""
    names = (f"m_calibration{kind}Intrinsic", f"m_{kind.lower()}Width", f"m_{kind.lower()}Height")
    numbers, width, height = (np.array(values[name], dtype=np.float64) for name in names)
    return checked(info, numbers.reshape(4, 4), int(width[0]), int(height[0]))


FORMAT = recorded(
    "7-Scenes folder",
    lambda path, head: path.is_dir() and _names(path) is not None,
    lambda *folder: Contents([_camera(*folder)]),
    lambda path, account: poses_of_files(numbered_files(path, _POSE), at_rate(), account),
)
