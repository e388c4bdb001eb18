"""Reproject a curve of one sensor into the other, and find readings that their own neighbours support."""

# mypy: allow-untyped-decorators
from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.curves import SLACK_M, Float32Array, FloatArray
from fusion.estimation import TINY
from fusion.kernel import kernel

_STEEP = 6.0  # a surface seen at more than 80 degrees from its normal is an edge


@kernel
def joined(near: float, far: float, angle: float, slack_m: float) -> bool:
    """Return whether two neighbouring readings can be on one surface; false for ``nan``."""
    return abs(near - far) <= slack_m + _STEEP * angle * min(near, far)


@kernel
def reproject(
    ranges: Float32Array,
    start: float,
    step: float,
    matrix: FloatArray,
    other: tuple[float, float, int],
    slack_share: float,
) -> NDArray[np.float32]:
    """Compute what another sensor in the plane would measure of the surfaces of a curve.

    Parameters
    ----------
    ranges, start, step
        (N,) the curve, ``nan`` invalid, counter-clockwise.
    matrix
        (3, 3) homography or transform from the curve's plane to the other's, for column vectors.
    other
        First bearing, step, and number of samples of the other sensor.
    slack_share
        Noise of the difference of neighbours, as a share of the range.

    Returns
    -------
    (count,) ranges of the nearest surfaces; ``nan`` if the curve has none.
    """
    other_start, other_step, count = other
    nearest = np.full(count, np.inf, np.float32)
    bearing = np.full(ranges.size, np.nan)
    reach = np.full(ranges.size, np.nan)
    for i in range(ranges.size):
        if np.isnan(ranges[i]):
            continue
        x, y = ranges[i] * math.cos(start + i * step), ranges[i] * math.sin(start + i * step)
        scale = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2]
        if abs(scale) < TINY:
            continue
        px = (matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2]) / scale
        py = (matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2]) / scale
        turned = math.atan2(py, px) - other_start
        bearing[i] = (turned - 2.0 * math.pi * math.floor((turned + 0.05) / (2.0 * math.pi))) / other_step
        reach[i] = math.hypot(px, py)
    for i in range(ranges.size):
        if np.isnan(reach[i]):
            continue
        if i + 1 < ranges.size and not np.isnan(reach[i + 1]):
            wide = abs(bearing[i + 1] - bearing[i])
            slack = SLACK_M + slack_share * min(reach[i], reach[i + 1])
            if wide * other_step < 4.0 * step and joined(reach[i], reach[i + 1], step, slack):
                _draw(nearest, bearing[i], bearing[i + 1], reach[i], reach[i + 1])
                continue
        # At an edge, as wide as the reading itself.
        half = 0.5 * step / other_step
        _draw(nearest, bearing[i] - half, bearing[i] + half, reach[i], reach[i])
    for k in range(count):
        if np.isinf(nearest[k]):
            nearest[k] = np.nan
    return nearest


@kernel
def _draw(nearest: Float32Array, from_at: float, to_at: float, from_m: float, to_m: float) -> None:
    """Draw a straight piece into the samples that look at it, if it is the nearest; in place."""
    if from_at > to_at:
        from_at, to_at, from_m, to_m = to_at, from_at, to_m, from_m
    wide = max(to_at - from_at, TINY)
    for k in range(max(0, math.ceil(from_at)), min(nearest.size - 1, math.floor(to_at)) + 1):
        share = (k - from_at) / wide
        # A straight wall is almost a straight line in 1 / range.
        here = 1.0 / ((1.0 - share) / from_m + share / to_m)
        if here < nearest[k]:
            nearest[k] = here


@kernel
def smooth(ranges: Float32Array, step: float, reach: int, slack_share: float) -> NDArray[np.float32]:
    """Move each reading to the line through its neighbours on the same surface, fitted in 1 / range."""
    result = ranges.copy()
    for i in range(ranges.size):
        if np.isnan(ranges[i]):
            continue
        low = high = i
        while low > 0 and i - low < reach and _same(ranges, low - 1, low, step, slack_share):
            low -= 1
        while (
            high + 1 < ranges.size and high - i < reach and _same(ranges, high, high + 1, step, slack_share)
        ):
            high += 1
        half = min(i - low, high - i) if min(i - low, high - i) >= 2 else reach
        low, high = max(low, i - half), min(high, i + half)
        n, sx, sy, sxx, sxy = 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(low, high + 1):
            x, y = float(j - i), 1.0 / ranges[j]
            n, sx, sy, sxx, sxy = n + 1.0, sx + x, sy + y, sxx + x * x, sxy + x * y
        spread = n * sxx - sx * sx
        if n >= 3.0 and spread > 0.0:
            fitted = (sy * sxx - sx * sxy) / spread
            if fitted > 0.0 and abs(1.0 / fitted - ranges[i]) < SLACK_M + 3.0 * slack_share * ranges[i]:
                result[i] = 1.0 / fitted
    return result


@kernel
def _same(ranges: Float32Array, i: int, j: int, step: float, slack_share: float) -> bool:
    """Return whether two neighbours are on one surface."""
    return joined(ranges[i], ranges[j], step, SLACK_M + slack_share * min(ranges[i], ranges[j]))


@kernel
def without_bumps(
    ranges: Float32Array, step: float, lone: int, bump: int, slack_share: float
) -> NDArray[np.float32]:
    """Remove readings that are not consistent with the rest of the curve.

    A run of up to ``lone`` samples that differs from its neighbours on both sides is removed; one of up to
    ``bump`` only if its left and right sides would join without it. A thin object also differs from its
    background, but it is nearer, and is kept.
    """
    result = ranges.copy()
    first = 0
    while first < ranges.size:
        if np.isnan(ranges[first]):
            first += 1
            continue
        last = first
        while last + 1 < ranges.size and _same(ranges, last, last + 1, step, slack_share):
            last += 1
        length = last - first + 1
        if length <= bump:
            before, after = _valid_before(ranges, first), _valid_after(ranges, last)
            drop = length <= lone
            if not drop and before >= 0 and after >= 0 and after - before <= 2 * bump:
                # Behind the line of its neighbours: multipath.
                level = 0.5 * (ranges[before] + ranges[after])
                drop = joined(ranges[before], ranges[after], step * (after - before), SLACK_M) and (
                    ranges[first] > level
                )
            if drop:
                result[first : last + 1] = np.nan
        first = last + 1
    return result


@kernel
def _valid_before(ranges: Float32Array, first: int) -> int:
    """Return the index of the last reading before, -1 if none."""
    at = first - 1
    while at >= 0 and np.isnan(ranges[at]):
        at -= 1
    return at


@kernel
def _valid_after(ranges: Float32Array, last: int) -> int:
    """Return the index of the first reading after, -1 if none."""
    at = last + 1
    while at < ranges.size and np.isnan(ranges[at]):
        at += 1
    return at if at < ranges.size else -1
