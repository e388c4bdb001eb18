"""What determines the shape of the whole map: the errors that loops closed, the rest, other constraints."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.graph.edge import Edge
from slam.graph.keyframe_graph import graph_of, joined, row_of, together
from slam.graph.loop_closure import position_sigmas
from slam.measurements import FloatArray, Pose, composed, motion_between


@dataclass(frozen=True, slots=True)
class Closing:
    """Loops between the same two sections of the path.

    Attributes
    ----------
    place, keyframe
        End nodes of the first of the loops.
    path_m
        Path length from the place to the keyframe.
    before_m
        Error of that loop by the odometry steps alone.
    after_m, after_sigmas
        Largest residual of the loops in the finished map: metres, Mahalanobis distance.
    without_m
        Standard deviation of the keyframe relative to the place without these loops; infinite if nothing else
        connects the two.
    """

    place: int
    keyframe: int
    loops: int
    path_m: float
    before_m: float
    after_m: float
    after_sigmas: float
    without_m: float


def closings(held: Sequence[Edge], poses: Sequence[Pose], reach_m: float, most: int) -> list[Closing]:
    """Return the loops that corrected the largest errors of the steps, largest first.

    Parameters
    ----------
    held
        The inlier edges of the graph.
    poses
        ``T_map_keyframe`` of all keyframes.
    reach_m
        Loops belong together if their places, and their keyframes, are within this path length.
    most
        Largest number returned; loops across a break of the steps, as between sessions, are left out.
    """
    loops = [edge for edge in held if edge.loop is not None]
    if not loops:
        return []
    rows = np.array([row_of(pose) for pose in poses])
    travelled_m = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rows[:, :2], axis=0).T))])
    tracked, piece = _tracked(held, poses)
    groups = []
    for group in loop_groups(travelled_m[list(map(_ends, loops))], reach_m):
        members = sorted((loops[n] for n in group.tolist()), key=lambda loop: (loop.target, loop.source))
        first = members[0]
        if piece[first.source] == piece[first.target]:
            groups.append((_missed(first, tracked)[0], members))
    groups.sort(key=lambda group: -group[0])
    graph = graph_of(len(poses), (edge for edge in held if edge.loop is None))
    # The loops of a group are removed together.
    parts = {_ends(loop): (n, n) for n, (_, members) in enumerate(groups[:most]) for loop in members}
    for ends, motion in together(loops).items():
        graph.add_edge(*ends, motion.pose, motion.covariance, parts.get(ends, (-1, -1)))
    found = []
    for n, (before_m, members) in enumerate(groups[:most]):
        first = members[0]
        without = graph.relative_covariances(first.target, np.array([first.source]), rows, without=n)
        after_m, after_sigmas = max(_missed(loop, poses) for loop in members)
        path_m = float(abs(travelled_m[first.target] - travelled_m[first.source]))
        without_m = float(position_sigmas(without)[0])
        found.append(Closing(*_ends(first), len(members), path_m, before_m, after_m, after_sigmas, without_m))
    return found


def _ends(loop: Edge) -> tuple[int, int]:
    return loop.source, loop.target


def _tracked(edges: Sequence[Edge], poses: Sequence[Pose]) -> tuple[list[Pose], NDArray[np.int64]]:
    """Return the poses by the steps alone, and the unbroken piece of each keyframe."""
    steps = {edge.target: edge for edge in reversed(edges) if edge.source == edge.target - 1}
    tracked, broken = list(poses[:1]), np.zeros(len(poses), np.int64)
    for key in range(1, len(poses)):
        step = steps.get(key)
        broken[key] = step is None
        tracked.append(poses[key] if step is None else composed(tracked[-1], step.T_source_target))
    return tracked, np.cumsum(broken)


def loop_groups(ends: FloatArray, reach: float) -> list[NDArray[np.int64]]:
    """Return groups of loops whose ends, (n, 2) along the path, are within reach, by their numbers."""
    from scipy.spatial import cKDTree  # loaded where it is used: that takes 0.1 s

    pairs = cKDTree(ends).query_pairs(reach, p=math.inf, output_type="ndarray")
    numbers = joined(len(ends), pairs)
    return [np.flatnonzero(numbers == number) for number in range(numbers.max() + 1)]


def _missed(loop: Edge, poses: Sequence[Pose]) -> tuple[float, float]:
    """Return the residual of a loop: metres, and Mahalanobis distance."""
    motion = motion_between(poses[loop.source], poses[loop.target])
    error = motion_between(loop.T_source_target, motion)
    innovation = loop.T_source_target.localCoordinates(motion)  # type: ignore[arg-type]
    squares = float(innovation @ np.linalg.solve(loop.covariance, innovation))
    return float(np.linalg.norm(error.translation())), math.sqrt(squares)
