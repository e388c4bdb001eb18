"""The graph of keyframes: edges between neighbours, loops, and the estimated poses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam.config.stages import GraphConfig
from slam.graph.edge import GUESSES, Edge, EdgeKind
from slam.graph.loop_candidate import LoopCandidate, judged
from slam.graph.pose_graph import BatchResult, PoseGraph
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.matching.motion import Motion
from slam.measurements import IN_PLANE, BoolArray, FloatArray, Pose, composed

_PLACES = (EdgeKind.GNSS, EdgeKind.SURVEY, EdgeKind.TAG)


class KeyframeGraph:
    """Keyframes 0..n-1, in 2D or 3D, depending on the first pose.

    Attributes
    ----------
    uncertainty
        Relative uncertainty of keyframes, projected onto the ground plane.
    loops
        All loop candidates so far, accepted and rejected.
    """

    def __init__(self, origin: Pose, config: GraphConfig) -> None:
        self.graph = PoseGraph(origin)
        self.uncertainty = UncertaintyGraph()
        self.loops: list[LoopCandidate] = []
        self._config = config
        self._planar = isinstance(origin, gtsam.Pose2)
        # Of the poses as objects, how many are as the graph has them.
        self._poses: list[Pose] = []
        self._known = 0
        self._rows = np.zeros((64, 3))
        self._loop_waits = False
        self._optimized = False
        self._append(origin)

    def __len__(self) -> int:
        return len(self.graph)

    def poses(self) -> Sequence[Pose]:
        """Current estimates, ``T_map_keyframe``."""
        self._poses[self._known :] = [self.graph.pose(key) for key in range(self._known, len(self))]
        self._known = len(self)
        return self._poses

    def rows(self) -> FloatArray:
        """(n, 3) current estimates projected onto the ground plane, x, y, yaw in the map."""
        return self._rows[: len(self.graph)]

    def add_keyframe(self, step: Pose, edges: Iterable[Edge] = ()) -> int:
        """Add the next keyframe and return its number.

        Parameters
        ----------
        step
            Best estimate of the motion from the last keyframe: the initial guess.
        edges
            Measured edges. If no trusted edge connects it to the last keyframe, the step does, with the
            covariance of an unmeasured step.
        """
        pose = composed(self.graph.pose(len(self) - 1), step)
        key = self.graph.add_node(pose)
        self._append(pose)
        edges = list(edges)
        if not any(edge.trusted and edge.source == key - 1 for edge in edges):
            covariance = unmeasured(self._config, planar=self._planar)
            edges.append(Edge(key - 1, key, step, covariance, EdgeKind.ASSUMED, trusted=True))
        for edge in edges:
            if edge.source == key - 1:
                self.graph.add_edge(edge)
            else:
                self.add_edge(edge)
        each = [_in_plane(edge) for edge in edges if edge.source == key - 1]
        covariance = each[0] if len(each) == 1 else np.linalg.inv(np.linalg.inv(each).sum(axis=0))
        self.uncertainty.add_edge(key - 1, key, np.array(row_of(step)), covariance)
        return key

    def add_edge(self, edge: Edge) -> None:
        """Add a motion between two existing keyframes."""
        self.graph.add_edge(edge)
        relative = np.array(row_of(edge.T_source_target))
        self.uncertainty.add_edge(edge.source, edge.target, relative, _in_plane(edge))

    def add_loop(self, candidate: LoopCandidate) -> None:
        """Add a loop candidate: to the graph if accepted, and always to the report."""
        if candidate.accepted and candidate.motion is not None:
            self._loop_waits = True
            self.add_edge(candidate.edge(len(self.loops)))
        self.loops.append(candidate)

    def update(self) -> None:
        """Update with iSAM2 if a new loop waits; in 2D only every few keyframes.

        Without a new loop, the estimates already follow the chain.
        """
        every = self._config.incremental_every if self._planar else 1
        if self._loop_waits and (len(self) - 1) % every == 0:
            self._read_poses(self.graph.update())
            self._loop_waits = False

    def pieces(self, kept: BoolArray, reach_m: float) -> NDArray[np.int64]:
        """Return (n,) the piece of each keyframe by the kept edges (E,); only guesses connect two pieces."""
        edges, count, lost_m = self.graph.edges, len(self), self._config.lost_sigma_m
        steps = lone_steps(edges, kept, count, lost_m)
        ties = tied(edges, kept, steps.unseen, self.rows(), 2.0 * reach_m)
        return (steps if ties[kept].all() else lone_steps(edges, kept & ties, count, lost_m)).pieces

    def optimize(self, inlier_probability: float) -> BatchResult:
        """Solve the whole graph; mark loops that disagree with the others as rejected."""
        if not self._optimized:
            self.graph.update()
            self._optimized = True
        outcome = self.graph.optimize(inlier_probability)
        self.loops = judged(self.loops, self.graph.edges, outcome.kept)
        self._read_poses(0)
        return outcome

    def _append(self, pose: Pose) -> None:
        """Append the estimate of a new keyframe."""
        self._optimized = False
        self.uncertainty.add_node()
        if len(self) > len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[len(self) - 1] = row_of(pose)

    def _read_poses(self, first: int) -> None:
        """Read the poses of the solver, from a node on."""
        self._known = min(self._known, first)
        rows = (
            self.graph.planar_poses(first)
            if self._planar
            else [row_of(pose) for pose in self.poses()[first:]]
        )
        self._rows[first : len(self)] = rows


def together(edges: Iterable[Edge]) -> dict[tuple[int, int], Motion]:
    """Combine all edges between the same two nodes, source and target, into one in the ground plane."""
    ends, rows, covariances = combined(edges)
    return dict(zip(map(tuple, ends.tolist()), map(Motion, rows, covariances), strict=True))


def combined(edges: Iterable[Edge]) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Return the same as arrays: ends (M, 2), motions (M, 3), covariances (M, 3, 3)."""
    edges = list(edges)
    ends = np.array([(edge.source, edge.target) for edge in edges], np.int64).reshape(-1, 2)
    keys = ends @ [ends.max(initial=0) + 1, 1]
    first, which, counts = np.unique(keys, return_index=True, return_inverse=True, return_counts=True)[1:]
    each = np.array([_in_plane(edge) for edge in edges]).reshape(-1, 3, 3)
    covariances = each[first]
    if (several := counts > 1).any():
        order = np.argsort(which, kind="stable")
        order = order[several[which[order]]]
        begun = np.cumsum([0, *counts[several]])[:-1]
        covariances[several] = np.linalg.inv(np.add.reduceat(np.linalg.inv(each[order]), begun))
    order = np.argsort(first)
    rows = np.array([row_of(edges[n].T_source_target) for n in first[order].tolist()]).reshape(-1, 3)
    return ends[first[order]], rows, covariances[order]


