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
        seen = np.zeros((self._count, 6))
        wanted = np.zeros(self._count, np.bool_)
        wanted[targets] = True
        edges = self._targets, self._costs, self._covariances.reshape(-1, 9)
        # An edge is put into the queue once at most, from its source.
        queue = np.empty(self._edges + 1), np.empty(self._edges + 1, np.int64)
        _follow(start, wanted, poses, self._heads, self._next, *edges, distance, seen, *queue)
        seen[np.isinf(distance)] = np.inf
        # Where the nine elements of a symmetric matrix are in its upper triangle.
        return seen[targets][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)

    def _append(self, source: int, target: int, cost: float, covariance: FloatArray) -> None:
        """One direction of an edge, covariance in the target's frame."""
        k = self._edges
        if k == self._next.size:
            self._next = np.concatenate([self._next, np.full_like(self._next, -1)])
            self._targets = np.concatenate([self._targets, np.zeros_like(self._targets)])
            self._costs = np.concatenate([self._costs, np.zeros_like(self._costs)])
            self._covariances = np.concatenate([self._covariances, np.zeros_like(self._covariances)])
        self._next[k] = self._heads[source]
        self._heads[source] = k
        self._targets[k] = target
        self._costs[k] = cost
        self._covariances[k] = covariance
        self._edges += 1


@kernel
def _follow(  # type: ignore[no-untyped-def]
    start, wanted, poses, heads, following, ends, costs, covariances, distance, seen, queued, queued_nodes
):
    """Dijkstra until all wanted nodes are reached; what is reached is seen by the sum of its path's edges.

    ``seen`` (n, 6) becomes the upper triangles of the covariances in the start's frame. The queue is a binary
    heap of two arrays: that of a list compiles half a second longer.
    """
    missing = ZERO
    for node in range(wanted.size):
        missing += wanted[node]
    cos = math.cos(poses[start, 2])
    sin = math.sin(poses[start, 2])
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
        missing -= wanted[node]
        k = heads[node]
        while k >= 0:
            end = ends[k]
            cost = reached + costs[k]
            if cost < distance[end]:
                distance[end] = cost
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
                # Ad C Ad^T by the end's pose in the start's frame.
                dx = poses[end, 0] - poses[start, 0]
                dy = poses[end, 1] - poses[start, 1]
                x = cos * dx + sin * dy
                y = cos * dy - sin * dx
                yaw = poses[end, 2] - poses[start, 2]
                c = math.cos(yaw)
                s = math.sin(yaw)
                tt = covariances[k, 8]
                xt = c * covariances[k, 2] - s * covariances[k, 5]
                yt = s * covariances[k, 2] + c * covariances[k, 5]
                xx = c * covariances[k, 0] - s * covariances[k, 1]
                xy = c * covariances[k, 1] - s * covariances[k, 4]
                yx = s * covariances[k, 0] + c * covariances[k, 1]
                yy = s * covariances[k, 1] + c * covariances[k, 4]
                seen[end, 0] = seen[node, 0] + c * xx - s * xy + y * (2.0 * xt + y * tt)
                seen[end, 1] = seen[node, 1] + s * xx + c * xy + y * yt - x * (xt + y * tt)
                seen[end, 2] = seen[node, 2] + xt + y * tt
                seen[end, 3] = seen[node, 3] + s * yx + c * yy - x * (2.0 * yt - x * tt)
                seen[end, 4] = seen[node, 4] + yt - x * tt
                seen[end, 5] = seen[node, 5] + tt
            k = following[k]


@kernel(inline="always")
def _sooner(cost, node, other_cost, other_node):  # type: ignore[no-untyped-def]
    """Which of two nodes the queue gives first."""
    return cost < other_cost or (cost == other_cost and node < other_node)
