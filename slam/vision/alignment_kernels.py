"""Terms of the alignment of a frame: point to plane, and reprojection."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel

_LEAST_NORMAL_COSINE = np.float32(0.8)  # surfaces with a larger angle between normals are not the same


def room_for_points() -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return the buffer of `surface_part`: the terms of so many points stay in the L1 cache."""
    return np.empty((17, 256), np.float32), np.empty(256, np.int32)


@kernel(nogil=True)
def surface_part(  # type: ignore[no-untyped-def]
    points, T, planes, camera, limits, room, at, sums, seen, residuals, informed
):
    """Add the point-to-plane terms of one view; ``T`` maps the frame into the view.

    The Hessian squares the view's noisy normals, so a flat wall seems to determine motion along itself. The
    product of both surfaces' normals, whose noise is independent, does not: that is the information.

    Parameters
    ----------
    points
        (6, N) points of the frame, and their normals.
    T
        (4, 4) of float32.
    planes
        (H * W, 4) of the view, see `slam.vision.surface.Surface`.
    camera
        (6,) of the view: fx, fy, cx, cy, width, height.
    limits
        (4,) gate in metres, scale of the kernel in standard deviations, floor and share of the depth's.
    room, at
        By `room_for_points`. The rows of ``room``: the derivative by the view's normal (6), the distance, its
        weight, the points in the view (3), their pixels off the centre (2), the view's planes (4).
    sums
        (6, 7) Hessian and gradient of the residual; if ``informed``, the information and an unused column.
    seen, residuals
        (N,) 1 if any view has a surface; least residual in standard deviations.
    """
    m = room
    for first in range(0, points.shape[1], at.size):
        end = min(first + at.size, points.shape[1])
        px, py, pz = points[0, first:end], points[1, first:end], points[2, first:end]
        ox, oy, oz = points[3, first:end], points[4, first:end], points[5, first:end]
        _place(px, py, pz, T, camera, m[8], m[9], m[10], m[11], m[12], at)
        _look_up(planes, at, px.size, m[13], m[14], m[15], m[16])
        _turn(m[14], m[15], m[16], ox, oy, oz, T, m[3], m[4], m[5], m[7])
        planes_hit = m[13], m[14], m[15], m[16]
        part = seen[first:end], residuals[first:end]
        _judge(m[8], m[9], m[10], m[11], m[12], planes_hit, camera, limits, m[6], m[7], *part)
        _moment(px, py, pz, m[3], m[4], m[5], m[0], m[1], m[2])
        if informed:
            _moment(px, py, pz, ox, oy, oz, m[8], m[9], m[10])
            for a in range(6):
                _add_up(m[7], m[a], m[8], m[9], m[10], ox, oy, oz, m[6], px.size, sums[a])
        else:
            for a in range(6):
                _add_up(m[7], m[a], m[0], m[1], m[2], m[3], m[4], m[5], m[6], px.size, sums[a])


@kernel(nogil=True, error_model="numpy")
def _place(px, py, pz, T, camera, x, y, z, du, dv, at):  # type: ignore[no-untyped-def]
    """Compute points in the view, pixel offsets from the centre, and pixel index; -1 outside the image."""
    nothing, half, one = np.float32(0.0), np.float32(0.5), np.float32(1.0)
    r00, r01, r02, tx = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    r10, r11, r12, ty = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    r20, r21, r22, tz = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    fx, fy, cx, cy, width, height = camera[0], camera[1], camera[2], camera[3], camera[4], camera[5]
    for i in range(px.size):
        across = r00 * px[i] + r01 * py[i] + r02 * pz[i] + tx
        down = r10 * px[i] + r11 * py[i] + r12 * pz[i] + ty
        depth = r20 * px[i] + r21 * py[i] + r22 * pz[i] + tz
        inverse = one / (depth if depth > nothing else one)
        u = np.floor(fx * across * inverse + cx + half)
        v = np.floor(fy * down * inverse + cy + half)
        inside = (depth > nothing) & (u >= nothing) & (v >= nothing) & (u < width) & (v < height)
        x[i], y[i], z[i], du[i], dv[i] = across, down, depth, u - cx, v - cy
        at[i] = np.int32(v * width + u if inside else -one)


