"""Surfaces in a depth image: smoothed depth and normals by local planes, and points drawn from them.

A plane is linear in inverse depth, ``1/z = a u + b v + c``, and there the noise of a structured-light or
stereo camera is the same at every pixel: the least-squares plane of a window gives both the smoothed depth
and the normal.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from slam.measurements import CameraIntrinsics, Float32Array, FloatArray

_LEAST_SHARE = 0.5  # of a window's pixels on the same surface, below which there is no normal
_LEAST_DETERMINANT = 1e-3
_SAME_SURFACE = 0.04  # relative difference of inverse depth to the window's centre


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
    inverse = _inverse(depth_m, farthest_m)
    smooth = np.zeros_like(inverse)
    normals = np.zeros((*inverse.shape, 3), np.float32)
    k = intrinsics
    _fit_planes(inverse, radius, 1, k.fx, k.fy, k.cx, k.cy, smooth, normals)
    return Surface(smooth, normals, intrinsics)


def points_of(
    depth_m: Float32Array, intrinsics: CameraIntrinsics, radius: int, farthest_m: float, count: int
) -> SurfacePoints:
    """About ``count`` points with normals on an even lattice over the image."""
    inverse = _inverse(depth_m, farthest_m)
    step = max(1, round(np.sqrt(np.count_nonzero(inverse) / count)))
    smooth = np.zeros_like(inverse)
    normals = np.zeros((*inverse.shape, 3), np.float32)
    k = intrinsics
    _fit_planes(inverse, radius, step, k.fx, k.fy, k.cx, k.cy, smooth, normals)
    rows, columns = np.nonzero(smooth)
    z = 1.0 / smooth[rows, columns].astype(np.float64)
    points = np.stack([(columns - k.cx) / k.fx * z, (rows - k.cy) / k.fy * z, z], axis=1)
    return SurfacePoints(points, normals[rows, columns].astype(np.float64))


def _inverse(depth_m: Float32Array, farthest_m: float) -> Float32Array:
    """(H, W) inverse depth, 0 where there is no reading or one from behind ``farthest_m``."""
    with np.errstate(divide="ignore"):
        return np.where((depth_m > 0.0) & (depth_m <= farthest_m), np.float32(1.0) / depth_m, np.float32(0.0))


@numba.njit(cache=True, nogil=True)
def _fit_planes(
    inverse: NDArray[Any],
    radius: int,
    step: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    smooth: NDArray[Any],
    normals: NDArray[Any],
) -> None:
    """Least-squares plane of every ``step``-th window into ``smooth`` and ``normals``."""
    height, width = inverse.shape
    least = _LEAST_SHARE * (2 * radius + 1) ** 2
    for v in range(radius, height - radius, step):
        for u in range(radius, width - radius, step):
            centre = inverse[v, u]
            if centre <= 0.0:
                continue
            gate = _SAME_SURFACE * centre
            n = 0.0
            su = 0.0
            sv = 0.0
            suu = 0.0
            svv = 0.0
            suv = 0.0
            sw = 0.0
            swu = 0.0
            swv = 0.0
            for dv in range(-radius, radius + 1):
                for du in range(-radius, radius + 1):
                    w = inverse[v + dv, u + du]
                    if w <= 0.0 or abs(w - centre) > gate:
                        continue
                    w -= centre
                    n += 1.0
                    su += du
                    sv += dv
                    suu += du * du
                    svv += dv * dv
                    suv += du * dv
                    sw += w
                    swu += w * du
                    swv += w * dv
            if n < least:
                continue
            mu = su / n
            mv = sv / n
            a = suu / n - mu * mu
            b = suv / n - mu * mv
            d = svv / n - mv * mv
            e = swu / n - sw / n * mu
            f = swv / n - sw / n * mv
            determinant = a * d - b * b
            if determinant < _LEAST_DETERMINANT:
                continue
            slope_u = (e * d - f * b) / determinant
            slope_v = (f * a - e * b) / determinant
            w0 = centre + sw / n - slope_u * mu - slope_v * mv
            if w0 <= 0.0:
                continue
            # The plane n . p = 1 in camera coordinates.
            nx = slope_u * fx
            ny = slope_v * fy
            nz = w0 - slope_u * (u - cx) - slope_v * (v - cy)
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            smooth[v, u] = w0
            normals[v, u, 0] = -nx / length
            normals[v, u, 1] = -ny / length
            normals[v, u, 2] = -nz / length
