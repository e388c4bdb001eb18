"""Terms of the alignment of a frame: point to plane, and reprojection."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import ZERO, kernel

_LEAST_NORMAL_COSINE = 0.8  # two surfaces turned further apart are not the same


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
    view = (T, inverse_depth, surface_normals, *camera)
    limits = (gate_m, kernel, depth_floor_m, depth_share)
    terms = np.empty((19, 256))  # so many points' terms stay in the nearest cache
    _surface_part(points, normals, *view, *limits, hessian, gradient, information, seen, residuals, terms)


@kernel(nogil=True)
def _surface_part(  # type: ignore[no-untyped-def]
    points,
    normals,
    T,
    inverse_depth,
    surface_normals,
    fx,
    fy,
    cx,
    cy,
    gate_m,
    kernel,
    depth_floor_m,
    depth_share,
    hessian,
    gradient,
    information,
    seen,
    residuals,
    terms,
):
    """Add up the terms of blocks of points, in ``terms`` (19, block)."""
    inverse_fx, inverse_fy, inverse_kernel = 1.0 / fx, 1.0 / fy, 1.0 / kernel
    height, width = inverse_depth.shape
    r00, r01, r02, tx = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, ty = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, tz = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    count = ZERO
    for i in range(points.shape[0]):
        if count == terms.shape[1]:
            _add_up(terms, count, hessian, gradient, information)
            count = ZERO
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        z = r20 * px + r21 * py + r22 * pz + tz
        if z <= 0.0:
            continue
        x = r00 * px + r01 * py + r02 * pz + tx
        y = r10 * px + r11 * py + r12 * pz + ty
        inverse_z = 1.0 / z
        u = math.floor(fx * x * inverse_z + cx + 0.5)
        v = math.floor(fy * y * inverse_z + cy + 0.5)
        if u < 0 or v < 0 or u >= width or v >= height or inverse_depth[v, u] <= 0.0:
            continue
        seen[i] = 1
        nx, ny, nz = surface_normals[v, u, 0], surface_normals[v, u, 1], surface_normals[v, u, 2]
        # The view's normal, seen from the frame.
        mx = r00 * nx + r10 * ny + r20 * nz
        my = r01 * nx + r11 * ny + r21 * nz
        mz = r02 * nx + r12 * ny + r22 * nz
        ox, oy, oz = normals[i, 0], normals[i, 1], normals[i, 2]
        if mx * ox + my * oy + mz * oz < _LEAST_NORMAL_COSINE:
            continue
        qz = 1.0 / inverse_depth[v, u]
        if abs(z - qz) > gate_m * max(1.0, z * z) * 2.0:
            continue
        r = nx * (x - (u - cx) * inverse_fx * qz) + ny * (y - (v - cy) * inverse_fy * qz) + nz * (z - qz)
        inverse_sigma = 1.0 / (depth_floor_m + depth_share * z * z)
        normalised = abs(r) * inverse_sigma
        residuals[i] = min(residuals[i], normalised)
        share = normalised * inverse_kernel
        weight = inverse_sigma / (1.0 + share * share)
        weight *= weight
        jx, jy, jz = py * mz - pz * my, pz * mx - px * mz, px * my - py * mx
        terms[0, count], terms[1, count], terms[2, count] = jx, jy, jz
        terms[3, count], terms[4, count], terms[5, count] = mx, my, mz
        terms[6, count], terms[7, count], terms[8, count] = weight * jx, weight * jy, weight * jz
        terms[9, count], terms[10, count], terms[11, count] = weight * mx, weight * my, weight * mz
        terms[12, count] = py * oz - pz * oy
        terms[13, count] = pz * ox - px * oz
        terms[14, count] = px * oy - py * ox
        terms[15, count], terms[16, count], terms[17, count] = ox, oy, oz
        terms[18, count] = r
        count += 1
    _add_up(terms, count, hessian, gradient, information)


@kernel(nogil=True)
def _add_up(
    terms: NDArray[Any],
    count: int,
    hessian: NDArray[Any],
    gradient: NDArray[Any],
    information: NDArray[Any],
) -> None:
    """Add products of ``terms`` (19, N): derivative by the view's normal (6), the same times its weight (6),
    derivative by the point's own normal (6), distance.
    """
    for a in range(6):
        weighted = terms[6 + a, :count]
        gradient[a] -= _dot(weighted, terms[18, :count])
        for b in range(6):
            hessian[a, b] += _dot(weighted, terms[b, :count])
            information[a, b] += _dot(weighted, terms[12 + b, :count])


@kernel(nogil=True, fastmath=True)
def _dot(first: NDArray[Any], second: NDArray[Any]) -> float:
    """Inner product, in the order that vector instructions like."""
    total = 0.0
    for i in range(first.size):
        total += first[i] * second[i]
    return total


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
    slopes = np.zeros((2, 6))
    _feature_part(points, pixels, sigma_px, T, *camera, kernel, slopes, hessian, gradient, residuals)


@kernel(nogil=True)
def _feature_part(  # type: ignore[no-untyped-def]
    points, pixels, sigma_px, T, fx, fy, cx, cy, kernel, slopes, hessian, gradient, residuals
):
    """Add up, with room for the derivatives of both errors, (2, 6)."""
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        residuals[i] = math.inf
        if z <= 0.0:
            continue
        eu = fx * x / z + cx - pixels[i, 0]
        ev = fy * y / z + cy - pixels[i, 1]
        sigma = sigma_px[i]
        normalised = math.sqrt(0.5 * (eu * eu + ev * ev)) / sigma
        residuals[i] = normalised
        share = normalised / kernel
        weight = 1.0 / (1.0 + share * share)
        weight = weight * weight / (sigma * sigma)
        # Moving the camera by (w, v) moves the point by -w x p - v.
        gx = fx / z
        gy = fy / z
        hx = -fx * x / (z * z)
        hy = -fy * y / (z * z)
        slopes[0, 0] = -hx * y
        slopes[0, 1] = hx * x - gx * z
        slopes[0, 2] = gx * y
        slopes[0, 3] = -gx
        slopes[0, 5] = -hx
        slopes[1, 0] = gy * z - hy * y
        slopes[1, 1] = hy * x
        slopes[1, 2] = -gy * x
        slopes[1, 4] = -gy
        slopes[1, 5] = -hy
        for a in range(6):
            du = slopes[0, a]
            dv = slopes[1, a]
            gradient[a] -= weight * (du * eu + dv * ev)
            for b in range(6):
                hessian[a, b] += weight * (du * slopes[0, b] + dv * slopes[1, b])
