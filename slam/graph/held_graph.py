"""A solved graph with its first node fixed: for covariances, and for the effect of one edge on the others."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from slam.graph.edge import Edge
from slam.graph.factors import gauge, weighted
from slam.heap import give_back
from slam.measurements import FloatArray, Pose


def marginals(poses: Sequence[Pose], edges: Iterable[Edge]) -> FloatArray:
    """Return the covariance of every node with node 0 fixed, by QR, accurate for long stiff chains.

    Each clique of the Bayes tree conditions its nodes on those of its parent, so that one pass from the root
    gives the covariance of all nodes that share a clique (Takahashi, Fagan and Chin 1973, by blocks).

    Parameters
    ----------
    poses
        (n,) estimates, at which the edges are linearised.
    edges
        Edges that connect all nodes.

    Returns
    -------
    (n, d, d), GTSAM's tangent of each pose.
    """
    cliques, nothing = list[tuple[list[int], FloatArray, FloatArray]](), np.ones(1)

    def eliminate(
        factors: gtsam.GaussianFactorGraph, keys: gtsam.Ordering
    ) -> tuple[gtsam.GaussianConditional, gtsam.GaussianFactor]:
        clique, rest = gtsam.EliminateQR(factors, keys)
        # These are views of the clique's own memory.
        cliques.append((list(clique.keys()), clique.R().copy(), clique.S().copy()))
        # The tree would keep all the rows that were assembled, fifteen times as many as these.
        return gtsam.GaussianConditional(0, nothing, np.diag(nothing)), rest

    graph, values = held_graph(poses, edges)
    linear = graph.linearize(values)
    del graph, values  # as large as the following
    give_back()
    linear.eliminateMultifrontal(None, eliminate)
    size = 3 if isinstance(poses[0], gtsam.Pose2) else 6
    covariances, above = np.empty((len(poses), size, size)), dict[int, int]()
    clique_of = {key: n for n, (keys, root, _) in enumerate(cliques) for key in keys[: len(root) // size]}
    below = defaultdict[int, list[int]](list)
    for n, (keys, root, _) in enumerate(cliques):
        # Of the separator, the node eliminated first belongs to the parent clique.
        below[min((clique_of[key] for key in keys[len(root) // size :]), default=-1)].append(n)
    waiting = [(n, above, np.zeros((0, 0))) for n in below[-1]]
    while waiting:
        clique, above, known = waiting.pop()
        keys, root, shares = cliques[clique]
        inverse, own = np.linalg.inv(root), len(root)
        # R x + S y = noise, with y the separator to the parent clique.
        first = np.array([above[key] for key in keys[own // size :]], np.int64)
        rows = (first[:, None] + range(size)).ravel()
        shared, gain = known[rows[:, None], rows], inverse @ shares
        across = gain @ shared
        joint = np.empty((own + len(shared), own + len(shared)))
        joint[:own, :own], joint[own:, own:] = inverse @ inverse.T + across @ gain.T, shared
        joint[:own, own:], joint[own:, :own] = -across, -across.T
        places = {key: size * place for place, key in enumerate(keys)}
        for key in keys[: own // size]:
            covariances[key] = joint[places[key] : places[key] + size, places[key] : places[key] + size]
        waiting += [(child, places, joint) for child in below[clique]]
    return covariances


def held_graph(
    poses: Sequence[Pose], edges: Iterable[Edge | gtsam.NonlinearFactor]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Return GTSAM's graph of edges or their factors, with node 0 fixed by factor 0, and the values."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gauge(poses[0]))
    for edge in edges:
        graph.add(weighted(edge, 1.0) if isinstance(edge, Edge) else edge)
    for node, pose in enumerate(poses):
        values.insert(node, pose)
    return graph, values
