"""Graphs of some laps around a ring, in the plane and in space, and where GTSAM puts their nodes."""

from collections.abc import Sequence

import gtsam
import numpy as np

from slam.graph.edge import Edge, EdgeKind
from slam.graph.held_graph import held_graph
from slam.measurements import FloatArray, Pose

SIDES = 12
PLANE = np.diag([0.02, 0.02, 0.01]) ** 2
SPACE = np.diag([0.01, 0.01, 0.01, 0.02, 0.02, 0.02]) ** 2


def solved(poses: Sequence[Pose], edges: Sequence[Edge]) -> list[Pose]:
    """Where the edges put the nodes, to the last digit."""
    exact = gtsam.LevenbergMarquardtParams()
    exact.setRelativeErrorTol(1e-15)
    exact.setAbsoluteErrorTol(1e-15)
    values = gtsam.LevenbergMarquardtOptimizer(*held_graph(poses, edges), exact).optimize()
    at = values.atPose2 if isinstance(poses[0], gtsam.Pose2) else values.atPose3
    return [at(node) for node in range(len(poses))]


def ring(step: Pose, covariance: FloatArray, laps: int = 3, seed: int = 5) -> tuple[list[Pose], list[Edge]]:
    """Some laps around a ring, with noise, each keyframe seen again from a lap before; solved."""
    rng = np.random.default_rng(seed)
    truth, poses = [type(step)()], [type(step)()]
    for _ in range(laps * SIDES):
        truth.append(truth[-1].compose(step))

    def edge(source: int, target: int, kind: EdgeKind, loop: int | None = None) -> Edge:
        motion = truth[source].between(truth[target])
        measured = motion.retract(rng.multivariate_normal(np.zeros(len(covariance)), covariance))
        return Edge(source, target, measured, covariance, kind, kind is EdgeKind.LIDAR, loop)

    edges = [edge(node, node + 1, EdgeKind.LIDAR) for node in range(laps * SIDES)]
    for one in edges:
        poses.append(poses[-1].compose(one.T_source_target))
    ends = range(SIDES, laps * SIDES, 4)
    edges += [edge(end - SIDES, end, EdgeKind.LOOP, loop) for loop, end in enumerate(ends)]
    return solved(poses, edges), edges


RINGS = {
    "plane": (gtsam.Pose2(1.0, 0.1, 2 * np.pi / SIDES), PLANE),
    "space": (gtsam.Pose3(gtsam.Rot3.RzRyRx(0.02, 0.1, 2 * np.pi / SIDES), np.array([1.0, 0.1, 0.1])), SPACE),
}
