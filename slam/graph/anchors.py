"""Positions on the earth as edges of the pose graph, and the georeference of the map.

The earth is added to the graph as one more node; each measured position is an edge from it that gives no
heading. All are solved together. The position errors have Student's t distribution with three degrees of
freedom (Lange, Little and Taylor 1989), because walls reflect signals. Receivers also report covariances that
are too small; neighbouring fixes show by how much. Then the edges are expressed from node 0, which is fixed
in the map, so that they are like other edges: they may be rejected, are saved, and hold for edited or joined
maps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from fusion.estimation import ROUNDS, gate
from slam.graph.edge import Edge, EdgeKind
from slam.graph.factors import solved
from slam.graph.held_graph import held_graph, marginals
from slam.measurements import IN_PLANE, FloatArray, Pose, composed, motion_between, planar, spatial

_FREEDOM = 3.0
# Tolerance of the iteration, in whitened errors.
_SETTLED_SIGMAS = 0.01
# A map without gravity tilts by some degrees; the pose of the earth is unknown.
_LEANS_RAD, NOWHERE_M = 0.05, 1e5


@dataclass(frozen=True, slots=True)
class Anchor:
    """A position measured at a node.

    Attributes
    ----------
    place_m, covariance_m2
        (3,) and (3, 3) in east, north, up.
    arm_m
        (3,) the measured point, such as an antenna, in the node's frame.
    together
        Number of anchors with the same error, itself included: together they count as one.
    """

    node: int
    place_m: FloatArray
    covariance_m2: FloatArray
    arm_m: FloatArray
    together: float = 1.0


@dataclass(frozen=True, slots=True)
class Anchored:
    """A map aligned with its anchors.

    Attributes
    ----------
    T_enu_map
        Pose of the map; in 2D, its height is the median of the anchors' heights.
    edges
        Edges from node 0 to the nodes of the anchors that fit, without its own.
    from_earth
        The same edges from the earth, the node after the last, including those of node 0.
    scale
        Factor by which errors are larger than the stated sigmas; 1 if they are not.
    misfits
        Share of the anchors rejected.
    """

    T_enu_map: gtsam.Pose3
    edges: list[Edge]
    from_earth: list[Edge]
    scale: float
    misfits: float


def anchored(
    poses: Sequence[Pose], edges: Sequence[Edge], anchors: Sequence[Anchor], kind: EdgeKind = EdgeKind.GNSS
) -> Anchored | None:
    """Solve a graph with its anchors.

    Parameters
    ----------
    poses
        (n,) optimised poses of the nodes.
    edges
        That hold.
    kind
        Kind of the anchors; the stated sigmas of a receiver are checked against neighbouring fixes.

    Returns
    -------
    None if the path is no longer than the anchors' sigma: then they do not determine the heading.
    """
    axes = 3 if isinstance(poses[0], gtsam.Pose3) else 2
    places = np.array([anchor.place_m for anchor in anchors])
    spreads = np.array([anchor.covariance_m2[:axes, :axes] for anchor in anchors])
    variances = 0.5 * np.trace(spreads[:, :2, :2], axis1=1, axis2=2)
    far_m = np.linalg.norm(places[:, :2] - np.median(places[:, :2], axis=0), axis=1).max()
    if far_m <= _FREEDOM * math.sqrt(float(np.median(variances))):
        return None
    antennas = _seen(poses, anchors)
    T_map_enu = _laid(antennas, places, 1.0 / variances)
    nodes = [*poses, _like(poses[0], T_map_enu)]
    scale2 = _scale2(antennas, places, spreads, T_map_enu) if kind is EdgeKind.GNSS else 1.0
    held = [*edges, _upright(nodes)]
    together = np.array([anchor.together for anchor in anchors])
    weights, before = np.ones(len(anchors)), np.full(len(anchors), np.inf)
    for _ in range(ROUNDS):
        ties = _edges(nodes, len(poses), anchors, together * scale2 / weights, kind)
        values = solved(*held_graph(nodes, [*held, *ties]))
        nodes = [values.atPose3(n) if axes == 3 else values.atPose2(n) for n in range(len(nodes))]
        T_enu_map = spatial(nodes[-1]).inverse()
        offsets = np.array([T_enu_map.transformFrom(antennas) for antennas in _seen(nodes, anchors)]) - places
        if axes == 2:
            height_m = np.array([0.0, 0.0, -np.median(offsets[:, 2])])
            T_enu_map = gtsam.Pose3(T_enu_map.rotation(), T_enu_map.translation() + height_m)
        squares = np.einsum("ki,kij,kj->k", offsets[:, :axes], np.linalg.inv(spreads), offsets[:, :axes])
        squares /= scale2
        weights = (_FREEDOM + axes) / (_FREEDOM + squares)
        sigmas = np.sqrt(squares)
        if np.abs(sigmas - before).max() < _SETTLED_SIGMAS:
            break
        before = sigmas
    fits = squares <= gate(axes)
    ties, from_earth = (
        [
            edge
            for edge, fit in zip(_edges(nodes, source, anchors, together * scale2, kind), fits, strict=True)
            if fit and edge.target != source
        ]
        for source in (0, len(poses))
    )
    return Anchored(
        T_enu_map, ties, [_upright(nodes).turned(), *from_earth], math.sqrt(scale2), 1.0 - float(fits.mean())
    )


def seen_from_earth(poses: Sequence[Pose], edges: Sequence[Edge], solution: Anchored) -> FloatArray:
    """Return (n, d, d) covariance of each node with the earth fixed, in GTSAM's tangent of the node.

    ``edges`` are the inliers with their joint uncertainty; edges of the earth from node 0 are left out.
    """
    earth = _like(poses[0], solution.T_enu_map.inverse())
    kinds = {edge.kind for edge in solution.edges}
    turned = [
        replace(
            edge, source=(edge.source + 1) % (len(poses) + 1), target=(edge.target + 1) % (len(poses) + 1)
        )
        for edge in [*solution.from_earth, *(edge for edge in edges if edge.kind not in kinds)]
    ]
    return marginals([earth, *poses], turned)[1:]


def _scale2(seen_m: FloatArray, places_m: FloatArray, spreads: FloatArray, T_map_enu: gtsam.Pose3) -> float:
    """Return the factor of the squared errors over the stated ones, from anchors and their neighbours' mean.

    The drift of a path is nearly the same at three consecutive positions.
    """
    off_m = np.array([T_map_enu.transformFrom(place) for place in places_m])[:, :2] - seen_m[:, :2]
    apart_m = off_m[1:-1] - 0.5 * (off_m[:-2] + off_m[2:])
    turn = np.asarray(T_map_enu.rotation().matrix())[:2, :2]
    within = turn @ spreads[:, :2, :2] @ turn.T
    within = within[1:-1] + 0.25 * (within[:-2] + within[2:])
    squares = np.einsum("ki,kij,kj->k", apart_m, np.linalg.inv(within), apart_m)
    return max(1.0, float(np.median(squares)) / gate(2, 0.5))


def with_earth(poses: Sequence[Pose], edges: Sequence[Edge]) -> tuple[list[Pose], list[Edge]]:
    """Return a graph, and the earth as one more node for each node from which edges of anchors start.

    These edges share the error of the earth's pose, which depends on the whole graph.
    """
    nodes, joined, earths = [*poses], list[Edge](), dict[tuple[int, str], int]()
    for edge in edges:
        if edge.kind in (EdgeKind.GNSS, EdgeKind.SURVEY):
            key, source = (edge.source, edge.kind), poses[edge.source]
            if key not in earths:
                earths[key] = len(nodes)
                nodes.append(_like(source, gtsam.Pose3(gtsam.Rot3(), spatial(source).translation())))
                joined.append(_upright(nodes, edge.source))
            T_earth_source = motion_between(nodes[earths[key]], source)
            T_earth_target = composed(T_earth_source, edge.T_source_target)
            edge = replace(edge, source=earths[key], T_source_target=T_earth_target)
        joined.append(edge)
    return nodes, joined


def _seen(poses: Sequence[Pose], anchors: Sequence[Anchor]) -> FloatArray:
    """Return (k, 3) the measured points of the anchors in the map."""
    return np.array([spatial(poses[anchor.node]).transformFrom(anchor.arm_m) for anchor in anchors])


def _laid(seen_m: FloatArray, places_m: FloatArray, weights: FloatArray) -> gtsam.Pose3:
    """Return the upright ``T_map_enu`` that aligns positions (k, 3) with the map; Umeyama 1991, in 2D."""
    middles = [np.average(points, axis=0, weights=weights) for points in (seen_m, places_m)]
    (x, y), (east, north) = (
        (points - middle)[:, :2].T for points, middle in zip((seen_m, places_m), middles, strict=True)
    )
    turn = gtsam.Rot3.Yaw(math.atan2(weights @ (east * y - north * x), weights @ (east * x + north * y)))
    return gtsam.Pose3(turn, middles[0] - np.asarray(turn.rotate(middles[1])))


def _upright(nodes: Sequence[Pose], source: int = 0) -> Edge:
    """Return an edge from a node to the earth, the last node: it only limits the tilt of the map."""
    nothing, leans = NOWHERE_M**2, _LEANS_RAD**2
    planar = isinstance(nodes[0], gtsam.Pose2)
    variances = [nothing, nothing, math.pi**2] if planar else [leans, leans, math.pi**2, *[nothing] * 3]
    motion = motion_between(nodes[source], nodes[-1])
    return Edge(source, len(nodes) - 1, motion, np.diag(variances), EdgeKind.GNSS, trusted=True)


def _edges(
    nodes: Sequence[Pose], source: int, anchors: Sequence[Anchor], scales: FloatArray, kind: EdgeKind
) -> list[Edge]:
    """Return an edge for each anchor, from its node to the earth, the last node: position without heading.

    ``scales`` (k,) are factors of the covariances.
    """
    earth, edges = nodes[-1], list[Edge]()
    T_source_earth = spatial(motion_between(nodes[source], earth))
    for anchor, scale in zip(anchors, scales.tolist(), strict=True):
        turn = spatial(motion_between(earth, nodes[anchor.node])).rotation()
        place = gtsam.Pose3(turn, anchor.place_m - np.asarray(turn.rotate(anchor.arm_m)))
        axes = np.asarray(turn.matrix())
        pose = _like(earth, T_source_earth.compose(place))
        covariance = np.full(6, math.pi**2) * np.eye(6)
        if isinstance(pose, gtsam.Pose2):
            covariance[:2, :2] = 0.0
        covariance[3:, 3:] = scale * axes.T @ anchor.covariance_m2 @ axes
        # The rotation is about the measured point, not about the node.
        adjoint = gtsam.Pose3(gtsam.Rot3(), anchor.arm_m).AdjointMap()
        covariance = adjoint @ covariance @ adjoint.T
        if isinstance(pose, gtsam.Pose2):
            covariance = covariance[np.ix_(IN_PLANE, IN_PLANE)]
        edges.append(Edge(source, anchor.node, pose, covariance, kind, trusted=False))
    return edges


def _like(pose: Pose, other: gtsam.Pose3) -> Pose:
    """Return a pose projected onto the plane, if the first one is planar."""
    if isinstance(pose, gtsam.Pose3):
        return other
    return planar(other)
