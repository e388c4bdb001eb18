"""Camera calibration before the first image: lens, depth scale, mounting."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam.datasets.bags.lens import Lens
from slam.datasets.dataset import RecordFault
from slam.errors import DatasetError
from slam.estimates import NORM_TOLERANCE
from slam.foreign import from_yaml
from slam.measurements import CameraIntrinsics, FloatArray

FILE_NAME = "calibration.yaml"
OTHER_ASPECT = "image size does not fit the calibration"

_SAME_ASPECT = 0.005  # rounding of sizes; 1280 x 720 and 848 x 480 already show other parts of the scene
_FARTHEST_M = 1e8
_STRETCH_TOLERANCE = 0.05  # published rotations have determinants of 0.9995; a scaled one is refused
# Driver default of a Kinect without calibration; the TUM benchmark calls it the ROS default.
KINECT = CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)


@dataclass(frozen=True, slots=True)
class Calibration:
    """Calibration of a camera.

    Attributes
    ----------
    intrinsics
        For images of its width and height; 0 x 0 if the source does not say for which.
    depth_steps_per_m
        Units per metre of the depth files.
    invalid_codes
        Depth values that mean "no reading", besides 0.
    T_base_camera
        Pose of the optical frame of the upright image; None if the log does not contain it.
    assumed
        Why the intrinsics are assumed, for the report; empty if the log or its publisher gives them.
    color_lens
        Lens of the stored colour image, if it differs (at the same position): colour is then warped to
        ``intrinsics``. None if both images share a lens.
    """

    intrinsics: CameraIntrinsics
    depth_steps_per_m: float
    invalid_codes: tuple[int, ...] = ()
    T_base_camera: gtsam.Pose3 | None = None
    assumed: str = ""
    color_lens: Lens | None = None

    def intrinsics_for(self, width: int, height: int) -> CameraIntrinsics:
        """The intrinsics for images of a size; the centre of pixel (0, 0) is at (0, 0).

        Raises
        ------
        RecordFault
            The aspect ratio differs from that of the known intrinsics: the crop is unknown.
        """
        known = self.intrinsics
        if (known.width, known.height) in ((width, height), (0, 0)):
            return replace(known, width=width, height=height)
        if not self.assumed and not same_aspect((width, height), (known.width, known.height)):
            sizes = f"{width} x {height}, calibrated {known.width} x {known.height}"
            raise RecordFault(OTHER_ASPECT, sizes)
        scale = width / known.width
        cut = 0.5 * (height - known.height * scale)  # assume a centred crop
        return CameraIntrinsics(
            known.fx * scale,
            known.fy * scale,
            (known.cx + 0.5) * scale - 0.5,
            (known.cy + 0.5) * scale - 0.5 + cut,
            width,
            height,
        )


def same_aspect(first: tuple[int, int], second: tuple[int, int]) -> bool:
    """Whether two sizes (width, height) show the same field of view."""
    return abs(first[0] * second[1] / (first[1] * second[0]) - 1.0) < _SAME_ASPECT


def read_calibration(folder: Path, default: Calibration) -> Calibration:
    """The folder's ``calibration.yaml`` merged into a default; the default if there is no such file.

    The file may give ``intrinsics`` (fx, fy, cx, cy and, together, width and height),
    ``depth_steps_per_m`` and ``T_base_camera`` (``translation_m``, ``quaternion_xyzw``).

    Raises
    ------
    DatasetError
        The file cannot be read, or a value is invalid: a wrong calibration would distort the whole map.
    """
    path = folder / FILE_NAME
    if not path.is_file():
        return default
    content = read_yaml(path)
    result = default
    try:
        if "intrinsics" in content:
            result = replace(result, intrinsics=_intrinsics(content["intrinsics"]), assumed="")
        if "depth_steps_per_m" in content:
            result = replace(result, depth_steps_per_m=positive(content["depth_steps_per_m"]))
        if (pose := _mounting(content, "T_base_camera")) is not None:
            result = replace(result, T_base_camera=pose)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        missing = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise DatasetError(f"{path}: {missing}; correct the calibration, or remove the file") from error
    return result


def read_mounting(path: Path, name: str) -> gtsam.Pose3 | None:
    """Return a named pose of a calibration, None if missing; DatasetError if it cannot be read."""
    try:
        return _mounting(read_yaml(path), name) if path.is_file() else None
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: {name}: {error}; correct it, or remove the file") from error


def _mounting(content: dict[str, Any], name: str) -> gtsam.Pose3 | None:
    """A pose by name; None if the name does not exist."""
    fields = content.get(name)
    return None if fields is None else pose_from(fields["translation_m"], fields["quaternion_xyzw"])


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a small YAML file of named values; DatasetError if it is none."""
    try:
        text = path.read_text(encoding="utf-8")
        # OpenCV writes a first line and a tag that are not YAML.
        content = from_yaml(text.replace("%YAML:1.0", "", 1).replace("!!opencv-matrix", ""))
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path} cannot be read: {error}; correct or remove it") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{path} holds no named values; correct or remove it")
    return content


