"""CameraInfo messages: the pinhole model, and the undistortion of images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.datasets.budget import MOST_PIXELS
from slam.datasets.dataset import RecordFault
from slam.measurements import CameraIntrinsics, FloatArray

NO_LENS = "CameraInfo without usable intrinsics"

_PLUMB = frozenset({"", "plumb_bob", "rational_polynomial", "brown_conrady", "none"})
_FISHEYE = frozenset({"equidistant", "fisheye", "kannala_brandt4"})
_NEGLIGIBLE = 1e-9
_TENTH = 0.1  # pixels


@dataclass(frozen=True, slots=True, eq=False)
class Lens:
    """A camera's lens.

    Attributes
    ----------
    distortion
        (D,) coefficients in OpenCV's order; empty if there is none.
    fisheye
        Whether the distortion model is equidistant.
    unknown_model
        Name of an unsupported model, whose distortion remains in the images.
    """

    intrinsics: CameraIntrinsics
    distortion: FloatArray
    fisheye: bool = False
    unknown_model: str = ""

    def maps(
        self, seen_by: CameraIntrinsics | None = None, turn: FloatArray | None = None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
        """Columns and rows to look up for each undistorted pixel; None if nothing is to be done.

        Parameters
        ----------
        seen_by, turn
            The wanted camera at the same position, and the (3, 3) rotation of this camera in it.
        """
        lens, target = self.intrinsics, seen_by or self.intrinsics
        rotation = np.eye(3) if turn is None else turn
        still = float(np.abs(rotation - np.eye(3)).max()) < _NEGLIGIBLE
        if not self.distortion.size and still and _same_view(lens, target):
            return None
        import cv2

        build = cv2.fisheye.initUndistortRectifyMap if self.fisheye else cv2.initUndistortRectifyMap
        distortion = self.distortion if self.distortion.size else np.zeros(4)
        size = (target.width, target.height)
        columns, rows = build(_matrix(lens), distortion, rotation, _matrix(target), size, cv2.CV_32FC1)
        return np.asarray(columns), np.asarray(rows)


def _matrix(lens: CameraIntrinsics) -> FloatArray:
    """K."""
    return np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])


def _same_view(first: CameraIntrinsics, second: CameraIntrinsics) -> bool:
    """Whether two pinhole cameras have the same view to 0.1 pixel, at any image size."""
    scale = second.width / max(first.width, 1)
    expected = np.array([first.fx, first.fy, first.cx + 0.5, first.cy + 0.5]) * scale
    got = np.array([second.fx, second.fy, second.cx + 0.5, second.cy + 0.5])
    return bool(np.abs(expected - got).max() < _TENTH)


def lens_of(message: Any, *, rectified: bool) -> Lens:
    """A lens from a CameraInfo, of ROS 1 (``K``) or ROS 2 (``k``).

    Parameters
    ----------
    rectified
        Whether the images are rectified: then P applies, without distortion, else K and D.

    Raises
    ------
    RecordFault
        It has no focal length (an uncalibrated camera), or an impossible size.
    """
    k, p, d = (_numbers(message, name) for name in "kpd")
    width, height = int(message.width), int(message.height)
    fx, fy, cx, cy = _pin_hole(k, p, rectified=rectified)
    known = bool(np.isfinite([fx, fy, cx, cy]).all()) and min(fx, fy) > 0.0
    if not known or min(width, height) < 0 or width * height > MOST_PIXELS or (width > 0) != (height > 0):
        raise RecordFault(NO_LENS, f"{width} x {height}, {fx} {fy} {cx} {cy}")
    intrinsics = _cut(CameraIntrinsics(fx, fy, cx, cy, width, height), getattr(message, "roi", None))
    model = str(message.distortion_model).lower().replace(" ", "_")
    plain = rectified or not d.size or not np.isfinite(d).all() or np.abs(d).max() < _NEGLIGIBLE
    if plain:
        return Lens(intrinsics, np.zeros(0))
    fisheye = model in _FISHEYE and d.size >= 4
    if not fisheye and (model not in _PLUMB or d.size not in (4, 5, 8, 12, 14)):
        return Lens(intrinsics, np.zeros(0), unknown_model=model or f"{d.size} coefficients")
    return Lens(intrinsics, d[:4] if fisheye else d, fisheye)


def _cut(lens: CameraIntrinsics, region: Any) -> CameraIntrinsics:
    """Intrinsics for the region of interest; without one, those of the whole sensor."""
    if region is None or not (region.width and region.height):
        return lens
    cx, cy = lens.cx - region.x_offset, lens.cy - region.y_offset
    return CameraIntrinsics(lens.fx, lens.fy, cx, cy, int(region.width), int(region.height))


def _numbers(message: Any, name: str) -> FloatArray:
    """A field in upper-case or lower-case spelling."""
    value = getattr(message, name, None)
    if value is None:
        value = getattr(message, name.upper())
    return np.asarray(value, dtype=np.float64).ravel()


def _pin_hole(k: FloatArray, p: FloatArray, *, rectified: bool) -> tuple[float, float, float, float]:
    """Focal lengths and principal point."""
    if rectified and p.size == 12 and p[0] > 0.0:
        return float(p[0]), float(p[5]), float(p[2]), float(p[6])
    if k.size != 9:
        raise RecordFault(NO_LENS, f"K has {k.size} numbers")
    return float(k[0]), float(k[4]), float(k[2]), float(k[5])
