"""Camera keyframes in space: chains, loops, and what GNC refuses."""

from __future__ import annotations

import math

import gtsam
import numpy as np
import pytest

from slam.config.stages import GraphConfig
from slam.estimates import MotionEstimate
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph
from slam.graph.loop_candidate import LoopCandidate
from slam.matching.upright import Gravity

SIDES = 12
# A regular walk that turns once around and climbs nothing.
STEP = gtsam.Pose3(gtsam.Rot3.Ry(2.0 * math.pi / SIDES), np.array([0.3, 0.0, 0.05]))
DRIFT = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.004, -0.003, 0.006), np.array([0.01, -0.008, 0.012]))
COVARIANCE = np.diag([0.01**2] * 3 + [0.02**2] * 3)
ORIGINS = [gtsam.Pose3(), gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.4, 2.0), np.array([5.0, -6.0, 7.0]))]


def loop(place: int, keyframe: int, motion: gtsam.Pose3, *, accepted: bool = True) -> LoopCandidate:
    estimate = MotionEstimate(motion, np.eye(6) * 1e-4, 0.9, 0.9, 0.01, True, False, np.zeros(6))
    reason = "" if accepted else "too little fits"
    return LoopCandidate(place, keyframe, 0.0, 0.0, 1.0, estimate, accepted, reason)


def truth(origin: gtsam.Pose3, count: int) -> list[gtsam.Pose3]:
    poses = [origin]
    for _ in range(count):
        poses.append(poses[-1] * STEP)
    return poses


def walked(origin: gtsam.Pose3, drift: gtsam.Pose3 = DRIFT) -> KeyframeGraph:
    graph = KeyframeGraph(origin, GraphConfig())
    for n in range(SIDES):
        assert step(graph, STEP * drift) == n + 1
    return graph


def step(graph: KeyframeGraph, motion: gtsam.Pose3) -> int:
    """The next keyframe, by a camera."""
    key = len(graph)
    edge = Edge(key - 1, key, motion, COVARIANCE, EdgeKind.RGBD, trusted=True)
    return graph.add_keyframe(motion, [edge])


def worst_m(graph: KeyframeGraph, origin: gtsam.Pose3) -> float:
    """Greatest distance of a keyframe from its truth."""
    pairs = zip(graph.poses(), truth(origin, SIDES), strict=True)
    return max(float(np.linalg.norm(pose.translation() - true.translation())) for pose, true in pairs)


@pytest.mark.parametrize("origin", ORIGINS)
def test_without_loops_the_chain_is_the_answer(origin: gtsam.Pose3) -> None:
    graph = walked(origin, gtsam.Pose3())
    assert len(graph) == SIDES + 1
    before = worst_m(graph, origin)
    outcome = graph.optimize(0.99)
    assert outcome.kept.all()
    assert before < 1e-9
    assert worst_m(graph, origin) < 1e-6


@pytest.mark.parametrize("origin", ORIGINS)
@pytest.mark.parametrize("batch", [False, True])
def test_a_loop_closes_the_round(origin: gtsam.Pose3, batch: bool) -> None:
    graph = walked(origin)
    missed, last = worst_m(graph, origin), graph.poses()[-1]
    true = truth(origin, SIDES)
    graph.add_loop(loop(0, SIDES, true[0].between(true[-1])))
    if batch:
        assert graph.optimize(0.99).kept.all()
    else:
        graph.update()
    apart = [
        float(np.linalg.norm(end.translation() - origin.translation())) for end in (last, graph.poses()[-1])
    ]
    assert apart[1] < 0.5 * apart[0]
    assert worst_m(graph, origin) < missed
    assert graph.loops[0].accepted


def test_update_without_a_loop_changes_nothing() -> None:
    graph = walked(ORIGINS[0])
    before = [pose.matrix() for pose in graph.poses()]
    graph.update()
    np.testing.assert_array_equal(before, [pose.matrix() for pose in graph.poses()])


