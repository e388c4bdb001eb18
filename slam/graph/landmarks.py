"""Landmarks that are recognised wherever they are seen, as edges between the keyframes that saw them.

A landmark is added to the graph as one more node, each sighting as an edge to it that may be rejected. All
are solved together. Then the edges are expressed from the node that saw the landmark best, so that they are
like other edges: they may be rejected, are saved, and hold for edited or joined maps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.estimation import SETTLED, gate
from slam.graph.anchors import NOWHERE_M
from slam.graph.edge import Edge, EdgeKind
from slam.graph.factors import solved
from slam.graph.held_graph import held_graph
from slam.graph.influence import LinearMap
from slam.graph.pose_graph import PoseGraph
from slam.measurements import BoolArray, FloatArray, Pose, composed, motion_between


@dataclass(frozen=True, slots=True)
class Sighting:
    """A landmark, seen from a node.

    Attributes
    ----------
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
    """A landmark estimated from all its sightings.

    Attributes
    ----------
    node
        The inlier node that saw it best.
    T_node_landmark
        Its pose in the frame of that node.
    covariance
        (d, d) of this pose, in GTSAM's tangent of the landmark.
    holds
        Which of its sightings agree with each other and the path.
    elsewhere
        Number of sightings in visits that saw it elsewhere.
    edges
        Edges from the node to the others that saw it.
    """

    node: int
    T_node_landmark: Pose
    covariance: FloatArray
    holds: BoolArray
    elsewhere: int
    edges: list[Edge]


def landmarks_of(
    poses: Sequence[Pose], edges: Sequence[Edge], seen: Sequence[Sequence[Sighting]]
) -> list[Landmark | None]:
    """Solve a graph with its landmarks.

    Sightings of a landmark from consecutive nodes are one visit and count as one: if a tag is moved between
    two visits, all sightings of the second are wrong together. A landmark is assumed static as long as its
    visits agree with each other and the path: otherwise the visit whose removal improves the fit most is
    rejected, one after the other (Baarda 1968).

    Parameters
    ----------
    poses
        (n,) of the nodes.
    edges
        That hold.
    seen
        The sightings of each landmark, in the order of their nodes, at least one.

    Returns
    -------
    The estimate of each landmark; None if no sighting is an inlier.
    """
    visits = [visit for sightings in seen for visit in _visits(sightings)]
    of = np.repeat(np.arange(len(seen)), [len(_visits(sightings)) for sightings in seen])
    nodes, ties, holds = _visited(poses, edges, visits)
    hubs = [nodes[len(poses) + int(np.flatnonzero(of == number)[0])] for number in range(len(seen))]
    nodes, still = _still([*nodes, *hubs], ties, len(poses), of, holds)
    landmarks = list[Landmark | None]()
    for number, sightings in enumerate(seen):
        own = np.flatnonzero(of == number)
        fit = np.concatenate([holds[visit] & still[visit] for visit in own])
        landmark = nodes[len(poses) + len(of) + number]
        moved = sum(len(holds[visit]) for visit in own[~still[own]])
        landmarks.append(_landmark_of(nodes, landmark, sightings, fit, moved) if fit.any() else None)
    return landmarks


def _visited(
    poses: Sequence[Pose], edges: Sequence[Edge], visits: Sequence[Sequence[Sighting]]
) -> tuple[list[Pose], list[Edge], list[BoolArray]]:
    """Return the graph with one node per visit, its inliers, and which sightings agree within their visit."""
    nodes, ties = [*poses], [*edges]
    for visit in visits:
        best = min(visit, key=_size)
        nodes.append(composed(poses[best.node], best.T_node_landmark))
        ties += [
            Edge(one.node, len(nodes) - 1, one.T_node_landmark, one.covariance, EdgeKind.TAG, trusted=False)
            for one in visit
        ]
        # A visit without inliers still needs a pose.
        vague = NOWHERE_M**2 * np.eye(len(best.covariance))
        ties.append(Edge(best.node, len(nodes) - 1, best.T_node_landmark, vague, EdgeKind.TAG, trusted=True))
    graph = PoseGraph(poses[0])
    for node in nodes[1:]:
        graph.add_node(node)
    for edge in ties:
        graph.add_edge(edge)
    kept = graph.optimize().kept
    fits = iter(kept[[n for n, edge in enumerate(ties) if edge.kind is EdgeKind.TAG and not edge.trusted]])
    holds = [np.array([next(fits) for _ in visit]) for visit in visits]
    ties = [edge for edge, keep in zip(ties, kept, strict=True) if keep]
    return [graph.pose(node) for node in range(len(nodes))], ties, holds


