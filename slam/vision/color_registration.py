"""Registration of a colour camera to the depth camera: map colour pixels to the depth image, and back.

Both optical frames are right-handed (z forward, x right, y down) and parallel; a small rotation of the colour
camera appears as a shift of its principal point. `color_registration_fit.py` estimates the registration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.curves import NEAREST_M
from fusion.kernel import kernel
from slam.errors import DatasetError
from slam.measurements import AnyFloatArray, BoolArray, CameraIntrinsics, ColorImage, Float32Array, FloatArray

# Readings of one surface differ by less; otherwise the nearer one occludes the other.
RIM_SHARE = 0.05
# A pixel occludes another in the colour image if it is nearer by more than this share.
_HIDING_SHARE = 0.03


@dataclass(frozen=True, slots=True)
class ColorRegistration:
    """Pose of the colour camera relative to the depth camera.

    Attributes
    ----------
    T_depth_color
        Pose of the colour camera in the depth camera's frame: a shift across the optical axis.
    accepted
        Whether the evidence for a registration other than identity is clear. If not, the colour camera is
        the depth camera: `intrinsics_color` is `intrinsics_depth`, the transform is identity.
    reason
        Reason in one line, with the deciding figures.
    inlier_share_before, inlier_share_after
        Share of the held-out matches that a rigid motion explains within 2 pixels: with colour assumed
        registered, and with the registration fitted on the other pairs. Both 0 if nothing was measured.
    """

    intrinsics_color: CameraIntrinsics
    intrinsics_depth: CameraIntrinsics
    T_depth_color: gtsam.Pose3
    accepted: bool
    reason: str
    inlier_share_before: float = 0.0
    inlier_share_after: float = 0.0

    def cameras(self) -> FloatArray:
        """Return (10,) the parameters for `points_of_pixels`."""
        shift = self.T_depth_color.translation()
        return camera_row(self.intrinsics_color, self.intrinsics_depth, float(shift[0]), float(shift[1]))


def identity_registration(intrinsics: CameraIntrinsics, reason: str) -> ColorRegistration:
    """Return the registration of colour and depth from one camera."""
    return ColorRegistration(intrinsics, intrinsics, gtsam.Pose3(), accepted=False, reason=reason)


def camera_row(
    color: CameraIntrinsics, depth: CameraIntrinsics, shift_x_m: float, shift_y_m: float
) -> FloatArray:
    """Return (10,) fx, fy, cx, cy of colour, of depth, and x, y of the colour camera in the depth frame."""
    colors = [color.fx, color.fy, color.cx, color.cy]
    return np.array([*colors, depth.fx, depth.fy, depth.cx, depth.cy, shift_x_m, shift_y_m])


def register_features(
    pixels_color: AnyFloatArray, depth_m: Float32Array, registration: ColorRegistration
) -> tuple[Float32Array, Float32Array]:
    """Find the positions of colour keypoints in the depth image, and their depth.

    Along the ray of each keypoint, the first surface of the depth image is used.

    Parameters
    ----------
    pixels_color
        (N, 2) column and row in the colour image.
    depth_m
        (H, W) of the depth camera, 0 invalid.

    Returns
    -------
    pixels_depth
        (N, 2) column and row in the depth image; NaN without a surface.
    depth_at_m
        (N,) along the optical axis of the depth camera (the colour camera's is the same); 0 without a
        surface. The 3D point in the depth frame is that pixel's, by the depth camera's intrinsics.

    Raises
    ------
    DatasetError
        The depth image has another size than the intrinsics say.
    """
    _check_size(depth_m, registration.intrinsics_depth)
    cameras = registration.cameras()
    points_color = points_of_pixels(np.ascontiguousarray(pixels_color, dtype=np.float64), depth_m, cameras)
    z = points_color[:, 2]
    is_known = z > 0.0
    safe = np.where(is_known, z, 1.0)
    focal, centre, shift = cameras[4:6], cameras[6:8], cameras[8:10]
    pixels = (points_color[:, :2] + shift) / safe[:, None] * focal + centre
    pixels[~is_known] = np.nan
    return pixels.astype(np.float32), z.astype(np.float32)


def register_color(
    color: ColorImage, depth_m: Float32Array, registration: ColorRegistration
) -> tuple[ColorImage, BoolArray]:
    """Project the colour image into the depth camera.

    Parameters
    ----------
    color
        (Hc, Wc, 3) of the colour camera.
    depth_m
        (H, W) of the depth camera, 0 invalid.

    Returns
    -------
    color_depth
        (H, W, 3), 0 if the colour is unknown.
    known
        (H, W) false without depth, outside the colour image, or if a nearer surface occludes the point for
        the colour camera.

    Raises
    ------
    DatasetError
        The depth image has another size than the intrinsics say.
    """
    import cv2

    _check_size(depth_m, registration.intrinsics_depth)
    columns, rows = _color_pixels(depth_m, registration.cameras())
    # A depth buffer of the colour camera, with points one pixel wide.
    buffer, known = np.full(color.shape[:2], np.inf, np.float32), np.zeros(depth_m.shape, np.bool_)
    _buffer_depths(columns, rows, depth_m, buffer, known)
    warped = cv2.remap(color, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    warped[~known] = 0
    return np.asarray(warped, dtype=np.uint8), known


def _check_size(depth_m: Float32Array, intrinsics: CameraIntrinsics) -> None:
    """Check that the depth image has the size of its intrinsics."""
    if depth_m.shape != (intrinsics.height, intrinsics.width):
        raise DatasetError(
            f"depth image of {depth_m.shape[1]} x {depth_m.shape[0]}, the depth camera has "
            f"{intrinsics.width} x {intrinsics.height}: give the intrinsics of this image"
        )


def points_of_pixels(pixels_color: FloatArray, depth_m: Float32Array, cameras: FloatArray) -> FloatArray:
    """Return (N, 3) points in the colour frame of (N, 2) colour pixels; z is 0 if the ray hits no surface.

    Parameters
    ----------
    cameras
        (10,) by `camera_row`.
    """
    return points_of_images(pixels_color, [depth_m], np.array([0, len(pixels_color)]), cameras, NEAREST_M)


def points_of_images(
    pixels_color: FloatArray,
    depths_m: Sequence[Float32Array],
    starts: NDArray[np.int64],
    cameras: FloatArray,
    nearest_m: float,
) -> FloatArray:
    """As `points_of_pixels`, for images without nearer readings: image p has pixels from starts[p]."""
    fx, fy, cx, cy, fx_depth, fy_depth, cx_depth, cy_depth, shift_x, shift_y = cameras.tolist()
    rays = (pixels_color - (cx, cy)) / (fx, fy)
    # A point at depth z is (along, down) / z pixels away from the point at infinity on its ray.
    along, down = fx_depth * shift_x, fy_depth * shift_y
    reach = float(np.hypot(along, down))
    places = rays * (fx_depth, fy_depth) + (cx_depth, cy_depth)
    steps, z = math.ceil(reach / nearest_m), np.zeros(len(rays))
    for depth_m, first, end in zip(depths_m, starts, starts[1:], strict=False):
        _first_meetings(depth_m, places[first:end], along, down, reach, steps, z[first:end])
    return np.column_stack([rays * z[:, None], z])


@kernel(error_model="numpy")
def _first_meetings(depth_m, starts, along, down, reach, steps, hit_m):  # type: ignore[no-untyped-def]
    """Return depths (N,) of the first intersection of rays with the depth image; 0 if there is none."""
    height, width = depth_m.shape
    right, below = (along / reach, down / reach) if reach > 0.0 else (0.0, 0.0)
    for i in range(starts.shape[0]):
        column = starts[i, 0]
        row = starts[i, 1]
        for step in range(steps, -1, -1):
            c = int(np.floor(column + right * step + 0.5))
            r = int(np.floor(row + below * step + 0.5))
            if c < 0 or r < 0 or c >= width or r >= height:
                continue
            z = np.float64(depth_m[r, c])
            if z <= 0.0 or abs(reach - step * z) > z:  # up to one step: a pixel of disparity
                continue
            # The step was a whole pixel: repeat at the depth found, unless that leaves the surface.
            finer = _surface_reading(depth_m, column + along / z, row + down / z)
            hit_m[i] = finer if finer > 0.0 and abs(reach / finer - reach / z) <= 1.0 else z
            break


@kernel(inline="always")
def _surface_reading(depth_m, column, row):  # type: ignore[no-untyped-def]
    """Interpolate up to four readings bilinearly; at an edge, use the nearest one; 0 without any."""
    left = int(np.floor(column))
    top = int(np.floor(row))
    total = weights = farthest = 0.0
    nearest = math.inf
    for r in range(top, top + 2):
        for c in range(left, left + 2):
            if c < 0 or r < 0 or c >= depth_m.shape[1] or r >= depth_m.shape[0]:
                continue
            z = np.float64(depth_m[r, c])
            weight = (1.0 - abs(column - c)) * (1.0 - abs(row - r))
            if z > 0.0 and weight > 0.0:
                nearest = min(nearest, z)
                farthest = max(farthest, z)
                total += weight * z
                weights += weight
    if farthest - nearest <= RIM_SHARE * nearest and weights > 0.0:
        nearest = total / weights
    return nearest if weights > 0.0 else 0.0


def _color_pixels(depth_m: Float32Array, cameras: FloatArray) -> tuple[Float32Array, Float32Array]:
    """Return (H, W) column and row in the colour image of each depth pixel; -1 without a reading."""
    fx, fy, cx, cy, fx_depth, fy_depth, cx_depth, cy_depth, shift_x, shift_y = cameras.tolist()
    height, width = depth_m.shape
    known = depth_m > 0.0
    z = np.where(known, depth_m, 1.0).astype(np.float64)
    columns = ((np.arange(width) - cx_depth) / fx_depth - shift_x / z) * fx + cx
    rows = ((np.arange(height)[:, None] - cy_depth) / fy_depth - shift_y / z) * fy + cy
    return np.where(known, columns, -1.0).astype(np.float32), np.where(known, rows, -1.0).astype(np.float32)


@kernel
def _buffer_depths(columns, rows, depth_m, buffer, visible):  # type: ignore[no-untyped-def]
    """Draw the points into the buffer, then test each against it."""
    height, width = buffer.shape
    for r in range(depth_m.shape[0]):
        for c in range(depth_m.shape[1]):
            z = depth_m[r, c]
            left = int(np.floor(columns[r, c]))
            top = int(np.floor(rows[r, c]))
            if z > 0.0 and left >= 0 and top >= 0 and left < width - 1 and top < height - 1:
                for y in range(top, top + 2):
                    for x in range(left, left + 2):
                        if z < buffer[y, x]:
                            buffer[y, x] = z
    for r in range(depth_m.shape[0]):
        for c in range(depth_m.shape[1]):
            x = int(np.floor(columns[r, c] + 0.5))
            y = int(np.floor(rows[r, c] + 0.5))
            if depth_m[r, c] > 0.0 and x >= 0 and y >= 0 and x < width and y < height:
                visible[r, c] = depth_m[r, c] <= (1.0 + _HIDING_SHARE) * buffer[y, x]
