"""Keyframes of a robot on a floor: what holds the chain, what may be refused, and what bridges a gap.

All through public methods, and by where the keyframes come to lie.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
import pytest

from slam.config.stages import GraphConfig
from slam.estimates import MotionEstimate
from slam.graph.edge import Edge, EdgeKind
from slam.graph.keyframe_graph import KeyframeGraph, guessed_steps, lone_steps, unmeasured
from slam.graph.loop_candidate import LoopCandidate
from slam.mapper.planar_chain import edges_of
from slam.matching.motion import Motion
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, pose2_from_row

AHEAD = np.array([0.2, 0.0, 0.05])
CONFIDENT = np.diag([0.005, 0.005, 0.002]) ** 2
ROUGH = np.diag([0.07, 0.07, 0.04]) ** 2
WRONG = np.array([0.15, -0.1, 0.1])
PROBABILITY, REACH_M = 0.99, 3.0


def step(motion: FloatArray = AHEAD, covariance: FloatArray = CONFIDENT) -> Motion:
    return Motion(motion, covariance)


def beside(x_m: float, y_m: float, yaw_rad: float) -> FloatArray:
    """A motion that is off by so much."""
    return AHEAD + np.array([x_m, y_m, yaw_rad])


def empty(config: GraphConfig | None = None) -> KeyframeGraph:
    """The first keyframe alone, at the origin of the plane."""
    return KeyframeGraph(gtsam.Pose2(), config or GraphConfig())


def follow(
    graph: KeyframeGraph,
    motion: FloatArray,
    match: Motion | None,
    wheels: Motion | None,
    cameras: Sequence[Motion] = (),
    *,
    match_doubtful: bool = False,
) -> int:
    """The next keyframe of a robot on a floor."""
    edges = edges_of(len(graph), motion, match, wheels, cameras, GraphConfig(), match_doubtful=match_doubtful)
    return graph.add_keyframe(pose2_from_row(motion), edges)


def astray(motion: FloatArray = AHEAD) -> FloatArray:
    return compose(motion, WRONG)


def truth(count: int) -> FloatArray:
    """(count + 1, 3) keyframes that each go one step ahead."""
    poses = [np.zeros(3)]
    for _ in range(count):
        poses.append(compose(poses[-1], AHEAD))
    return np.array(poses)


def loop(place: int, keyframe: int, motion: FloatArray, *, accepted: bool = True) -> LoopCandidate:
    estimate = MotionEstimate(pose2_from_row(motion), CONFIDENT, 0.9, 0.9, 0.01, True, False, np.zeros(3))
    return LoopCandidate(place, keyframe, 0.3, 0.1, 0.9, estimate, accepted, "" if accepted else "too few")


def true_loop(place: int, keyframe: int) -> LoopCandidate:
    poses = truth(keyframe)
    return loop(place, keyframe, between(poses[place], poses[keyframe]))


def chain(count: int, graph: KeyframeGraph | None = None) -> KeyframeGraph:
    """Steps that matches and wheels measure, the wheels as roughly as they are."""
    graph = graph or empty()
    for _ in range(count):
        follow(graph, AHEAD, step(), step(covariance=ROUGH))
    return graph


def worst(graph: KeyframeGraph) -> float:
    """Greatest error of a keyframe's x, y or yaw."""
    poses = graph.rows()
    return float(max(np.abs(between(*pair)).max() for pair in zip(truth(len(poses) - 1), poses, strict=True)))


def refused(graph: KeyframeGraph) -> list[EdgeKind]:
    """Optimise; the kinds of the edges that were not kept."""
    kept = graph.optimize(PROBABILITY).kept
    return [edge.kind for edge, keep in zip(graph.graph.edges, kept, strict=True) if not keep]


