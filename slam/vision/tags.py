"""Detect AprilTags and ArUco markers in an image, with their poses and covariances.

OpenCV finds them (Garrido-Jurado 2014; the families of Olson 2011). Four corners allow two poses of a square,
tilted in opposite directions (Collins and Bartoli 2014). If the corners do not decide, the depth image may;
if that does not either, the tag gives only its position.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST, ROUNDS, SETTLED, TINY, gate
from slam.config.tags import KnownPlaces
from slam.measurements import BoolArray, CameraIntrinsics, ColorImage, FloatArray


@dataclass(frozen=True, slots=True)
class TagView:
    """A tag in an image.

    Attributes
    ----------
    T_camera_tag
        Centre of the tag: x to the right seen from the front, y up, z out of it.
    information
        (6, 6) for corner errors of 1 px, GTSAM's tangent of the tag.
    misfit_px2
        Sum of the squared errors of the corners, of two degrees of freedom.
    lead_px2
        Excess squared error of the second pose that four corners allow.
    """

    number: int
    T_camera_tag: gtsam.Pose3
    information: FloatArray
    misfit_px2: float
    lead_px2: float

    def covariance(self, sigma_px: float) -> FloatArray:
        """Return (6, 6) in GTSAM's tangent of the tag, for this corner noise.

        If the second pose fits as well, the tag gives only its position.
        """
        covariance = np.asarray(sigma_px**2 * np.linalg.inv(self.information), np.float64)
        if self.lead_px2 < sigma_px**2 * gate():
            covariance[:3], covariance[:, :3] = 0.0, 0.0
            covariance[:3, :3] = math.pi**2 * np.eye(3)
        return covariance


@cache
def _dictionary(family: str) -> Any:
    """Return OpenCV's dictionary of a family."""
    from cv2 import aruco  # slow to load

    kind = "" if "x" in family else "ARUCO_" if family[0] in "mo" else "APRILTAG_"
    return aruco.getPredefinedDictionary(getattr(aruco, f"DICT_{kind}{family.upper()}"))


@cache
def _detector(family: str) -> Any:
    """Return OpenCV's detector for a family."""
    from cv2 import aruco

    return aruco.ArucoDetector(_dictionary(family), aruco.DetectorParameters())


def tag_cells(family: str, number: int) -> BoolArray:
    """Return (n, n) the white cells of a tag: white border, black border, and bits; the upper row first."""
    from cv2 import aruco

    dictionary = _dictionary(family)
    bits = aruco.generateImageMarker(dictionary, number, dictionary.markerSize + 2, borderBits=1)
    white = np.ones((len(bits) + 2, len(bits) + 2), np.bool_)
    white[1:-1, 1:-1] = bits > 0
    return white


def find_tags(color: ColorImage, intrinsics: CameraIntrinsics, places: KnownPlaces) -> list[TagView]:
    """Detect tags in an image.

    Parameters
    ----------
    color
        (H, W, 3) RGB.
    """
    import cv2

    if places.size_m is None:
        return []
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    quads, numbers, _ = _detector(places.family).detectMarkers(gray)
    cells = _dictionary(places.family).markerSize + 2
    views = []
    for quad, number in zip(quads, [] if numbers is None else numbers.ravel().tolist(), strict=True):
        side_m = places.sizes_m.get(number, places.size_m)
        corners = _refined(gray, quad.reshape(4, 2).astype(np.float64), cells)
        view = None if corners is None else _posed(number, corners, side_m, intrinsics)
        if view is not None:
            views.append(view)
    return views