class LoneSteps(NamedTuple):
    """Whether only wheels measured the step from each keyframe (n,), and the share of wrong ones.

    ``pieces`` (n,) is the piece of each keyframe if all these steps are taken as guesses.
    """

    unseen: BoolArray
    pieces: NDArray[np.int64]
    share: float


def guessed_steps(edges: Sequence[Edge], kept: BoolArray, nodes: int, lost_sigma_m: float) -> BoolArray:
    """Return (n - 1,) from which keyframes no kept edge measures the step, at least in one direction.

    Edges with a sigma of ``lost_sigma_m`` or more in any direction measure nothing.
    """
    guessed = np.ones(nodes - 1, np.bool_)
    held = [
        edge
        for edge, keep in zip(edges, kept.tolist(), strict=True)
        if keep and edge.kind not in (EdgeKind.ASSUMED, EdgeKind.IMU) and edge.target == edge.source + 1
    ]
    ends, _, covariances = combined(held)
    certain = np.linalg.eigvalsh(covariances[:, :2, :2])[:, -1] < lost_sigma_m**2
    guessed[ends[certain, 0]] = False
    return guessed


def lone_steps(edges: Sequence[Edge], kept: BoolArray, nodes: int, lost_sigma_m: float) -> LoneSteps:
    """Estimate how often wheels are wrong in steps that only they measured, from steps tested by loops.

    It is the share of rejected steps. As a prior, the share among steps that matches also measured, which are
    wrong less often, counts as two steps (rule of succession). Edges with a sigma of ``lost_sigma_m`` or more
    connect nothing.
    """
    judged_edges = list(zip(edges, kept.tolist(), strict=True))
    held = [edge for edge, keep in judged_edges if keep]
    single = [(edge, keep) for edge, keep in judged_edges if edge.target == edge.source + 1]
    measured = {edge.source for edge, keep in single if keep and edge.kind not in GUESSES}
    right = {edge.source: True for edge, _ in single if edge.kind is EdgeKind.WHEEL}
    right |= {edge.source: False for edge, keep in single if edge.kind is EdgeKind.WHEEL and not keep}
    lone, (ends, _, covariances) = sorted(right.keys() - measured), combined(held)
    certain = np.linalg.eigvalsh(covariances[:, :2, :2])[:, -1] < lost_sigma_m**2
    certain &= ~np.isin(ends[:, 0], lone) | (np.diff(ends)[:, 0] != 1)
    # A fix may be off by metres, and yet is no guess.
    fixes = [(edge.source, edge.target) for edge in held if edge.kind in _PLACES]
    pieces = joined(nodes, [*ends[certain].tolist(), *fixes])
    parting = {step for step in lone if pieces[step] != pieces[step + 1]}
    tried = [right[step] for step in lone if not right[step] or step not in parting]
    matched = [right[step] for step in right.keys() & measured]
    before = (1.0 + matched.count(False)) / (2.0 + len(matched))
    share = (tried.count(False) + 2.0 * before) / (len(tried) + 2.0)
    return LoneSteps(np.isin(np.arange(nodes), lone), pieces, share)


