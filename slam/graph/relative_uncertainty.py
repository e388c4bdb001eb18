"""Relative covariance of one node to all others: Dijkstra projection (Olson 2008, Sec. IV).

The least uncertain path of edges from a node is an upper bound of the relative covariance, without inverting
the graph. Loop closure uses it to decide where to search, and how far. Every few consecutive nodes share an
anchor, more in a longer log. Paths lead from anchor to anchor, so a search costs the same in large maps.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.kernel import ONE, ZERO, kernel
from slam.matching.motion import Motion
from slam.matching.planar import between
from slam.measurements import FloatArray

# Lever arm of a yaw error: the distance from a node over which its surroundings are matched.
_LEVER_M = 5.0
# Limit of the nodes visited by a search; with more anchors, every second one is removed.
_MOST_ANCHORS = 4096


# An uncertain motion is a row: pose of its end in the frame of its start (3), its covariance in the end's
# frame (9), and the cost by which paths are compared (1).
_POSE, _COVARIANCE, _COST = slice(3), slice(3, 12), 12


class UncertaintyGraph:
    """Growing adjacency of a planar pose graph, for relative covariances."""

    def __init__(self) -> None:
        self._count = 0
        # Number of nodes per anchor, and motion from its anchor to each node.
        self._stride = 1
        self._inside = np.zeros((64, 13))
        self._ends = np.zeros((256, 2), np.int64)
        self._steps = np.zeros((256, 13))
        self._edges = 0
        self._heads = np.full(64, -1, np.int64)
        self._next = np.full(256, -1, np.int64)
        # For each edge, the first and last part of the path that it crosses and that may be left out.
        self._parts = np.full((256, 2), -1, np.int64)

    def add_node(self) -> None:
        """Add the next node."""
        node = self._count
        self._count += 1
        if self._count > len(self._inside):
            self._inside = np.concatenate([self._inside, np.zeros_like(self._inside)])
        # Until an edge connects it to its anchor.
        self._inside[node, _COST] = math.inf if node % self._stride else 0.0
        if node // self._stride == _MOST_ANCHORS:
            self._thin()
        if node // self._stride >= self._heads.size:
            self._heads = np.concatenate([self._heads, np.full_like(self._heads, -1)])

    def add_edge(
        self,
        source: int,
        target: int,
        relative: FloatArray,
        covariance: FloatArray,
        parts: tuple[int, int] = (-1, -1),
    ) -> None:
        """Join two nodes; ``relative`` (3,) and ``covariance`` (3, 3) as in ``pose_graph.Edge``.

        Edges that cross a part, from the first of their ``parts`` to the last, can be left out of a search.
        """
        cost = covariance[0, 0] + covariance[1, 1] + _LEVER_M**2 * covariance[2, 2]
        step = np.concatenate([relative, covariance.ravel(), [cost]])[None]
        # Anchors themselves, in small maps all nodes, need no motion.
        if self._inside[source, _COST]:
            step = _then(self._inside[[source]], step)
        if source // self._stride == target // self._stride:
            if step[0, _COST] < self._inside[target, _COST]:
                self._inside[target] = step[0]
            return
        if self._inside[target, _COST]:
            step = _then(step, _back(self._inside[[target]]))
        if np.isfinite(step[0, _COST]):
            ends = source // self._stride, target // self._stride
            self._append(ends, step[0], parts)
            self._append(ends[::-1], _back(step)[0], parts)

    def add_edges(
        self,
        ends: NDArray[np.int64],
        relatives: FloatArray,
        covariances: FloatArray,
        parts: NDArray[np.int64],
    ) -> None:
        """Join pairs of nodes (M, 2) of a graph without edges; see `add_edge`."""
        if self._stride > 1 or not len(ends):
            for n, (source, target) in enumerate(ends.tolist()):
                crossed = int(parts[n, 0]), int(parts[n, 1])
                self.add_edge(source, target, relatives[n], covariances[n], crossed)
            return
        costs = covariances[:, 0, 0] + covariances[:, 1, 1] + _LEVER_M**2 * covariances[:, 2, 2]
        steps = np.column_stack([relatives, covariances.reshape(-1, 9), costs])
        self._steps = np.stack([steps, _back(steps)], axis=1).reshape(-1, 13)
        self._ends = np.stack([ends, ends[:, ::-1]], axis=1).reshape(-1, 2)
        self._parts, self._edges = np.repeat(parts, 2, axis=0), len(self._ends)
        self._next = np.full(self._edges, -1)
        order = np.argsort(self._ends[:, 0], kind="stable")
        sources = self._ends[order, 0]
        same = sources[1:] == sources[:-1]
        self._next[order[1:][same]] = order[:-1][same]
        last = np.append(~same, True)
        self._heads[sources[last]] = order[last]

    def motion(self, start: int, end: int, poses: FloatArray) -> Motion:
        """Return the pose of a node relative to another; the covariance is infinite without a path."""
        covariance = self.relative_covariances(end, np.array([start]), poses)[0]
        return Motion(between(poses[start], poses[end]), covariance)

    def relative_covariances(
        self, start: int, targets: NDArray[np.int64], poses: FloatArray, without: int = -2
    ) -> FloatArray:
        """Return covariances of ``inverse(pose_target) * pose_start`` in the start's frame, one per target.

        Parameters
        ----------
        targets
            (m,) the target nodes.
        poses
            (n, 3) current estimates, map frame.
        without
            The part whose edges no path may take.

        Returns
        -------
        (m, 3, 3); infinite if there is no path.
        """
        anchors = np.ascontiguousarray(poses[: self._count : self._stride])
        distance = np.full(len(anchors), np.inf)
        seen = np.zeros((len(anchors), 6))
        target = np.zeros(len(anchors), np.bool_)
        target[targets // self._stride] = True
        # An edge enters the queue at most once, from its source.
        queue = np.empty(self._edges + 1), np.empty(self._edges + 1, np.int64)
        first = start // self._stride
        edges = self._heads, self._next, self._ends, self._steps, self._parts
        _follow(first, target, anchors, *edges, without, distance, seen, *queue)
        # Index of the nine elements of a symmetric matrix in its upper triangle.
        anchor = targets // self._stride
        rows, cost = seen[anchor][:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3), distance[anchor]
        if self._stride > 1:
            own, others = self._inside[[start]], self._inside[targets]
            away = composed(inverse(poses[[start]]), poses[targets])
            rows = moved(rows, inverse(own[:, _POSE])) + _covariance(own) + moved(_covariance(others), away)
            cost = cost + own[:, _COST] + others[:, _COST]
        rows[targets == start] = 0.0
        rows[np.isinf(cost)] = np.inf
        return rows

    def _append(self, ends: tuple[int, int], step: FloatArray, parts: tuple[int, int]) -> None:
        """Append one direction of an edge between two anchors."""
        k = self._edges
        if k == self._next.size:
            self._next = np.concatenate([self._next, np.full_like(self._next, -1)])
            self._parts = np.concatenate([self._parts, np.full_like(self._parts, -1)])
            self._ends = np.concatenate([self._ends, np.zeros_like(self._ends)])
            self._steps = np.concatenate([self._steps, np.zeros_like(self._steps)])
        self._next[k] = self._heads[ends[0]]
        self._heads[ends[0]] = k
        self._ends[k], self._parts[k] = ends, parts
        self._steps[k] = step
        self._edges += 1

    def _thin(self) -> None:
        """Remove every second anchor; its edges go through the one before."""
        ends, steps = self._ends[: self._edges], self._steps[: self._edges]
        parts = self._parts[: self._edges].copy()
        order = np.argsort(steps[:, _COST], kind="stable")
        # From each remaining anchor to the next one: by the edge of least cost.
        aside = np.zeros((2 * (_MOST_ANCHORS // 2 + 1), 13))
        aside[1::2, _COST] = np.inf
        for k in order[(ends[order, 1] - ends[order, 0] == 1) & (ends[order, 1] % 2 == 1)][::-1]:
            aside[ends[k, 1]] = steps[k]
        anchors = np.arange(self._count) // self._stride
        self._inside[: self._count] = _then(aside[anchors], self._inside[: self._count])
        steps = _then(_then(aside[ends[:, 0]], steps), _back(aside[ends[:, 1]]))
        self._stride *= 2
        ends = ends // 2
        order = np.argsort(steps[:, _COST], kind="stable")
        order = order[(ends[order, 0] != ends[order, 1]) & np.isfinite(steps[order, _COST])]
        # The least uncertain of the edges between the same two.
        _, first = np.unique(ends[order], axis=0, return_index=True)
        kept = order[first]
        self._edges = 0
        self._heads[:] = -1
        for pair, k in zip(ends[kept].tolist(), kept, strict=True):
            self._append(pair, steps[k], (int(parts[k, 0]), int(parts[k, 1])))


def _then(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return (N, 13) the composition of motions."""
    joined = np.empty_like(b)
    _join(a, b, joined)
    return joined


