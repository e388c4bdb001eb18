"""How uncertain is the pose of one node seen from all others: Dijkstra projection (Olson 2008, Sec. IV).

The least uncertain path of edges from a node bounds the relative covariance from above, without inverting
the graph. It tells loop closure where to look, and how far.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import ONE, ZERO, kernel
from slam.matching.planar import adjoint, rotate_covariance
from slam.measurements import FloatArray

# A yaw error is worth its lever arm: how far from a node its surroundings are matched.
_LEVER_M = 5.0


class UncertaintyGraph:
    """Growing adjacency of a planar pose graph, for relative covariances."""

    def __init__(self) -> None:
        self._count = 0
        self._heads = np.full(64, -1, np.int64)
        self._next = np.full(256, -1, np.int64)
        self._targets = np.zeros(256, np.int64)
        self._sources = np.zeros(256, np.int64)
        self._costs = np.zeros(256)
        self._covariances = np.zeros((256, 3, 3))
        self._edges = 0

    def add_node(self) -> None:
        """Add the next node."""
        self._count += 1
        if self._count > self._heads.size:
            self._heads = np.concatenate([self._heads, np.full_like(self._heads, -1)])

    def add_edge(self, source: int, target: int, relative: FloatArray, covariance: FloatArray) -> None:
        """Join two nodes; ``relative`` (3,) and ``covariance`` (3, 3) as in ``pose_graph.Edge``."""
        cost = float(covariance[0, 0] + covariance[1, 1] + _LEVER_M**2 * covariance[2, 2])
        self._append(source, target, cost, covariance)
        self._append(target, source, cost, rotate_covariance(adjoint(relative), covariance))

    def relative_covariances(self, start: int, targets: NDArray[np.int64], poses: FloatArray) -> FloatArray:
        """Covariance of ``inverse(pose_target) * pose_start`` in the start's frame, one a target.

        Parameters
        ----------
        start
            The node that is seen.
        targets
            (m,) the nodes that see it.
        poses
            (n, 3) current estimates, map frame.

        Returns
        -------
        (m, 3, 3); infinite where no path leads.
        """
        distance = np.full(self._count, np.inf)
        arrived_by = np.full(self._count, -1)
        wanted = np.zeros(self._count, np.bool_)
        wanted[targets] = True
        # Every edge is put into the queue once at most, from its source.
        queue = np.empty(self._edges + 1), np.empty(self._edges + 1, np.int64)
        _cheapest_paths(
            start, wanted, self._heads, self._next, self._targets, self._costs, distance, arrived_by, *queue
        )
        carried = np.zeros((self._count + len(targets), 3, 3))
        scratch = np.zeros(self._count, np.bool_), np.empty(self._count, np.int64), np.eye(3)
        _carry(start, targets, poses, arrived_by, self._sources, self._covariances, carried, *scratch)
        seen = carried[self._count :]
        seen[np.isinf(distance[targets])] = np.inf
        return seen

    def _append(self, source: int, target: int, cost: float, covariance: FloatArray) -> None:
        """One direction of an edge, covariance in the target's frame."""
        k = self._edges
        if k == self._next.size:
            self._next = np.concatenate([self._next, np.full_like(self._next, -1)])
            self._targets = np.concatenate([self._targets, np.zeros_like(self._targets)])
            self._sources = np.concatenate([self._sources, np.zeros_like(self._sources)])
            self._costs = np.concatenate([self._costs, np.zeros_like(self._costs)])
            self._covariances = np.concatenate([self._covariances, np.zeros_like(self._covariances)])
        self._next[k] = self._heads[source]
        self._heads[source] = k
        self._targets[k] = target
        self._sources[k] = source
        self._costs[k] = cost
        self._covariances[k] = covariance
        self._edges += 1


