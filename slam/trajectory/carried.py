"""Covariance of the pose of every reading, propagated from the keyframes around it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

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
    """Compute the covariance of each pose of a trajectory from the keyframes before and after it.

    Between two keyframes the error is a Brownian bridge (Gauss-Markov with independent increments): the ends
    are weighted by the share of the path. If the ends are known better than the step between them, the rest
    of the step's covariance is added. Beyond the first and last keyframe the nearest step is continued.

    Parameters
    ----------
    trajectory
        N poses in the map.
    anchors
        (K,) increasing numbers of the keyframes' readings, K > 0.
    covariances
        (K, d, d) covariances of the base at the keyframes, GTSAM's tangent of the base; d is 3 or 6.
    steps
        (K - 1, d, d) covariances of the motion from each to the next, in the tangent at its end.

    Returns
    -------
    (N, d, d) of x, y, yaw, or of x, y, z and a rotation vector, along the axes of the map.
    """
    rotations = scipy.spatial.transform.Rotation.from_quat(trajectory.quaternions_xyzw)
    ends = _along_map(covariances, rotations[anchors])
    if not len(steps):
        return _moved(
            np.repeat(ends, len(trajectory), axis=0), _from(trajectory, anchors[[0] * len(trajectory)])
        )
    between = _along_map(steps, rotations[anchors[1:]])
    numbers = np.arange(len(trajectory))
    # Each gap starts at its own keyframe; the first and the last also cover the poses outside.
    gap = np.clip(np.searchsorted(anchors, numbers, side="right") - 1, 0, len(steps) - 1)
    path = np.concatenate([[0.0], np.cumsum(path_lengths(Poses(trajectory.positions_m, rotations)))])
    length = (path[anchors[1:]] - path[anchors[:-1]])[gap]
    share = ((path - path[anchors[gap]]) / length)[:, None, None]
    start = _moved(ends[gap], _from(trajectory, anchors[gap]))
    stop = _moved(ends[gap + 1], _from(trajectory, anchors[gap + 1]))
    bridge = _moved(_excess(between, ends)[gap], _from(trajectory, anchors[gap + 1]))
    onward = _moved(between[gap], _from(trajectory, anchors[gap + 1]))
    inside = (1.0 - share) * start + share * stop + share * (1.0 - share) * bridge
    return np.where(
        share < 0.0, start - share * onward, np.where(share > 1.0, stop + (share - 1.0) * onward, inside)
    )


def unseen_covariances(
    trajectory: Trajectory, scans: NDArray[np.int64], wheels: Poses | None, size: int
) -> FloatArray:
    """Compute the additional covariance of poses in gaps without a matched scan, and before and after.

    From the last scan to the next the error is a Brownian bridge. Wheels drift with the path as usual, and
    their error at the next scan may have occurred at any time, as by a slip. Without wheels the robot may be
    anywhere that it can reach at its usual speed.

    Parameters
    ----------
    scans
        (S,) increasing numbers of the readings whose pose comes from a scan, S > 0.
    wheels
        N poses, odom frame; None without wheels.
    size
        3 on a floor, 6 in 3D.

    Returns
    -------
    (N, 3, 3) of x, y, yaw, or (N, 6, 6) of x, y, z and a rotation vector: along the axes of the map.
    """
    poses, power = Poses.of_trajectory(trajectory), 2 if wheels is None else 1
    missed, travelled = poses[scans[:-1]].between(poses[scans[1:]]), trajectory.stamps_s
    if wheels is not None:
        missed = wheels[scans[:-1]].between(wheels[scans[1:]]).between(missed)
        travelled = np.concatenate([[0.0], np.cumsum(path_lengths(wheels))])
    # Of position and rotation.
    squares = np.square(missed.offsets()).reshape(-1, 2, 3).sum(axis=2)
    gaps_s, lengths = np.diff(trajectory.stamps_s[scans]), np.diff(travelled[scans]) ** power
    usual_gaps = (gaps_s > 0.0) & (gaps_s <= GAP_S)
    rates = squares[usual_gaps].sum(axis=0) / max(float(lengths[usual_gaps].sum()), TINY)
    over = lengths[:, None] * rates + (squares if wheels is not None else 0.0)
    last = np.searchsorted(scans, np.arange(len(trajectory)), side="right") - 1
    last_scan = scans[np.maximum(last, 0)]
    since = travelled - travelled[last_scan]
    variances = np.zeros((len(trajectory), 2))
    outside = (last < 0) | (last == len(scans) - 1)
    variances[outside] = np.abs(since[outside, None]) ** power * rates
    inside = np.flatnonzero(~outside)
    inside = inside[gaps_s[last[inside]] > GAP_S]
    gap = last[inside]
    # Stamps may run backward.
    share = np.clip(since[inside] / (travelled[scans[gap + 1]] - travelled[scans[gap]]), 0.0, 1.0)[:, None]
    variances[inside] = share * (1.0 - share) * over[gap]
    covariances = variances[:, [0, 0, 1] if size == 3 else [0, 0, 0, 1, 1, 1], None] * np.eye(size)
    return covariances if wheels is None else _moved(covariances, _from(trajectory, last_scan))


def bridged_covariances(trajectory: Trajectory, bridged: Mapping[int, FloatArray]) -> FloatArray:
    """Return the (N, 6, 6) additional covariance of poses from an IMU alone, see `Readings.bridged`."""
    covariances, rows = np.zeros((len(trajectory), 6, 6)), list(bridged)
    turns = scipy.spatial.transform.Rotation.from_quat(trajectory.quaternions_xyzw[rows])
    covariances[rows] = _along_map(np.array(list(bridged.values())), turns)
    return covariances


def grown_covariances(trajectory: Trajectory, covariances: FloatArray, first: int, last: int) -> FloatArray:
    """Return the (last - first + 1, d, d) covariance that poses have in addition to a rigid first pose.

    Parameters
    ----------
    covariances
        (N, d, d) covariances of all poses, along the axes of the map.
    """
    rows = slice(first, last + 1)
    shifts = trajectory.positions_m[rows] - trajectory.positions_m[first]
    return covariances[rows] - _moved(np.repeat(covariances[[first]], len(shifts), axis=0), shifts)


def late_covariances(
    trajectory: Trajectory, fixed: int, sessions: Sequence[tuple[int, float]], size: int
) -> FloatArray:
    """Compute the effect of a common stamp error per session on poses, one of which is fixed.

    Parameters
    ----------
    trajectory
        N poses in the map, one session after the other.
    fixed
        Number of the fixed pose, in the first session: if it moves, all others get an error.
    sessions
        For each its number of poses, and the standard deviation of its error in seconds; errors of two
        sessions are independent.
    size
        3 on a floor, 6 in 3D.

    Returns
    -------
    (N, 3, 3) of x, y, yaw, or (N, 6, 6) of x, y, z and a rotation vector: along the axes of the map.
    """
    ends = np.cumsum([poses for poses, _ in sessions])
    speeds = np.concatenate(
        [_speeds(trajectory[end - n : end]) for end, (n, _) in zip(ends, sessions, strict=True)]
    )
    errors = np.repeat([sigma_s for _, sigma_s in sessions], np.diff(ends, prepend=0))[:, None] * speeds
    held_errors = np.tile(sessions[0][1] * speeds[fixed], (len(speeds), 1))
    held_errors[:, :3] += np.cross(held_errors[:, 3:], _from(trajectory, np.full(len(trajectory), fixed)))
    errors[: ends[0]] -= held_errors[: ends[0]]
    held_errors[: ends[0]] = 0.0
    both = np.array([errors, held_errors])[:, :, [0, 1, 5] if size == 3 else slice(None)]
    return np.einsum("kni,knj->nij", both, both)


def _speeds(trajectory: Trajectory) -> FloatArray:
    """Return (N, 6) velocities and turn rates along the axes of the map, of one session."""
    stamps_s, order = np.unique(trajectory.stamps_s, return_index=True)
    if len(order) < 2:
        return np.zeros((len(trajectory), 6))
    rotations = scipy.spatial.transform.Rotation.from_quat(trajectory.quaternions_xyzw[order])
    turned = scipy.spatial.transform.Slerp(stamps_s, rotations)
    ends = np.add.outer([-0.5 * GAP_S, 0.5 * GAP_S], trajectory.stamps_s).clip(stamps_s[0], stamps_s[-1])
    shifts = [np.diff(np.interp(ends, stamps_s, row), axis=0)[0] for row in trajectory.positions_m[order].T]
    turns = (turned(ends[1]) * turned(ends[0]).inv()).as_rotvec()
    return np.column_stack([*shifts, turns]) / np.diff(ends, axis=0).T


def _excess(steps: FloatArray, ends: FloatArray) -> FloatArray:
    """Return the (K - 1, d, d) covariance of steps that exceeds that of their two ends."""
    values, axes = np.linalg.eigh(steps - 2.0 * (ends[:-1] + ends[1:]))
    return np.einsum("kij,kj,klj->kil", axes, np.maximum(values, 0.0), axes)


def _along_map(covariances: FloatArray, rotations: scipy.spatial.transform.Rotation) -> FloatArray:
    """Rotate (K, d, d) from the tangent of the base to the axes of the map."""
    turn = np.zeros_like(covariances)
    if covariances.shape[1] == 3:
        turn[:] = rotations.as_matrix()
    else:
        # GTSAM's tangent in space is rotation, then translation.
        covariances = np.roll(covariances, 3, axis=(1, 2))
        turn[:, :3, :3] = turn[:, 3:, 3:] = rotations.as_matrix()
    return turn @ covariances @ turn.transpose(0, 2, 1)


def _from(trajectory: Trajectory, anchors: NDArray[np.int64]) -> FloatArray:
    """Return (N, 3) from the anchor of each pose to the pose, along the axes of the map."""
    return trajectory.positions_m - trajectory.positions_m[anchors]


def _moved(covariances: FloatArray, shifts: FloatArray) -> FloatArray:
    """Return (N, d, d) of a rigidly attached point at a shift (N, 3): a rotation moves it."""
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
