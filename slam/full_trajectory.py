"""A pose for every reading: motion between anchors from the odometry, the correction spread over the way."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from slam.matching.planar import between, compose, wrap
from slam.measurements import FloatArray

# Scans on either side by which it is judged how far a way and the matches disagree.
_AROUND = 10
# A radian of turn counts as this much way when a correction is spread; standing still counts a little.
_TURN_M_PER_RAD = 0.3
_STILL_M = 1e-6


@numba.njit(cache=True)
def spread_correction(motion: FloatArray, anchors: NDArray[np.int64], anchor_poses: FloatArray) -> FloatArray:
    """Carry corrected anchor poses over to all poses of a drifting trajectory.

    Parameters
    ----------
    motion
        (N, 3) x, y, yaw of every reading in the drifting frame, in log order.
    anchors
        (M,) increasing numbers of the readings whose map pose is known, M > 0.
    anchor_poses
        (M, 3) their poses in the map.

    Returns
    -------
    (N, 3) in the map frame. Between two anchors the drifting motion starts at the first; what it misses
    the second by is added in proportion to the way. Before the first and after the last anchor the
    motion is attached rigidly.
    """
    poses = np.empty_like(motion)
    carried = np.empty(3)
    first = anchors[0]
    for n in range(first):
        _carry_over(anchor_poses[0], motion[first], motion[n], poses[n])
    for m in range(anchors.size):
        start = anchors[m]
        _carry_over(anchor_poses[m], motion[start], motion[start], poses[start])
        stop = anchors[m + 1] if m + 1 < anchors.size else motion.shape[0]
        for n in range(start + 1, stop):
            _carry_over(anchor_poses[m], motion[start], motion[n], poses[n])
        if m + 1 == anchors.size:
            break
        _carry_over(anchor_poses[m], motion[start], motion[stop], carried)
        miss_x = anchor_poses[m + 1, 0] - carried[0]
        miss_y = anchor_poses[m + 1, 1] - carried[1]
        miss_yaw = wrap(anchor_poses[m + 1, 2] - carried[2])
        whole = 0.0
        for n in range(start, stop):
            whole += _way(motion[n], motion[n + 1])
        way = 0.0
        for n in range(start + 1, stop):
            way += _way(motion[n - 1], motion[n])
            share = way / whole
            poses[n, 0] += share * miss_x
            poses[n, 1] += share * miss_y
            poses[n, 2] += share * miss_yaw
    return poses


@numba.njit(cache=True)
def steadied(
    matched: FloatArray, bridged: FloatArray, variances: FloatArray, anchors: NDArray[np.int64]
) -> FloatArray:
    """Take the noise of matches out of the poses between anchors, by a way that is smoother.

    Where matches and way disagree, around a scan, by no more than the matches' noise, the way is as good and
    the difference is noise; where they disagree by more, the way is wrong by the rest: Wiener's share of the
    difference is kept, in each direction.

    Parameters
    ----------
    matched, bridged
        (S, 3) poses of the scans, and where the way from anchor to anchor passes; the same at the anchors.
    variances
        (S, 3) of the matches, x and y along the base's axes, yaw; nan where unknown: such a pose stays.
    anchors
        (M,) increasing numbers of the scans whose pose is known.

    Returns
    -------
    (S, 3); at the anchors, and before the first and after the last, as matched.
    """
    poses = matched.copy()
    count = matched.shape[0]
    off = np.zeros((count, 3))
    free = np.ones(count)
    for n in range(count):
        off[n] = between(bridged[n], matched[n])
    for anchor in anchors:
        free[anchor] = 0.0
    kept = np.empty(3)
    for n in range(anchors[0] + 1, anchors[-1]):
        if free[n] == 0.0 or np.isnan(variances[n, 0]):
            continue
        first, stop = max(anchors[0], n - _AROUND), min(anchors[-1] + 1, n + _AROUND + 1)
        for k in range(3):
            squares = 0.0
            seen = 0.0
            for m in range(first, stop):
                squares += free[m] * off[m, k] * off[m, k]
                seen += free[m]
            noise = variances[n, k] * seen
            kept[k] = off[n, k] * (1.0 - noise / squares) if squares > noise else 0.0
        poses[n] = compose(bridged[n], kept)
    return poses


@numba.njit(cache=True)
def _carry_over(anchor: FloatArray, start: FloatArray, end: FloatArray, out: FloatArray) -> None:
    """Write the pose that the motion from ``start`` to ``end`` leads to from an anchor, (3,) each."""
    moved = compose(anchor, between(start, end))
    for k in range(3):
        out[k] = moved[k]


@numba.njit(cache=True)
def _way(a: FloatArray, b: FloatArray) -> float:
    """Way between two poses, turns included."""
    return math.hypot(b[0] - a[0], b[1] - a[1]) + _TURN_M_PER_RAD * abs(wrap(b[2] - a[2])) + _STILL_M
