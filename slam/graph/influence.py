"""Influence of each loop on the finished map: how far it would move without the loop, or with it forced in.

The final map is the least-squares solution of the edges that were kept. There an edge has the whitened
residual e and the Jacobian A, and all kept edges together have the information H = P^-1. Without the edge
the solution moves, to first order, by

    P A' (I - A P A')^-1 e

If a rejected edge is forced in, the solution moves by the negative of this, with + for - in the brackets. A P
A' is the leverage of the edge, between 0 and I: the part of the map's estimate that comes from the edge
itself (Cook and Weisberg 1982, for several rows at once). e' (I - A P A')^-1 e is the decrease of the sum of
squared residuals without the edge. It is also the squared Mahalanobis distance of the edge from the
prediction of the others: for a true edge it is chi-square distributed with the degrees of freedom of a pose.
So it tests an edge as Baarda (1968) tests one observation for a blunder.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.kernel import kernel
from slam.errors import GraphError
from slam.graph.edge import Edge
from slam.graph.held_graph import held_graph
from slam.graph.loop_candidate import LoopCandidate
from slam.heap import give_back
from slam.measurements import BoolArray, FloatArray, Pose

if TYPE_CHECKING:
    from scipy.sparse import csr_array

# Existing factors are reused.
_Edges: TypeAlias = Sequence[Edge] | Sequence[gtsam.NonlinearFactor]


@dataclass(frozen=True, slots=True)
class Influences:
    """Influence of some edges on a map.

    Attributes
    ----------
    edges
        (L,) edge numbers.
    shifts_m
        (L,) largest motion of a node if the edge is removed, or, if it is rejected, forced in.
    nodes
        (L,) the node with this motion.
    residuals
        (L,) residual of the edge in the map, in its standard deviations (the whitened norm).
    left_out
        (L,) residual of the edge in the map without it, in standard deviations of both.
    """

    edges: NDArray[np.int64]
    shifts_m: FloatArray
    nodes: NDArray[np.int64]
    residuals: FloatArray
    left_out: FloatArray


class LinearMap:
    """The edges of a finished map, linearised at its poses, with node 0 fixed.

    Parameters
    ----------
    poses
        (n,) poses of the nodes after the final optimisation.
    edges, kept
        All edges that may be queried, and which are inliers.

    Raises
    ------
    GraphError
        If the inliers do not connect all nodes.
    """

    def __init__(self, poses: Sequence[Pose], edges: _Edges, kept: Sequence[bool] | BoolArray) -> None:
        self._planar = isinstance(poses[0], gtsam.Pose2)
        self._size = 3 if self._planar else 6
        self._kept = np.array(kept, np.bool_)
        give_back()  # memory freed by the solver
        self._jacobian, self._residuals = linearized(poses, edges)
        give_back()
        self._factor = _Factor(self._jacobian[np.repeat(self._kept, self._size)])
        give_back()
        # One step to the exact solution: optimisers stop slightly before it.
        self._residuals += self._jacobian @ self.step()

    def step(self) -> FloatArray:
        """Return ((n - 1) d,) the Gauss-Newton step of nodes 1 to n - 1, in their tangents."""
        rows = np.repeat(self._kept, self._size)
        gradient = self._jacobian[rows].T @ self._residuals[rows]
        return -self._factor.solve(gradient)

    def influences(self, chosen: Sequence[int] | NDArray[np.int64]) -> Influences:
        """Return the influences of these edges, or of the edges of each row switched together."""
        sets, rows = np.array(chosen, np.int64), list[tuple[NDArray[Any], ...]]()
        for at, pulled, residuals, left_out in self._switched(sets):
            tangents = self._factor.backward(at, pulled).reshape(-1, self._size, len(residuals))
            squares = np.square(tangents[:, :2] if self._planar else tangents[:, 3:]).sum(axis=1)
            most = squares.argmax(axis=0)
            rows.append((np.sqrt(squares.max(axis=0)), most + 1, np.linalg.norm(residuals, axis=1), left_out))
            del at, pulled, tangents, squares
        return Influences(sets, *map(np.concatenate, zip(*rows, strict=True)))

    def left_out(self, asked: Sequence[int]) -> FloatArray:
        """Return the residual of each of these edges in the map without it: see `Influences`."""
        return np.concatenate([left_out for *_, left_out in self._switched(np.array(asked, np.int64))])

    def _switched(self, sets: NDArray[np.int64]) -> Iterator[tuple[NDArray[Any], ...]]:
        """Yield for sets of edges: rows and values of the shift, residuals, and residuals without them."""
        sets, size, together = sets.reshape(len(sets), -1), self._size, 72 // self._size
        for some in (sets[first : first + together] for first in range(0, len(sets), together)):
            rows = (some[..., None] * size + np.arange(size)).reshape(len(some), -1)
            at, pulled = self._factor.forward(self._jacobian, rows.ravel())
            columns, residuals = pulled.reshape(len(at), *rows.shape).swapaxes(0, 1), self._residuals[rows]
            signs = np.repeat(np.where(self._kept[some], -1.0, 1.0), size, axis=1)
            leverage = columns.swapaxes(1, 2) @ columns
            pull = np.linalg.solve(signs[..., None] * np.eye(rows.shape[1]) + leverage, residuals[..., None])
            left_out = np.sqrt(np.abs((residuals * pull[..., 0]).sum(axis=1)))
            pulled = (columns @ pull)[..., 0].T
            del columns, leverage  # as large as all of the following
            yield at, pulled, residuals, left_out


class _Factor:
    """The information of all inlier edges as L L', in a sparse ordering."""

    def __init__(self, held: csr_array) -> None:
        from scipy.sparse.linalg import splu  # imported on use: that takes 0.1 s

        symmetric = {"SymmetricMode": True}
        information = (held.T @ held).tocsc()
        try:
            superlu = splu(information, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)
        except RuntimeError as error:
            raise GraphError("the edges that are kept do not join all keyframes") from error
        self._order = superlu.perm_c.copy()  # its own keeps all data of SuperLU
        # With diagonal pivots, the other factor is the transpose up to the pivots.
        lower, self._roots = superlu.L.tocsc(), np.sqrt(superlu.U.diagonal())
        self._lower = lower.indptr, lower.indices, lower.data
        self._buffer = np.zeros((len(self._roots), 0))

    def solve(self, right: FloatArray) -> FloatArray:
        """Solve with the information for (N,); SciPy's own object would take much more memory."""
        x = np.empty((len(right), 1))
        x[self._order, 0] = right
        _forward(*self._lower, x, np.ones(len(right), np.bool_))
        return self.backward(np.arange(len(right)), x / self._roots[:, None])[:, 0]

    def forward(self, jacobian: csr_array, rows: NDArray[np.int64]) -> tuple[NDArray[np.intp], FloatArray]:
        """Return L^-1 times some rows: (t,) indices that are not zero in any, and (t, m) the values."""
        if self._buffer.shape[1] != len(rows):
            self._buffer = np.zeros((len(self._roots), len(rows)))
        nonzero = np.zeros(len(self._roots), np.bool_)
        # By hand: slicing rows of a sparse matrix in SciPy takes longer than all the rest.
        for place, row in enumerate(rows.tolist()):
            entries = slice(jacobian.indptr[row], jacobian.indptr[row + 1])
            at = self._order[jacobian.indices[entries]]
            self._buffer[at, place], nonzero[at] = jacobian.data[entries], True
        _forward(*self._lower, self._buffer, nonzero)
        (at,) = nonzero.nonzero()
        values: FloatArray = self._buffer[at]
        values /= self._roots[at, None]
        self._buffer[at] = 0.0
        return at, values

    def backward(self, at: NDArray[np.intp], columns: FloatArray) -> FloatArray:
        """Return (N, m) L'^-1 times some columns, in the form of `forward`."""
        values = np.zeros((len(self._roots), columns.shape[1]))
        values[at] = columns / self._roots[at, None]
        _backward(*self._lower, values)
        return values[self._order]