class TestNewKeyframe:
    def test_the_first_is_the_origin(self) -> None:
        graph = empty()
        assert len(graph) == 1 and graph.loops == []
        np.testing.assert_array_equal(graph.rows(), np.zeros((1, 3)))

    def test_each_follows_the_last_by_the_best_knowledge(self) -> None:
        """More of them than the first guess at how many there will be."""
        graph = empty()
        for n in range(150):
            assert follow(graph, AHEAD, step(astray()), step(astray(), ROUGH)) == n + 1
        assert len(graph) == 151
        np.testing.assert_allclose(graph.rows(), truth(150), atol=1e-9)

    def test_an_update_without_a_loop_leaves_the_poses(self) -> None:
        graph = empty(GraphConfig(incremental_every=1))
        follow(graph, AHEAD, step(astray()), None)
        before = graph.rows().copy()
        graph.update()
        np.testing.assert_array_equal(graph.rows(), before)

    def test_match_and_wheels_are_averaged_by_their_covariances(self) -> None:
        graph = empty()
        follow(graph, AHEAD, step(covariance=CONFIDENT), step(beside(0.01, 0, 0), 3.0 * CONFIDENT))
        assert refused(graph) == []
        np.testing.assert_allclose(graph.rows()[1], beside(0.0025, 0, 0), atol=1e-6)

    @pytest.mark.parametrize("share", [1.0, 0.1])
    def test_what_nothing_measured_is_as_unsure_as_the_settings_say(self, share: float) -> None:
        config = GraphConfig(lost_sigma_m=2.0)
        np.testing.assert_allclose(
            np.sqrt(np.diag(unmeasured(config, share, planar=True))), share * np.array([2.0, 2.0, 1.0])
        )

    def test_one_that_nothing_holds_is_held_loosely(self) -> None:
        """By its first guess, until a loop shows more."""
        graph = chain(2)
        graph.add_keyframe(pose2_from_row(astray()))
        assert (graph.graph.edges[-1].kind, graph.graph.edges[-1].trusted) == (EdgeKind.ASSUMED, True)
        graph.add_loop(true_loop(0, 3))
        assert refused(graph) == []
        assert worst(graph) < 0.01


class TestWhoIsRefused:
    """One sensor is far off at one keyframe of a chain, and a loop or the others say so."""

    def test_wheels_against_a_match(self) -> None:
        graph = chain(4)
        follow(graph, AHEAD, step(), step(astray(), CONFIDENT))
        assert refused(graph) == [EdgeKind.WHEEL]
        assert worst(graph) < 1e-3

    def test_a_camera_against_a_match(self) -> None:
        graph = chain(4)
        follow(graph, AHEAD, step(), None, [step(astray())])
        assert refused(graph) == [EdgeKind.RGBD]
        assert worst(graph) < 1e-3

    def test_a_camera_against_wheels_where_nothing_matched(self) -> None:
        graph = chain(4)
        follow(graph, AHEAD, None, step(covariance=CONFIDENT), [step(astray())])
        assert refused(graph) == [EdgeKind.RGBD]
        assert worst(graph) < 1e-3

    def test_no_loop_breaks_a_match_that_is_sure(self) -> None:
        graph = chain(5)
        graph.add_loop(loop(0, 5, astray(truth(5)[5])))
        assert refused(graph) == [EdgeKind.LOOP]
        assert not graph.loops[0].accepted
        assert worst(graph) < 1e-3

    def test_loops_overrule_a_doubtful_match(self) -> None:
        graph = chain(2)
        follow(graph, astray(), step(astray()), None, match_doubtful=True)
        chain(2, graph)
        for place in (0, 1):
            graph.add_loop(true_loop(place, 5))
        assert refused(graph) == [EdgeKind.LIDAR]
        assert all(candidate.accepted for candidate in graph.loops)
        assert worst(graph) < 0.01

    def test_a_doubtful_match_that_nobody_contradicts_stays(self) -> None:
        graph = chain(2)
        follow(graph, AHEAD, step(), None, match_doubtful=True)
        graph.add_loop(true_loop(0, 3))
        assert refused(graph) == []
        assert worst(graph) < 1e-3

    def test_where_a_doubtful_match_falls_the_camera_shows_the_way(self) -> None:
        """The match was a person's who walked ahead: what is left holds loosely where the camera says."""
        graph = chain(3)
        follow(
            graph, astray(), step(astray()), step(covariance=4.0 * CONFIDENT), [step(), step()],
            match_doubtful=True,
        )  # fmt: skip
        assert EdgeKind.LIDAR in refused(graph)
        assert worst(graph) < 0.02

    def test_without_match_and_wheels_cameras_may_be_overruled(self) -> None:
        graph = chain(2)
        follow(graph, astray(), None, None, [step(astray())])
        chain(2, graph)
        for place in (0, 1):
            graph.add_loop(true_loop(place, 5))
        assert refused(graph) == [EdgeKind.RGBD]
        assert worst(graph) < 0.01

    def test_what_nothing_measured_yields_to_a_loop(self) -> None:
        graph = chain(2)
        follow(graph, astray(), None, None)
        graph.add_loop(true_loop(0, 3))
        assert refused(graph) == []
        assert worst(graph) < 0.01


