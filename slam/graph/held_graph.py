"""A graph as it stands, its first node held: for covariances, and for what one edge does to the others."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from slam.graph.edge import Edge
from slam.graph.factors import between_factor, gauge
from slam.measurements import FloatArray, Pose


def marginals(poses: Sequence[Pose], edges: Iterable[Edge], most_kept: int = 2000) -> FloatArray:
    """Covariance of every node where node 0 is held, by QR: what is long and stiff loses no digits.

    Parameters
    ----------
    poses
        (n,) estimates, at which the edges are linearised.
    edges
        That hold all of them together.
    most_kept
        Of what GTSAM keeps of one node for the next: so many, for they grow with the map and its loops.

    Returns
    -------
    (n, d, d), GTSAM's tangent of each pose.
    """
    graph, values = held_graph(poses, edges)
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    solver = gtsam.ISAM2(parameters)
    solver.update(graph, values)
    found = []
    for node in range(len(poses)):
        found.append(solver.marginalCovariance(node))
        if solver.numCachedSeparatorMarginals() > most_kept:
            solver.deleteCachedShortcuts()
    return np.array(found)


def held_graph(
    poses: Sequence[Pose], edges: Iterable[Edge]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """GTSAM's graph of some edges, factor 0 holding node 0, and its values at the poses."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gauge(poses[0]))
    for edge in edges:
        graph.add(between_factor(edge, gtsam.noiseModel.Gaussian.Covariance(edge.covariance)))
    for node, pose in enumerate(poses):
        values.insert(node, pose)
    return graph, values