def test_the_chain_goes_on_from_the_corrected_poses() -> None:
    graph = walked(ORIGINS[0])
    true = truth(ORIGINS[0], SIDES)
    graph.add_loop(loop(0, SIDES, true[0].between(true[-1])))
    graph.update()
    last = graph.poses()[-1]
    step(graph, STEP)
    assert graph.poses()[-1].equals(last * STEP, 1e-9)


def test_a_false_loop_is_refused_and_said_so() -> None:
    """A metre and half a turn off, against a chain and two true loops."""
    graph = walked(ORIGINS[0])
    true = truth(ORIGINS[0], SIDES)
    graph.add_loop(loop(0, 6, gtsam.Pose3(), accepted=False))
    graph.add_loop(loop(0, SIDES, true[0].between(true[-1])))
    graph.add_loop(loop(1, SIDES - 1, true[1].between(true[SIDES - 1])))
    wrong = true[2].between(true[8]) * gtsam.Pose3(gtsam.Rot3.Ry(1.5), np.array([1.0, 0.0, 0.0]))
    graph.add_loop(loop(2, 8, wrong))
    outcome = graph.optimize(0.99)
    assert outcome.kept.tolist() == [True] * (SIDES + 2) + [False]
    assert [edge.loop for edge in graph.graph.edges] == [None] * SIDES + [1, 2, 3]
    assert [candidate.accepted for candidate in graph.loops] == [False, True, True, False]
    assert [one.reason.split()[0] for one in graph.loops if one.reason] == ["too", "disagrees"]
    assert worst_m(graph, ORIGINS[0]) < 0.08


def test_a_refused_candidate_is_reported_but_no_edge() -> None:
    graph = walked(ORIGINS[0])
    graph.add_loop(loop(0, SIDES, gtsam.Pose3(), accepted=False))
    assert len(graph.graph.edges) == SIDES
    assert [candidate.reason for candidate in graph.loops] == ["too little fits"]


def test_a_step_that_nothing_measured_yields_to_a_loop() -> None:
    """A camera that was covered for a while: the guess is half a metre off, the loop says where it is."""
    graph = KeyframeGraph(ORIGINS[0], GraphConfig())
    for n in range(4):
        if n == 2:
            graph.add_keyframe(STEP)
        else:
            step(graph, STEP)
    assert graph.graph.edges[2].kind is EdgeKind.ASSUMED
    assert {edge.kind for edge in graph.graph.edges} == {EdgeKind.RGBD, EdgeKind.ASSUMED}
    moved = STEP * STEP * STEP * gtsam.Pose3(gtsam.Rot3(), np.array([0.5, 0.0, 0.0])) * STEP
    graph.add_loop(loop(0, 4, moved))
    graph.optimize(0.99)
    assert graph.loops[0].accepted
    assert np.linalg.norm(graph.poses()[4].translation() - moved.translation()) < 0.03
    assert np.linalg.norm(graph.poses()[2].translation() - (STEP * STEP).translation()) < 0.03


def test_gravity_puts_a_bent_and_tilted_walk_upright() -> None:
    origin = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.3, -0.2, 0.0), np.array([1.0, 2.0, 3.0]))
    true, graph = truth(origin, SIDES), walked(gtsam.Pose3())
    down = np.array([0.0, 0.0, -1.0])
    stated = {key: Gravity(0.0, pose.rotation().unrotate(down), 1e-3) for key, pose in enumerate(true)}
    before = [pose.rotation().unrotate(down) @ stated[key].down for key, pose in enumerate(graph.poses())]
    graph.graph.level(stated)
    graph.optimize(0.99)
    after = [pose.rotation().unrotate(down) @ stated[key].down for key, pose in enumerate(graph.poses())]
    assert math.acos(min(before)) > 0.3 and math.acos(min(1.0, *after)) < 0.01
    assert graph.poses()[0].translation() == pytest.approx(np.zeros(3), abs=1e-3)