def _back(a: FloatArray) -> FloatArray:
    """Return (N, 13) the inverse motions."""
    back = np.empty_like(a)
    _turn_round(a, back)
    return back


@kernel
def _join(a, b, joined):  # type: ignore[no-untyped-def]
    """Write the composition of motions (N, 13)."""
    for n in range(a.shape[0]):
        cos, sin = math.cos(a[n, 2]), math.sin(a[n, 2])
        joined[n, 0] = a[n, 0] + cos * b[n, 0] - sin * b[n, 1]
        joined[n, 1] = a[n, 1] + sin * b[n, 0] + cos * b[n, 1]
        joined[n, 2] = a[n, 2] + b[n, 2]
        joined[n, 12] = a[n, 12] + b[n, 12]
        # The covariance of the first in the frame of the end of the second.
        cos, sin = math.cos(b[n, 2]), math.sin(b[n, 2])
        _move(a, n, -cos * b[n, 0] - sin * b[n, 1], sin * b[n, 0] - cos * b[n, 1], cos, -sin, joined)
        for k in range(3, 12):
            joined[n, k] += b[n, k]


@kernel
def _turn_round(a, back):  # type: ignore[no-untyped-def]
    """Write the inverse of motions (N, 13)."""
    for n in range(a.shape[0]):
        x, y, cos, sin = a[n, 0], a[n, 1], math.cos(a[n, 2]), math.sin(a[n, 2])
        back[n, 0] = -cos * x - sin * y
        back[n, 1] = sin * x - cos * y
        back[n, 2] = -a[n, 2]
        back[n, 12] = a[n, 12]
        _move(a, n, x, y, cos, sin, back)


