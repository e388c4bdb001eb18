"""Planar rigid transform between a lidar curve and an image's curve, estimated over any number of pairs.

If samples are paired by index, as in Xu2024 Eq. (5), a camera in front of or behind the lidar is paired
with another point of the same wall. Here each camera point is moved into the lidar's frame and compared
with the lidar curve at its own bearing, along the normal of the wall (point to line), until convergence.

`rigid_fit` is the rotation and translation between matched points of two curves, some of which are noise;
Xu2024 Eq. (5). Points are rows (x, y) there and matrices act on columns; the paper's ``L A = D`` is this
with A transposed.
"""

# mypy: allow-untyped-decorators
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion.curves import BESIDE, EDGE_M, Curve, FloatArray
from fusion.estimation import FEWEST, ROUNDS, SETTLED, TINY
from fusion.kernel import kernel

_NARROW_M = 0.06  # a residual beyond counts little in the last round

DRAWS = 84  # Xu2024, 3.2.2: 4 / c^n tries make 97.5 % sure at an inlier share c = 0.6 and n = 6
EPS_OVER_E = 2.0**0.25  # the middle of the paper's best range, E to sqrt(2) E


@dataclass(frozen=True)
class Alignment:
    """A planar rigid transform.

    Attributes
    ----------
    T_laser_level
        (3, 3) transform from the camera's level plane to the lidar's.
    covariance
        (3, 3) covariance of x, y, yaw.
    """

    T_laser_level: FloatArray
    covariance: FloatArray


def align(
    curves: Sequence[Curve],
    slices: Sequence[Curve],
    yaw_rad: float,
    offset_xy: tuple[float, float] = (0.0, 0.0),
) -> Alignment | None:
    """Align the image curves of several pairs to their lidar curves by one transform.

    Parameters
    ----------
    curves, slices
        Curves of lidar and camera, pair by pair; all lidar curves have the same angles.
    yaw_rad, offset_xy
        Initial guess, accurate to a few degrees and 0.3 m.

    Returns
    -------
    The alignment; None if too few samples match, or they do not determine it (a single wall).
    """
    if len(curves) != len(slices) or not curves:
        raise ValueError(f"{len(curves)} lidar curves and {len(slices)} slices; give pairs")
    lidar = np.stack([curve.ranges_m for curve in curves])
    start, step = curves[0].start_angle_rad, curves[0].step_rad
    points = np.concatenate([piece.points() for piece in slices])
    pair = np.repeat(np.arange(len(slices)), [piece.ranges_m.size for piece in slices])
    normals = np.concatenate([_normals(piece.points()) for piece in slices])
    usable = np.isfinite(normals).all(axis=1)
    points, normals, pair = points[usable], normals[usable], pair[usable]
    motion = np.array([*offset_xy, yaw_rad])
    result = np.zeros((5, 3))
    for turn in range(ROUNDS):
        width = max(_NARROW_M, 2.0 * EDGE_M * 0.6**turn)
        result = _normal_equations(lidar, start, step, points, normals, pair, motion, width)
        information = result[:3]
        if result[4, 0] < FEWEST or np.linalg.cond(information) > 1e8:
            return None
        change = -np.linalg.solve(information, result[3])
        motion = motion + change
        if width == _NARROW_M and np.abs(change).max() < SETTLED:
            break
    variance = result[4, 1] / max(result[4, 0] - 3.0, 1.0)
    covariance = variance * np.linalg.inv(result[:3])
    return Alignment(planar(*motion), covariance)


def planar(x_m: float, y_m: float, yaw_rad: float) -> FloatArray:
    """Return the (3, 3) matrix of a planar transform, for column vectors."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s, x_m], [s, c, y_m], [0.0, 0.0, 1.0]])


@kernel
def _normals(points: FloatArray) -> FloatArray:
    """Return (N, 2) unit normals of the lines through each point's neighbours; ``nan`` without a line."""
    count = points.shape[0]
    normals = np.full((count, 2), np.nan)
    for i in range(count):
        n, sx, sy, sxx, sxy, syy = 0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(max(0, i - BESIDE), min(count, i + BESIDE + 1)):
            x, y = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1]
            if x * x + y * y < 0.09:  # also false for nan
                n += 1
                sx, sy = sx + x, sy + y
                sxx, sxy, syy = sxx + x * x, sxy + x * y, syy + y * y
        if n < 5:
            continue
        sxx, sxy, syy = sxx - sx * sx / n, sxy - sx * sy / n, syy - sy * sy / n
        spread = math.sqrt((sxx - syy) ** 2 + 4.0 * sxy * sxy)
        thin, long = 0.5 * (sxx + syy - spread), 0.5 * (sxx + syy + spread)
        if thin > 0.02 * long:
            continue
        angle = 0.5 * math.atan2(2.0 * sxy, sxx - syy)
        normals[i, 0], normals[i, 1] = -math.sin(angle), math.cos(angle)
    return normals


