"""Surfaces in a depth image: smoothed depth and normals from local planes, and points sampled from them.

A plane is linear in inverse depth, ``1/z = a u + b v + c``, and there the noise of a structured-light or
stereo camera is the same at every pixel: the least-squares plane of a window gives both the smoothed depth
and the normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.measurements import CameraIntrinsics, Float32Array
from slam.vision.plane_windows import fit_planes


@dataclass(frozen=True, slots=True)
class Surface:
    """Surface of a keyframe for matching.

    Attributes
    ----------
    planes
        (H, W, 4) smoothed inverse depth, 1/m, and unit normal towards the camera, camera frame; zero without
        a surface. The values of a pixel are adjacent.
    """

    planes: Float32Array
    intrinsics: CameraIntrinsics


@dataclass(frozen=True, slots=True)
class SurfacePoints:
    """Surface points of a frame: points and unit normals, camera frame, as rows of an array (6, N)."""

    rows: Float32Array

    @property
    def points(self) -> Float32Array:
        """(N, 3)."""
        return self.rows[:3].T

    def every(self, step: int) -> SurfacePoints:
        """Return some of the points, evenly sampled."""
        return SurfacePoints(np.ascontiguousarray(self.rows[:, ::step]))

    def __len__(self) -> int:
        return self.rows.shape[1]


def working_depth(
    depth_m: Float32Array, intrinsics: CameraIntrinsics, width: int
) -> tuple[Float32Array, CameraIntrinsics]:
    """Return every n-th pixel of a depth image with at most ``width`` columns, and its intrinsics.

    Pixels are dropped, not averaged: an average across an edge is a flying point.
    """
    step = -(-intrinsics.width // width)
    first = step // 2
    reduced = np.ascontiguousarray(depth_m[first::step, first::step])
    return reduced, CameraIntrinsics(
        fx=intrinsics.fx / step,
        fy=intrinsics.fy / step,
        cx=(intrinsics.cx - first) / step,
        cy=(intrinsics.cy - first) / step,
        width=reduced.shape[1],
        height=reduced.shape[0],
    )


def surface_of(
    depth_m: Float32Array, intrinsics: CameraIntrinsics, radius: int, farthest_m: float
) -> Surface:
    """Return smoothed depth and normals of every pixel.

    Parameters
    ----------
    depth_m
        (H, W), 0 where invalid.
    radius
        Half size of the window in pixels.
    farthest_m
        Farther readings are ignored.
    """
    inverse, k = _inverse(depth_m, farthest_m), intrinsics
    planes = np.zeros((*inverse.shape, 4), np.float32)
    fitted = fit_planes(inverse, radius, 1, k.fx, k.fy, k.cx, k.cy)
    planes[tuple(slice(radius, radius + side) for side in fitted.shape[:2])] = fitted
    return Surface(planes, intrinsics)


def points_of(
    depth_m: Float32Array, intrinsics: CameraIntrinsics, radius: int, farthest_m: float, count: int
) -> SurfacePoints:
    """Return about ``count`` points with normals on a regular grid over the image."""
    inverse = _inverse(depth_m, farthest_m)
    step = max(1, round(np.sqrt(np.count_nonzero(inverse) / count)))
    k = intrinsics
    planes = fit_planes(inverse, radius, step, k.fx, k.fy, k.cx, k.cy)
    valid = np.nonzero(planes[..., 0])
    inverse, *normals = planes[valid].T
    z = np.float32(1.0) / inverse
    rows, columns = (radius + step * places for places in valid)
    xy = (columns - k.cx) / k.fx * z, (rows - k.cy) / k.fy * z
    return SurfacePoints(np.array([*xy, z, *normals], np.float32))


def _inverse(depth_m: Float32Array, farthest_m: float) -> Float32Array:
    """Return (H, W) inverse depth, 0 without a reading or beyond ``farthest_m``."""
    with np.errstate(divide="ignore"):
        inverse = np.float32(1.0) / depth_m
    inverse[~((depth_m > 0.0) & (depth_m <= farthest_m))] = 0.0
    return inverse