@kernel
def _move(a, n, x, y, cos, sin, moved):  # type: ignore[no-untyped-def]
    """Write the covariance of a motion (13,) transformed by a pose: Ad C Ad^T, see `moved`."""
    for column in range(3, 6):
        xx, yy, tt = a[n, column], a[n, column + 3], a[n, column + 6]
        moved[n, column + 6] = tt
        moved[n, column] = cos * xx - sin * yy + y * tt
        moved[n, column + 3] = sin * xx + cos * yy - x * tt
    for row in range(3, 12, 3):
        xx, yy, tt = moved[n, row], moved[n, row + 1], moved[n, row + 2]
        moved[n, row] = cos * xx - sin * yy + y * tt
        moved[n, row + 1] = sin * xx + cos * yy - x * tt


def _covariance(a: FloatArray) -> FloatArray:
    """Return (N, 3, 3) covariances of motions."""
    return a[:, _COVARIANCE].reshape(-1, 3, 3)


def composed(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return (N, 3) the composition of poses, with broadcasting."""
    cos, sin = np.cos(a[:, 2]), np.sin(a[:, 2])
    x = a[:, 0] + cos * b[:, 0] - sin * b[:, 1]
    y = a[:, 1] + sin * b[:, 0] + cos * b[:, 1]
    return np.stack([x, y, a[:, 2] + b[:, 2]], axis=1)


def inverse(a: FloatArray) -> FloatArray:
    """Return (N, 3) the inverse poses."""
    cos, sin = np.cos(a[:, 2]), np.sin(a[:, 2])
    return np.stack([-cos * a[:, 0] - sin * a[:, 1], sin * a[:, 0] - cos * a[:, 1], -a[:, 2]], axis=1)


def seen_from(origins: FloatArray, poses: FloatArray) -> FloatArray:
    """Return (K, 3) the found poses in the frames of the given ones."""
    offsets = composed(inverse(origins), poses)
    offsets[:, 2] = np.remainder(offsets[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    return offsets


def moved(covariance: FloatArray, T_a_b: FloatArray) -> FloatArray:
    """Transform (N, 3, 3) covariances from the tangent space of b to that of a: Ad C Ad^T, GTSAM's order."""
    adjoint = np.zeros((len(T_a_b), 3, 3))
    cos, sin = np.cos(T_a_b[:, 2]), np.sin(T_a_b[:, 2])
    adjoint[:, 0, 0], adjoint[:, 0, 1], adjoint[:, 0, 2] = cos, -sin, T_a_b[:, 1]
    adjoint[:, 1, 0], adjoint[:, 1, 1], adjoint[:, 1, 2] = sin, cos, -T_a_b[:, 0]
    adjoint[:, 2, 2] = 1.0
    moved: FloatArray = adjoint @ covariance @ adjoint.transpose(0, 2, 1)
    return moved


@kernel
def _follow(  # type: ignore[no-untyped-def]
    start, target, poses, heads, following, ends, steps, parts, without, distance, seen, queued, queued_nodes
):
    """Run Dijkstra until all wanted nodes are reached; the edges of a path are summed.

    ``seen`` (n, 6) becomes the upper triangles of the covariances in the start's frame. The queue is a binary
    heap of two arrays: that of a list compiles half a second longer.
    """
    missing = ZERO
    for node in range(target.size):
        missing += target[node]
    cos = math.cos(poses[start, 2])
    sin = math.sin(poses[start, 2])
    distance[start] = 0.0
    queued[0] = 0.0
    queued_nodes[0] = start
    length = ONE
    while length > 0 and missing > 0:
        reached = queued[0]
        node = queued_nodes[0]
        # The last element moves from the top of the heap down.
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
        # It entered again at less cost, and is finished already.
        if reached > distance[node]:
            continue
        missing -= target[node]
        k = heads[node]
        while k >= 0:
            end = ends[k, 1]
            cost = reached + steps[k, 12]
            if cost < distance[end] and not parts[k, 0] <= without <= parts[k, 1]:
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
                tt = steps[k, 11]
                xt = c * steps[k, 5] - s * steps[k, 8]
                yt = s * steps[k, 5] + c * steps[k, 8]
                xx = c * steps[k, 3] - s * steps[k, 4]
                xy = c * steps[k, 4] - s * steps[k, 7]
                yx = s * steps[k, 3] + c * steps[k, 4]
                yy = s * steps[k, 4] + c * steps[k, 7]
                seen[end, 0] = seen[node, 0] + c * xx - s * xy + y * (2.0 * xt + y * tt)
                seen[end, 1] = seen[node, 1] + s * xx + c * xy + y * yt - x * (xt + y * tt)
                seen[end, 2] = seen[node, 2] + xt + y * tt
                seen[end, 3] = seen[node, 3] + s * yx + c * yy - x * (2.0 * yt - x * tt)
                seen[end, 4] = seen[node, 4] + yt - x * tt
                seen[end, 5] = seen[node, 5] + tt
            k = following[k]


@kernel(inline="always")
def _sooner(cost, node, other_cost, other_node):  # type: ignore[no-untyped-def]
    """Return which of two nodes the queue returns first."""
    return cost < other_cost or (cost == other_cost and node < other_node)
