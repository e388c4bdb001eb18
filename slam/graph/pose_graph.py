"""The pose graph.

During mapping, iSAM2 (Kaess 2012) updates the estimate. At the end, graduated non-convexity with truncated
least squares (Yang 2020) decides which loops and wheel odometry edges are inliers. For SE(2) and SE(3).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import compress

import gtsam
import numpy as np

from fusion.estimation import SETTLED, TINY, gate
from fusion.showing import one_line
from slam.errors import GraphError
from slam.graph.edge import Edge, EdgeKind, check_edge, check_pose
from slam.graph.factors import begun, between_factor, gauge, mapping_noise, prior, solved, weighted
from slam.graph.gravity import gravity_factors, heading_alone, upright_poses
from slam.graph.influence import misfits
from slam.heap import give_back
from slam.matching.upright import Gravity
from slam.measurements import BoolArray, FloatArray, Pose, composed, numbers_of

# Of GNC: growth of its control parameter a round, twice the library's pace, and its end: only edges within a
# hundredth of the gate are undecided then. Real logs reject the same edges.
_GNC_STEP, _GREATEST_CONTROL = 2.0, 100.0
# Number of planar nodes that iSAM2 moves before a batch solution; in 3D a quarter, because a node takes four
# times the memory.
_NODES_A_WINDOW = 3000


@dataclass(frozen=True, slots=True)
class BatchResult:
    """The result of the final optimisation.

    Attributes
    ----------
    error
        Half the sum of squared whitened residuals of the edges that were kept.
    kept
        (E,) in the order of ``PoseGraph.edges``: False if an edge was rejected as an outlier.
    cost
        The error, plus half the gate for each rejected edge, plus the logarithm of the number of ways to
        reject as many edges of a kind (Rissanen 1978). A lower cost is more likely.
    """

    error: float
    kept: BoolArray
    cost: float


class PoseGraph:
    """Poses 0..n-1 and the edges between them; a prior fixes the first pose.

    Parameters
    ----------
    origin
        Pose of node 0, Pose2 or Pose3; it defines the dimension of the graph.

    Examples
    --------
    Around a square of 2 m by wheels that turn too far, with a true loop at the end and a false one.

    >>> import gtsam, numpy as np, slam
    >>> graph = slam.PoseGraph(gtsam.Pose2())
    >>> wheels, walls = np.diag([0.1, 0.1, 0.05]) ** 2, np.diag([0.02, 0.02, 0.01]) ** 2
    >>> step = gtsam.Pose2(2.0, 0.0, np.pi / 2 + 0.05)
    >>> for node in range(4):
    ...     new = graph.add_node(graph.pose(node) * step)
    ...     graph.add_edge(slam.Edge(node, new, step, wheels, slam.EdgeKind.WHEEL, trusted=True))
    >>> back, false = gtsam.Pose2(), gtsam.Pose2(0.5, 0.0, 1.0)
    >>> graph.add_edge(slam.Edge(0, 4, back, walls, slam.EdgeKind.LOOP, trusted=False))
    >>> graph.add_edge(slam.Edge(0, 2, false, walls, slam.EdgeKind.LOOP, trusted=False))
    >>> graph.optimize().kept.tolist()
    [True, True, True, True, True, False]
    >>> np.abs(graph.planar_poses()[:4, :2].round(1)).tolist()  # the corners
    [[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]]
    """

    def __init__(self, origin: Pose) -> None:
        self.edges: list[Edge] = []
        self._dimension = 3 if isinstance(origin, gtsam.Pose2) else 6
        self._origin = origin
        self._down: dict[int, Gravity] = {}
        self._pending, self._pending_values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._estimate = gtsam.Values()
        self._isam: gtsam.ISAM2 | None = None
        # Nodes that updates keep fixed, and the estimates of the others from the last update.
        self._held, self._moved = 0, gtsam.Values()
        self._count = 0
        # The inliers of the last optimisation among its edges, and the remaining error.
        self._kept, self._error = np.zeros(0, np.bool_), -math.inf
        self._made: dict[int, tuple[Edge, gtsam.NonlinearFactor]] = {}  # those edges, and their factors
        self.add_node(origin)
        self._pending.add(self._prior())

    __repr__ = one_line

    def __len__(self) -> int:
        return self._count

    def add_node(self, guess: Pose) -> int:
        """Add a pose with its initial estimate and return its number."""
        check_pose(guess, self._dimension)
        key = self._count
        self._pending_values.insert(key, guess)
        self._estimate.insert(key, guess)
        self._count += 1
        return key

    def add_edge(self, edge: Edge) -> None:
        """Add a relative pose.

        Raises
        ------
        GraphError
            If the edge names a node that does not exist, is not finite, or its covariance is not positive
            definite.

        Examples
        --------
        >>> import gtsam, numpy as np, slam
        >>> graph = slam.PoseGraph(gtsam.Pose2())
        >>> flat = np.diag([1.0, 1.0, 0.0])  # a covariance must not be zero in any direction
        >>> new, step = graph.add_node(gtsam.Pose2()), gtsam.Pose2()
        >>> graph.add_edge(slam.Edge(0, new, step, flat, slam.EdgeKind.WHEEL, trusted=True))
        Traceback (most recent call last):
        ...
        slam.errors.GraphError: wheel odometry edge 0 -> 1: the covariance is not positive definite
        """
        check_edge(edge, self._count, self._dimension)
        self.edges.append(edge)
        self._pend(edge)

    def update(self) -> int:
        """Update the estimate with iSAM2 and return the first node that may have moved.

        The cost of iSAM2 grows with the number of passes by a place. So after many nodes the whole graph is
        solved in one batch and then fixed: only newer nodes move, until there are many of them again.

        Examples
        --------
        >>> import gtsam, numpy as np, slam
        >>> graph = slam.PoseGraph(gtsam.Pose2())
        >>> guessed = graph.add_node(gtsam.Pose2(0.9, 0.1, 0.0))
        >>> step, noise = gtsam.Pose2(1.0, 0.0, 0.0), 1e-4 * np.eye(3)
        >>> graph.add_edge(slam.Edge(0, guessed, step, noise, slam.EdgeKind.LIDAR, trusted=True))
        >>> graph.update(), round(graph.pose(guessed).x(), 3)
        (0, 1.0)
        """
        if self._count - self._held > _NODES_A_WINDOW * 9 / self._dimension**2:
            self._start_anew(held=self._count)
            return 0
        if self._isam is None:
            self._isam = gtsam.ISAM2()
        try:
            self._isam.update(self._pending, self._pending_values)
            self._moved = self._isam.calculateEstimate()
            self._estimate.update(self._moved)
        except RuntimeError:  # for nodes that it has marginalised, or, in 3D, unmeasured edges
            self._start_anew(held=0)
            return 0
        self._pending, self._pending_values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        return self._held

    def _pend(self, edge: Edge) -> None:
        """Add an edge to the next update; fixed nodes keep their poses."""
        if min(edge.source, edge.target) >= self._held:
            self._pending.add(between_factor(edge, mapping_noise(edge)))
        elif max(edge.source, edge.target) >= self._held:
            edge = edge if edge.target >= self._held else edge.turned()
            place = composed(self.pose(edge.source), edge.T_source_target)
            self._pending.add(prior(edge.target, place, mapping_noise(edge)))

    def _start_anew(self, held: int) -> None:
        """Solve the whole graph with damping, and start a new iSAM2 with the nodes that are not fixed."""
        graph = self._graph(between_factor(edge, mapping_noise(edge)) for edge in self.edges)
        # A few steps bring a map that was solved before up to date.
        self._estimate = solved(graph, self._estimate, most_steps=3 if held else 100)
        self._isam, self._held = None, held
        give_back()
        self._pending = gtsam.NonlinearFactorGraph() if held else graph
        self._pending_values = gtsam.Values() if held else gtsam.Values(self._estimate)

    def optimize(self, inlier_probability: float = 0.99) -> BatchResult:
        """Solve the whole graph: GNC-TLS over the untrusted edges, then plain least squares.

        False loops may agree with each other, and GNC finds a solution near its initial estimate. So if it
        first rejects more loops than the gate does by chance, it is run again from the poses of the odometry
        steps alone, which no loop has bent; the solution with the lower cost is used.

        Parameters
        ----------
        inlier_probability
            Probability that a true edge passes the chi-square gate.
        """
        if not 0.0 < numbers_of(inlier_probability, (), "inlier_probability", GraphError) < 1.0:
            raise GraphError(f"inlier_probability is {inlier_probability}; give one between 0 and 1")
        begun, first = self._estimate, not len(self._kept)
        best, ended = self._decided(inlier_probability), self._estimate
        loops = np.array([edge.kind == EdgeKind.LOOP and not edge.trusted for edge in self.edges], np.bool_)
        if first and (loops > best.kept).sum() > (1.0 - inlier_probability) * loops.sum():
            self._estimate, self._kept = begun, ~loops
            other = self._decided(inlier_probability, anew=True)
            best, self._estimate = (other, self._estimate) if other.cost < best.cost else (best, ended)
        self._kept, self._error = best.kept.copy(), best.error
        self._isam, self._moved = None, gtsam.Values()  # as large as the map, and rarely used again
        give_back()
        return best

    def _decided(self, inlier_probability: float, *, anew: bool = False) -> BatchResult:
        """Run GNC from the current poses; return which edges it keeps, and the resulting poses.

        A long chain can bend far at low cost, so GNC, which finds a solution near its initial estimate, may
        keep loops that all others contradict. They are rejected, the worst first, while the cost falls.
        """
        most = gate(self._dimension, inlier_probability)
        self._made = {id(e): self._made.get(id(e)) or (e, weighted(e, 1.0)) for e in self.edges}
        factors = [self._made[id(edge)][1] for edge in self.edges]
        loops = [k for k, edge in enumerate(self.edges) if edge.loop is not None and not edge.trusted]
        best = self._solution(factors, self._gnc_weights(factors, most, anew) > 0.5, most)
        while True:
            ended, kept, poses = self._estimate, best.kept.copy(), map(self.pose, range(self._count))
            asked = [k for k in loops if kept[k]]
            left_out = misfits(list(poses), factors, kept, asked)
            if left_out.max(initial=0.0) ** 2 <= most:
                return best
            kept[asked[left_out.argmax()]] = False
            other = self._solution(factors, kept, most)
            if other.cost >= best.cost:
                self._estimate = ended
                return best
            best = other

    def _solution(self, factors: list[gtsam.NonlinearFactor], kept: BoolArray, most: float) -> BatchResult:
        """Return the poses from the kept edges, and the cost if a gate is ``most``."""
        self._estimate = solved(graph := self._graph(compress(factors, kept)), self._estimate)
        cost = (error := float(graph.error(self._estimate))) + 0.5 * most * (~kept).sum()
        cost += sum(math.log(math.comb(count, out)) for count, out in self._refused(kept))
        return BatchResult(error, kept, cost)

    def _refused(self, kept: BoolArray) -> list[tuple[int, int]]:
        """Return, for each kind, how many edges may be rejected and how many are."""
        kinds = Counter(edge.kind for edge in self.edges if not edge.trusted)
        refused = Counter(edge.kind for edge in compress(self.edges, ~kept))
        return [(count, refused[kind]) for kind, count in kinds.items()]

    def level(self, down: dict[int, Gravity]) -> None:
        """Let the next optimisation level a 3D graph.

        Only the position and heading of node 0 are then fixed.

        Parameters
        ----------
        down
            Gravity at nodes, by node number.

        Examples
        --------
        A camera that looks ahead, but whose first pose was said to look down by a quarter turn.

        >>> import gtsam, numpy as np, slam
        >>> from slam.matching.upright import Gravity
        >>> graph = slam.PoseGraph(gtsam.Pose3(gtsam.Rot3.Ry(np.pi / 2), np.zeros(3)))
        >>> graph.level({0: Gravity(0.0, np.array([0.0, 0.0, -1.0]), sigma_rad=0.01)})
        >>> np.abs(graph.pose(0).rotation().rpy()).round(3).tolist()
        [0.0, 0.0, 0.0]
        """
        poses = upright_poses([self.pose(key) for key in range(self._count)], down)
        self._estimate, self._origin, self._down = gtsam.Values(), poses[0], down
        for key, pose in enumerate(poses):
            self._estimate.insert(key, pose)
        self._isam, self._held = None, self._count
        self._pending, self._pending_values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def begin_with(self, kept: Iterable[bool]) -> None:
        """Let the next optimisation start with the inliers of an earlier one.

        Examples
        --------
        >>> import gtsam, numpy as np, slam
        >>> graph = slam.PoseGraph(gtsam.Pose2())
        >>> new, noise = graph.add_node(gtsam.Pose2(1.0, 0.0, 0.0)), 1e-4 * np.eye(3)
        >>> step, far = gtsam.Pose2(1.0, 0.0, 0.0), gtsam.Pose2(5.0, 0.0, 0.0)
        >>> graph.add_edge(slam.Edge(0, new, step, noise, slam.EdgeKind.WHEEL, trusted=True))
        >>> graph.add_edge(slam.Edge(0, new, far, noise, slam.EdgeKind.LOOP, trusted=False))
        >>> graph.begin_with([True, False])  # the loop was refused before
        >>> graph.optimize().kept.tolist()
        [True, False]
        """
        self._kept = np.fromiter(kept, np.bool_)

    def initialize(self) -> None:
        """Initialise the poses from the edges alone: LAGO (Carlone 2014) in 2D, chordal initialisation in 3D.

        Examples
        --------
        >>> import gtsam, numpy as np, slam
        >>> graph = slam.PoseGraph(gtsam.Pose2())
        >>> lost = graph.add_node(gtsam.Pose2(50.0, 0.0, 2.0))
        >>> step = gtsam.Pose2(1.0, 0.0, 0.0)
        >>> graph.add_edge(slam.Edge(0, lost, step, np.eye(3), slam.EdgeKind.WHEEL, trusted=True))
        >>> graph.initialize()
        >>> round(graph.pose(lost).x(), 3)
        1.0
        """
        self._estimate = begun(self.edges, self._prior())

    def pose(self, key: int) -> Pose:
        """Estimated pose of a node; a GraphError if there is no such node."""
        try:
            return self._estimate.atPose2(key) if self._dimension == 3 else self._estimate.atPose3(key)
        except (RuntimeError, TypeError):
            raise GraphError(f"{key!r:.60} is none of the nodes 0..{self._count - 1}") from None

    def planar_poses(self, first: int = 0) -> FloatArray:
        """Return (n, 3) x, y, yaw of all nodes in SE(2), or from the ``first`` one that an update moved."""
        estimate = self._moved if first else self._estimate
        rows: FloatArray = gtsam.utilities.extractPose2(estimate)
        return rows.reshape(-1, 3)

    def _gnc_weights(self, factors: list[gtsam.NonlinearFactor], most: float, anew: bool) -> FloatArray:
        """Return the weight of every edge, 0..1, after GNC-TLS with the trusted edges as known inliers.

        As Yang 2020, Sec. IV-B, but each round makes one step from the result of the last; GTSAM solves
        completely from the first estimate each time. Edges rejected before start as rejected. With ``anew``
        they start by how they fit the poses that all others give, and half of them may be wrong. If new edges
        change nothing, for less error than it costs to reject one more (see `_solution`), no round is made.
        """
        weights: FloatArray = np.append(self._kept, np.ones(len(self.edges) - len(self._kept)))
        graph, asked = self._graph(factors), [k for k, edge in enumerate(self.edges) if not edge.trusted]

        def errors() -> FloatArray:
            return np.array([factors[k].error(self._estimate) for k in asked])

        limit, own, at_first = 0.5 * most, weights[asked], errors()  # an error is half a squared residual
        if ((at_first <= limit) == own).all():
            return weights
        for k in np.array(asked)[own <= 0.0].tolist():
            graph.replace(k + 1, weighted(self.edges[k], 0.0))  # factor 0 is the prior
        self._estimate = solved(graph, self._estimate)
        ended, grown = errors(), float(graph.error(self._estimate)) - self._error
        odds = [(count - out) / (out + 1) for count, out in self._refused(weights > 0.5) if out < count]
        pays = limit + math.log(min(odds, default=1.0))
        if not anew and grown <= pays and ((ended <= limit) == own).all():
            return weights
        # Remark 5: where the surrogate cost begins to be convex.
        worst = float(np.median(ended[own <= 0.0]) if anew else at_first[own > 0.0].max(initial=0.0))
        control = limit / (2.0 * worst - limit) if 2.0 * worst > limit else math.inf
        control = min(control, _GREATEST_CONTROL / _GNC_STEP)  # at least once: rejected edges are tested, too
        while control < _GREATEST_CONTROL:
            shares = limit * control * (control + 1.0) / np.maximum(errors(), TINY)  # Eq. (14)
            before, own = own, np.clip(np.sqrt(shares) - control, 0.0, 1.0)
            for n in np.flatnonzero(own != before).tolist():
                graph.replace(asked[n] + 1, weighted(self.edges[asked[n]], float(own[n])))
            self._estimate = solved(graph, self._estimate, most_steps=1)
            if ((own == 0.0) | (own == 1.0)).all():
                break
            control *= _GNC_STEP
        weights[asked] = own
        return weights

    def _graph(self, factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
        """Build the factor graph of the prior and the edges."""
        graph = gtsam.NonlinearFactorGraph()
        # Gravity after the edges, which are found by their index.
        for factor in [self._prior(), *factors, *gravity_factors(self._down)]:
            graph.add(factor)
        return graph

    def _prior(self) -> gtsam.NonlinearFactor:
        """Return the prior of node 0; if gravity is known, without roll and pitch."""
        if not self._down:
            return gauge(self._origin)
        covariance = heading_alone(self._origin, SETTLED**2 * np.eye(6))
        return prior(0, self._origin, gtsam.noiseModel.Gaussian.Covariance(covariance))
