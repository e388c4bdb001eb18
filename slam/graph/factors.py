"""GTSAM factors of the edges and priors of the pose graph, and its solver."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

import gtsam
import numpy as np

from fusion.estimation import SETTLED, TINY
from slam.graph.edge import Edge
from slam.measurements import Pose

# Scale of the Cauchy kernel on uncertain edges while mapping, in standard deviations.
_CAUCHY_SIGMAS = 1.0


def mapping_noise(edge: Edge) -> gtsam.noiseModel.Base:
    """Return the noise of an edge during mapping: robust if it may be rejected."""
    noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
    if edge.trusted:
        return noise
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY_SIGMAS)
    return gtsam.noiseModel.Robust.Create(kernel, noise)


def between_factor(edge: Edge, noise: gtsam.noiseModel.Base) -> gtsam.NonlinearFactor:
    """Return the factor of an edge."""
    if isinstance(edge.T_source_target, gtsam.Pose2):
        return gtsam.BetweenFactorPose2(edge.source, edge.target, edge.T_source_target, noise)
    return gtsam.BetweenFactorPose3(edge.source, edge.target, edge.T_source_target, noise)


def weighted(edge: Edge, weight: float) -> gtsam.NonlinearFactor:
    """Return the factor of an edge with its information scaled by a weight, 0..1."""
    # Nearly zero, since GTSAM accepts no weight of zero.
    return between_factor(edge, gtsam.noiseModel.Gaussian.Covariance(edge.covariance / max(weight, TINY)))


def gauge(origin: Pose) -> gtsam.NonlinearFactor:
    """Return the prior that fixes node 0: the gauge, not a measurement."""
    dimension = 3 if isinstance(origin, gtsam.Pose2) else 6
    return prior(0, origin, gtsam.noiseModel.Isotropic.Sigma(dimension, SETTLED))


def prior(node: int, pose: Pose, noise: gtsam.noiseModel.Base) -> gtsam.NonlinearFactor:
    """Return the prior of a node with a known pose."""
    if isinstance(pose, gtsam.Pose2):
        return gtsam.PriorFactorPose2(node, pose, noise)
    return gtsam.PriorFactorPose3(node, pose, noise)


def solved(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, most_steps: int = 100) -> gtsam.Values:
    """Solve least squares by at most so many damped steps; a single step is undamped if that helps."""
    if most_steps == 1:
        with suppress(RuntimeError):  # the graph is singular
            moved = start.retract(graph.linearize(start).optimize())
            if graph.error(moved) <= graph.error(start):
                return moved
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(most_steps)
    return gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()


def begun(edges: Sequence[Edge], held: gtsam.NonlinearFactor) -> gtsam.Values:
    """Return initial poses from edges alone: LAGO (Carlone 2014) in 2D, chordal initialisation in 3D."""
    planar = isinstance(held, gtsam.PriorFactorPose2)
    graph = gtsam.NonlinearFactorGraph()
    graph.add(held)
    for edge in edges:
        noise = gtsam.noiseModel.Gaussian.Covariance(edge.covariance)
        if planar:  # LAGO accepts no correlated noise; for initialisation, the variances suffice
            noise = gtsam.noiseModel.Diagonal.Variances(np.diag(edge.covariance))
        graph.add(between_factor(edge, noise))
    return gtsam.lago.initialize(graph) if planar else gtsam.InitializePose3.initialize(graph)