class TestPieces:
    """What is held together by more than a guess."""

    @pytest.mark.parametrize(("closed", "pieces"), [(False, 2), (True, 1)])
    def test_a_gap_that_nothing_measured_parts_the_map_until_a_loop_joins_it(
        self, closed: bool, pieces: int
    ) -> None:
        graph = empty()
        for n in range(8):
            lost = n == 4
            graph.add_keyframe(
                pose2_from_row(AHEAD),
                edges_of(len(graph), AHEAD, None if lost else step(), None, [], GraphConfig(), 20.0),
            )
        if closed:
            over = compose(compose(AHEAD, AHEAD), compose(AHEAD, AHEAD))
            graph.add_edge(Edge(2, 6, pose2_from_row(over), CONFIDENT, EdgeKind.LOOP, trusted=False))
        kept = graph.optimize(PROBABILITY).kept
        found = graph.pieces(kept, REACH_M)
        assert len(set(found)) == pieces
        assert len(set(found[:5])) == len(set(found[5:])) == 1

    def test_a_step_in_space_that_nothing_measured_parts_the_map(self) -> None:
        graph, ahead = KeyframeGraph(gtsam.Pose3(), GraphConfig()), gtsam.Pose3(gtsam.Rot3(), [0.2, 0.0, 0.0])
        for n in range(1, 6):
            seen = Edge(n - 1, n, ahead, np.eye(6) * 1e-4, EdgeKind.LIDAR, trusted=True)
            graph.add_keyframe(ahead, [] if n == 3 else [seen])
        assert graph.pieces(graph.optimize(PROBABILITY).kept, REACH_M).tolist() == [0, 0, 0, 1, 1, 1]

    @pytest.mark.parametrize(
        ("loops", "pieces"), [([], 2), ([60], 2), ([60, 70], 2), ([60, 95], 1), ([60, 62, 64, 66], 1)]
    )
    def test_what_wheels_alone_show_is_a_guess_until_loops_tie_it_along_its_way(
        self, loops: list[int], pieces: int
    ) -> None:
        """As far as a place is seen to both ends (20 cm a step), or by more than three loops."""
        graph, ahead = empty(), Motion(AHEAD, ROUGH)
        for n in range(100):
            follow(graph, AHEAD, None if n == 50 else step(), ahead)
        over = Motion(between(truth(60)[44], truth(60)[60]), ROUGH)
        graph.add_edge(Edge(44, 60, pose2_from_row(over.pose), ROUGH, EdgeKind.WHEEL, trusted=False))
        for keyframe in loops:
            graph.add_loop(true_loop(keyframe - 55, keyframe))
        assert len(set(graph.pieces(graph.optimize(PROBABILITY).kept, REACH_M))) == pieces

    @pytest.mark.parametrize(
        ("loops", "pieces"), [([(20, 110)], 2), ([(20, 110), (30, 120)], 2), ([(20, 110), (60, 150)], 1)]
    )
    def test_a_loop_ties_no_parts_by_what_ties_each_to_others(
        self, loops: list[tuple[int, int]], pieces: int
    ) -> None:
        """Four parts, of which the first two are one, and the last two; 20 cm a step."""
        graph, ahead = empty(), Motion(AHEAD, ROUGH)
        for n in range(160):
            follow(graph, AHEAD, None if n in (40, 80, 120) else step(), ahead)
        for place, keyframe in [(4, 44), (38, 78), (84, 124), (118, 158), *loops]:
            graph.add_loop(true_loop(place, keyframe))
        assert len(set(graph.pieces(graph.optimize(PROBABILITY).kept, REACH_M))) == pieces


class TestBridge:
    """Keyframes 3 and 4 were guessed by wheels that drifted; a match joins 5 to 2."""

    def drifted(self, bridge: FloatArray, *, doubtful: bool) -> KeyframeGraph:
        graph = chain(2)
        drift = beside(0.03, 0.0, 0.02)
        for _ in range(2):
            follow(graph, drift, None, step(drift, ROUGH))
        follow(graph, AHEAD, step(covariance=unmeasured(GraphConfig(), 0.1, planar=True)), step(drift, ROUGH))
        graph.add_edge(Edge(2, 5, pose2_from_row(bridge), CONFIDENT, EdgeKind.LIDAR, trusted=not doubtful))
        return graph

    def test_it_is_as_exact_as_the_match(self) -> None:
        graph = self.drifted(truth(3)[3], doubtful=False)
        assert refused(graph) == []
        np.testing.assert_allclose(graph.rows()[5], truth(5)[5], atol=0.005)

    @pytest.mark.parametrize("doubtful", [False, True])
    def test_a_wrong_loop_does_not_break_it_unless_it_is_doubtful(self, doubtful: bool) -> None:
        """Two false loops that agree with each other; the chain between is loose, and may bend to them."""
        graph = self.drifted(truth(3)[3], doubtful=doubtful)
        for place in (0, 1):
            graph.add_loop(loop(place, 5, astray(between(truth(5)[place], truth(5)[5]))))
        assert refused(graph) == ([EdgeKind.LIDAR] if doubtful else [EdgeKind.LOOP] * 2)

    def test_a_wrong_one_that_is_doubtful_yields_to_loops(self) -> None:
        graph = self.drifted(astray(truth(3)[3]), doubtful=True)
        for place in (0, 1):
            graph.add_loop(true_loop(place, 5))
        assert refused(graph) == [EdgeKind.LIDAR]
        assert worst(graph) < 0.05


