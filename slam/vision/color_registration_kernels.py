"""Hot loops of the estimate of a registration: all motions of frame pairs settle, all matches are judged."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.measurements import FloatArray

IntArray: TypeAlias = NDArray[np.int64]

# Keeps a motion that its matches do not determine where it is.
_DAMPING = 1e-6


@kernel
def settle_motions(
    points_a: FloatArray,
    points_b: FloatArray,
    pixels_a: FloatArray,
    pixels_b: FloatArray,
    starts: IntArray,
    poses: FloatArray,
    camera: FloatArray,
    scale_px: float,
    iterations: int,
) -> FloatArray:
    """Gauss-Newton on the reprojection errors of each pair, both ways, with the kernel of Geman and McClure.

    Parameters
    ----------
    points_a, points_b
        (N, 3) of all matches in the colour frames a and b; a point with z = 0 is left out.
    pixels_a, pixels_b
        (N, 2) where they are seen.
    starts
        (P + 1,) the matches of pair p are starts[p] to starts[p + 1].
    poses
        (P, 3, 4) first guess of ``T_b_a``.
    camera
        (4,) fx, fy, cx, cy of the colour camera.
    scale_px
        Error at which a match has half its loss.

    Returns
    -------
    poses
        (P, 3, 4) settled.
    """
    settled = poses.copy()
    for pair in range(starts.size - 1):
        for _ in range(iterations):
            hessian, gradient = np.zeros((6, 6)), np.zeros(6)
            pose = settled[pair]
            for i in range(starts[pair], starts[pair + 1]):
                _add_forth(hessian, gradient, points_a[i], pixels_b[i], pose, camera, scale_px)
                _add_back(hessian, gradient, points_b[i], pixels_a[i], pose, camera, scale_px)
            for k in range(6):
                hessian[k, k] += _DAMPING * (1.0 + hessian[k, k])
            _move(pose, -np.linalg.solve(hessian, gradient))
    return settled


@kernel
def squared_errors(
    points_a: FloatArray,
    points_b: FloatArray,
    pixels_a: FloatArray,
    pixels_b: FloatArray,
    starts: IntArray,
    poses: FloatArray,
    camera: FloatArray,
) -> FloatArray:
    """(N, 2) squared reprojection errors in pixels, a seen in b and b seen in a; NaN without a point."""
    errors = np.full((points_a.shape[0], 2), np.nan)
    for pair in range(starts.size - 1):
        pose = poses[pair]
        for i in range(starts[pair], starts[pair + 1]):
            x, y, z = _forth(pose, points_a[i])
            if points_a[i, 2] > 0.0 and z > 0.0:
                du, dv = _miss(x, y, z, pixels_b[i], camera)
                errors[i, 0] = du * du + dv * dv
            x, y, z = _back(pose, points_b[i])
            if points_b[i, 2] > 0.0 and z > 0.0:
                du, dv = _miss(x, y, z, pixels_a[i], camera)
                errors[i, 1] = du * du + dv * dv
    return errors


@kernel
def _forth(pose: FloatArray, point: FloatArray) -> tuple[float, float, float]:
    """A point of a in b."""
    x = pose[0, 0] * point[0] + pose[0, 1] * point[1] + pose[0, 2] * point[2] + pose[0, 3]
    y = pose[1, 0] * point[0] + pose[1, 1] * point[1] + pose[1, 2] * point[2] + pose[1, 3]
    z = pose[2, 0] * point[0] + pose[2, 1] * point[1] + pose[2, 2] * point[2] + pose[2, 3]
    return x, y, z


@kernel
def _back(pose: FloatArray, point: FloatArray) -> tuple[float, float, float]:
    """A point of b in a."""
    dx, dy, dz = point[0] - pose[0, 3], point[1] - pose[1, 3], point[2] - pose[2, 3]
    x = pose[0, 0] * dx + pose[1, 0] * dy + pose[2, 0] * dz
    y = pose[0, 1] * dx + pose[1, 1] * dy + pose[2, 1] * dz
    z = pose[0, 2] * dx + pose[1, 2] * dy + pose[2, 2] * dz
    return x, y, z


@kernel
def _miss(x: float, y: float, z: float, pixel: FloatArray, camera: FloatArray) -> tuple[float, float]:
    """Where a point is projected to, less where it is seen."""
    return camera[0] * x / z + camera[2] - pixel[0], camera[1] * y / z + camera[3] - pixel[1]


@kernel
def _add_forth(
    hessian: FloatArray,
    gradient: FloatArray,
    point: FloatArray,
    pixel: FloatArray,
    pose: FloatArray,
    camera: FloatArray,
    scale_px: float,
) -> None:
    """One point of a seen in b; the motion is turned and shifted in b: ``exp(v, w) T_b_a``."""
    x, y, z = _forth(pose, point)
    if point[2] <= 0.0 or z <= 0.0:
        return
    du, dv = _miss(x, y, z, pixel, camera)
    weight = _weight(du * du + dv * dv, scale_px)
    _add_row(hessian, gradient, camera[0] / z, 0.0, -camera[0] * x / (z * z), x, y, z, du, weight)
    _add_row(hessian, gradient, 0.0, camera[1] / z, -camera[1] * y / (z * z), x, y, z, dv, weight)


@kernel
def _add_back(
    hessian: FloatArray,
    gradient: FloatArray,
    point: FloatArray,
    pixel: FloatArray,
    pose: FloatArray,
    camera: FloatArray,
    scale_px: float,
) -> None:
    """One point of b seen in a: its derivatives, turned into b, have the other sign."""
    x, y, z = _back(pose, point)
    if point[2] <= 0.0 or z <= 0.0:
        return
    du, dv = _miss(x, y, z, pixel, camera)
    weight = _weight(du * du + dv * dv, scale_px)
    for row in range(2):
        side = camera[row] / z
        depth = -side * (x if row == 0 else y) / z
        a = -(pose[0, row] * side + pose[0, 2] * depth)
        b = -(pose[1, row] * side + pose[1, 2] * depth)
        c = -(pose[2, row] * side + pose[2, 2] * depth)
        miss = du if row == 0 else dv
        _add_row(hessian, gradient, a, b, c, point[0], point[1], point[2], miss, weight)


@kernel
def _weight(squared: float, scale_px: float) -> float:
    """Of Geman and McClure."""
    share = scale_px * scale_px / (scale_px * scale_px + squared)
    return share * share


@kernel
def _add_row(
    hessian: FloatArray,
    gradient: FloatArray,
    a: float,
    b: float,
    c: float,
    x: float,
    y: float,
    z: float,
    miss: float,
    weight: float,
) -> None:
    """One scalar error with derivative (a, b, c) by the point (x, y, z), which the motion moves."""
    row = (a, b, c, y * c - z * b, z * a - x * c, x * b - y * a)
    for j in range(6):
        gradient[j] += weight * row[j] * miss
        for k in range(6):
            hessian[j, k] += weight * row[j] * row[k]


@kernel
def _move(pose: FloatArray, step: FloatArray) -> None:
    """``pose`` becomes a turn by step[3:] and a shift by step[:3] after it; in place."""
    angle = np.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
    axis = step[3:] / max(angle, 1e-12)
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    turn = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
    pose[:] = turn @ pose.copy()
    pose[:, 3] += step[:3]
