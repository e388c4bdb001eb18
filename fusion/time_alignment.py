"""Which readings of two sensors belong together in time, and by how much their clocks differ: Xu2024, 2.1.

The paper samples a 1000 Hz curve at the image's 24 Hz. Here each image gets the scan nearest to it, within a
tolerance and one to one; and where both sensors tell how fast the robot turns, a constant offset between
their clocks is estimated from the two yaw rates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.curves import FloatArray
from fusion.estimation import FEWEST
from fusion.similarity import MIDDLE_MAX

IntPairs = NDArray[np.int64]

_STEP_S = 0.01
_PEAK_STEPS = 12
_LEAST_TURN_RAD_S = 0.02  # standard deviation of a yaw rate: below, the robot hardly turns


@dataclass(frozen=True)
class ClockOffset:
    """By how much one clock is ahead of another.

    Attributes
    ----------
    offset_s
        Stamps of the second sensor less those of the first, for the same instant.
    sigma_s
        Standard deviation of the offset.
    correlation
        Of the two yaw rates at the offset.
    """

    offset_s: float
    sigma_s: float
    correlation: float


def pair_stamps(first_s: NDArray[Any], second_s: NDArray[Any], tolerance_s: float) -> IntPairs:
    """Pairs of stamps that are each other's nearest.

    Parameters
    ----------
    first_s, second_s
        (N,) and (M,) stamps in any order.
    tolerance_s
        Greatest difference of a pair, inclusive.

    Returns
    -------
    (K, 2) indices into both, by rising first stamp; no index twice.

    Raises
    ------
    ValueError
        A stamp that is not finite, or a tolerance below zero.

    Examples
    --------
    >>> import fusion, numpy as np
    >>> fusion.pair_stamps(np.array([0.0, 1.0, 2.0]), np.array([0.98, 2.3, 0.01]), 0.05).tolist()
    [[0, 2], [1, 0]]
    """
    a, b = np.asarray(first_s, dtype=np.float64), np.asarray(second_s, dtype=np.float64)
    if not (np.isfinite(a).all() and np.isfinite(b).all()) or not tolerance_s >= 0.0:
        raise ValueError("stamps must be finite and the tolerance not below zero")
    if a.size == 0 or b.size == 0:
        return np.empty((0, 2), dtype=np.int64)
    order_a, order_b = np.argsort(a, kind="stable"), np.argsort(b, kind="stable")
    mine = _nearest(a[order_a], b[order_b])
    theirs = _nearest(b[order_b], a[order_a])
    index = np.arange(a.size)
    mutual = theirs[mine] == index
    near = np.abs(a[order_a] - b[order_b][mine]) <= tolerance_s
    kept = mutual & near
    return np.column_stack([order_a[kept], order_b[mine[kept]]]).astype(np.int64)


def _nearest(sorted_from: FloatArray, sorted_to: FloatArray) -> NDArray[np.int64]:
    """For each the index of the nearest; the earlier of two that are equally near."""
    right = np.searchsorted(sorted_to, sorted_from).clip(0, sorted_to.size - 1)
    left = (right - 1).clip(0)
    closer = np.abs(sorted_from - sorted_to[left]) <= np.abs(sorted_from - sorted_to[right])
    return np.where(closer, left, right).astype(np.int64)


def clock_offset(
    first_s: FloatArray,
    first_yaw_rate: FloatArray,
    second_s: FloatArray,
    second_yaw_rate: FloatArray,
    most_s: float = 1.0,
) -> ClockOffset | None:
    """A constant offset between two clocks, by where two yaw rates (rad/s) correlate best.

    Parameters
    ----------
    first_s, first_yaw_rate
        (N,) rising stamps and rates of the first sensor.
    second_s, second_yaw_rate
        (M,) of the second.
    most_s
        Offsets of up to this are tried.

    Returns
    -------
    None where the offset is open: too few rates, hardly a turn, or no clear peak inside the range.

    Raises
    ------
    ValueError
        Stamps that do not rise.

    Examples
    --------
    >>> import fusion, numpy as np
    >>> def yaw_rate(true_s):
    ...     return 0.5 * np.sin(true_s) + 0.3 * np.sin(2.7 * true_s)
    >>> scans_s, images_s = np.arange(0.0, 20.0, 0.1), np.arange(0.0, 20.0, 0.04)
    >>> found = fusion.clock_offset(scans_s, yaw_rate(scans_s), images_s + 0.25, yaw_rate(images_s))
    >>> round(found.offset_s, 2)
    0.25
    """
    for stamps in (first_s, second_s):
        if np.any(np.diff(stamps) <= 0.0):
            raise ValueError("stamps must rise; sort them and drop doubles")
    if min(first_s.size, second_s.size) < FEWEST:
        return None
    low, high = max(first_s[0], second_s[0]) + most_s, min(first_s[-1], second_s[-1]) - most_s
    if high - low < FEWEST * _STEP_S:
        return None
    times = np.arange(low, high, _STEP_S)
    rate = np.interp(times, first_s, first_yaw_rate)
    shifts = np.arange(-math.ceil(most_s / _STEP_S), math.ceil(most_s / _STEP_S) + 1) * _STEP_S
    moved = np.stack([np.interp(times + shift, second_s, second_yaw_rate) for shift in shifts])
    if min(rate.std(), moved.std(axis=1).min()) < _LEAST_TURN_RAD_S:
        return None
    correlation = _correlations(rate, moved)
    best = int(np.argmax(correlation))
    if not 0 < best < shifts.size - 1 or correlation[best] < MIDDLE_MAX:
        return None
    # A parabola through the whole peak: single samples of it are rough with interpolated noise.
    low_k, high_k = max(0, best - _PEAK_STEPS), min(shifts.size, best + _PEAK_STEPS + 1)
    bend, tilt, _ = np.polyfit(shifts[low_k:high_k] - shifts[best], correlation[low_k:high_k], 2)
    part = -0.5 * tilt / bend if bend < 0.0 else 0.0
    offset = float(shifts[best] + np.clip(part, -_PEAK_STEPS * _STEP_S, _PEAK_STEPS * _STEP_S))
    readings = min(first_s.size, second_s.size)
    return ClockOffset(offset, _sigma_s(times, rate, moved[best], readings), float(correlation[best]))


def _correlations(rate: FloatArray, moved: FloatArray) -> FloatArray:
    """(K,) Pearson's correlation of a rate with each of (K, T) others."""
    a = rate - rate.mean()
    b = moved - moved.mean(axis=1, keepdims=True)
    return np.asarray(b @ a / np.sqrt((a @ a) * (b * b).sum(axis=1)))


def _sigma_s(times: FloatArray, rate: FloatArray, other: FloatArray, readings: int) -> float:
    """Standard deviation of a shift: noise of the difference over the slope, by the number of readings."""
    # Noise makes slopes of its own, but not the same ones in both.
    slope_squared = float((np.gradient(rate, times) * np.gradient(other, times)).sum())
    noise = (other - other.mean()) - (rate - rate.mean())
    # Interpolated samples are no news: what counts is the number of readings.
    share = min(1.0, readings / times.size)
    information = slope_squared * share / max(float(noise.var()), 1e-12)
    return math.sqrt(1.0 / information) if information > 0.0 else math.inf
