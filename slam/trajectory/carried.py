"""The covariance of every reading's pose, carried on from the keyframes around it."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from fusion.estimation import TINY
from fusion.time_alignment import GAP_S
from slam.estimates import Trajectory
from slam.measurements import FloatArray
from slam.trajectory.poses import Poses
from slam.trajectory.spread import path_lengths


def carried_covariances(
    trajectory: Trajectory, anchors: NDArray[np.int64], covariances: FloatArray, steps: FloatArray
) -> FloatArray:
    """Covariance of each pose of a trajectory, by the keyframes before and after it.

    On the way from one keyframe to the next the error is a Brownian bridge (Gauss-Markov with independent
    increments): ends weigh by the share of the way, and where the ends are known better than the step between
    them, what is left of the step comes on top. Past either end the step beside goes on.

    Parameters
    ----------
    trajectory
        N poses in the map.
    anchors
        (K,) increasing numbers of the keyframes' readings, K > 0.
    covariances
        (K, d, d) of the base at the keyframes, GTSAM's tangent of the base; d is 3 or 6.
    steps
        (K - 1, d, d) of the motion from each to the next, in the tangent where it ends.

    Returns
    -------
    (N, d, d) of x, y, yaw, or of x, y, z and a rotation vector: all along the axes of the map.
    """
    rotations = scipy.spatial.transform.Rotation.from_quat(trajectory.quaternions_xyzw)
    ends = _along_map(covariances, rotations[anchors])
    if not len(steps):
        return _moved(
            np.repeat(ends, len(trajectory), axis=0), _from(trajectory, anchors[[0] * len(trajectory)])
        )
    between = _along_map(steps, rotations[anchors[1:]])
    numbers = np.arange(len(trajectory))
    # Each gap reaches from its own keyframe on; the first and the last also tell of what is outside.
    gap = np.clip(np.searchsorted(anchors, numbers, side="right") - 1, 0, len(steps) - 1)
    path = np.concatenate([[0.0], np.cumsum(path_lengths(Poses(trajectory.positions_m, rotations)))])
    length = (path[anchors[1:]] - path[anchors[:-1]])[gap]
    share = ((path - path[anchors[gap]]) / length)[:, None, None]
    start = _moved(ends[gap], _from(trajectory, anchors[gap]))
    stop = _moved(ends[gap + 1], _from(trajectory, anchors[gap + 1]))
    left = _moved(_left_over(between, ends)[gap], _from(trajectory, anchors[gap + 1]))
    onward = _moved(between[gap], _from(trajectory, anchors[gap + 1]))
    inside = (1.0 - share) * start + share * stop + share * (1.0 - share) * left
    return np.where(
        share < 0.0, start - share * onward, np.where(share > 1.0, stop + (share - 1.0) * onward, inside)
    )


def unseen_covariances(trajectory: Trajectory, scans: NDArray[np.int64], size: int) -> FloatArray:
    """How uncertain poses are besides, where a robot without wheels was not seen: in gaps, and outside.

    There it may be anywhere that it comes to from the last place that was seen, and from which it comes to
    the next, as fast as it moves elsewhere (a Brownian bridge over the time of the gap).

    Parameters
    ----------
    scans
        (S,) increasing numbers of the readings that were placed by a scan.
    size
        3 on a floor, 6 in space.

    Returns
    -------
    (N, 3, 3) of x, y, yaw, or (N, 6, 6) of x, y, z and a rotation vector: along the axes of the map.
    """
    seen, numbers = trajectory[scans], np.arange(len(trajectory))
    times_s = np.diff(seen.stamps_s)
    usual = (times_s > 0.0) & (times_s <= GAP_S)
    sum_s2 = float(times_s[usual] @ times_s[usual])
    turns = scipy.spatial.transform.Rotation.from_quat(seen.quaternions_xyzw)
    ways = np.asarray(np.linalg.norm(np.diff(seen.positions_m, axis=0), axis=1))[usual]
    turned = np.asarray((turns[:-1].inv() * turns[1:]).magnitude())[usual]
    way, turn = (float(one @ one) / max(sum_s2, TINY) for one in (ways, turned))
    last = np.searchsorted(scans, numbers, side="right") - 1
    since_s = trajectory.stamps_s - seen.stamps_s[np.maximum(last, 0)]
    until_s = seen.stamps_s[np.minimum(last + 1, len(scans) - 1)] - trajectory.stamps_s
    outside = (last < 0) | (last == len(scans) - 1)
    inside = np.where(since_s + until_s > GAP_S, since_s * until_s, 0.0)
    spread = np.where(outside, since_s**2, inside).clip(0.0)
    variances = [way, way, turn] if size == 3 else [way] * 3 + [turn] * 3
    return np.asarray(spread[:, None, None] * np.diag(variances))


def late_covariances(trajectory: Trajectory, held: int, sigma_s: float) -> FloatArray:
    """What a shared error of all stamps does to the poses of a robot on a floor, one of which is held.

    Parameters
    ----------
    trajectory
        N poses in the map.
    held
        Number of the pose on which the others are laid: where it moves, they are all off.
    sigma_s
        Standard deviation of the error.

    Returns
    -------
    (N, 3, 3) of x, y, yaw, along the axes of the map.
    """
    stamps_s, order = np.unique(trajectory.stamps_s, return_index=True)
    rows = trajectory[order].to_planar()
    rows[:, 2] = np.unwrap(rows[:, 2])
    ends = [trajectory.stamps_s + share * GAP_S for share in (-0.5, 0.5)]
    before, after = (np.column_stack([np.interp(end, stamps_s, row) for row in rows.T]) for end in ends)
    speeds = (after - before) / GAP_S
    x, y, _ = _from(trajectory, np.full(len(trajectory), held)).T
    along_x, along_y, turn = speeds[held]
    off = speeds - np.column_stack([along_x - turn * y, along_y + turn * x, np.full_like(x, turn)])
    return sigma_s**2 * off[:, :, None] * off[:, None, :]


def _left_over(steps: FloatArray, ends: FloatArray) -> FloatArray:
    """(K - 1, d, d) by how much steps are more uncertain than two such ends can be of each other."""
    values, axes = np.linalg.eigh(steps - 2.0 * (ends[:-1] + ends[1:]))
    return np.einsum("kij,kj,klj->kil", axes, np.maximum(values, 0.0), axes)


def _along_map(covariances: FloatArray, rotations: scipy.spatial.transform.Rotation) -> FloatArray:
    """(K, d, d) of a tangent of the base, along the axes of the map."""
    turn = np.zeros_like(covariances)
    if covariances.shape[1] == 3:
        turn[:] = rotations.as_matrix()
    else:
        # GTSAM's tangent in space is rotation, then translation.
        covariances = np.roll(covariances, 3, axis=(1, 2))
        turn[:, :3, :3] = turn[:, 3:, 3:] = rotations.as_matrix()
    return turn @ covariances @ turn.transpose(0, 2, 1)


def _from(trajectory: Trajectory, anchors: NDArray[np.int64]) -> FloatArray:
    """(N, 3) from an anchor each to every pose, along the axes of the map."""
    return trajectory.positions_m - trajectory.positions_m[anchors]


def _moved(covariances: FloatArray, shifts: FloatArray) -> FloatArray:
    """(N, d, d) of what is rigidly joined, at a shift (N, 3) from there: a turn moves it."""
    lever = np.zeros_like(covariances)
    lever[:] = np.eye(covariances.shape[1])
    x, y, z = shifts.T
    if covariances.shape[1] == 3:
        lever[:, 0, 2], lever[:, 1, 2] = -y, x
    else:
        lever[:, 0, 4], lever[:, 0, 5] = z, -y
        lever[:, 1, 3], lever[:, 1, 5] = -z, x
        lever[:, 2, 3], lever[:, 2, 4] = y, -x
    return lever @ covariances @ lever.transpose(0, 2, 1)
