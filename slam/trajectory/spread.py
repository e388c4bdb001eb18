"""Pose of every reading: odometry between keyframes, with the correction distributed over the path."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST, TINY
from slam.measurements import BoolArray, FloatArray
from slam.trajectory.poses import Poses

# A radian of turn counts as this much path when a correction is spread; standing still counts a little.
_TURN_M_PER_RAD = 0.3


def spread_correction(
    motion: Poses, anchors: NDArray[np.int64], anchor_poses: Poses, guessed: BoolArray | None = None
) -> Poses:
    """Distribute the correction of anchor poses over all poses of a drifting trajectory.

    Parameters
    ----------
    motion
        N poses of every reading in the drifting frame, in log order.
    anchors
        (M,) increasing numbers of the readings whose map pose is known, M > 0.
    anchor_poses
        M of them, in the map.
    guessed
        (N,) which poses nothing measured: any error is assumed in the path to and from them.

    Returns
    -------
    N poses in the map. Between two anchors the drifting motion starts at the first; its error at the second
    is distributed in proportion to the path. Before the first and after the last anchor the motion is
    attached rigidly.
    """
    numbers = np.arange(len(motion))
    # The anchor at or before each reading; the first for those ahead of it.
    before = np.maximum(np.searchsorted(anchors, numbers, side="right") - 1, 0)
    poses = anchor_poses[before].compose(motion[anchors[before]].between(motion))
    if len(anchors) < 2:
        return poses
    start, stop = anchors[:-1], anchors[1:]
    reached = anchor_poses[:-1].compose(motion[start].between(motion[stop]))
    turned = anchor_poses[1:].rotations * reached.rotations.inv()
    missed = np.hstack([anchor_poses[1:].positions_m - reached.positions_m, turned.as_rotvec()])
    steps = path_lengths(motion)
    if guessed is not None:
        loose = guessed[:-1] | guessed[1:]
        in_doubt = np.bincount(before[:-1], loose, len(anchors))[before[:-1]] > 0
        steps = np.where(loose | ~in_doubt, steps, 0.0)
    path = np.concatenate([[0.0], np.cumsum(steps)])
    inside = (numbers > anchors[0]) & (numbers < anchors[-1])
    gap = before[inside]
    share = np.zeros((len(motion), 1))
    share[inside, 0] = (path[inside] - path[start[gap]]) / (path[stop] - path[start])[gap]
    return poses.moved(share * missed[np.minimum(before, len(missed) - 1)])


def steadied(matched: Poses, bridged: Poses, variances: FloatArray, anchors: NDArray[np.int64]) -> Poses:
    """Reduce the noise of matches in the poses between anchors, by a smoother motion.

    If matches and motion differ, around a scan, by at most the noise of the matches, the difference is noise.
    If they differ by more, the motion is wrong by the rest. In each direction, the share of the difference by
    Wiener's filter is kept.

    Parameters
    ----------
    matched, bridged
        S poses of the scans, and those of the motion from anchor to anchor; equal at the anchors.
    variances
        (S, 6) of the matches' position and rotation, along the base's axes; nan where unknown: such a pose
        stays.
    anchors
        (M,) increasing numbers of the scans whose pose is known.

    Returns
    -------
    S poses; at the anchors, and before the first and after the last, as matched.
    """
    numbers = np.arange(len(matched))
    within = (numbers >= anchors[0]) & (numbers <= anchors[-1])
    free = np.ones(len(matched))
    free[anchors] = 0.0
    offsets = bridged.between(matched).offsets()
    counted = (free * within)[:, None]
    squares = _around(counted * offsets * offsets)
    noise = variances * _around(counted)
    steady = within & (free > 0.0) & ~np.isnan(variances[:, 0])
    share = np.zeros_like(offsets)
    np.divide(noise, squares, out=share, where=squares > noise)
    kept = np.where(squares > noise, offsets * (1.0 - share), 0.0)
    kept[~steady] = 0.0
    still = Poses.planar(np.zeros((len(matched), 3)))
    return bridged.compose(still.moved(kept)).where(steady, matched)


def _around(rows: FloatArray) -> FloatArray:
    """Return (S, K) sums over each row and enough rows around it for a statistic."""
    half = FEWEST // 2
    padded = np.pad(rows, ((half, half), (0, 0)))
    total = np.zeros_like(rows)
    for first in range(2 * half + 1):
        total += padded[first : first + len(rows)]
    return total


def path_lengths(motion: Poses) -> FloatArray:
    """Return (N - 1,) lengths from each pose to the next, including rotations."""
    steps = np.linalg.norm(np.diff(motion.positions_m, axis=0), axis=1)
    turns_rad = (motion.rotations[:-1].inv() * motion.rotations[1:]).magnitude()
    return steps + _TURN_M_PER_RAD * turns_rad + TINY