class TestLoops:
    def test_update_waits_for_a_loop_and_its_turn(self) -> None:
        graph = empty(GraphConfig(incremental_every=5))
        drift = beside(0.0, 0.0, 0.01)
        for _ in range(4):
            follow(graph, drift, step(drift, ROUGH), None)
        graph.add_loop(true_loop(0, 4))
        guessed = graph.rows().copy()
        graph.update()
        np.testing.assert_array_equal(graph.rows(), guessed)
        follow(graph, drift, step(drift, ROUGH), None)
        graph.update()
        assert np.abs(graph.rows()[4] - truth(4)[4]).max() < 0.3 * np.abs(guessed[4] - truth(4)[4]).max()
        follow(graph, AHEAD, step(), None)
        np.testing.assert_allclose(graph.rows()[6], compose(graph.rows()[5], AHEAD), atol=1e-9)

    def test_a_refused_candidate_is_reported_and_no_edge(self) -> None:
        graph = chain(3)
        edges = len(graph.graph.edges)
        graph.add_loop(loop(0, 3, astray(), accepted=False))
        assert len(graph.graph.edges) == edges
        graph.optimize(PROBABILITY)
        assert [(one.accepted, one.reason) for one in graph.loops] == [(False, "too few")]
        assert worst(graph) < 1e-3

    def test_a_loop_makes_the_relative_uncertainty_smaller(self) -> None:
        """It decides where the next loops are sought."""
        traces = []
        for candidates in ([], [true_loop(0, 6)]):
            graph = chain(6)
            for candidate in candidates:
                graph.add_loop(candidate)
            covariances = graph.uncertainty.relative_covariances(6, np.array([0, 5]), graph.rows())
            traces.append(np.trace(covariances, axis1=1, axis2=2))
        assert traces[1][0] < 0.5 * traces[0][0]
        assert traces[1][1] == pytest.approx(traces[0][1])

    def test_steps_that_loops_have_not_tried_show_nothing_of_how_often_wheels_are_wrong(self) -> None:
        """Of three that nothing but wheels shows, a loop has refused the one that it lies across."""
        graph = empty()
        for n in range(30):
            wheels = step(compose(AHEAD, np.array([0.0, 0.0, 1.5])), ROUGH) if n == 5 else step(AHEAD, ROUGH)
            follow(graph, AHEAD, None if n in (5, 15, 25) else step(), wheels)
        over = truth(8)[8]
        for closed in (False, True):
            if closed:
                graph.add_edge(Edge(0, 8, pose2_from_row(over), CONFIDENT, EdgeKind.LOOP, False, loop=0))
            edges, kept = graph.graph.edges, np.ones(len(graph.graph.edges), np.bool_)
            if closed:
                kept &= [edge.kind is not EdgeKind.WHEEL or edge.source != 5 for edge in edges]
            lone = lone_steps(edges, kept, len(graph), GraphConfig().lost_sigma_m)
            assert np.flatnonzero(lone.unseen).tolist() == [5, 15, 25]
            assert len(set(lone.pieces)) == (3 if closed else 4)
            assert (lone.share > 0.3) is closed


def test_a_step_is_guessed_where_a_match_leaves_a_direction_open_and_nothing_else_measured_it() -> None:
    along = CONFIDENT + np.diag([30.0, 0.0, 0.0]) ** 2
    graph, config = empty(), GraphConfig()
    for key, (match, wheels) in enumerate(
        [(step(), None), (step(covariance=along), None), (step(covariance=along), step()), (None, None)], 1
    ):
        is_open = match is not None and match.covariance is along
        edges = edges_of(key, AHEAD, match, wheels, [], config, match_open=is_open)
        graph.add_keyframe(pose2_from_row(AHEAD), edges)
    edges = graph.graph.edges
    kept = np.ones(len(edges), np.bool_)
    guessed = guessed_steps(edges, kept, len(graph), config.lost_sigma_m)
    assert guessed.tolist() == [False, True, False, True]
