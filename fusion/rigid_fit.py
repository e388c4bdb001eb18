"""Rotation and translation between matched points of two curves, some of which are noise; Xu2024 Eq. (5).

Points are rows (x, y) here and matrices act on columns; the paper's ``L A = D`` is this with A transposed.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from fusion.alignment import planar
from fusion.curves import FloatArray
from fusion.estimation import ROUNDS

DRAWS = 84  # Xu2024, 3.2.2: 4 / c^n tries make 97.5 % sure at an inlier share c = 0.6 and n = 6
EPS_OVER_E = 2.0**0.25  # the middle of the paper's best range, E to sqrt(2) E


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
    """Return the (3, 3) rigid transform of least squares.

    Examples
    --------
    >>> import numpy as np
    >>> from fusion.rigid_fit import rigid_motion
    >>> square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    >>> rigid_motion(square, square + [2.0, 0.0])[:2, 2].round(3).tolist()
    [2.0, 0.0]
    """
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
    scale = np.where(np.abs(h[:, 2]) > 1e-12, h[:, 2], np.nan)
    return np.asarray(h[:, :2] / scale[:, None])