def pose_from(translation_m: Any, quaternion_xyzw: Any) -> gtsam.Pose3:
    """Return a pose of two lists of numbers; ValueError if they are not finite, no pose, or too far away."""
    translation = np.asarray(translation_m, dtype=np.float64).ravel()
    x, y, z, w = unit_quaternion(np.asarray(quaternion_xyzw, dtype=np.float64).ravel())
    if translation.size != 3 or not (np.abs(translation) < _FARTHEST_M).all():
        raise ValueError(f"translation {translation_m} is not three numbers below {_FARTHEST_M:g} m")
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), translation)


def pose_from_matrix(matrix: FloatArray) -> gtsam.Pose3:
    """A pose from a (4, 4) transform; its rotation matrix is replaced by the nearest orthonormal one.

    Raises
    ------
    ValueError
        Not finite, or scaled by more than 5 %, or mirrored.
    """
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError("not 4 x 4 finite numbers")
    left, stretch, right = np.linalg.svd(matrix[:3, :3])
    rotation = left @ right
    if np.abs(stretch - 1.0).max() > _STRETCH_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise ValueError(f"stretched by {stretch.min():.4g} to {stretch.max():.4g}, or mirrored")
    return gtsam.Pose3(gtsam.Rot3(rotation), matrix[:3, 3])


def unit_quaternion(quaternion: FloatArray) -> FloatArray:
    """Return a quaternion at unit length, (4,); ValueError if it is none."""
    # Unlike NumPy's norm it takes the hugest numbers of a damaged file without a warning.
    norm = math.hypot(*quaternion.tolist()) if quaternion.size == 4 else math.nan
    if not abs(norm - 1.0) <= NORM_TOLERANCE:
        raise ValueError(f"quaternion {quaternion.tolist()} is not four numbers of length 1")
    unit: FloatArray = quaternion / norm
    return unit


def _intrinsics(fields: Any) -> CameraIntrinsics:
    """Check for positive focal lengths, a finite principal point, and an optional size."""
    fx, fy = positive(fields["fx"]), positive(fields["fy"])
    cx, cy = float(fields["cx"]), float(fields["cy"])
    width, height = int(fields.get("width") or 0), int(fields.get("height") or 0)
    if not (math.isfinite(cx) and math.isfinite(cy)) or min(width, height) < 0 or (width > 0) != (height > 0):
        raise ValueError(f"intrinsics {fields} are not a camera's")
    return CameraIntrinsics(fx, fy, cx, cy, width, height)


def positive(value: Any) -> float:
    """A positive finite number."""
    number = float(value)
    if not 0.0 < number < math.inf:
        raise ValueError(f"{value} is not a positive number")
    return number
