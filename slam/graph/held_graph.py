"""A graph as it stands, its first node held: for covariances, and for what one edge does to the others."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from slam.graph.edge import Edge
from slam.graph.factors import between_factor, gauge
from slam.measurements import FloatArray, Pose


def marginals(poses: Sequence[Pose], edges: Iterable[Edge]) -> FloatArray:
    """Covariance of every node where node 0 is held, by QR: what is long and stiff loses no digits.

    Each clique of the Bayes tree tells its nodes by those of the clique above, so that one pass from the
    root gives the covariance of all that share a clique (Takahashi, Fagan and Chin 1973, by blocks).

    Parameters
    ----------
    poses
        (n,) estimates, at which the edges are linearised.
    edges
        That hold all of them together.

    Returns
    -------
    (n, d, d), GTSAM's tangent of each pose.
    """
    graph, values = held_graph(poses, edges)
    tree = graph.linearize(values).eliminateMultifrontal(None, gtsam.EliminateQR)
    size = 3 if isinstance(poses[0], gtsam.Pose2) else 6
    found, above = np.empty((len(poses), size, size)), dict[int, int]()
    waiting = [(root, above, np.zeros((0, 0))) for root in tree.roots()]
    while waiting:
        clique, above, known = waiting.pop()
        told = clique.conditional()
        keys, inverse = list(told.keys()), np.linalg.inv(told.R())
        own = len(inverse)
        # R x + S y = noise, with y the nodes that the clique shares with the one above.
        rows = (
            np.array([above[key] for key in keys[own // size :]], np.int64)[:, None] + range(size)
        ).ravel()
        shared, gain = known[np.ix_(rows, rows)], inverse @ told.S()
        across = gain @ shared
        joint = np.block([[inverse @ inverse.T + across @ gain.T, -across], [-across.T, shared]])
        places = {key: size * place for place, key in enumerate(keys)}
        for key in keys[: own // size]:
            found[key] = joint[places[key] : places[key] + size, places[key] : places[key] + size]
        waiting += [(clique[child], places, joint) for child in range(clique.nrChildren())]
    return found


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
