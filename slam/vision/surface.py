"""Surfaces in a depth image: smoothed depth and normals by local planes, and points drawn from them.

A plane is linear in inverse depth, ``1/z = a u + b v + c``, and there the noise of a structured-light or
stereo camera is the same at every pixel: the least-squares plane of a window gives both the smoothed depth
and the normal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.measurements import CameraIntrinsics, Float32Array, FloatArray
from slam.vision.plane_windows import fit_planes


@dataclass(frozen=True, slots=True)
class Surface:
    """What a keyframe offers to be matched against.

    Attributes
    ----------
    inverse_depth
        (H, W) smoothed, 1/m; 0 where there is no surface.
    normals
        (H, W, 3) unit, towards the camera, camera frame; zero where there is none.
    intrinsics
        Of these images.
    """

    inverse_depth: Float32Array
    normals: Float32Array
    intrinsics: CameraIntrinsics


@dataclass(frozen=True, slots=True)
class SurfacePoints:
    """What a frame is matched by: (N, 3) points and unit normals, camera frame."""

    points: FloatArray
    normals: FloatArray

    def __len__(self) -> int:
        return len(self.points)


def working_depth(
    depth_m: Float32Array, intrinsics: CameraIntrinsics, width: int
) -> tuple[Float32Array, CameraIntrinsics]:
    """Every n-th pixel of a depth image, so that at most ``width`` columns remain, and their intrinsics.

    Pixels are dropped, not averaged: an average over a rim is a point in mid air.
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
    """Smoothed depth and normals of every pixel.

    Parameters
    ----------
    depth_m
        (H, W), 0 where invalid.
    radius
        Half size of the window in pixels.
    farthest_m
        What lies behind is left out.
    """
    inverse, k = _inverse(depth_m, farthest_m), intrinsics
    smooth = np.zeros_like(inverse)
    normals = np.zeros((*inverse.shape, 3), np.float32)
    planes = fit_planes(inverse, radius, 1, k.fx, k.fy, k.cx, k.cy)
    inner = tuple(slice(radius, radius + side) for side in planes.shape[:2])
    smooth[inner], normals[inner] = planes[..., 0], planes[..., 1:]
    return Surface(smooth, normals, intrinsics)


def points_of(
    depth_m: Float32Array, intrinsics: CameraIntrinsics, radius: int, farthest_m: float, count: int
) -> SurfacePoints:
    """About ``count`` points with normals on an even lattice over the image."""
    inverse = _inverse(depth_m, farthest_m)
    step = max(1, round(np.sqrt(np.count_nonzero(inverse) / count)))
    k = intrinsics
    planes = fit_planes(inverse, radius, step, k.fx, k.fy, k.cx, k.cy)
    found = np.nonzero(planes[..., 0])
    planes = planes[found].astype(np.float64)
    z = 1.0 / planes[:, 0]
    rows, columns = (radius + step * places for places in found)
    points = np.stack([(columns - k.cx) / k.fx * z, (rows - k.cy) / k.fy * z, z], axis=1)
    return SurfacePoints(points, np.ascontiguousarray(planes[:, 1:]))


def _inverse(depth_m: Float32Array, farthest_m: float) -> Float32Array:
    """(H, W) inverse depth, 0 where there is no reading or one from behind ``farthest_m``."""
    with np.errstate(divide="ignore"):
        inverse = np.float32(1.0) / depth_m
    inverse[~((depth_m > 0.0) & (depth_m <= farthest_m))] = 0.0
    return inverse
