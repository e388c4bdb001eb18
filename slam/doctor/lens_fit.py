"""Estimates the intrinsics of a depth camera: a scene keeps its shape while the camera turns.

With wrong intrinsics and correct depth, points are too far from or too close to the optical axis; seen from
two sides, the same points then have two shapes. So matched features with depth determine focal length and
principal point, without other inputs. The scale of depth is not determined: shapes of any scale are similar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion.estimation import FEWEST, ROUNDS, SETTLED, gate, median_to_sigma
from slam.doctor.camera_samples import MatchedPair
from slam.measurements import CameraIntrinsics, FloatArray

_KEPT = 48  # features per pair


@dataclass(frozen=True, slots=True)
class LensFit:
    """Estimated intrinsics, relative to the stated ones.

    Attributes
    ----------
    focal_gain
        Ratio of its focal lengths to the stated ones.
    center_px
        (2,) its principal point.
    sigmas
        (3,) standard deviations of focal_gain and center_px.
    """

    focal_gain: float
    center_px: FloatArray
    sigmas: FloatArray


def lens_fit(pairs: Sequence[MatchedPair], stated: CameraIntrinsics) -> LensFit | None:
    """The lens with which matched features move rigidly; None if there are too few."""
    chosen = [pair for pair in pairs if len(pair.first) >= FEWEST]
    if len(chosen) < FEWEST:
        return None
    first, second = (
        np.stack([getattr(p, name)[np.linspace(0, len(p.first) - 1, _KEPT).astype(int)] for p in chosen])
        for name in ("first", "second")
    )
    # Focal gain, and the principal point as a share of the focal length.
    lens = np.array([1.0, 0.0, 0.0])
    steps = np.diag([SETTLED] * 3)
    errors = _errors(first, second, lens, stated)
    sigma = max(_sigma(errors), SETTLED)
    information = np.eye(3)
    for _ in range(ROUNDS):
        weights = (gate(3) * sigma**2 / ((errors**2).sum(axis=-1) + gate(3) * sigma**2)) ** 2
        slopes = np.stack(
            [(_errors(first, second, lens + step, stated) - errors) / SETTLED for step in steps], axis=-1
        )
        information = np.einsum("pn,pnki,pnkj->ij", weights, slopes, slopes)
        change = -np.linalg.solve(
            information + SETTLED**2 * np.eye(3), np.einsum("pn,pnki,pnk->i", weights, slopes, errors)
        )
        lens = lens + change
        # Weights that depend on the median do not converge completely.
        if np.abs(change).max() < 10 * SETTLED:
            break
        errors = _errors(first, second, lens, stated)
        sigma = max(_sigma(errors), SETTLED)
    else:
        return None
    # Features of a pair share the error of its motion.
    covariance = sigma**2 * np.linalg.inv(information) * first.shape[1] ** 0.5
    center = np.array([stated.cx + lens[1] * stated.fx, stated.cy + lens[2] * stated.fy])
    sigmas = np.sqrt(np.diag(covariance)) * [1.0, stated.fx, stated.fy]
    return LensFit(float(lens[0]), center, sigmas)


def _points(rows: FloatArray, lens: FloatArray, stated: CameraIntrinsics) -> FloatArray:
    """(..., 3) points in the camera frame."""
    x = ((rows[..., 0] - stated.cx) / stated.fx - lens[1]) / lens[0]
    y = ((rows[..., 1] - stated.cy) / stated.fy - lens[2]) / lens[0]
    z = rows[..., 2]
    return np.stack([x * z, y * z, z], axis=-1)


def _errors(first: FloatArray, second: FloatArray, lens: FloatArray, stated: CameraIntrinsics) -> FloatArray:
    """(P, N, 3) errors of points moved to the second view: of bearings, and of relative depth.

    Bearings are in units of the stated focal length, depths are not: otherwise a shorter focal length would
    reduce the residuals of depth, and with little rotation the fit would shrink it only for that.
    """
    a, b = _points(first, lens, stated), _points(second, lens, stated)
    # The error of depth grows with the depth.
    weights = 1.0 / np.maximum(a[..., 2:], SETTLED) ** 2
    for _ in range(3):
        moved = _moved(a, b, weights)
        error = np.linalg.norm(moved - b, axis=-1, keepdims=True) / b[..., 2:]
        width = np.median(error, axis=1, keepdims=True) + SETTLED
        weights = 1.0 / (b[..., 2:] * (1.0 + (error / width) ** 2)) ** 2
    return np.asarray((moved - b) / b[..., 2:] * [lens[0], lens[0], 1.0])


def _moved(a: FloatArray, b: FloatArray, weights: FloatArray) -> FloatArray:
    """(P, N, 3) the first points after the best rigid motion to the second ones (Kabsch 1976)."""
    total = weights.sum(axis=1, keepdims=True)
    from_a, to_b = (
        (weights * a).sum(axis=1, keepdims=True) / total,
        (weights * b).sum(axis=1, keepdims=True) / total,
    )
    spread = np.einsum("pni,pnj->pij", weights * (a - from_a), b - to_b)
    left, _, right = np.linalg.svd(spread)
    signs = np.ones((len(a), 3))
    signs[:, 2] = np.sign(np.linalg.det(left @ right))
    turn = np.einsum("pij,pj,pjk->pik", left, signs, right)
    return np.asarray((a - from_a) @ turn + to_b)


def _sigma(errors: FloatArray) -> float:
    """Robust standard deviation of a coordinate."""
    return float(np.median(np.linalg.norm(errors, axis=-1))) * median_to_sigma(3) / 3.0**0.5