@kernel
def _forward(
    first: NDArray[np.int32], below: NDArray[np.int32], lower: FloatArray, x: FloatArray, nonzero: BoolArray
) -> None:
    """Solve a unit lower triangular system by columns; return the rows of x that are not zero."""
    for column in range(len(x)):
        if nonzero[column]:
            solved = x[column]
            for k in range(first[column], first[column + 1]):
                if below[k] > column:
                    nonzero[below[k]] = True
                    other = x[below[k]]  # one row at a time, so that its loop is vectorised
                    for place in range(len(other)):
                        other[place] -= lower[k] * solved[place]


@kernel
def _backward(first: NDArray[np.int32], below: NDArray[np.int32], lower: FloatArray, x: FloatArray) -> None:
    """Solve with its transpose for each column of x (N, m)."""
    for column in range(len(x) - 1, -1, -1):
        solved = x[column]
        for k in range(first[column], first[column + 1]):
            if below[k] > column:
                other = x[below[k]]
                for place in range(len(other)):
                    solved[place] -= lower[k] * other[place]


def influences(poses: Sequence[Pose], edges: Sequence[Edge], kept: Sequence[bool] | BoolArray) -> Influences:
    """Return the influence of all loops; of none if the inliers do not connect all nodes.

    Parameters
    ----------
    poses
        (n,) poses of the nodes after the final optimisation.
    edges, kept
        All edges of the graph, and which are inliers.
    """
    loops = [number for number, edge in enumerate(edges) if edge.loop is not None]
    none, nothing = np.zeros(0, np.int64), np.zeros(0)
    if loops:
        with suppress(GraphError):
            return LinearMap(poses, edges, kept).influences(loops)
    return Influences(none, nothing, none, nothing, nothing)