def _refined(gray: NDArray[np.uint8], corners: FloatArray, cells: int) -> FloatArray | None:
    """Return corners (4, 2) as intersections of lines fitted to the edges, as Wang and Olson 2016.

    OpenCV's corners are of a contour of whole pixels, half a pixel inside. None if the tag is too small to
    resolve its edges: OpenCV detects it anyway.
    """
    # One cell from its ends, where the other edges are visible.
    along = np.linspace(1.0, cells - 1.0, FEWEST) / cells
    for _ in range(ROUNDS):
        ends = np.roll(corners, -1, axis=0)
        sides_px = np.linalg.norm(ends - corners, axis=1)
        if sides_px.min() < cells:
            return None  # a cell is a pixel: there is no edge to see
        directions = (ends - corners) / sides_px[:, None]
        outward = np.column_stack([directions[:, 1], -directions[:, 0]])
        # Across each edge by the width of the black border at its narrower end, and as far into the white.
        reach_px = np.minimum(np.roll(sides_px, 1), np.roll(sides_px, -1)) / cells
        across = np.linspace(-1.0, 1.0, FEWEST) * reach_px[:, None]
        points = corners[:, None] + along[:, None] * (ends - corners)[:, None]
        values = _bilinear(gray, points[:, :, None] + across[:, None, :, None] * outward[:, None, None])
        rise = np.maximum(np.diff(values, axis=2), 0.0) + TINY
        middles = 0.5 * (across[:, 1:] + across[:, :-1])
        offsets = np.sum(rise * middles[:, None], axis=2) / rise.sum(axis=2)
        slope, shift = np.polyfit(along - 0.5, offsets.T, 1)
        # A line by its end points.
        first = corners + (shift - 0.5 * slope)[:, None] * outward
        last = ends + (shift + 0.5 * slope)[:, None] * outward
        lines = np.cross(np.insert(first, 2, 1.0, axis=1), np.insert(last, 2, 1.0, axis=1))
        meet = np.cross(np.roll(lines, 1, axis=0), lines)
        crossings = meet[:, :2] / meet[:, 2:]
        moved_px = np.abs(crossings - corners).max()
        if not moved_px <= sides_px.min() / cells:
            return None
        corners = crossings
        if moved_px < 100 * SETTLED:
            break
    return corners


def _bilinear(gray: NDArray[np.uint8], points: FloatArray) -> FloatArray:
    """Return the brightness (...) of an image at points (..., 2), column and row, bilinear."""
    most = np.array(gray.shape[::-1]) - 2
    cell = np.clip(np.floor(points).astype(np.int64), 0, most)
    (left, top), (right, down) = np.moveaxis(cell, -1, 0), np.moveaxis(points - cell, -1, 0)
    upper = (1.0 - right) * gray[top, left] + right * gray[top, left + 1]
    lower = (1.0 - right) * gray[top + 1, left] + right * gray[top + 1, left + 1]
    return np.asarray((1.0 - down) * upper + down * lower)


def _posed(number: int, corners_px: FloatArray, side_m: float, lens: CameraIntrinsics) -> TagView | None:
    """Return the pose of a square from its corners (4, 2); None if it is not in front of the camera."""
    import cv2

    # Corners in OpenCV's order: x to the right seen from the front, y up.
    square = 0.5 * side_m * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    matrix = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
    count, turns, shifts, _ = cv2.solvePnPGeneric(
        square, corners_px[:, None], matrix, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    fits = []
    for turn, shift in zip(turns[:count], shifts[:count], strict=True):
        cv2.solvePnPRefineLM(square, corners_px[:, None], matrix, None, turn, shift)
        pose = gtsam.Pose3(gtsam.Rot3(cv2.Rodrigues(turn)[0]), shift.ravel())
        points = square @ np.asarray(pose.rotation().matrix()).T + pose.translation()
        if points[:, 2].min() > TINY:
            seen_px = points[:, :2] / points[:, 2:] * [lens.fx, lens.fy] + [lens.cx, lens.cy]
            fits.append((float(np.sum((seen_px - corners_px) ** 2)), pose, points))
    if not fits:
        return None
    misfit, pose, points = min(fits, key=lambda fit: fit[0])
    # For a strongly tilted tag, both converge to the same pose.
    rivals = [fit[0] for fit in fits if not fit[1].equals(pose, 10 * SETTLED)]
    slopes = _slopes(points, square, np.asarray(pose.rotation().matrix()), lens)
    return TagView(number, pose, slopes.T @ slopes, misfit, min(rivals, default=math.inf) - misfit)


def _slopes(points: FloatArray, square: FloatArray, turn: FloatArray, lens: CameraIntrinsics) -> FloatArray:
    """Return (8, 6) derivatives of the corners' pixels by GTSAM's tangent of the tag, in its own axes."""
    (x, y, z), nothing = points.T, np.zeros(len(points))
    by_point = np.array(
        [[lens.fx / z, nothing, -lens.fx * x / z**2], [nothing, lens.fy / z, -lens.fy * y / z**2]]
    )
    by_point = np.moveaxis(by_point, 2, 0)
    # Each row crossed with the corner: its motion by a rotation.
    crossed = np.cross(np.eye(3)[None], square[:, None])
    by_tag = turn @ np.concatenate(
        [crossed.transpose(0, 2, 1), np.tile(np.eye(3), (len(square), 1, 1))], axis=2
    )
    return np.asarray((by_point @ by_tag).reshape(-1, 6))
