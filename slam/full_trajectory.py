"""A pose for every reading: motion between anchors from the odometry, the correction spread over the way."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from slam.matching.planar import between, compose, wrap
from slam.measurements import FloatArray

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
def _carry_over(anchor: FloatArray, start: FloatArray, end: FloatArray, out: FloatArray) -> None:
    """Write the pose that the motion from ``start`` to ``end`` leads to from an anchor, (3,) each."""
    moved = compose(anchor, between(start, end))
    for k in range(3):
        out[k] = moved[k]


@numba.njit(cache=True)
def _way(a: FloatArray, b: FloatArray) -> float:
    """Way between two poses, turns included."""
    return math.hypot(b[0] - a[0], b[1] - a[1]) + _TURN_M_PER_RAD * abs(wrap(b[2] - a[2])) + _STILL_M
