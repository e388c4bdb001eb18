"""A pose for every reading: motion between anchors from the odometry, the correction spread over the way."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam.measurements import FloatArray

# Scans on either side by which it is judged how far a way and the matches disagree.
_AROUND = 10
# A radian of turn counts as this much way when a correction is spread; standing still counts a little.
_TURN_M_PER_RAD = 0.3
_STILL_M = 1e-6


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
    numbers = np.arange(len(motion))
    # The anchor at or before each reading; the first for those ahead of it.
    before = np.maximum(np.searchsorted(anchors, numbers, side="right") - 1, 0)
    poses = _composed(anchor_poses[before], _between(motion[anchors[before]], motion))
    start, stop = anchors[:-1], anchors[1:]
    missed = anchor_poses[1:] - _composed(anchor_poses[:-1], _between(motion[start], motion[stop]))
    missed[:, 2] = _wrapped(missed[:, 2])
    way = np.concatenate([[0.0], np.cumsum(_ways(motion))])
    inside = (numbers > anchors[0]) & (numbers < anchors[-1])
    gap = before[inside]
    share = (way[inside] - way[start[gap]]) / (way[stop] - way[start])[gap]
    poses[inside] += share[:, None] * missed[gap]
    return poses


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
    numbers = np.arange(len(matched))
    within = (numbers >= anchors[0]) & (numbers <= anchors[-1])
    free = np.ones(len(matched))
    free[anchors] = 0.0
    off = _between(bridged, matched)
    counted = (free * within)[:, None]
    squares = _around(counted * off * off)
    noise = variances * _around(counted)
    steady = within & (free > 0.0) & ~np.isnan(variances[:, 0])
    kept = np.zeros_like(off)
    np.divide(noise, squares, out=kept, where=squares > noise)
    kept = np.where(squares > noise, off * (1.0 - kept), 0.0)
    return np.where(steady[:, None], _composed(bridged, kept), matched)


def _around(rows: FloatArray) -> FloatArray:
    """(S, K) sums over the rows that lie no more than `_AROUND` away."""
    padded = np.pad(rows, ((_AROUND, _AROUND), (0, 0)))
    total = np.zeros_like(rows)
    for first in range(2 * _AROUND + 1):
        total += padded[first : first + len(rows)]
    return total


def _composed(a: FloatArray, b: FloatArray) -> FloatArray:
    """T_a * T_b, row by row, (N, 3)."""
    cos, sin = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.column_stack(
        [
            a[:, 0] + cos * b[:, 0] - sin * b[:, 1],
            a[:, 1] + sin * b[:, 0] + cos * b[:, 1],
            _wrapped(a[:, 2] + b[:, 2]),
        ]
    )


def _between(a: FloatArray, b: FloatArray) -> FloatArray:
    """inverse(T_a) * T_b, row by row, (N, 3)."""
    cos, sin = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    return np.column_stack([cos * dx + sin * dy, -sin * dx + cos * dy, _wrapped(b[:, 2] - a[:, 2])])


def _wrapped(angles_rad: FloatArray) -> FloatArray:
    """The same angles in [-pi, pi)."""
    return angles_rad - 2.0 * math.pi * np.floor((angles_rad + math.pi) / (2.0 * math.pi))


def _ways(motion: FloatArray) -> FloatArray:
    """(N - 1,) way from each pose to the next, turns included."""
    steps = np.diff(motion, axis=0)
    return np.hypot(steps[:, 0], steps[:, 1]) + _TURN_M_PER_RAD * np.abs(_wrapped(steps[:, 2])) + _STILL_M
