"""Robust likelihood ratio of two metric curves: how well they explain each other. It is our own measure.

PCC matches any two curves that rise and fall together, at any scale; in Eq. (4) a few samples that see
different things decide. If both curves are metric, a stricter test is possible: the evidence for "the same
surface" against "any two surfaces of a home", sample by sample, with a floor so that no single sample
decides. The sum over samples also takes their number into account. The sensors may be in different places:
the camera may be in front of or behind the lidar by one of a few offsets.
"""

# mypy: allow-untyped-decorators
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.curves import Curve, Float32Array, FloatArray
from fusion.kernel import kernel

OFFSETS_M = (-0.2, -0.1, 0.0, 0.1, 0.2)  # ranges of the camera minus those of the lidar: sensors of one robot
SIGMA_SHARE = 0.02  # noise of both sensors, and half a step of the offsets: of the range and two metres more
SAME_SHARE = 0.6  # of samples see the same surface if curves match
ELSEWHERE_PER_M = 0.4  # density of the difference of two unrelated ranges, about zero


def sample_weights(curve_m: Float32Array) -> tuple[Float32Array, Float32Array, np.float32]:
    """Compute the weights of each lidar sample for the kernels.

    Returns
    -------
    (Psi,) the log ratio of an exact match, (Psi,) one over the standard deviation times sqrt(2), both 0 for
    an invalid sample; and the log ratio of a mismatch.
    """
    valid = np.isfinite(curve_m)
    sigma = SIGMA_SHARE * (2.0 + np.where(valid, curve_m, 1.0))
    peak = np.log(SAME_SHARE / (sigma * math.sqrt(2.0 * math.pi)) / ELSEWHERE_PER_M)
    weight = np.where(valid, peak, 0.0).astype(np.float32)
    sharpness = np.where(valid, 1.0 / (math.sqrt(2.0) * sigma), 0.0).astype(np.float32)
    return weight, sharpness, np.float32(math.log(1.0 - SAME_SHARE))


def log_ratio_map(candidates_m: Float32Array, curve_m: Float32Array) -> Float32Array:
    """Return the log likelihood ratio of every candidate at every offset along the lidar curve, in nats.

    Parameters
    ----------
    candidates_m
        (V, W) ranges, ``nan`` invalid.
    curve_m
        (Psi,) ranges of the lidar, Psi >= W.

    Returns
    -------
    (V, Psi - W + 1), for the best of `OFFSETS_M`.

    Raises
    ------
    ValueError
        If the lidar curve is shorter than the candidates.
    """
    if curve_m.size < candidates_m.shape[1]:
        raise ValueError(
            f"the lidar curve has {curve_m.size} samples, the image's {candidates_m.shape[1]};"
            " the lidar must be the wider one"
        )
    weight, sharpness, floor = sample_weights(curve_m)
    ranges = np.where(np.isfinite(curve_m), curve_m, 0.0).astype(np.float32)
    offsets = np.array(OFFSETS_M, dtype=np.float32)
    # The kernel's arithmetic does not handle nan: a hole is an impossible range.
    candidates = np.where(np.isfinite(candidates_m), candidates_m, -1.0).astype(np.float32)
    return _log_ratios(candidates, ranges, weight, sharpness, floor, offsets)


@kernel(fastmath={"reassoc", "contract", "nsz", "arcp", "nnan"})
def _log_ratios(
    candidates: Float32Array,
    curve: Float32Array,
    weight: Float32Array,
    sharpness: Float32Array,
    floor: np.float32,
    offsets: Float32Array,
) -> NDArray[np.float32]:
    """Compute the map; the inner loop is over windows, so that it reads neighbouring samples."""
    rows, width = candidates.shape
    windows = curve.size - width + 1
    best = np.empty((rows, windows), np.float32)
    total = np.empty(windows, np.float32)
    for v in range(rows):
        best[v] = -np.float32(1e9)
        for offset in offsets:
            total[:] = np.float32(0.0)
            for w in range(width):
                expected = candidates[v, w] - offset
                if not expected > 0.0:
                    continue
                near, gain, sharp = curve[w:], weight[w:], sharpness[w:]
                for u in range(windows):
                    residual = (expected - near[u]) * sharp[u]
                    total[u] += max(gain[u] - residual * residual, floor)
            for u in range(windows):
                best[v, u] = max(best[v, u], total[u])
    return best


def log_ratios_at(
    candidates_m: Float32Array, bearings_rad: FloatArray, curve: Curve, yaw_rad: float, offsets_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return log ratios at one yaw, for camera positions in front of or behind the lidar.

    Parameters
    ----------
    candidates_m, bearings_rad
        (V, W) ranges and (W,) bearings in the camera's level frame.
    yaw_rad
        Bearing in the lidar's frame minus bearing in the camera's level frame.
    offsets_m
        (O,) offsets along the x axis of the level frame.

    Returns
    -------
    (O, V) sums over the samples, and (V,) number of samples that both have.
    """
    weight, sharpness, floor = sample_weights(curve.ranges_m)
    at = np.round((bearings_rad + yaw_rad - curve.start_angle_rad) / curve.step_rad).astype(int)
    inside = (at >= 0) & (at < curve.ranges_m.size)
    at = at.clip(0, curve.ranges_m.size - 1)
    expected = np.where(inside, curve.ranges_m[at], np.nan)
    in_both = np.isfinite(candidates_m) & np.isfinite(expected)
    residual = np.where(in_both, candidates_m - np.where(inside, np.nan_to_num(expected), 0.0), 0.0)
    # A camera in front of the lidar measures shorter ranges, most of all straight ahead.
    shifts = offsets_m[:, None, None] * np.cos(bearings_rad)
    scaled = (residual + shifts) * sharpness[at]
    gained = np.where(in_both, np.maximum(weight[at] - scaled * scaled, floor), 0.0)
    return gained.sum(axis=2), in_both.sum(axis=1).astype(np.float64)