@kernel
def _cheapest_paths(  # type: ignore[no-untyped-def]
    start, wanted, heads, following, ends, costs, distance, arrived_by, queued, queued_nodes
):
    """Dijkstra until all wanted nodes are reached: the edge by which each node is reached, -1 for none.

    The queue is a binary heap of two arrays: numba takes half a second for the one of a list.
    """
    missing = ZERO
    for node in range(wanted.size):
        missing += wanted[node]
    distance[start] = 0.0
    queued[0] = 0.0
    queued_nodes[0] = start
    length = ONE
    while length > 0 and missing > 0:
        reached = queued[0]
        node = queued_nodes[0]
        # The last of the queue sinks from its top.
        length -= 1
        last = queued[length]
        last_node = queued_nodes[length]
        at = ZERO
        child = ONE
        while child < length:
            right = child + 1
            if right < length and _sooner(
                queued[right], queued_nodes[right], queued[child], queued_nodes[child]
            ):
                child = right
            if not _sooner(queued[child], queued_nodes[child], last, last_node):
                break
            queued[at] = queued[child]
            queued_nodes[at] = queued_nodes[child]
            at = child
            child = 2 * at + 1
        queued[at] = last
        queued_nodes[at] = last_node
        # Put in once more, at less cost, and done with since.
        if reached > distance[node]:
            continue
        if wanted[node]:
            missing -= 1
        k = heads[node]
        while k >= 0:
            end = ends[k]
            cost = reached + costs[k]
            if cost < distance[end]:
                distance[end] = cost
                arrived_by[end] = k
                at = length
                length += 1
                while at > 0:
                    above = (at - 1) >> 1
                    if not _sooner(cost, end, queued[above], queued_nodes[above]):
                        break
                    queued[at] = queued[above]
                    queued_nodes[at] = queued_nodes[above]
                    at = above
                queued[at] = cost
                queued_nodes[at] = end
            k = following[k]


@kernel(inline="always")
def _sooner(cost, node, other_cost, other_node):  # type: ignore[no-untyped-def]
    """Which of two nodes the queue gives first."""
    return cost < other_cost or (cost == other_cost and node < other_node)


@kernel
def _carry(  # type: ignore[no-untyped-def]
    start, targets, poses, arrived_by, sources, covariances, carried, known, path, turn
):
    """Add up the covariances along the paths; a stretch that two paths share is added up once.

    Row k of ``carried`` is the covariance of inverse(pose_start) * pose_k in frame k; the rows after those of
    the nodes are those of the targets, in the start's frame.
    """
    count = poses.shape[0]
    known[start] = True
    for t in range(targets.size):
        node = targets[t]
        length = ZERO
        while not known[node] and arrived_by[node] >= 0:
            path[length] = node
            length += 1
            node = sources[arrived_by[node]]
        # Outwards to the target; last, what the start sees of it.
        for n in range(length - 1, -2, -1):
            here, there, into = start, targets[t], count + t
            k = -1
            if n >= 0:
                here = into = path[n]
                k = arrived_by[here]
                there = sources[k]
                known[here] = True
            cos = math.cos(poses[here, 2])
            sin = math.sin(poses[here, 2])
            dx = poses[there, 0] - poses[here, 0]
            dy = poses[there, 1] - poses[here, 1]
            yaw = poses[there, 2] - poses[here, 2]
            yaw -= 2.0 * math.pi * math.floor((yaw + math.pi) / (2.0 * math.pi))
            turn[0, 0] = turn[1, 1] = math.cos(yaw)
            turn[1, 0] = math.sin(yaw)
            turn[0, 1] = -math.sin(yaw)
            turn[0, 2] = -sin * dx + cos * dy
            turn[1, 2] = -(cos * dx + sin * dy)
            for i in range(3):
                for j in range(3):
                    total = carried[into, i, j]
                    for a in range(3):
                        for b in range(3):
                            total += turn[i, a] * carried[there, a, b] * turn[j, b]
                    carried[into, i, j] = total + covariances[k, i, j] if k >= 0 else total
