"""Update a trajectory after its keyframes have moved in an optimisation without the log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from slam.estimates import Trajectory
from slam.measurements import FloatArray
from slam.trajectory.carried import carried_covariances, late_covariances
from slam.trajectory.poses import Poses
from slam.trajectory.spread import spread_correction

Indices: TypeAlias = NDArray[np.int64]


def resettled(
    trajectory: Trajectory,
    keyframe_stamps_s: FloatArray,
    before: Poses,
    after: Poses,
    sessions: Sequence[tuple[int, int, float]],
    node_covariances: tuple[FloatArray, FloatArray],
) -> tuple[Trajectory, FloatArray]:
    """Update a trajectory of one or more sessions and its covariances after its keyframes moved.

    Parameters
    ----------
    trajectory
        All sessions, one after the other.
    keyframe_stamps_s
        (K,) time of each keyframe.
    before, after
        K base poses at the keyframes, when the trajectory was made and now.
    sessions
        Number of keyframes and poses of each, and the sigma of its common stamp error, as
        `slam.storage.map_contents.parts_of` returns.
    node_covariances
        Covariances (K, d, d) of ``after``, and (K - 1, d, d) of the steps, as `carried_covariances` takes
        them.
    """
    covariances, steps = node_covariances
    positions, quaternions, cov_parts, start, first, node = [], [], [], [], 0, 0
    # One session at a time: their clocks may overlap.
    for keyframes, poses, _ in sessions:
        part, nodes = slice(first, first + poses), slice(node, node + keyframes)
        first, node = part.stop, nodes.stop
        session = trajectory[part]
        readings, kept = _readings_of(keyframe_stamps_s[nodes], session.stamps_s)
        motion = Poses.of_trajectory(session)
        anchors = after[nodes][kept].compose(before[nodes][kept].between(motion[readings]))
        carried = spread_correction(motion, readings, anchors).trajectory(session.stamps_s)
        # Where a keyframe is passed over, the steps to it and from it are one.
        moves = steps[nodes.start : nodes.stop - 1]
        moves = np.add.reduceat(moves[: kept[-1]], kept[:-1]) if len(kept) > 1 else moves[:0]
        cov_parts.append(carried_covariances(carried, readings, covariances[nodes][kept], moves))
        start.append(readings[0])
        positions.append(carried.positions_m)
        quaternions.append(carried.quaternions_xyzw)
    moved = Trajectory(trajectory.stamps_s, np.concatenate(positions), np.concatenate(quaternions))
    total = np.concatenate(cov_parts)
    if any(sigma_s for *_, sigma_s in sessions):
        late = [(poses, sigma_s) for _, poses, sigma_s in sessions]
        total += late_covariances(moved, int(start[0]), late, total.shape[1])
    return moved, total


def _readings_of(keyframes_s: FloatArray, stamps_s: FloatArray) -> tuple[Indices, Indices]:
    """Return the reading of each keyframe in log order, and which keyframes these are.

    A log whose clock was set back has stamps twice: a keyframe that would go back is skipped.
    """
    order = np.argsort(stamps_s, kind="stable")
    nearest = np.clip(np.searchsorted(stamps_s[order], keyframes_s), 0, len(stamps_s) - 1)
    readings = order[nearest]
    last = np.concatenate([[-1], np.maximum.accumulate(readings)[:-1]])
    kept = np.flatnonzero((stamps_s[readings] == keyframes_s) & (readings > last))
    return readings[kept], kept
