"""Reads lenses that data sets publish with the images: text of four numbers, matrices, JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from slam.datasets.account import Account
from slam.datasets.bags.lens import Lens
from slam.datasets.numbered_frames import lens_of
from slam.datasets.pose_files import numbers_of, square_matrix
from slam.errors import DatasetError
from slam.foreign import from_json
from slam.measurements import CameraIntrinsics, FloatArray

LENS_MOVES = "camera: the lens moves by up to {share:.1%} of its focal length, its median taken"
_LARGEST_BYTES = 1 << 26  # of a JSON file, which may contain a pose per frame (phones)


def four_numbers(path: Path) -> CameraIntrinsics:
    """Read ``fx fy cx cy`` at the beginning of a text file; DatasetError if they are missing."""
    numbers = numbers_of(path)
    if numbers is None or numbers.size < 4:
        raise DatasetError(f"{path} does not begin with fx fy cx cy; correct it, or give a calibration.yaml")
    fx, fy, cx, cy = numbers[:4]
    return checked(path, np.array([[fx, 0.0, cx], [0.0, fy, cy]]))


def camera_matrix(path: Path, size: int = 3, width: int = 0, height: int = 0) -> CameraIntrinsics:
    """The lens in a square matrix of a text file; DatasetError if there is none."""
    matrix = square_matrix(path, size)
    if matrix is None:
        raise DatasetError(f"{path} holds no {size} x {size} camera matrix; correct it, or remove the file")
    return checked(path, matrix, width, height)


def checked(path: Path, matrix: FloatArray, width: int = 0, height: int = 0) -> CameraIntrinsics:
    """The lens of a matrix in a file; DatasetError if it is invalid."""
    try:
        return lens_of(matrix, width, height)
    except ValueError as error:
        raise DatasetError(
            f"{path}: {error} are not a camera's; correct it, or give a calibration.yaml"
        ) from error


def json_object(path: Path) -> dict[str, Any]:
    """The named values of a JSON file; DatasetError if it has none."""
    try:
        if path.stat().st_size > _LARGEST_BYTES:
            raise ValueError(f"{path.stat().st_size} bytes")
        content = from_json(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path} cannot be read: {error}; correct or remove it") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{path} holds no named values; correct or remove it")
    return content


def lens_of_json(path: Path, fields: dict[str, Any], width: str = "width", height: str = "height") -> Any:
    """The lens of named values fx, fy, cx, cy and a size; DatasetError if one is missing."""
    try:
        fx, fy, cx, cy = (float(fields[name]) for name in ("fx", "fy", "cx", "cy"))
        size = int(fields.get(width) or 0), int(fields.get(height) or 0)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DatasetError(
            f"{path} gives no lens ({error}); correct it, or give a calibration.yaml"
        ) from error
    return checked(path, np.array([[fx, 0.0, cx], [0.0, fy, cy]]), *size)


def open3d_lens(path: Path) -> CameraIntrinsics:
    """Open3D's ``intrinsic_matrix`` of nine numbers in column-major order; DatasetError if there is none."""
    content = json_object(path)
    if "fx" in content:
        return lens_of_json(path, content)
    try:
        matrix = np.array(content["intrinsic_matrix"], dtype=np.float64).reshape(3, 3).T
        size = int(content.get("width") or 0), int(content.get("height") or 0)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DatasetError(f"{path}: {error}; correct it, or give a calibration.yaml") from error
    return checked(path, matrix, *size)


def median_lens(lenses: list[CameraIntrinsics], account: Account) -> CameraIntrinsics:
    """The median of the lenses of many frames; the variation of the focal length is noted."""
    numbers = np.array([[lens.fx, lens.fy, lens.cx, lens.cy] for lens in lenses])
    fx, fy, cx, cy = (float(value) for value in np.median(numbers, axis=0))
    if spread := float(np.abs(numbers[:, 0] / fx - 1.0).max()):
        account.report.note(LENS_MOVES.format(share=spread), 1)
    return CameraIntrinsics(fx, fy, cx, cy, lenses[0].width, lenses[0].height)


def plain_lens(intrinsics: CameraIntrinsics) -> Lens:
    """A lens without distortion."""
    return Lens(intrinsics, np.zeros(0))
