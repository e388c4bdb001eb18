"""Least-squares planes in the windows of an inverse depth image, one row of windows at a time.

Sums of a whole row run over its pixels in the innermost loop, where vector instructions are used.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel

SAME_SURFACE = np.float32(0.04)  # largest relative difference of inverse depths of neighbours


def fit_planes(
    inverse: NDArray[Any], radius: int, step: int, fx: float, fy: float, cx: float, cy: float
) -> NDArray[np.float32]:
    """Fit a plane in every ``step``-th window of ``inverse`` (H, W), 1/m.

    Parameters
    ----------
    radius
        Half size of a window, pixels; the first window's centre is as far from the image's upper left corner.

    Returns
    -------
    planes
        (rows, columns, 4) inverse depth and unit normal; zero without a plane.
    """
    height, width = inverse.shape
    rows, columns = (max(-(-(side - 2 * radius) // step), 0) for side in (height, width))
    # Columns a step apart are adjacent, (H, step, W / step).
    combed = np.pad(inverse, ((0, 0), (0, -width % step))).reshape(height, -1, step).transpose(0, 2, 1)
    least = 0.5 * (2 * radius + 1) ** 2  # share of a window's pixels on one surface
    planes = np.zeros((rows, columns, 4), np.float32)
    room = (
        np.empty((9, columns), np.float32),
        np.empty((5, columns), np.float32),
        np.empty(columns, np.float32),
    )
    _fit_planes(np.ascontiguousarray(combed), radius, fx, fy, cx, cy, least, planes, *room)
    return planes


@kernel(nogil=True)
def _fit_planes(  # type: ignore[no-untyped-def]
    combed, radius, fx, fy, cx, cy, least, planes, sums, line, gate
):
    """Fit the planes, with buffers for the sums of a row of windows, of a line, and for its limits."""
    step = combed.shape[1]
    # Pixels on the surface, their offsets and products, and their differences w to the centre's
    # inverse depth with their products.
    sum_n, sum_u, sum_uu, sum_v, sum_vv = sums[0], sums[1], sums[2], sums[3], sums[4]
    sum_uv, sum_w, sum_wu, sum_wv = sums[5], sums[6], sums[7], sums[8]
    for row in range(planes.shape[0]):
        v = radius + row * step
        _sum_windows(combed, v, radius, sums, line, gate)
        for column in range(planes.shape[1]):
            u = radius + column * step
            n = float(sum_n[column])
            centre = combed[v, u % step, u // step]
            if centre <= 0.0 or n < least:
                continue
            mu = sum_u[column] / n
            mv = sum_v[column] / n
            mean = sum_w[column] / n
            a = sum_uu[column] / n - mu * mu
            b = sum_uv[column] / n - mu * mv
            d = sum_vv[column] / n - mv * mv
            e = sum_wu[column] / n - mean * mu
            f = sum_wv[column] / n - mean * mv
            determinant = a * d - b * b
            slope_u = (e * d - f * b) / determinant
            slope_v = (f * a - e * b) / determinant
            w0 = centre + mean - slope_u * mu - slope_v * mv
            if w0 <= 0.0:
                continue
            # The plane n . p = 1 in camera coordinates.
            nx = slope_u * fx
            ny = slope_v * fy
            nz = w0 - slope_u * (u - cx) - slope_v * (v - cy)
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            planes[row, column, 0] = w0
            planes[row, column, 1] = -nx / length
            planes[row, column, 2] = -ny / length
            planes[row, column, 3] = -nz / length


@kernel(nogil=True, inline="always")
def _sum_windows(combed, v, radius, sums, line, gate):  # type: ignore[no-untyped-def]
    """Compute sums (9, columns) over the windows around row ``v`` of pixels on their centres' surfaces.

    The rows are those that `_fit_planes` names; those of ``line`` are n, u, uu, w, wu.
    """
    step, span = combed.shape[1], sums.shape[1]
    centre = combed[v, radius % step, radius // step : radius // step + span]
    for i in range(span):
        gate[i] = SAME_SURFACE * centre[i]
    _clear(sums)
    for dv in range(-radius, radius + 1):
        _clear(line)
        for du in range(-radius, radius + 1):
            phase, first = (radius + du) % step, (radius + du) // step
            neighbour = combed[v + dv, phase, first : first + span]
            _count(neighbour, centre, gate, np.float32(du), line[0], line[1], line[2], line[3], line[4])
        along = np.float32(dv)
        _add(line[0], np.float32(1.0), sums[0])
        _add(line[1], np.float32(1.0), sums[1])
        _add(line[2], np.float32(1.0), sums[2])
        _add(line[0], along, sums[3])
        _add(line[0], along * along, sums[4])
        _add(line[1], along, sums[5])
        _add(line[3], np.float32(1.0), sums[6])
        _add(line[4], np.float32(1.0), sums[7])
        _add(line[3], along, sums[8])


@kernel(nogil=True)
def _count(
    neighbour: NDArray[Any],
    centre: NDArray[Any],
    gate: NDArray[Any],
    du: Any,
    n: NDArray[Any],
    u: NDArray[Any],
    uu: NDArray[Any],
    w: NDArray[Any],
    wu: NDArray[Any],
) -> None:
    """Add the pixels on the centre's surface, their offset ``du`` and differences, branch-free."""
    for i in range(n.size):
        difference = neighbour[i] - centre[i]
        on = (abs(difference) <= gate[i]) & (neighbour[i] > np.float32(0.0))
        weight = np.float32(1.0) if on else np.float32(0.0)
        counted = difference if on else np.float32(0.0)
        n[i] += weight
        u[i] += weight * du
        uu[i] += weight * du * du
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
