"""Decodes cameras and scans of RTAB-Map databases, by format version."""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.datasets.budget import LARGEST_BYTES, Budget
from slam.datasets.calibration import pose_from_matrix
from slam.datasets.dataset import RecordFault
from slam.datasets.numbered_frames import lens_of
from slam.measurements import CameraIntrinsics, FloatArray

BAD_MODEL = "camera model damaged"
STEREO = "stereo images without depth"
BAD_PACKING = "packed data damaged"

_HEAD = struct.Struct("<11i")
_POSE_NUMBERS = 12
_MONO = 0
# OpenCV types: the low three bits are the number type, the higher ones the channel count.
_KINDS = {0: "u1", 1: "i1", 2: "<u2", 3: "<i2", 4: "<i4", 5: "<f4", 6: "<f8"}
_IN_THE_PLANE = frozenset({1, 2, 3, 4})  # formats of scans


@dataclass(frozen=True, slots=True)
class ScanInfo:
    """Metadata of a scan: its angles, if it has any, and the pose of its lidar on the robot."""

    in_the_plane: bool | None
    range_max_m: float
    angle_min_rad: float
    angle_max_rad: float
    angle_step_rad: float
    T_base_laser: gtsam.Pose3


def camera_models(blob: bytes) -> list[tuple[CameraIntrinsics, gtsam.Pose3]]:
    """Return lens and mounting of the cameras of a node; RecordFault if damaged, or of a stereo camera."""
    try:
        # The first number of a serialised model is the major version; of older models, a focal length.
        if len(blob) >= _HEAD.size and 0 <= struct.unpack_from("<i", blob)[0] < 1000:
            return _serialised(blob)
        return _plain(floats_of(blob))
    except (ValueError, struct.error) as error:
        raise RecordFault(BAD_MODEL, str(error)) from error


def _serialised(blob: bytes) -> list[tuple[CameraIntrinsics, gtsam.Pose3]]:
    """Since 0.18: a header of integers, then K, D, R, P and the pose."""
    models, at = [], 0
    while at < len(blob):
        head = _HEAD.unpack_from(blob, at)
        if head[3] != _MONO:
            raise RecordFault(STEREO, f"type {head[3]}")
        sizes = head[6:10]
        if min(head[4:]) < 0 or sizes[0] not in (0, 9) or sizes[3] not in (0, 12) or head[10] not in (0, 12):
            raise ValueError(f"sizes {head[4:]}")
        at += _HEAD.size
        numbers = np.frombuffer(blob, "<f8", sum(sizes), at)
        at += numbers.nbytes
        mounting = floats_of(blob[at : at + 4 * head[10]])
        at += 4 * head[10]
        # Images are stored rectified: P applies to them if there is one.
        matrix = numbers[-12:].reshape(3, 4) if sizes[3] else numbers[:9].reshape(3, 3)
        models.append((lens_of(matrix, head[4], head[5]), pose_of(mounting)))
    return models


def _plain(numbers: FloatArray) -> list[tuple[CameraIntrinsics, gtsam.Pose3]]:
    """Before 0.18: fx, fy, cx, cy, the size (since 0.11.2), and the pose."""
    for lens_numbers in (6, 4):
        row = lens_numbers + _POSE_NUMBERS
        if numbers.size and numbers.size % row == 0:
            models = []
            for fx, fy, cx, cy, *rest in numbers.reshape(-1, row).tolist():
                width, height = (int(rest[0]), int(rest[1])) if lens_numbers == 6 else (0, 0)
                lens = lens_of(np.array([[fx, 0.0, cx], [0.0, fy, cy]]), width, height)
                models.append((lens, pose_of(np.array(rest[-_POSE_NUMBERS:]))))
            return models
    if numbers.size in (17, 19):
        raise RecordFault(STEREO, f"{numbers.size} numbers")
    raise ValueError(f"{numbers.size} numbers")


def floats_of(blob: bytes) -> FloatArray:
    """Convert four-byte floats to doubles; ValueError if the number of bytes is wrong."""
    with np.errstate(invalid="ignore"):
        return np.frombuffer(blob, "<f4").astype(np.float64)


def pose_of(numbers: FloatArray) -> gtsam.Pose3:
    """A pose from three rows of its matrix, or the identity; ValueError if it is invalid."""
    if not numbers.size:
        return gtsam.Pose3()
    return pose_from_matrix(np.vstack([numbers.reshape(3, 4), [0.0, 0.0, 0.0, 1.0]]))


def scan_info(blob: bytes) -> ScanInfo:
    """The metadata of a scan; RecordFault if they are damaged."""
    numbers = floats_of(blob[: len(blob) // 4 * 4])
    before = numbers.size - _POSE_NUMBERS
    try:
        pose = pose_of(numbers[before:]) if before in (2, 3, 7) else None
    except ValueError as error:
        raise RecordFault(BAD_MODEL, str(error)) from error
    if pose is None or not np.isfinite(numbers).all():
        raise RecordFault(BAD_MODEL, f"{numbers.size} numbers beside a scan")
    if before == 7:
        kind, _, farthest, first, last, step, _ = numbers[:7].tolist()
        return ScanInfo(int(kind) in _IN_THE_PLANE, farthest, first, last, step, pose)
    plane = None if before == 2 or not numbers[2] else int(numbers[2]) in _IN_THE_PLANE
    return ScanInfo(plane, float(numbers[1]), 0.0, 0.0, 0.0, pose)


def scan_points(blob: bytes, budget: Budget) -> NDArray[Any]:
    """Return (N, C) rows of a packed scan, coordinates first; RecordFault if they cannot be unpacked."""
    if len(blob) < 12:
        raise RecordFault(BAD_PACKING, f"{len(blob)} bytes")
    rows, columns, kind = struct.unpack("<3i", blob[-12:])
    number, channels = _KINDS.get(kind & 7), (kind >> 3) + 1
    expected = rows * columns * channels * (np.dtype(number).itemsize if number else 0)
    if min(rows, columns) < 1 or channels > 16 or not 0 < expected <= LARGEST_BYTES:
        raise RecordFault(BAD_PACKING, f"{rows} x {columns} of kind {kind}")
    budget.take(expected, 0)
    try:
        content = zlib.decompressobj().decompress(blob, expected)
    except zlib.error as error:
        raise RecordFault(BAD_PACKING, str(error)) from error
    if len(content) != expected:
        raise RecordFault(BAD_PACKING, f"{len(content)} of {expected} bytes")
    return np.frombuffer(content, number).reshape(rows * columns, channels)
