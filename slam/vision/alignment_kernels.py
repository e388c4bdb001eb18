"""Normal equations of the alignment of a frame: point to plane, and reprojection."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

_LEAST_NORMAL_COSINE = 0.8  # two surfaces turned further apart are not the same
_NEAREST_M = 0.2


@numba.njit(cache=True, nogil=True)
def surface_part(
    points: NDArray[Any],
    normals: NDArray[Any],
    T: NDArray[Any],
    inverse_depth: NDArray[Any],
    surface_normals: NDArray[Any],
    camera: tuple[float, float, float, float],
    gate_m: float,
    kernel: float,
    depth_floor_m: float,
    depth_share: float,
    hessian: NDArray[Any],
    gradient: NDArray[Any],
    information: NDArray[Any],
    seen: NDArray[Any],
    residuals: NDArray[Any],
) -> None:
    """Add the point-to-plane terms of one view; ``T`` maps the frame into the view.

    ``hessian`` squares the view's noisy normals, and so a flat wall seems to tell motion along itself. The
    product of both surfaces' normals, whose noise is independent, does not: that is the ``information``.
    """
    fx, fy, cx, cy = camera
    height, width = inverse_depth.shape
    jacobian = np.empty(6)
    twin = np.empty(6)
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if z < _NEAREST_M:
            continue
        u = int(np.floor(fx * x / z + cx + 0.5))
        v = int(np.floor(fy * y / z + cy + 0.5))
        if u < 0 or v < 0 or u >= width or v >= height or inverse_depth[v, u] <= 0.0:
            continue
        seen[i] = 1
        nx, ny, nz = surface_normals[v, u, 0], surface_normals[v, u, 1], surface_normals[v, u, 2]
        # The view's normal, seen from the frame.
        mx = T[0, 0] * nx + T[1, 0] * ny + T[2, 0] * nz
        my = T[0, 1] * nx + T[1, 1] * ny + T[2, 1] * nz
        mz = T[0, 2] * nx + T[1, 2] * ny + T[2, 2] * nz
        if mx * normals[i, 0] + my * normals[i, 1] + mz * normals[i, 2] < _LEAST_NORMAL_COSINE:
            continue
        qz = 1.0 / inverse_depth[v, u]
        if abs(z - qz) > gate_m * max(1.0, z * z) * 2.0:
            continue
        r = nx * (x - (u - cx) / fx * qz) + ny * (y - (v - cy) / fy * qz) + nz * (z - qz)
        sigma = depth_floor_m + depth_share * z * z
        normalised = abs(r) / sigma
        residuals[i] = min(residuals[i], normalised)
        weight = 1.0 / (1.0 + (normalised / kernel) ** 2)
        weight = weight * weight / (sigma * sigma)
        jacobian[0] = py * mz - pz * my
        jacobian[1] = pz * mx - px * mz
        jacobian[2] = px * my - py * mx
        jacobian[3] = mx
        jacobian[4] = my
        jacobian[5] = mz
        twin[0] = py * normals[i, 2] - pz * normals[i, 1]
        twin[1] = pz * normals[i, 0] - px * normals[i, 2]
        twin[2] = px * normals[i, 1] - py * normals[i, 0]
        twin[3] = normals[i, 0]
        twin[4] = normals[i, 1]
        twin[5] = normals[i, 2]
        for a in range(6):
            gradient[a] -= weight * jacobian[a] * r
            for b in range(6):
                hessian[a, b] += weight * jacobian[a] * jacobian[b]
                information[a, b] += weight * jacobian[a] * twin[b]


@numba.njit(cache=True, nogil=True)
def feature_part(
    points: NDArray[Any],
    pixels: NDArray[Any],
    sigma_px: NDArray[Any],
    T: NDArray[Any],
    camera: tuple[float, float, float, float],
    kernel: float,
    hessian: NDArray[Any],
    gradient: NDArray[Any],
    residuals: NDArray[Any],
) -> None:
    """Add the reprojection terms, Yang2021 Eq. (5); ``T`` maps the odometry frame into the camera."""
    fx, fy, cx, cy = camera
    du = np.empty(6)
    dv = np.empty(6)
    for i in range(points.shape[0]):
        x = T[0, 0] * points[i, 0] + T[0, 1] * points[i, 1] + T[0, 2] * points[i, 2] + T[0, 3]
        y = T[1, 0] * points[i, 0] + T[1, 1] * points[i, 1] + T[1, 2] * points[i, 2] + T[1, 3]
        z = T[2, 0] * points[i, 0] + T[2, 1] * points[i, 1] + T[2, 2] * points[i, 2] + T[2, 3]
        residuals[i] = np.inf
        if z < _NEAREST_M:
            continue
        eu = fx * x / z + cx - pixels[i, 0]
        ev = fy * y / z + cy - pixels[i, 1]
        normalised = np.sqrt(0.5 * (eu * eu + ev * ev)) / sigma_px[i]
        residuals[i] = normalised
        weight = 1.0 / (1.0 + (normalised / kernel) ** 2)
        weight = weight * weight / (sigma_px[i] * sigma_px[i])
        # Moving the camera by (w, v) moves the point by -w x p - v.
        gx = fx / z
        gy = fy / z
        hx = -fx * x / (z * z)
        hy = -fy * y / (z * z)
        du[0] = hx * -y
        du[1] = gx * -z + hx * x
        du[2] = gx * y
        du[3] = -gx
        du[4] = 0.0
        du[5] = -hx
        dv[0] = gy * z + hy * -y
        dv[1] = hy * x
        dv[2] = gy * -x
        dv[3] = 0.0
        dv[4] = -gy
        dv[5] = -hy
        for a in range(6):
            gradient[a] -= weight * (du[a] * eu + dv[a] * ev)
            for b in range(6):
                hessian[a, b] += weight * (du[a] * du[b] + dv[a] * dv[b])
