"""Positions measured along a path, and how they enter the graph of its keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.time_alignment import GAP_S
from slam.estimates import Trajectory
from slam.graph.anchors import Anchor, Anchored, anchored
from slam.graph.edge import EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.pose_graph import BatchResult
from slam.measurements import FloatArray, Pose, spatial

# Usually no larger share of the anchors is wrong.
_WRONG_SHARE = 0.1


@dataclass(frozen=True, slots=True)
class Track:
    """Track of the robot: its trajectory, and its poses at the nodes.

    Attributes
    ----------
    nodes, bases, stamps_s
        (K,) poses of the graph's nodes, of the base at each node, and their stamps.
    readings, trajectory
        The pose of every reading, interpolated between these; in log order, and sorted by time.
    """

    nodes: Sequence[Pose]
    bases: Sequence[Pose]
    stamps_s: FloatArray
    readings: Trajectory
    trajectory: Trajectory

    @classmethod
    def of(
        cls, nodes: Sequence[Pose], bases: Sequence[Pose], stamps_s: FloatArray, trajectory: Trajectory
    ) -> Track:
        """Create it from a trajectory in any order."""
        return cls(
            nodes, bases, stamps_s, trajectory, trajectory[np.argsort(trajectory.stamps_s, kind="stable")]
        )

    def nearest(self, stamps_s: FloatArray) -> NDArray[np.int64]:
        """Return (k,) the keyframe nearest in time to each of (k,) stamps."""
        in_time = np.argsort(self.stamps_s, kind="stable")
        middles_s = 0.5 * (self.stamps_s[in_time][1:] + self.stamps_s[in_time][:-1])
        return np.asarray(in_time[np.searchsorted(middles_s, stamps_s)])

    def seen_from(self, key: int, stamp_s: float) -> gtsam.Pose3 | None:
        """Return the pose of the base at a time in the frame of a node; None if unknown."""
        at = _pose_at(self.trajectory, stamp_s)
        if at is None:
            return None
        # The motion since the keyframe, by odometry.
        moved = spatial(self.bases[key]).between(at)
        return spatial(self.nodes[key]).between(spatial(self.bases[key])).compose(moved)


def anchor(
    graph: KeyframeGraph,
    anchors: Sequence[Anchor],
    outcome: BatchResult,
    inlier_probability: float,
    kind: EdgeKind,
) -> tuple[BatchResult, Anchored | None]:
    """Align a graph with known positions and solve it again.

    Parameters
    ----------
    outcome
        The result of the previous optimisation.
    inlier_probability
        See `slam.graph.pose_graph.PoseGraph.optimize`.

    Returns
    -------
    The new result and the pose of the map; the previous result and None if the positions do not determine it.
    """
    edges, kept = graph.graph.edges, outcome.kept
    inliers = [edge for edge, keep in zip(edges, kept, strict=True) if keep]
    solution = anchored(graph.poses(), inliers, anchors, kind)
    if solution is None:
        return outcome, None
    if solution.misfits > _WRONG_SHARE:
        # A false loop outweighs any position. If far more fit without loops, loops start rejected.
        chain = [edge for edge in inliers if edge.loop is None]
        other = anchored(graph.poses(), chain, anchors, kind)
        if other is not None and other.misfits < 0.5 * solution.misfits:
            solution, kept = other, kept & np.array([edge.loop is None for edge in edges])
    for edge in solution.edges:
        graph.graph.add_edge(edge)
    graph.graph.begin_with([*kept, *[True] * len(solution.edges)])
    return graph.optimize(inlier_probability), solution


def _pose_at(path: Trajectory, stamp_s: float) -> gtsam.Pose3 | None:
    """Interpolate between two poses of a trajectory sorted by time; None if unknown."""
    after = int(np.searchsorted(path.stamps_s, stamp_s))
    pair = path[max(after - 1, 0) : after + 1]
    ends = pair.poses()
    if np.abs(pair.stamps_s - stamp_s).min() > GAP_S:
        return None
    if len(ends) < 2 or pair.stamps_s[1] <= pair.stamps_s[0]:
        return ends[0]
    share = (stamp_s - pair.stamps_s[0]) / (pair.stamps_s[1] - pair.stamps_s[0])
    return ends[0].slerp(float(np.clip(share, 0.0, 1.0)), ends[1])