def tied(
    edges: Sequence[Edge], kept: BoolArray, unseen: BoolArray, rows: FloatArray, least_m: float
) -> BoolArray:
    """Return (E,) whether an edge may connect its nodes: parts of the path only with enough loops.

    One loop, or a few, may be at a place that looks the same. So the loops between two parts must be more
    than the numbers of a pose, or cover enough of both paths; then the two parts count as one for all others.
    Wheel edges over many steps count as the single steps. A part ends where a step is ``unseen`` (n,).
    """
    parts = np.append(0, np.cumsum(unseen[:-1]))
    ways_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(rows[:, :2], axis=0).T)))
    ends = np.array([(edge.source, edge.target) for edge in edges], np.int64).reshape(-1, 2)
    kinds = np.array([edge.kind for edge in edges], np.str_)
    loops, wheels = (kinds == kind.value for kind in (EdgeKind.LOOP, EdgeKind.WHEEL))
    across = parts[ends[:, 0]] != parts[ends[:, 1]]
    ties: BoolArray = ~across | ~(loops | wheels) | (np.diff(ends)[:, 0] == 1)
    numbers = max((len(edge.covariance) for edge in edges), default=0)
    part_of = joined(parts[-1] + 1, parts[ends[kept & across & ties & (np.diff(ends)[:, 0] != 1)]])
    while (waiting := np.flatnonzero(kept & loops & (np.diff(part_of[parts[ends]])[:, 0] != 0))).size:
        pairs = np.sort(part_of[parts[ends[waiting]]], axis=1)
        ends_m = np.take_along_axis(
            ways_m[ends[waiting]], np.argsort(part_of[parts[ends[waiting]]], axis=1), axis=1
        )
        pairs_found, which, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
        first, last = np.full((2, len(pairs_found), 2), [[[np.inf]], [[-np.inf]]])
        np.minimum.at(first, which, ends_m)
        np.maximum.at(last, which, ends_m)
        enough = (counts > numbers) | ((last - first).min(axis=1) >= least_m)
        if not enough.any():
            break
        part_of = joined(len(part_of), pairs_found[enough])[part_of]
    return ties | (loops & (np.diff(part_of[parts[ends]])[:, 0] == 0))


def joined(nodes: int, ends: ArrayLike) -> NDArray[np.int64]:
    """Return (n,) the component of each node, for pairs of joined nodes."""
    # SciPy is loaded where it is used: that takes 0.1 s.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    sources, targets = np.array(ends, np.int64).reshape(-1, 2).T
    graph = coo_array((np.ones(len(sources)), (sources, targets)), shape=(nodes, nodes))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def graph_of(nodes: int, edges: Iterable[Edge], parts: NDArray[np.int64] | None = None) -> UncertaintyGraph:
    """Build the relative uncertainty of nodes from some edges; edges between the same two are combined.

    ``parts`` (nodes,) is the part of the path that begins at a node and may be left out, or -1: then only
    loops cross it.
    """
    graph, edges = UncertaintyGraph(), list(edges)
    for _ in range(nodes):
        graph.add_node()
    ends, rows, covariances = combined(edges)
    crossing = np.full_like(ends, -1)
    if parts is not None:
        steps = {(edge.source, edge.target) for edge in edges if edge.loop is None}
        at = np.flatnonzero(parts >= 0)
        first, last = np.searchsorted(at, np.sort(ends)).T - [[0], [1]]
        crossed = np.array([one in steps for one in map(tuple, ends.tolist())], np.bool_) & (first <= last)
        crossing[crossed] = parts[at[np.column_stack([first, last])[crossed]]]
    graph.add_edges(ends, rows, covariances, crossing)
    return graph


def unmeasured(config: GraphConfig, share: float = 1.0, *, planar: bool) -> FloatArray:
    """Return the covariance (d, d) of an unmeasured step, GTSAM's order, with scaled sigmas."""
    metres, radians = share * config.lost_sigma_m, share * config.lost_sigma_rad
    sigmas = [metres, metres, radians] if planar else [radians] * 3 + [metres] * 3
    return np.diag(np.square(sigmas))


def from_above(edge: Edge) -> Motion:
    """Return the motion of an edge in x, y and yaw."""
    return Motion(np.array(row_of(edge.T_source_target)), _in_plane(edge))


def _in_plane(edge: Edge) -> FloatArray:
    """Return the covariance (3, 3) of x, y, yaw of an edge, in the target's frame."""
    if isinstance(edge.T_source_target, gtsam.Pose3):
        return edge.covariance[np.ix_(IN_PLANE, IN_PLANE)]
    return edge.covariance


def row_of(pose: Pose) -> list[float]:
    """Return x, y, yaw of a pose."""
    if isinstance(pose, gtsam.Pose2):
        return [pose.x(), pose.y(), pose.theta()]
    return [pose.x(), pose.y(), pose.rotation().yaw()]