def misfits(poses: Sequence[Pose], edges: _Edges, kept: BoolArray, asked: list[int]) -> FloatArray:
    """See `LinearMap.left_out`; empty if the inlier edges do not connect all nodes."""
    with suppress(GraphError):
        return LinearMap(poses, edges, kept).left_out(asked) if asked else np.zeros(0)
    return np.zeros(0)


def all_edges(edges: Sequence[Edge], loops: Sequence[LoopCandidate]) -> list[Edge]:
    """Return the graph's edges, followed by the matched loops that were rejected before entering it."""
    inside = {edge.loop for edge in edges}
    outside = [
        loop.edge(number)
        for number, loop in enumerate(loops)
        if loop.motion is not None and number not in inside
    ]
    return [*edges, *outside]


def elimination_order(nodes: int, edges: Sequence[Edge]) -> NDArray[np.int64]:
    """Return (nodes,) a node ordering in which the normal equations of all edges stay sparse (COLAMD)."""
    graph = gtsam.SymbolicFactorGraph()
    for node in range(nodes):
        graph.push_factor(node)
    for edge in edges:
        graph.push_factor(edge.source, edge.target)
    order = gtsam.Ordering.ColamdSymbolicFactorGraph(graph)
    return np.array([order.at(place) for place in range(nodes)], np.int64)


def linearized(poses: Sequence[Pose], edges: _Edges) -> tuple[csr_array, FloatArray]:
    """Return the whitened Jacobian (E d, (n - 1) d) and residuals (E d,) of the edges; node 0 is fixed."""
    from scipy.sparse import csr_array

    graph, values = held_graph(poses, edges)
    size = 3 if isinstance(poses[0], gtsam.Pose2) else 6
    # Indices from 1; node 0 is first, and minus the residual last.
    rows, columns, entries = graph.linearize(values).sparseJacobian_()
    is_jacobian = (rows > size) & (columns > size)
    ends = (rows[is_jacobian].astype(np.int64) - size - 1, columns[is_jacobian].astype(np.int64) - size - 1)
    across = (len(poses) - 1) * size
    augmented = csr_array((entries[is_jacobian], ends), shape=(len(edges) * size, across + 1))
    return augmented[:, :across], -augmented[:, [across]].toarray().ravel()
