"""Height of the lidar's plane above the camera, estimated over many pairs.

The mean likelihood of a height is not usable: different heights are seen in different places (low ones only
from afar), and some places are easier. So heights are compared in pairs over the samples that both have, and
one value per height is fitted to all these differences.
"""

# mypy: allow-untyped-decorators
from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.curves import EDGE_M, Curve, Float32Array, FloatArray
from fusion.kernel import kernel
from fusion.likelihood import ELSEWHERE_PER_M, SAME_SHARE, SIGMA_SHARE
from fusion.panorama import CurveStack

LEAST_COVER = 0.1  # of the samples of the best covered height: excludes heights that the camera hardly sees
_AS_GOOD = 0.12  # nats per sample: less is no difference between two heights
_MOST_STEPS = 4


class HeightContest:
    """Sums of the score differences between heights, over all pairs."""

    def __init__(self, heights: int) -> None:
        self._gain = np.zeros((heights, heights))
        self._shared = np.zeros((heights, heights))

    def add(self, stack: CurveStack, curve: Curve, T_laser_level: FloatArray) -> None:
        """Add the comparison of the heights of one camera's slices in one pair."""
        ratios = log_ratios(
            stack.ranges_m,
            stack.bearings_rad(),
            T_laser_level,
            curve.ranges_m,
            curve.start_angle_rad,
            curve.step_rad,
        )
        has = np.isfinite(ratios).astype(np.float32)
        value = np.where(has > 0.0, ratios, np.float32(0.0))
        gain = value @ has.T
        self._gain += gain - gain.T
        self._shared += has @ has.T

    def winner(self) -> tuple[int, int, int]:
        """Return the index of the height with the largest value, and the first and last about as good.

        Upright walls are equal at many heights; only surfaces that begin or end between them differ.
        """
        cover = np.diag(self._shared)
        laplacian = np.diag(self._shared.sum(axis=1)) - self._shared
        values = np.linalg.lstsq(laplacian + 1e-6 * np.eye(cover.size), self._gain.sum(axis=1), rcond=None)[0]
        values = np.where(cover > LEAST_COVER * cover.max(), values, -np.inf)
        best = int(np.argmax(values))
        is_good = values >= values[best] - _AS_GOOD
        first = last = best
        while first > 0 and is_good[first - 1] and best - first < _MOST_STEPS:
            first -= 1
        while last + 1 < cover.size and is_good[last + 1] and last - best < _MOST_STEPS:
            last += 1
        return best, first, last


@kernel
def log_ratios(
    candidates: Float32Array,
    bearings: FloatArray,
    T_laser_level: FloatArray,
    lidar: Float32Array,
    start: float,
    step: float,
) -> NDArray[np.float32]:
    """Return (V, W) log likelihood ratios of the slice samples that the lidar sees; else ``nan``."""
    result = np.full(candidates.shape, np.nan, np.float32)
    rotation_x, rotation_y = np.cos(bearings), np.sin(bearings)
    ahead_x = T_laser_level[0, 0] * rotation_x + T_laser_level[0, 1] * rotation_y
    ahead_y = T_laser_level[1, 0] * rotation_x + T_laser_level[1, 1] * rotation_y
    for v in range(candidates.shape[0]):
        for w in range(candidates.shape[1]):
            if np.isnan(candidates[v, w]):
                continue
            x = candidates[v, w] * ahead_x[w] + T_laser_level[0, 2]
            y = candidates[v, w] * ahead_y[w] + T_laser_level[1, 2]
            at = (np.arctan2(y, x) - start) / step
            low = int(np.floor(at))
            if low < 0 or low + 1 >= lidar.size:
                continue
            near, far, share = lidar[low], lidar[low + 1], at - low
            expected = near if share < 0.5 else far
            if abs(near - far) < EDGE_M:
                expected = near + share * (far - near)
            if np.isnan(expected):
                continue
            sigma = SIGMA_SHARE * (0.5 + expected)
            error = (np.hypot(x, y) - expected) / sigma
            same = (
                SAME_SHARE * np.exp(-0.5 * error * error) / (np.sqrt(2.0 * np.pi) * sigma * ELSEWHERE_PER_M)
            )
            result[v, w] = np.log(same + 1.0 - SAME_SHARE)
    return result
