"""Least-squares planes in the windows of an inverse depth image, a row of windows at a time.

Sums of a whole row run over its pixels in the innermost loop, where vector instructions take them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel

_LEAST_SHARE = 0.5  # of a window's pixels on the same surface, below which there is no normal
_LEAST_DETERMINANT = 1e-3
_SAME_SURFACE = np.float32(0.04)  # relative difference of inverse depth to the window's centre
# Rows of the sums over a window: pixels on the surface, their offsets and products of them, and their
# differences w to the centre's inverse depth with their products.
_N, _U, _UU, _V, _VV, _UV, _W, _WU, _WV = range(9)


def fit_planes(
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
    """Plane of every ``step``-th window of ``inverse`` (H, W), 1/m, into ``smooth`` and ``normals``.

    Parameters
    ----------
    radius
        Half size of a window, pixels.
    smooth, normals
        (H, W) and (H, W, 3), left as they are where no plane is found.
    """
    span = max(inverse.shape[1] - 2 * radius, 0)
    least = _LEAST_SHARE * (2 * radius + 1) ** 2
    room = (np.empty((9, span), np.float32), np.empty((5, span), np.float32), np.empty(span, np.float32))
    _fit_planes(inverse, radius, step, fx, fy, cx, cy, least, smooth, normals, *room)


@kernel(nogil=True)
def _fit_planes(  # type: ignore[no-untyped-def]
    inverse, radius, step, fx, fy, cx, cy, least, smooth, normals, sums, line, gate
):
    """Fit the planes, with room for the sums of a row of windows, of a line of them, and for its limits."""
    height = inverse.shape[0]
    span = sums.shape[1]
    for v in range(radius, height - radius, step):
        _sum_windows(inverse, v, radius, sums, line, gate)
        for first in range(0, span, step):
            u = first + radius
            n = float(sums[_N, first])
            if inverse[v, u] <= 0.0 or n < least:
                continue
            mu = sums[_U, first] / n
            mv = sums[_V, first] / n
            mean = sums[_W, first] / n
            a = sums[_UU, first] / n - mu * mu
            b = sums[_UV, first] / n - mu * mv
            d = sums[_VV, first] / n - mv * mv
            e = sums[_WU, first] / n - mean * mu
            f = sums[_WV, first] / n - mean * mv
            determinant = a * d - b * b
            if determinant < _LEAST_DETERMINANT:
                continue
            slope_u = (e * d - f * b) / determinant
            slope_v = (f * a - e * b) / determinant
            w0 = inverse[v, u] + mean - slope_u * mu - slope_v * mv
            if w0 <= 0.0:
                continue
            # The plane n . p = 1 in camera coordinates.
            nx = slope_u * fx
            ny = slope_v * fy
            nz = w0 - slope_u * (u - cx) - slope_v * (v - cy)
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            smooth[v, u] = w0
            normals[v, u, 0] = -nx / length
            normals[v, u, 1] = -ny / length
            normals[v, u, 2] = -nz / length


@kernel(nogil=True, inline="always")
def _sum_windows(inverse, v, radius, sums, line, gate):  # type: ignore[no-untyped-def]
    """Sums (9, W - 2 radius) over the windows around row ``v`` of what is on their centres' surfaces."""
    span = sums.shape[1]
    centre = inverse[v, radius : radius + span]
    for i in range(span):
        gate[i] = _SAME_SURFACE * centre[i]
    _clear(sums)
    for dv in range(-radius, radius + 1):
        _clear(line)
        for du in range(-radius, radius + 1):
            beside = inverse[v + dv, radius + du : radius + du + span]
            _count(beside, centre, gate, np.float32(du), line[_N], line[_U], line[_UU])
            _differ(beside, centre, gate, np.float32(du), line[3], line[4])
        along = np.float32(dv)
        _add(line[_N], np.float32(1.0), sums[_N])
        _add(line[_U], np.float32(1.0), sums[_U])
        _add(line[_UU], np.float32(1.0), sums[_UU])
        _add(line[_N], along, sums[_V])
        _add(line[_N], along * along, sums[_VV])
        _add(line[_U], along, sums[_UV])
        _add(line[3], np.float32(1.0), sums[_W])
        _add(line[4], np.float32(1.0), sums[_WU])
        _add(line[3], along, sums[_WV])


@kernel(nogil=True)
def _count(
    beside: NDArray[Any],
    centre: NDArray[Any],
    gate: NDArray[Any],
    du: Any,
    n: NDArray[Any],
    u: NDArray[Any],
    uu: NDArray[Any],
) -> None:
    """Add the pixels that are on the centre's surface, and their offset ``du``; without a branch."""
    for i in range(n.size):
        on = (abs(beside[i] - centre[i]) <= gate[i]) & (beside[i] > np.float32(0.0))
        one = np.float32(1.0) if on else np.float32(0.0)
        n[i] += one
        u[i] += one * du
        uu[i] += one * du * du


@kernel(nogil=True)
def _differ(
    beside: NDArray[Any],
    centre: NDArray[Any],
    gate: NDArray[Any],
    du: Any,
    w: NDArray[Any],
    wu: NDArray[Any],
) -> None:
    """Add the differences of the pixels that are on the centre's surface; without a branch."""
    for i in range(w.size):
        difference = beside[i] - centre[i]
        on = (abs(difference) <= gate[i]) & (beside[i] > np.float32(0.0))
        counted = difference if on else np.float32(0.0)
        w[i] += counted
        wu[i] += counted * du


@kernel(nogil=True)
def _clear(sums: NDArray[Any]) -> None:
    """Set to zero."""
    for row in range(sums.shape[0]):
        for i in range(sums.shape[1]):
            sums[row, i] = 0.0


@kernel(nogil=True)
def _add(values: NDArray[Any], factor: Any, total: NDArray[Any]) -> None:
    """Add a multiple."""
    for i in range(total.size):
        total[i] += factor * values[i]
