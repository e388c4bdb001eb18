"""Place descriptor for a 3D lidar, seen from above: scan context.

Kim and Kim, "Scan Context: Egocentric spatial descriptor for place recognition within 3D point cloud map",
IROS 2018. Differences: heights are measured from the lowest usual point, since the mounting may be unknown,
and the maximum range depends on the scene, since a room is smaller than a street.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import TINY
from slam.measurements import Float32Array, FloatArray

RINGS, SECTORS = 20, 60
_LOWEST_PERCENT = 2.0


def scan_context(points: FloatArray, voxel_m: float) -> Float32Array:
    """Return (RINGS, SECTORS) the largest height in each part of the surroundings, 0 if it is empty.

    Parameters
    ----------
    points
        (N, 3), z up.
    voxel_m
        Side of a voxel; a ring is four of them wide.
    """
    reach_m = 4 * RINGS * voxel_m
    context = np.zeros((RINGS, SECTORS), dtype=np.float32)
    x, y, z = np.ascontiguousarray(points.T, np.float32)
    ring = (np.sqrt(x * x + y * y) / reach_m * RINGS).astype(np.int64)
    (in_rings,) = np.nonzero(ring < RINGS)
    if in_rings.size:
        turn = np.arctan2(y[in_rings], x[in_rings]) / (2.0 * math.pi)
        turn[turn < 0.0] += 1.0
        sector = np.minimum((turn * SECTORS).astype(np.int64), SECTORS - 1)
        heights_m = z[in_rings]
        heights_m -= np.percentile(heights_m, _LOWEST_PERCENT)
        np.maximum.at(context.ravel(), ring[in_rings] * SECTORS + sector, heights_m)
    return context


def dissimilarity(one: Float32Array, other: Float32Array) -> tuple[float, float]:
    """Return the distance of two contexts 0..1, least over all yaws (Kim 2018 Eq. (6)-(7)), and that yaw.

    Returns
    -------
    The distance, and the yaw in radians of the other's base in the frame of the first.
    """
    distances = ContextBank([one]).dissimilarity(other)[0]
    best = int(np.argmin(distances))
    return float(distances[best]), math.remainder(2.0 * math.pi * best / SECTORS, 2.0 * math.pi)


class ContextBank:
    """Many contexts, for comparison with all of them at once.

    Parameters
    ----------
    contexts
        (RINGS, SECTORS) each, at least one.
    """

    def __init__(self, contexts: Sequence[Float32Array]) -> None:
        # A circular correlation over the yaws, all rings together.
        self._columns = np.array([_spectrum(_unit_columns(context)) for context in contexts])
        self._seen = np.array([np.fft.rfft(_seen(context)) for context in contexts])

    def dissimilarity(self, context: Float32Array) -> FloatArray:
        """Return (K, SECTORS) distances 0..1 of a context to each, rotated by so many sectors."""
        products = (self._columns * np.conj(_spectrum(_unit_columns(context)))).sum(axis=1)
        filled = _seen(context)
        counts = np.fft.irfft(self._seen * np.conj(np.fft.rfft(filled)), SECTORS).round()
        likeness = np.fft.irfft(products, SECTORS) / np.maximum(counts, 1.0)
        enough = counts > 0.5 * max(float(filled.sum()), 1.0)
        return np.asarray(np.where(enough, 1.0 - likeness, 1.0))


def ring_key(context: Float32Array) -> FloatArray:
    """Return (RINGS,) the mean of each ring, independent of the robot's yaw."""
    return np.asarray(context.mean(axis=1, dtype=np.float64))


def _unit_columns(context: Float32Array) -> FloatArray:
    """Return each sector as a unit vector."""
    values = context.astype(np.float64)
    return np.asarray(values / np.maximum(np.linalg.norm(values, axis=0), TINY))


def _seen(context: Float32Array) -> FloatArray:
    """Return (SECTORS,) 1 where anything is seen."""
    return np.asarray((context > 0.0).any(axis=0), dtype=np.float64)


def _spectrum(columns: FloatArray) -> NDArray[np.complex128]:
    """Return the spectrum of each ring."""
    return np.fft.rfft(columns, axis=1)
