"""An edge of the pose graph: a measured relative pose."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import gtsam
import numpy as np

from fusion.showing import one_line
from slam.errors import GraphError
from slam.measurements import FloatArray, Pose, numbers_of


class EdgeKind(StrEnum):
    """Source of an edge.

    Examples
    --------
    >>> import slam
    >>> slam.EdgeKind.LOOP == "loop", [str(kind) for kind in slam.EdgeKind][:2]
    (True, ['lidar match', 'RGB-D match'])
    """

    LIDAR = "lidar match"
    RGBD = "RGB-D match"
    WHEEL = "wheel odometry"
    LOOP = "loop"
    ASSUMED = "assumed motion"
    IMU = "IMU"
    GNSS = "GNSS"
    TAG = "tag"
    SURVEY = "survey"


# None of these has measured the motion of a robot.
GUESSES = (EdgeKind.WHEEL, EdgeKind.ASSUMED, EdgeKind.IMU)


@dataclass(frozen=True, slots=True)
class Edge:
    """A measured relative pose between two nodes.

    Attributes
    ----------
    source, target
        Node numbers.
    T_source_target
        Pose of the target in the source's frame.
    covariance
        (d, d), GTSAM's tangent order, in the target's frame.
    kind
        Source of the edge: an `EdgeKind`, or the name of a sensor that a program has registered.
    trusted
        True for the chain that keeps the graph connected. Other edges may be rejected as outliers.
    loop
        Number of the loop candidate of this edge; None for other edges.

    Examples
    --------
    >>> import gtsam, numpy as np, slam
    >>> step = gtsam.Pose2(1.0, 0.0, 0.1)
    >>> edge = slam.Edge(0, 1, step, np.diag([0.02, 0.02, 0.01]) ** 2, slam.EdgeKind.LIDAR, trusted=True)
    >>> edge.source, edge.target, edge.loop
    (0, 1, None)
    """

    source: int
    target: int
    T_source_target: Pose
    covariance: FloatArray
    kind: str
    trusted: bool
    loop: int | None = None

    __repr__ = one_line

    def turned(self) -> Edge:
        """Return the same edge in the opposite direction.

        Examples
        --------
        >>> import gtsam, numpy as np, slam
        >>> edge = slam.Edge(0, 1, gtsam.Pose2(1.0, 0.0, 0.0), np.eye(3), slam.EdgeKind.LIDAR, trusted=True)
        >>> back = edge.turned()
        >>> back.source, back.target, back.T_source_target.x()
        (1, 0, -1.0)
        """
        adjoint = self.T_source_target.AdjointMap()
        covariance = adjoint @ self.covariance @ adjoint.T
        back = self.T_source_target.inverse()
        return replace(
            self, source=self.target, target=self.source, T_source_target=back, covariance=covariance
        )


def check_edge(edge: Edge, nodes: int, dimension: int) -> None:
    """Raise a `GraphError` for an edge that GTSAM would accept silently, or that is none."""
    if not isinstance(edge, Edge) or not isinstance(edge.covariance, np.ndarray):
        raise GraphError(f"{edge!r:.60} is no edge; give slam.Edge, with its covariance as an array")
    name = f"{edge.kind} edge {edge.source} -> {edge.target}"
    ends = (edge.source, edge.target)
    if not all(isinstance(end, int | np.integer) and 0 <= end < nodes for end in ends):
        raise GraphError(f"{name}: the graph has nodes 0..{nodes - 1}; add the node first")
    if edge.source == edge.target:
        raise GraphError(f"{name}: an edge must join two different nodes")
    check_motion(name, edge.T_source_target, edge.covariance, dimension)


def check_motion(name: str, motion: Pose, covariance: FloatArray, dimension: int) -> None:
    """Raise a `GraphError` for a motion that is not finite, or a covariance that is not positive definite."""
    check_pose(motion, dimension)
    numbers_of(covariance, (dimension, dimension), f"{name}: the covariance", GraphError)
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise GraphError(f"{name}: the covariance is not positive definite") from None


def check_pose(pose: Pose, dimension: int) -> None:
    """Raise a `GraphError` for a pose of another kind than that of the graph, or with NaN or infinity."""
    kind = gtsam.Pose2 if dimension == 3 else gtsam.Pose3
    if not isinstance(pose, kind):
        raise GraphError(f"{type(pose).__name__} is no pose of this graph; give gtsam.{kind.__name__}")
    if not math.isfinite(pose.matrix().sum()):  # takes a quarter of the time of testing each number
        raise GraphError("a pose that is not finite cannot enter the graph; check the measurement")
