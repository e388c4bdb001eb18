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
    told, nothing = list[tuple[list[int], FloatArray, FloatArray]](), np.ones(1)

    def eliminate(
        factors: gtsam.GaussianFactorGraph, keys: gtsam.Ordering
    ) -> tuple[gtsam.GaussianConditional, gtsam.GaussianFactor]:
        clique, rest = gtsam.EliminateQR(factors, keys)
        # What these show is the clique's own memory.
        told.append((list(clique.keys()), clique.R().copy(), clique.S().copy()))
        # The tree would keep all the rows that were put together, fifteen times as many as these.
        return gtsam.GaussianConditional(0, nothing, np.diag(nothing)), rest

    graph, values = held_graph(poses, edges)
    linear = graph.linearize(values)
    del graph, values  # as large as what comes now
    give_back()
    linear.eliminateMultifrontal(None, eliminate)
    size = 3 if isinstance(poses[0], gtsam.Pose2) else 6
    found, above = np.empty((len(poses), size, size)), dict[int, int]()
    clique_of = {key: n for n, (keys, root, _) in enumerate(told) for key in keys[: len(root) // size]}
    below = defaultdict[int, list[int]](list)
    for n, (keys, root, _) in enumerate(told):
        # Of what it shares, the first that was eliminated is the clique's above.
        below[min((clique_of[key] for key in keys[len(root) // size :]), default=-1)].append(n)
    waiting = [(n, above, np.zeros((0, 0))) for n in below[-1]]
    while waiting:
        clique, above, known = waiting.pop()
        keys, root, shares = told[clique]
        inverse, own = np.linalg.inv(root), len(root)
        # R x + S y = noise, with y the nodes that the clique shares with the one above.
        first = np.array([above[key] for key in keys[own // size :]], np.int64)
        rows = (first[:, None] + range(size)).ravel()
        shared, gain = known[rows[:, None], rows], inverse @ shares
        across = gain @ shared
        joint = np.empty((own + len(shared), own + len(shared)))
        joint[:own, :own], joint[own:, own:] = inverse @ inverse.T + across @ gain.T, shared
        joint[:own, own:], joint[own:, :own] = -across, -across.T
        places = {key: size * place for place, key in enumerate(keys)}
        for key in keys[: own // size]:
            found[key] = joint[places[key] : places[key] + size, places[key] : places[key] + size]
        waiting += [(child, places, joint) for child in below[clique]]
    return found


def held_graph(
    poses: Sequence[Pose], edges: Iterable[Edge | gtsam.NonlinearFactor]
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """GTSAM's graph of some edges, or their factors, factor 0 holding node 0, and its values at the poses."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gauge(poses[0]))
    for edge in edges:
        graph.add(weighted(edge, 1.0) if isinstance(edge, Edge) else edge)
    for node, pose in enumerate(poses):
        values.insert(node, pose)
    return graph, values
