"""The maps of Xu2024 Eq. (5) between matched points: its homography, and the same by OpenCV's MAGSAC++."""

from __future__ import annotations

import math

import numpy as np

from fusion.alignment import moved, ransac
from fusion.curves import FloatArray

SAMPLE = 6  # Xu2024, 3.2.2
_LEAST_AREA = 1e-4  # of the points' smaller spread over the larger: less is a line


def fit(source: FloatArray, target: FloatArray, model: str, rng: np.random.Generator) -> FloatArray | None:
    """(3, 3) homography from (N, 2) points to others, by RANSAC as published, or ``magsac``.

    None where the points leave it open: too few, or on one line.
    """
    if is_degenerate(source) or is_degenerate(target):
        return None
    return _magsac(source, target) if model == "magsac" else ransac(source, target, rng, SAMPLE, _solve)


def is_degenerate(points: FloatArray) -> bool:
    """Whether points leave a homography open: fewer than it needs, or on a line."""
    if len(points) < SAMPLE:
        return True
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[1] ** 2 < _LEAST_AREA * spread[0] ** 2)


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


def _solve(source: FloatArray, target: FloatArray) -> FloatArray | None:
    """The homography through some pairs."""
    return None if is_degenerate(source) else homography_dlt(source, target)


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
