"""The map of the plane between matched points of two curves: Xu2024 Eq. (5), and two others behind one call.

Points are rows (x, y) here and matrices act on columns; the paper's ``L A = D`` is this with A transposed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np

from fusion.curves import BoolArray, FloatArray
from fusion.estimation import ROUNDS

Model: TypeAlias = Literal["homography", "magsac", "rigid"]

DRAWS = 84  # Xu2024, 3.2.2: 4 / c^n tries make 97.5 % sure at an inlier share c = 0.6 and n = 6
SAMPLE = 6
EPS_OVER_E = 2.0**0.25  # the middle of the paper's best range, E to sqrt(2) E
_LEAST_AREA = 1e-4  # of the points' smaller spread over the larger: less is a line


@dataclass(frozen=True)
class PlaneFit:
    """A map between two planes, with its own trust.

    Attributes
    ----------
    matrix
        (3, 3) for columns, from the first points' plane to the second's.
    inliers
        (N,) pairs whose residual is at most ``eps_m``; the others are noise, Xu2024 Eq. (6).
    mean_residual_m
        E of the paper: over all pairs.
    eps_m
        The threshold.
    """

    matrix: FloatArray
    inliers: BoolArray
    mean_residual_m: float
    eps_m: float


def fit(
    source: FloatArray,
    target: FloatArray,
    rng: np.random.Generator,
    *,
    model: Model = "rigid",
    eps_over_e: float = EPS_OVER_E,
) -> PlaneFit | None:
    """Fit a map to matched points of which some are noise.

    Parameters
    ----------
    source, target
        (N, 2) finite, row by row.
    rng
        Draws the samples.
    model
        ``homography`` by RANSAC exactly as published, ``magsac`` by OpenCV's USAC_MAGSAC, or ``rigid``, a
        turn and a shift, by RANSAC too.
    eps_over_e
        Threshold by the mean residual; the paper's best is 1 to sqrt(2).

    Returns
    -------
    None where the points leave the map open: too few, or on one line for a homography, in one place for a
    rigid motion.

    Raises
    ------
    ValueError
        Points that do not match in number, or are not finite.
    """
    source, target = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 2:
        raise ValueError(f"points have shapes {source.shape} and {target.shape}; give (N, 2) twice")
    if not (np.isfinite(source).all() and np.isfinite(target).all()):
        raise ValueError("a point is not finite; leave out pairs with a hole")
    if is_degenerate(source, model) or is_degenerate(target, model):
        return None
    matrix = _magsac(source, target) if model == "magsac" else _ransac(source, target, rng, model, eps_over_e)
    if matrix is None:
        return None
    residual = residuals(matrix, source, target)
    mean = float(residual.mean())
    eps = eps_over_e * mean
    return PlaneFit(matrix, residual <= eps, mean, eps)


def is_degenerate(points: FloatArray, model: Model) -> bool:
    """Whether points leave a model open: fewer than it needs, or spread over less than it needs."""
    if len(points) < (SAMPLE if model != "rigid" else 3):
        return True
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if model == "rigid":
        return bool(spread[0] < 1e-3)
    return bool(spread[1] ** 2 < _LEAST_AREA * spread[0] ** 2)


def residuals(matrix: FloatArray, source: FloatArray, target: FloatArray) -> FloatArray:
    """(N,) distances between moved source and target points; ``inf`` for what is moved to the horizon."""
    distance = np.linalg.norm(moved(matrix, source) - target, axis=1)
    return np.where(np.isfinite(distance), distance, np.inf)


def moved(matrix: FloatArray, points: FloatArray) -> FloatArray:
    """(N, 2) points through a homography; ``nan`` at the horizon."""
    h = points @ matrix[:, :2].T + matrix[:, 2]
    scale = np.where(np.abs(h[:, 2]) > 1e-12, h[:, 2], np.nan)
    return np.asarray(h[:, :2] / scale[:, None])


def homography_dlt(source: FloatArray, target: FloatArray) -> FloatArray | None:
    """The homography of least squares, by the normalised direct linear transform; None if it is open."""
    normal_s, normal_t = _normaliser(source), _normaliser(target)
    s, t = moved(normal_s, source), moved(normal_t, target)
    one, zero = np.ones(len(s)), np.zeros((len(s), 3))
    h = np.column_stack([s, one])
    rows = np.concatenate(
        [
            np.column_stack([h, zero, -t[:, :1] * h]),
            np.column_stack([zero, h, -t[:, 1:] * h]),
        ]
    )
    _, values, vt = np.linalg.svd(rows)
    if values.size < 8 or values[7] < 1e-9 * values[0]:
        return None
    matrix = np.linalg.solve(normal_t, vt[8].reshape(3, 3)) @ normal_s
    if abs(np.linalg.det(matrix)) < 1e-15 or abs(matrix[2, 2]) < 1e-12:
        return None
    return np.asarray(matrix / matrix[2, 2])


def rigid_motion(source: FloatArray, target: FloatArray) -> FloatArray:
    """The turn and shift of least squares, (3, 3)."""
    from_center, to_center = source.mean(axis=0), target.mean(axis=0)
    s, t = source - from_center, target - to_center
    angle = math.atan2(float((s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0]).sum()), float((s * t).sum()))
    c, n = math.cos(angle), math.sin(angle)
    rotation = np.array([[c, -n], [n, c]])
    matrix = np.eye(3)
    matrix[:2, :2], matrix[:2, 2] = rotation, to_center - rotation @ from_center
    return matrix


def _ransac(
    source: FloatArray,
    target: FloatArray,
    rng: np.random.Generator,
    model: Literal["homography", "rigid"],
    eps_over_e: float,
) -> FloatArray | None:
    """The draw whose pairs agree most, then fitted to all that agree with it."""
    size = SAMPLE if model == "homography" else 2
    best: tuple[float, FloatArray] | None = None
    for _ in range(DRAWS):
        chosen = rng.choice(len(source), size, replace=False)
        matrix = _solve(source[chosen], target[chosen], model)
        if matrix is not None:
            # E is by the mean over all pairs, which one wild pair can carry off: the median ranks draws.
            cost = float(np.median(residuals(matrix, source, target)))
            if best is None or cost < best[0]:
                best = cost, matrix
    if best is None:
        return None
    matrix = best[1]
    for _ in range(ROUNDS):
        residual = residuals(matrix, source, target)
        agree = residual <= eps_over_e * min(float(residual.mean()), 3.0 * float(np.median(residual)))
        again = _solve(source[agree], target[agree], model) if agree.sum() >= SAMPLE else None
        if again is None:
            break
        matrix = again
    return matrix


def _solve(source: FloatArray, target: FloatArray, model: Model) -> FloatArray | None:
    """The model through some pairs."""
    if model == "rigid":
        return rigid_motion(source, target)
    return None if is_degenerate(source, model) else homography_dlt(source, target)


def _magsac(source: FloatArray, target: FloatArray) -> FloatArray | None:
    """OpenCV's USAC_MAGSAC, in millimetres: its built-in scales are pixels."""
    import cv2

    scale = np.diag([1000.0, 1000.0, 1.0])
    cv2.setRNGSeed(0)
    found, _ = cv2.findHomography(
        1000.0 * source, 1000.0 * target, cv2.USAC_MAGSAC, 50.0, maxIters=2000, confidence=0.999
    )
    if found is None or not np.isfinite(found).all() or abs(found[2, 2]) < 1e-12:
        return None
    matrix = np.linalg.inv(scale) @ np.asarray(found, dtype=np.float64) @ scale
    return None if abs(np.linalg.det(matrix)) < 1e-15 else np.asarray(matrix / matrix[2, 2])


def _normaliser(points: FloatArray) -> FloatArray:
    """(3, 3) that brings points to mean zero and mean distance sqrt(2)."""
    center = points.mean(axis=0)
    reach = max(float(np.linalg.norm(points - center, axis=1).mean()), 1e-12)
    s = math.sqrt(2.0) / reach
    return np.array([[s, 0.0, -s * center[0]], [0.0, s, -s * center[1]], [0.0, 0.0, 1.0]])
