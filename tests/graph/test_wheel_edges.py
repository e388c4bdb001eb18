"""Wheels are as good as they proved."""

import math

import gtsam
import numpy as np
import pytest

from slam.config.stages import GraphConfig
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph, together
from slam.mapper.planar_chain import edges_of
from slam.matching.motion import Motion
from slam.matching.planar import between, compose
from slam.measurements import pose2_from_row
from tests.drawn_chain import BY_WHEELS, COUNT, GAP, POSES, STEP, SURE, chain, settle, walked, wheels_of


@pytest.mark.parametrize("proved", [True, False])
def test_wheels_alone_are_as_certain_as_long_stretches_prove(proved: bool) -> None:
    graph = KeyframeGraph(gtsam.Pose2(), GraphConfig())
    for edge in chain((GAP,)):
        graph.add_keyframe(edge.T_source_target, [edge])
    rng = np.random.default_rng(0)
    if proved:
        for key in (*range(24), *range(50, 60)):
            off = between(POSES[key], POSES[key + 10]) + [0.01, 0.01, 0.02] * rng.standard_normal(3)
            far = Edge(key, key + 10, pose2_from_row(off), BY_WHEELS, EdgeKind.WHEEL, trusted=False)
            graph.add_edge(far)
    settle(graph, 0.9, wheels_of(graph))
    of_gap = [edge for edge in graph.graph.edges if (edge.source, edge.target) == (GAP, GAP + 1)]
    sigmas = [float(np.sqrt(edge.covariance[2, 2])) for edge in of_gap]
    if proved:
        assert [edge.trusted for edge in of_gap] == [False, True, False]
        assert sigmas[0] == pytest.approx(0.02, rel=0.5)
        # All that loops may refuse left out, what holds is as loose as what nothing measured.
        assert sigmas[1] == pytest.approx(math.hypot(0.8, GraphConfig().lost_sigma_rad))
    (both,) = together(of_gap[-2:]).values()
    np.testing.assert_allclose(both.covariance, BY_WHEELS, rtol=1e-6)


@pytest.mark.parametrize("off_m", [0.0, 5.5])
def test_loops_that_agree_outweigh_the_claim_of_a_single_step_of_wheels(off_m: float) -> None:
    """The step is off by eleven of the sigmas that wheels claim, and eight loops across it say so."""
    graph = KeyframeGraph(gtsam.Pose2(), GraphConfig())
    for edge in chain((GAP,)):
        graph.add_keyframe(edge.T_source_target, [edge])
    rng = np.random.default_rng(0)
    for key in range(24):
        far = between(POSES[key], POSES[key + 10]) + [0.1, 0.1, 0.02] * rng.standard_normal(3)
        graph.add_edge(Edge(key, key + 10, pose2_from_row(far), BY_WHEELS, EdgeKind.WHEEL, trusted=False))
    settle(graph, 0.9, wheels_of(graph))
    true = walked([np.add(STEP, [0.0, off_m * (key == GAP), 0.0]) for key in range(COUNT - 1)])
    for n in range(8):
        stated = pose2_from_row(between(true[GAP - 20 + n], true[GAP + 10 + n]))
        graph.add_edge(Edge(GAP - 20 + n, GAP + 10 + n, stated, SURE, EdgeKind.LOOP, trusted=False, loop=n))
    kept = graph.graph.optimize().kept[-8:]
    assert kept.all()
    assert np.hypot(*(graph.graph.planar_poses()[-1] - true[-1])[:2]) < 0.05


@pytest.mark.parametrize("least_m", [0.9, 3.0])
def test_scans_far_apart_prove_wheels_step_by_step(least_m: float) -> None:
    """Half of them match, in a corridor: across and in turn wheels are proved, along it they claim on."""
    graph, rng = KeyframeGraph(gtsam.Pose2(), GraphConfig()), np.random.default_rng(0)
    match = Motion(STEP, np.diag([900.0, 1e-6, 1e-6]))
    for key in range(1, 80):
        wheels = Motion(STEP + [0.05, 0.02, 0.01] * rng.standard_normal(3), BY_WHEELS)
        seen = {"match": match if key % 2 else None, "match_open": bool(key % 2)}
        edges = edges_of(key, STEP, wheels=wheels, cameras=[], config=GraphConfig(), **seen)
        graph.add_keyframe(pose2_from_row(STEP), edges)
    settle(graph, least_m, wheels_of(graph))
    edges = [edge for edge in graph.graph.edges if edge.kind is EdgeKind.WHEEL]
    assert any(edge.trusted for edge in edges) == (least_m > 1.0)
    if least_m > 1.0:
        return
    claimed = np.sqrt(np.diag(BY_WHEELS))
    for motion in together(edges).values():
        sigmas = np.sqrt(np.diag(motion.covariance)).tolist()
        assert sigmas == pytest.approx([claimed[0], 0.02, 0.01], rel=0.5)


@pytest.mark.parametrize("learned", [1.0, 1 / 1.03])
def test_wheels_of_scans_far_apart_are_calibrated_by_those_that_match(learned: float) -> None:
    """Every second step matches; the radii differ, and a metre is too long, on all of them.

    What a metre is may have been learned on the way: from half of it on edges state it.
    """
    graph, rng = KeyframeGraph(gtsam.Pose2(), GraphConfig()), np.random.default_rng(0)
    poses = [np.zeros(3)]
    for key in range(1, 80):
        true = np.array([6.0, 0.0, 0.8 * (key % 5 == 0)])
        stated = true * [1.03, 1.0, 1.02] + [0.0, 0.0, 0.01] + 0.005 * rng.standard_normal(3)
        match = Motion(true, np.diag([1e-4, 1e-4, 1e-6])) if key % 2 else None
        poses.append(compose(poses[-1], stated))
        wheels = Motion(stated * [1.0 if key < 40 else learned, 1.0, 1.0], BY_WHEELS)
        edges = edges_of(key, true, match, wheels, [], GraphConfig())
        graph.add_keyframe(pose2_from_row(true), edges)
    far = Edge(0, 4, pose2_from_row(np.array([24.7, 0.6, 0.04])), BY_WHEELS, EdgeKind.WHEEL, trusted=False)
    graph.add_edge(far)
    settle(graph, 0.9, np.array(poses))
    for edge in graph.graph.edges:
        if edge.kind is EdgeKind.WHEEL:
            steps = edge.target - edge.source
            turn = 0.8 * (edge.target % 5 == 0)
            found = [edge.T_source_target.x(), edge.T_source_target.theta()]
            assert found == pytest.approx([6.0 * steps, turn], abs=0.03 * steps)
