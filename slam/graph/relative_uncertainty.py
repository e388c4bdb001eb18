"""How uncertain is the pose of one node seen from all others: Dijkstra projection (Olson 2008, Sec. IV).

The least uncertain path of edges from a node bounds the relative covariance from above, without inverting
the graph. It tells loop closure where to look, and how far.
"""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.matching.planar import add_rotated, adjoint, between, rotate_covariance
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
        heads = self._heads[: self._count]
        arrived_by = _cheapest_paths(start, targets, heads, self._next, self._targets, self._costs)
        return _carry(start, targets, poses, arrived_by, self._sources, self._covariances)

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
def _cheapest_paths(start, targets, heads, following, ends, costs):  # type: ignore[no-untyped-def]
    """Dijkstra until all targets are reached: the edge by which each node is reached, -1 for none."""
    distance = np.full(heads.size, np.inf)
    done = np.zeros(heads.size, np.bool_)
    arrived_by = np.full(heads.size, -1, np.int64)
    wanted = np.zeros(heads.size, np.bool_)
    wanted[targets] = True
    missing = wanted.sum()
    distance[start] = 0.0
    queue = [(0.0, start)]
    while len(queue) > 0 and missing > 0:
        reached, node = heapq.heappop(queue)
        if done[node]:
            continue
        done[node] = True
        if wanted[node]:
            missing -= 1
        k = heads[node]
        while k >= 0:
            end = ends[k]
            if reached + costs[k] < distance[end]:
                distance[end] = reached + costs[k]
                arrived_by[end] = k
                heapq.heappush(queue, (distance[end], end))
            k = following[k]
    return arrived_by


@kernel
def _carry(start, targets, poses, arrived_by, sources, covariances):  # type: ignore[no-untyped-def]
    """Add up the covariances along the paths; a stretch that two paths share is added up once."""
    # Covariance of inverse(pose_start) * pose_k in frame k.
    carried = np.zeros((poses.shape[0], 3, 3))
    known = np.zeros(poses.shape[0], np.bool_)
    known[start] = True
    seen = np.full((targets.size, 3, 3), np.inf)
    path = np.empty(poses.shape[0], np.int64)
    for t in range(targets.size):
        node = targets[t]
        length = 0
        while not known[node] and arrived_by[node] >= 0:
            path[length] = node
            length += 1
            node = sources[arrived_by[node]]
        for n in range(length - 1, -1, -1):
            end = path[n]
            k = arrived_by[end]
            back = adjoint(between(poses[end], poses[sources[k]]))
            add_rotated(back, carried[sources[k]], carried[end])
            known[end] = True
            for i in range(3):
                for j in range(3):
                    carried[end, i, j] += covariances[k, i, j]
        if known[targets[t]]:
            turn = adjoint(between(poses[start], poses[targets[t]]))
            seen[t, :, :] = 0.0
            add_rotated(turn, carried[targets[t]], seen[t])
    return seen
