"""Things that are known again wherever they are seen, as edges of the pose graph between those who saw them.

A landmark joins the graph as one more node, each sighting as an edge to it that may be refused. All are
solved together; then what was found is told from the node that saw it best, so that these edges are as
others: they may be refused, are saved, and hold when the map is edited or joined.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np

from slam.graph.anchors import NOWHERE_M
from slam.graph.pose_graph import Edge, EdgeKind, PoseGraph
from slam.measurements import BoolArray, FloatArray, Pose


@dataclass(frozen=True, slots=True)
class Sighting:
    """A landmark, seen from a node.

    Attributes
    ----------
    node
        Its number.
    T_node_landmark
        Pose2 or Pose3, as the nodes are.
    covariance
        (d, d) in GTSAM's tangent of the landmark.
    """

    node: int
    T_node_landmark: Pose
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class Landmark:
    """What all sightings of a landmark tell together.

    Attributes
    ----------
    node
        The node that saw it best of those that hold.
    T_node_landmark
        Where it is, seen from there.
    covariance
        (d, d) of that, in GTSAM's tangent of the landmark.
    holds
        Which of its sightings fit each other and the way.
    edges
        From the node to the others that saw it.
    """

    node: int
    T_node_landmark: Pose
    covariance: FloatArray
    holds: BoolArray
    edges: list[Edge]


def landmarks_of(
    poses: Sequence[Pose],
    edges: Sequence[Edge],
    seen: Sequence[Sequence[Sighting]],
) -> list[Landmark | None]:
    """Solve a graph with its landmarks.

    Parameters
    ----------
    poses
        (n,) of the nodes.
    edges
        That hold.
    seen
        The sightings of each landmark, at least one.

    Returns
    -------
    Of each landmark what was found; None where nothing holds.
    """
    graph = PoseGraph(poses[0])
    for pose in poses[1:]:
        graph.add_node(pose)
    for edge in edges:
        graph.add_edge(edge)
    first = len(edges)
    for sightings in seen:
        best = min(sightings, key=_size)
        node = graph.add_node(_compose(poses[best.node], best.T_node_landmark))
        far = NOWHERE_M**2 * np.eye(len(best.covariance))
        graph.add_edge(Edge(best.node, node, best.T_node_landmark, far, EdgeKind.TAG, trusted=True))
        for one in sightings:
            graph.add_edge(
                Edge(one.node, node, one.T_node_landmark, one.covariance, EdgeKind.TAG, trusted=False)
            )
    kept = graph.optimize().kept
    found = list[Landmark | None]()
    for number, sightings in enumerate(seen):
        holds = kept[first + 1 : first + 1 + len(sightings)]
        first += 1 + len(sightings)
        found.append(_told(graph, len(poses) + number, sightings, holds) if holds.any() else None)
    return found


def _told(graph: PoseGraph, landmark: int, sightings: Sequence[Sighting], holds: BoolArray) -> Landmark:
    """From the node that saw it best."""
    held = [one for one, keep in zip(sightings, holds.tolist(), strict=True) if keep]
    best = min(held, key=_size)
    T_node_landmark = _between(graph.pose(best.node), graph.pose(landmark))
    together = np.linalg.inv(np.sum([np.linalg.inv(one.covariance) for one in held], axis=0))
    edges = []
    for one in held:
        if one.node == best.node:
            continue
        back = one.T_node_landmark.inverse()
        adjoint = one.T_node_landmark.AdjointMap()
        # All share the error of where it is.
        covariance = adjoint @ (one.covariance + together) @ adjoint.T
        pose = _compose(T_node_landmark, back)
        edges.append(Edge(best.node, one.node, pose, covariance, EdgeKind.TAG, trusted=False))
    return Landmark(best.node, T_node_landmark, together, holds, edges)


def in_plane(sightings: Sequence[Sighting]) -> tuple[list[Sighting], gtsam.Rot3]:
    """Sightings by a robot on a floor, in the plane, and how the landmark leans: ``R_flat_landmark``."""
    best = min(sightings, key=_size)
    assert isinstance(best.T_node_landmark, gtsam.Pose3)
    lean = best.T_node_landmark.rotation()
    found = []
    for one in sightings:
        pose = one.T_node_landmark
        assert isinstance(pose, gtsam.Pose3)
        turn = np.asarray(pose.rotation().matrix())
        yaw = pose.rotation().compose(lean.inverse()).yaw()
        flat = np.array([[math.cos(yaw), math.sin(yaw), 0.0], [-math.sin(yaw), math.cos(yaw), 0.0]])
        # Of x and y along the axes of the flat landmark, and of yaw, by turn and shift of the landmark.
        slopes = np.zeros((3, 6))
        slopes[:2, 3:], slopes[2, :3] = flat @ turn, turn[2]
        planar = gtsam.Pose2(pose.x(), pose.y(), yaw)
        found.append(Sighting(one.node, planar, slopes @ one.covariance @ slopes.T))
    return found, lean


def _size(one: Sighting) -> float:
    """How uncertain a sighting is."""
    return float(np.trace(one.covariance))


def _between(one: Pose, other: Pose) -> Pose:
    """The other seen from one; GTSAM has no type for a pose of the plane or of space."""
    return one.between(other)  # type: ignore[arg-type]


def _compose(one: Pose, other: Pose) -> Pose:
    """One, then the other."""
    return one.compose(other)  # type: ignore[arg-type]
