"""Wheels that a run has shown to be exact judge between a match and a camera."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slam.graph.pose_graph import Edge, EdgeKind
from slam.graph.wheel_judge import outvoted_cameras
from slam.measurements import pose2_from_row

SIGMAS = {
    EdgeKind.LIDAR: (0.003, 0.003, 0.002),
    EdgeKind.WHEEL: (0.05, 0.05, 0.05),
    EdgeKind.RGBD: (0.003, 0.003, 0.003),
}
TRUE_SIGMA_M = 0.002


def chain(count: int, wheels_m: float = TRUE_SIGMA_M) -> list[Edge]:
    """Steps of 0.2 m, each told by match, wheels and camera, in this order."""
    rng = np.random.default_rng(0)
    edges = []
    for source in range(count):
        for kind, sigmas in SIGMAS.items():
            noise = rng.normal(0.0, wheels_m if kind is EdgeKind.WHEEL else TRUE_SIGMA_M, 3)
            motion = pose2_from_row(np.array([0.2, 0.0, 0.0]) + noise * (1.0, 1.0, 0.5))
            edges.append(Edge(source, source + 1, motion, np.diag(sigmas) ** 2, kind, trusted=False))
    return [replace(edge, trusted=edge.kind is EdgeKind.LIDAR) for edge in edges]


def thrown(edges: list[Edge], number: int) -> list[Edge]:
    """With an edge that is 3 cm off."""
    wrong = pose2_from_row(np.array([0.23, 0.0, 0.0]))
    return [replace(edge, T_source_target=wrong) if n == number else edge for n, edge in enumerate(edges)]


def test_a_camera_that_contradicts_both_tells_little() -> None:
    edges = thrown(chain(60), 3 * 20 + 2)
    found = outvoted_cameras(edges)
    assert list(found) == [62]
    assert found[62].T_source_target.equals(edges[62].T_source_target, 1e-12)
    assert np.sqrt(found[62].covariance[0, 0]) > 0.015


def test_wheels_may_side_with_the_camera() -> None:
    assert outvoted_cameras(thrown(chain(60), 3 * 20)) == {}


@pytest.mark.parametrize("edges", [chain(30), chain(60, wheels_m=0.05)], ids=["short", "wheels that slip"])
def test_wheels_that_are_not_known_to_be_exact_judge_nothing(edges: list[Edge]) -> None:
    assert outvoted_cameras(thrown(edges, 3 * 20 + 2)) == {}


def test_wheels_that_slip_once_are_still_exact() -> None:
    edges = thrown(thrown(chain(60), 3 * 40 + 1), 3 * 20 + 2)
    assert list(outvoted_cameras(edges)) == [62]
