"""What the search over the map asks again."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from slam.config.stages import GraphConfig, LoopConfig, MatchConfig
from slam.estimates import MotionEstimate
from slam.graph.edge import Edge, EdgeKind
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.place_search import PlaceSearch, _Judged
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.matching.motion import Motion
from slam.measurements import FloatArray, pose2_from_row

SURE, BY_WHEELS = np.diag([0.01, 0.01, 0.003]) ** 2, np.diag([0.5, 0.5, 0.8]) ** 2
COUNT, GAP = 80, 40
NOTHING_ELSE = SimpleNamespace(believed=lambda *_: [])


def test_places_nearby_are_tried_again_from_a_loop_that_rules_out_no_other() -> None:
    """A single loop across a gap gives the expected pose beyond it; other places remain possible.

    The surroundings are drawn by the new estimate: odometry may have been wrong within them.
    """
    step, edges = pose2_from_row(np.array([1.0, 0.0, 0.0])), list[Edge]()
    for key in range(COUNT - 1):
        stated = (BY_WHEELS, EdgeKind.WHEEL) if key == GAP else (SURE, EdgeKind.LIDAR)
        edges.append(Edge(key, key + 1, step, *stated, trusted=True))
    across = pose2_from_row(np.array([20.0, 0.0, 0.0]))
    edges.append(Edge(GAP - 10, GAP + 10, across, SURE, EdgeKind.LOOP, trusted=False, loop=0))
    known, drawn = list[UncertaintyGraph](), list[FloatArray]()
    lay = lambda poses, _: drawn.append(poses.copy())  # noqa: E731
    closer = SimpleNamespace(
        submaps=SimpleNamespace(travelled_m=float, sparse=False, lay=lay),
        close_again=lambda _, uncertainty, loops: known.append(uncertainty) or ["found"],
    )
    search = PlaceSearch(closer, LoopConfig(), MatchConfig(), GraphConfig())  # type: ignore[arg-type]
    search._stretches = SimpleNamespace(spacing_m=1.5)  # type: ignore[assignment]
    search._sets, search._corrected = SimpleNamespace(), True  # type: ignore[assignment]
    poses = np.outer(np.arange(float(COUNT)), [1.0, 0.0, 0.0])
    kept = np.ones(len(edges), np.bool_)
    assert search.search(poses, np.arange(float(COUNT)), edges, kept, []) == ["found"]
    assert len(drawn) == 1 and np.array_equal(drawn[0], poses)
    assert search._faulty is not None
    nearby, elsewhere = (one.motion(GAP, GAP + 5, poses) for one in (known[0], search._faulty.known))
    assert math.sqrt(nearby.covariance[2, 2]) < 0.05 < 0.5 < math.sqrt(elsewhere.covariance[2, 2])


def test_what_is_certain_is_judged_once_until_something_is_refused() -> None:
    """Of two sets: one where the way was matched throughout, and one across a gap."""
    step, edges = pose2_from_row(np.array([1.0, 0.0, 0.0])), list[Edge]()
    for key in range(COUNT - 1):
        stated = (BY_WHEELS, EdgeKind.WHEEL) if key == GAP else (SURE, EdgeKind.LIDAR)
        edges.append(Edge(key, key + 1, step, *stated, trusted=True))
    edges.append(Edge(0, 2, step.compose(step), SURE, EdgeKind.LOOP, trusted=False, loop=0))
    sets = [
        [LoopCandidate(key - 6, key, 0.0, 0.0, 1.0, motion_of(0.0), True, "") for key in keys]
        for keys in (range(10, 20), range(42, 46))
    ]
    submaps = SimpleNamespace(
        travelled_m=float, ways_m=lambda: np.arange(float(COUNT)), sparse=False, lay=lambda *_: None
    )
    search = PlaceSearch(SimpleNamespace(submaps=submaps), LoopConfig(), MatchConfig(), GraphConfig())  # type: ignore[arg-type]
    search._stretches = SimpleNamespace(spacing_m=1.5, untied=lambda _: [])  # type: ignore[assignment]
    search._sets = SimpleNamespace(largest=lambda: sets, entailed=lambda *_: None)  # type: ignore[assignment]
    search._corridors = NOTHING_ELSE  # type: ignore[assignment]
    search._trial = SimpleNamespace(hold=lambda _: ([], 9), contradicted=lambda _: 0.0)  # type: ignore[assignment]
    judged, cost = list[int](), search._cost
    search._cost = lambda one, known: (judged.append(one[0].keyframe), cost(one, known))[1]  # type: ignore[method-assign]
    poses = np.outer(np.arange(float(COUNT)), [1.0, 0.0, 0.0])
    stamps_s = np.arange(float(COUNT)) + 30.0 * (np.arange(COUNT) > GAP)
    for keep, expected in ((True, [10, 42]), (True, [42]), (False, [10, 42]), (False, [42])):
        judged.clear()
        assert search.search(poses, stamps_s, edges, np.arange(len(edges)) < COUNT - 1 + keep, []) == []
        assert judged == expected


def test_the_whole_map_is_searched_where_the_estimate_led_to_nothing() -> None:
    """A match past a gap says that the robot is half a kilometre from where it is."""
    step, edges = pose2_from_row(np.array([10.0, 0.0, 0.0])), list[Edge]()
    for key in range(COUNT - 1):
        stated = SURE * (400.0 if key == GAP else 1.0)
        edges.append(Edge(key, key + 1, step, stated, EdgeKind.LIDAR, trusted=True))
    poses, asked = np.outer(10.0 * np.arange(float(COUNT)), [1.0, 0.0, 0.0]), list[np.ndarray]()
    submaps = SimpleNamespace(travelled_m=float, sparse=False, lay=lambda *_: None)
    search = PlaceSearch(SimpleNamespace(submaps=submaps), LoopConfig(), MatchConfig(), GraphConfig())  # type: ignore[arg-type]
    search._stretches = SimpleNamespace(  # type: ignore[assignment]
        spacing_m=1.5,
        window_m=6.0,
        keys=np.arange(COUNT),
        untied=lambda _: [COUNT - 1],
        candidates=lambda number, possible, apart_m: asked.append(possible) or [],
    )
    search._sets, search._trial = SimpleNamespace(largest=list), SimpleNamespace()  # type: ignore[assignment]
    search._corridors = NOTHING_ELSE  # type: ignore[assignment]
    assert search.search(poses, np.arange(float(COUNT)), edges, np.ones(len(edges), np.bool_), []) == []
    near, anywhere = asked
    assert not near[0] and anywhere[0]
    assert not near[-1] and not anywhere[-1], "it is certain"


AWAY = 0, 60, Motion(np.zeros(3), SURE)


@pytest.mark.parametrize(("count", "way", "expected"), [(2, AWAY, []), (4, None, []), (4, AWAY, [60])])
def test_faults_are_looked_for_only_where_they_may_decide(
    count: int, way: tuple[int, int, Motion] | None, expected: list[int]
) -> None:
    """A plausible set across a gap, and another that only faults could explain: short, or a rival of it."""
    step = pose2_from_row(np.array([1.0, 0.0, 0.0]))
    stated = [
        (BY_WHEELS, EdgeKind.WHEEL) if key == GAP else (SURE, EdgeKind.LIDAR) for key in range(COUNT - 1)
    ]
    edges = [Edge(key, key + 1, step, *stated[key], trusted=True) for key in range(COUNT - 1)]
    poses, stamps_s = np.outer(np.arange(float(COUNT)), [1.0, 0.0, 0.0]), np.arange(float(COUNT))
    sets = [
        [
            LoopCandidate(key - away, key, 0.0, 0.0, 1.0, motion_of(ahead_m), True, "")
            for key in range(first, first + 3 * members, 3)
        ]
        for first, members, away, ahead_m in ((42, 5, 12, 12.0), (60, count, 50, 0.0))
    ]
    submaps = SimpleNamespace(travelled_m=float, ways_m=lambda: stamps_s, sparse=False, lay=lambda *_: None)
    search = PlaceSearch(SimpleNamespace(submaps=submaps), LoopConfig(), MatchConfig(), GraphConfig())  # type: ignore[arg-type]
    search._stretches = SimpleNamespace(spacing_m=1.5, untied=lambda _: [])  # type: ignore[assignment]
    search._sets = SimpleNamespace(largest=lambda: sets, entailed=lambda *_: way, remove=lambda _: None)  # type: ignore[assignment]
    search._corridors = NOTHING_ELSE  # type: ignore[assignment]
    search._trial = SimpleNamespace(hold=lambda _: ([], 0), contradicted=lambda _: 0.0)  # type: ignore[assignment]
    asked, cost = list[int](), search._with_faults
    search._with_faults = lambda one, *rest: (asked.append(one[0].keyframe), cost(one, *rest))[1]  # type: ignore[method-assign]
    assert search.search(poses, stamps_s, edges, np.ones(COUNT - 1, np.bool_), []) == sets[0]
    assert asked == expected
    search._trial, search._corrected = (
        SimpleNamespace(hold=lambda _: ([], 0), contradicted=lambda _: 1.0),
        False,
    )  # type: ignore[assignment]
    assert search.search(poses, stamps_s, edges, np.ones(COUNT - 1, np.bool_), []) == [], "contradicted"


@pytest.mark.parametrize(
    ("cost", "share", "believed"), [(0.0, 0.02, False), (0.0, 0.04, True), (40.0, 0.02, True)]
)
def test_places_that_contradict_each_other_are_no_rival(cost: float, share: float, believed: bool) -> None:
    """A true set, and a longer one elsewhere; if that one needs several faults, less is enough."""
    sets = [
        [
            LoopCandidate(place, 60 + key, 0.0, 0.0, 1.0, motion_of(0.0), True, "")
            for key in range(0, 3 * count, 3)
        ]
        for place, count in ((0, 4), (30, 7))
    ]
    submaps = SimpleNamespace(travelled_m=float)
    search = PlaceSearch(SimpleNamespace(submaps=submaps), LoopConfig(), MatchConfig(), GraphConfig())  # type: ignore[arg-type]
    poses = np.outer(np.arange(float(COUNT)), [1.0, 0.0, 0.0])
    search._faulty = SimpleNamespace(poses=poses)  # type: ignore[assignment]
    search._stretches = SimpleNamespace(spacing_m=1.5)  # type: ignore[assignment]
    search._sets = SimpleNamespace(largest=lambda: sets, entailed=lambda *_: None, remove=lambda _: None)  # type: ignore[assignment]
    search._trial = SimpleNamespace(  # type: ignore[assignment]
        hold=lambda _: ([], 0), contradicted=lambda one: share * (one is sets[1])
    )
    search._cost = lambda one, _: _Judged(cost * (one is sets[1]), 1.0, poses)  # type: ignore[method-assign]
    search._contradiction = lambda *_: 100.0  # type: ignore[method-assign]
    known = SimpleNamespace(motion=lambda *_, **__: Motion(np.zeros(3), SURE))
    assert search._believed(poses, known) == (sets[0] if believed else [])  # type: ignore[arg-type]


def motion_of(ahead_m: float) -> MotionEstimate:
    pose = pose2_from_row(np.array([ahead_m, 0.0, 0.0]))
    return MotionEstimate(pose, SURE, 0.9, 0.9, 0.01, True, False, np.zeros(3))