@kernel
def _normal_equations(
    lidar: NDArray[np.float32],
    start: float,
    step: float,
    points: FloatArray,
    normals: FloatArray,
    pair: NDArray[np.int64],
    motion: FloatArray,
    width: float,
) -> FloatArray:
    """Rows 0-2: information; 3: gradient; 4: weight, weighted sum of squares."""
    result = np.zeros((5, 3))
    c, s = math.cos(motion[2]), math.sin(motion[2])
    jacobian = np.empty(3)
    for k in range(points.shape[0]):
        turned_x = c * points[k, 0] - s * points[k, 1]
        turned_y = s * points[k, 0] + c * points[k, 1]
        x, y = turned_x + motion[0], turned_y + motion[1]
        bearing = math.atan2(y, x)
        at = (bearing - start) / step
        low = math.floor(at)
        if low < 0 or low + 1 >= lidar.shape[1]:
            continue
        near, far = lidar[pair[k], low], lidar[pair[k], low + 1]
        if not abs(near - far) < EDGE_M:  # an edge, or a hole
            continue
        reach = near + (at - low) * (far - near)
        nx, ny = c * normals[k, 0] - s * normals[k, 1], s * normals[k, 0] + c * normals[k, 1]
        residual = nx * (x - reach * math.cos(bearing)) + ny * (y - reach * math.sin(bearing))
        weight = 1.0 / (1.0 + (residual / width) ** 2) ** 2  # Geman and McClure
        if abs(residual) > 4.0 * width:
            continue
        jacobian[0], jacobian[1], jacobian[2] = nx, ny, ny * turned_x - nx * turned_y
        for i in range(3):
            result[3, i] += weight * jacobian[i] * residual
            for j in range(3):
                result[i, j] += weight * jacobian[i] * jacobian[j]
        result[4, 0] += weight
        result[4, 1] += weight * residual * residual
    return result


def rigid_fit(source: FloatArray, target: FloatArray, rng: np.random.Generator) -> FloatArray | None:
    """Return the (3, 3) transform from (N, 2) points to others, row by row; None if not determined."""
    spread = [
        np.linalg.norm(points - points.mean(axis=0), 2) for points in (source, target) if len(points) > 2
    ]
    if len(spread) < 2 or min(spread) < 1e-3:
        return None
    return ransac(source, target, rng, 2, rigid_motion)


def ransac(
    source: FloatArray,
    target: FloatArray,
    rng: np.random.Generator,
    size: int,
    solve: Callable[[FloatArray, FloatArray], FloatArray | None],
) -> FloatArray | None:
    """Return the (3, 3) transform of the sample with the most inliers, fitted to all its inliers.

    Parameters
    ----------
    size
        Number of pairs in a sample.
    solve
        Function that returns the (3, 3) transform between points, or None if not determined.
    """
    best: tuple[float, FloatArray] | None = None
    for _ in range(DRAWS):
        chosen = rng.choice(len(source), size, replace=False)
        matrix = solve(source[chosen], target[chosen])
        if matrix is not None:
            # E uses the mean over all pairs, which one outlier can dominate, so the median ranks draws.
            cost = float(np.median(residuals(matrix, source, target)))
            if best is None or cost < best[0]:
                best = cost, matrix
    if best is None:
        return None
    matrix = best[1]
    for _ in range(ROUNDS):
        residual = residuals(matrix, source, target)
        agree = residual <= EPS_OVER_E * min(float(residual.mean()), 3.0 * float(np.median(residual)))
        refined = solve(source[agree], target[agree]) if agree.sum() >= size else None
        if refined is None:
            break
        matrix = refined
    return matrix


def rigid_motion(source: FloatArray, target: FloatArray) -> FloatArray:
    """Return the (3, 3) rigid transform of least squares."""
    from_center, to_center = source.mean(axis=0), target.mean(axis=0)
    s, t = source - from_center, target - to_center
    angle = math.atan2(float((s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0]).sum()), float((s * t).sum()))
    matrix = planar(0.0, 0.0, angle)
    matrix[:2, 2] = to_center - matrix[:2, :2] @ from_center
    return matrix


def residuals(matrix: FloatArray, source: FloatArray, target: FloatArray) -> FloatArray:
    """Return (N,) distances between moved source and target points; ``inf`` for points at the horizon."""
    distance = np.linalg.norm(moved(matrix, source) - target, axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def moved(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """Apply a homography to (N, 2) points; ``nan`` at the horizon."""
    h = points @ matrix[:, :2].T + matrix[:, 2]
    scale = np.where(np.abs(h[:, 2]) > TINY, h[:, 2], np.nan)
    return np.asarray(h[:, :2] / scale[:, None])
