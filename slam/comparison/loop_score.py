"""Precision and recall of loops against the ground truth."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.comparison.product import AcceptedLoop
from slam.estimates import Trajectory
from slam.evaluation.alignment import nearest_indices
from slam.matching.planar import between, wrap
from slam.measurements import BoolArray, FloatArray

# A loop with a larger error connects the map to the wrong place.
RIGHT_WITHIN_M, RIGHT_WITHIN_RAD = 0.3, 0.15
# A revisit: this close to a position that was passed this much path length before, by the ground truth.
REVISIT_M, LEAST_PATH_M = 1.0, 10.0
_NEAR_S = 0.1


def loop_scores(
    loops: Sequence[AcceptedLoop], keyframe_stamps_s: FloatArray, truth: Trajectory
) -> dict[str, float]:
    """Precision and recall of accepted loops.

    Precision is the share of loops whose motion is right within 0.3 m and 0.15 rad; absent without loops.
    Recall is the share of revisiting keyframes (by the ground truth within 1 m of where the robot was at
    least 10 m of path before) that have a right loop from a keyframe less than 1 m of path away; absent
    without revisits.
    """
    poses, reported = _true_poses(truth, keyframe_stamps_s)
    path_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    right = np.array([_is_right(loop, truth) for loop in loops], dtype=bool)
    scores = {"loops": float(len(loops))}
    if len(loops):
        scores["loop_precision"] = float(right.mean())
    revisits = np.flatnonzero(_revisits(poses, path_m) & reported)
    if revisits.size:
        closed = np.array([loop.keyframe_stamp_s for loop, good in zip(loops, right, strict=True) if good])
        at_m = path_m[nearest_indices(keyframe_stamps_s, closed)] if closed.size else np.array([np.inf])
        apart_m = np.abs(path_m[revisits, None] - at_m[None, :]).min(axis=1)
        scores["loop_recall"] = float((apart_m <= REVISIT_M).mean())
    return scores


def _is_right(loop: AcceptedLoop, truth: Trajectory) -> bool:
    """Whether a loop agrees with the ground truth; false if the ground truth has no such stamps."""
    poses, reported = _true_poses(truth, np.array([loop.place_stamp_s, loop.keyframe_stamp_s]))
    if not reported.all():
        return False
    moved = between(*poses)
    position_fits = float(np.linalg.norm(moved[:2] - loop.xyt[:2])) <= RIGHT_WITHIN_M
    return position_fits and abs(wrap(moved[2] - loop.xyt[2])) <= RIGHT_WITHIN_RAD


def _revisits(poses: FloatArray, path_m: FloatArray) -> BoolArray:
    """(K,) whether a keyframe is near an older one, with enough path length between."""
    revisited = np.zeros(len(poses), dtype=bool)
    for key in range(len(poses)):
        old = path_m <= path_m[key] - LEAST_PATH_M
        if old.any():
            revisited[key] = np.hypot(*(poses[old, :2] - poses[key, :2]).T).min() <= REVISIT_M
    return revisited


def _true_poses(truth: Trajectory, stamps_s: FloatArray) -> tuple[FloatArray, BoolArray]:
    """(K, 3) true x, y, yaw at stamps, and whether the ground truth has them."""
    if not len(stamps_s):
        return np.zeros((0, 3)), np.zeros(0, dtype=bool)
    nearest = nearest_indices(truth.stamps_s, stamps_s)
    return truth.to_planar()[nearest], np.abs(truth.stamps_s[nearest] - stamps_s) <= _NEAR_S