def _still(
    nodes: list[Pose], edges: list[Edge], first: int, of: NDArray[np.int64], holds: Sequence[BoolArray]
) -> tuple[list[Pose], BoolArray]:
    """Return which visits agree on the pose of their landmark, and the resulting node poses.

    ``of`` (v,) is the landmark of each visit; after the ``first`` nodes follow visits, then landmarks.
    """
    still, sizes = np.ones(len(of), np.bool_), np.array([np.count_nonzero(fit) for fit in holds])
    dimension = len(edges[-1].covariance)
    # It is static, to the millimetre.
    same, nothing = (10 * SETTLED) ** 2 * np.eye(dimension), type(nodes[0])()
    while True:
        links = [
            Edge(first + visit, first + len(of) + of[visit], nothing, same, EdgeKind.TAG, trusted=True)
            for visit in range(len(of))
            if still[visit]
        ]
        values = solved(*held_graph(nodes, [*edges, *links]))
        nodes = [values.atPose2(n) if dimension == 3 else values.atPose3(n) for n in range(len(nodes))]
        among = np.bincount(of[still], minlength=int(of.max()) + 1)[of]
        asked = [n for n, link in enumerate(links) if among[link.source - first] > 1]
        if not asked:
            return nodes, still
        linear = LinearMap(nodes, [*edges, *links], np.ones(len(edges) + len(links), np.bool_))
        without = linear.left_out([len(edges) + n for n in asked])
        if without.max() ** 2 <= gate(dimension):
            return nodes, still
        worst = links[asked[int(without.argmax())]].source - first
        if among[worst] == 2:  # each contradicts the other
            worst = int(min(np.flatnonzero((of == of[worst]) & still), key=lambda visit: sizes[visit]))
        still[worst] = False


def _visits(sightings: Sequence[Sighting]) -> list[list[Sighting]]:
    """Group sightings by consecutive nodes."""
    visits = [[sightings[0]]]
    for sighting in sightings[1:]:
        if sighting.node - visits[-1][-1].node > 1:
            visits.append([])
        visits[-1].append(sighting)
    return visits


def _landmark_of(
    nodes: Sequence[Pose], landmark: Pose, sightings: Sequence[Sighting], holds: BoolArray, away: int
) -> Landmark:
    """Return a landmark relative to the node that saw it best."""
    inliers = [sighting for sighting, keep in zip(sightings, holds.tolist(), strict=True) if keep]
    best = min(inliers, key=_size)
    T_node_landmark = motion_between(nodes[best.node], landmark)
    together = np.linalg.inv(np.sum([np.linalg.inv(sighting.covariance) for sighting in inliers], axis=0))
    edges = []
    for sighting in inliers:
        if sighting.node == best.node:
            continue
        back = sighting.T_node_landmark.inverse()
        adjoint = sighting.T_node_landmark.AdjointMap()
        # All share the error of its pose: as independent errors, each is so many times as large.
        covariance = adjoint @ (sighting.covariance + len(inliers) * together) @ adjoint.T
        pose = composed(T_node_landmark, back)
        edges.append(Edge(best.node, sighting.node, pose, covariance, EdgeKind.TAG, trusted=False))
    return Landmark(best.node, T_node_landmark, together, holds, away, edges)


def in_plane(sightings: Sequence[Sighting]) -> tuple[list[Sighting], gtsam.Rot3]:
    """Return the sightings of a robot on a floor in 2D, and the tilt of the landmark: ``R_flat_landmark``."""
    best = min(sightings, key=_size)
    assert isinstance(best.T_node_landmark, gtsam.Pose3)
    lean = best.T_node_landmark.rotation()
    planar_sightings = []
    for sighting in sightings:
        pose = sighting.T_node_landmark
        assert isinstance(pose, gtsam.Pose3)
        turn = np.asarray(pose.rotation().matrix())
        yaw = pose.rotation().compose(lean.inverse()).yaw()
        flat = np.array([[math.cos(yaw), math.sin(yaw), 0.0], [-math.sin(yaw), math.cos(yaw), 0.0]])
        # Jacobian of x, y (axes of the flat landmark) and yaw by rotation and translation of the landmark.
        slopes = np.zeros((3, 6))
        slopes[:2, 3:], slopes[2, :3] = flat @ turn, turn[2]
        planar = gtsam.Pose2(pose.x(), pose.y(), yaw)
        planar_sightings.append(Sighting(sighting.node, planar, slopes @ sighting.covariance @ slopes.T))
    return planar_sightings, lean


def _size(one: Sighting) -> float:
    """Return a measure of the uncertainty of a sighting."""
    return float(np.trace(one.covariance))
