"""A chain of matched steps, and of steps that wheels alone show."""

from __future__ import annotations

import numpy as np

from slam.config.stages import GraphConfig
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.wheel_edges import calibrate_wheel_edges
from slam.matching.planar import compose
from slam.measurements import FloatArray, pose2_from_row, row_from_pose2

SURE, BY_WHEELS = np.diag([0.01, 0.01, 0.003]) ** 2, np.diag([0.5, 0.5, 0.8]) ** 2
STEP = np.array([1.0, 0.0, 0.05])
COUNT, GAP = 80, 40


def step(key: int, covariance: FloatArray, kind: EdgeKind, *, trusted: bool) -> Edge:
    return Edge(key, key + 1, pose2_from_row(STEP), covariance, kind, trusted)


def chain(gaps: tuple[int, ...] = (GAP,)) -> list[Edge]:
    """Matched steps, and those of wheels alone."""
    return [
        step(key, BY_WHEELS, EdgeKind.WHEEL, trusted=True)
        if key in gaps
        else step(key, SURE, EdgeKind.LIDAR, trusted=True)
        for key in range(COUNT - 1)
    ]


def walked(steps: list[FloatArray]) -> FloatArray:
    poses = [np.zeros(3)]
    for one in steps:
        poses.append(compose(poses[-1], one))
    return np.array(poses)


POSES = walked([STEP] * (COUNT - 1))


def wheels_of(graph: KeyframeGraph) -> FloatArray:
    """Where the wheels alone have the nodes."""
    steps = [STEP] * (len(graph) - 1)
    for edge in graph.graph.edges:
        if edge.kind is EdgeKind.WHEEL and edge.target == edge.source + 1:
            steps[edge.source] = row_from_pose2(edge.T_source_target)
    return walked(steps)


def settle(graph: KeyframeGraph, least_m: float, wheels: FloatArray) -> None:
    calibrate_wheel_edges(graph, least_m, wheels, np.arange(float(len(graph))), GraphConfig())