@kernel(nogil=True)
def _look_up(planes, at, count, inverse, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Look up the view's planes at pixels; inverse depth 0 if there is none."""
    nothing = np.float32(0.0)
    for i in range(count):
        pixel = max(at[i], 0)
        inverse[i] = planes[pixel, 0] if at[i] >= 0 else nothing
        nx[i] = planes[pixel, 1]
        ny[i] = planes[pixel, 2]
        nz[i] = planes[pixel, 3]


@kernel(nogil=True)
def _turn(nx, ny, nz, ox, oy, oz, T, mx, my, mz, facing):  # type: ignore[no-untyped-def]
    """Rotate the view's normals to the frame; write whether they agree with its own, 1 or 0."""
    nothing, one = np.float32(0.0), np.float32(1.0)
    r00, r01, r02 = T[0, 0], T[0, 1], T[0, 2]
    r10, r11, r12 = T[1, 0], T[1, 1], T[1, 2]
    r20, r21, r22 = T[2, 0], T[2, 1], T[2, 2]
    for i in range(ox.size):
        a = r00 * nx[i] + r10 * ny[i] + r20 * nz[i]
        b = r01 * nx[i] + r11 * ny[i] + r21 * nz[i]
        c = r02 * nx[i] + r12 * ny[i] + r22 * nz[i]
        cosine = a * ox[i] + b * oy[i] + c * oz[i]
        mx[i], my[i], mz[i] = a, b, c
        facing[i] = one if cosine >= _LEAST_NORMAL_COSINE else nothing


@kernel(nogil=True, error_model="numpy")
def _judge(  # type: ignore[no-untyped-def]
    x, y, z, du, dv, planes, camera, limits, distance, weight, seen, residuals
):
    """Compute distances to planes, weights (0 without a partner), and least residuals."""
    nothing, one, never = np.float32(0.0), np.float32(1.0), np.float32(np.inf)
    inverse, nx, ny, nz = planes
    inverse_fx, inverse_fy, gate_m = one / camera[0], one / camera[1], limits[0] + limits[0]
    inverse_kernel, floor_m, share = one / limits[1], limits[2], limits[3]
    for i in range(seen.size):
        known = inverse[i] > nothing
        seen[i] = one if known else seen[i]
        depth = one / (inverse[i] if known else one)
        aside = nx[i] * (x[i] - du[i] * inverse_fx * depth) + ny[i] * (y[i] - dv[i] * inverse_fy * depth)
        residual = aside + nz[i] * (z[i] - depth)
        square = z[i] * z[i]
        in_gate = known & (weight[i] > nothing) & (abs(z[i] - depth) <= gate_m * max(one, square))
        inverse_sigma = one / (floor_m + share * square)
        sigmas = abs(residual) * inverse_sigma
        tail = sigmas * inverse_kernel
        root = inverse_sigma / (one + tail * tail)
        distance[i] = residual
        residuals[i] = min(residuals[i], sigmas if in_gate else never)
        weight[i] = root * root if in_gate else nothing


@kernel(nogil=True)
def _moment(px, py, pz, nx, ny, nz, x, y, z):  # type: ignore[no-untyped-def]
    """Compute cross products of points and normals."""
    for i in range(px.size):
        x[i] = py[i] * nz[i] - pz[i] * ny[i]
        y[i] = pz[i] * nx[i] - px[i] * nz[i]
        z[i] = px[i] * ny[i] - py[i] * nx[i]


@kernel(nogil=True, fastmath=True)
def _add_up(weight, factor, a, b, c, d, e, f, g, count, sums):  # type: ignore[no-untyped-def]
    """Add weighted products of a factor with each of seven others, in an order that vectorises."""
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = np.float32(0.0)
    for i in range(count):
        weighted = weight[i] * factor[i]
        s0 += weighted * a[i]
        s1 += weighted * b[i]
        s2 += weighted * c[i]
        s3 += weighted * d[i]
        s4 += weighted * e[i]
        s5 += weighted * f[i]
        s6 += weighted * g[i]
    for k, s in enumerate((s0, s1, s2, s3, s4, s5, s6)):
        sums[k] += s


@kernel(nogil=True)
def feature_part(  # type: ignore[no-untyped-def]
    points, pixels, sigma_px, T, fx, fy, cx, cy, kernel, slopes, hessian, gradient, residuals
):
    """Add the reprojection terms, Yang2021 Eq. (5); ``T`` maps the odometry frame into the camera.

    ``slopes`` is a buffer of zeros for the derivatives of both errors, (2, 6).
    """
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
