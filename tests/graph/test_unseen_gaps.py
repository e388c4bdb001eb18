"""Loops across ground that nothing saw are believed in sets only."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from slam.estimates import MotionEstimate
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.graph.unseen_gaps import UnseenGaps

COUNT, GAP = 40, 20
# Ten metres on, where the second stretch truly lies to where the guess has it.
SHIFT = gtsam.Pose3(gtsam.Rot3.Yaw(0.2), np.array([10.0, 3.0, 0.0]))
POSES = [gtsam.Pose3(gtsam.Rot3(), np.array([2.0 * n, 0.0, 0.0])) for n in range(COUNT)]
ROWS = np.array([[2.0 * n, 0.0, 0.0] for n in range(COUNT)])
TRAVELLED_M = [2.0 * n for n in range(COUNT)]


def chain() -> UncertaintyGraph:
    graph = UncertaintyGraph()
    for key in range(COUNT):
        graph.add_node()
        if key:
            sigma = 10.0 if key == GAP else 0.01
            graph.add_edge(key - 1, key, np.array([2.0, 0.0, 0.0]), sigma**2 * np.eye(3))
    return graph


def loop(place: int, key: int, shift: gtsam.Pose3 = SHIFT) -> LoopCandidate:
    seen = POSES[place].between(shift.compose(POSES[key]))
    motion = MotionEstimate(seen, 1e-4 * np.eye(6), 1.0, 1.0, 0.01, True, False, np.zeros(6))
    return LoopCandidate(place, key, 1.0, 0.3, 1.0, motion, True, "")


def gaps(least_path_m: float = 12.0) -> UnseenGaps:
    found = UnseenGaps(least_path_m)
    found.begin(GAP)
    return found


def believed(found: UnseenGaps, *loops: LoopCandidate) -> list[LoopCandidate]:
    return found.believed(loops, ROWS, TRAVELLED_M, chain())


def test_one_alone_waits_and_ends_refused() -> None:
    found = gaps()
    assert believed(found, loop(3, 22)) == []
    (refused,) = found.alone()
    assert not refused.accepted
    assert "no other loop" in refused.reason


def test_what_does_not_cross_the_gap_is_taken() -> None:
    inside = loop(1, 9, gtsam.Pose3())
    assert believed(gaps(), inside) == [inside]


def test_those_that_agree_along_the_way_are_taken_and_a_lie_is_not() -> None:
    found = gaps()
    lie = loop(5, 23, gtsam.Pose3(gtsam.Rot3.Yaw(1.0), np.array([-4.0, 9.0, 0.0])))
    assert believed(found, loop(2, 22), lie, loop(5, 25)) == []
    assert [one.keyframe for one in believed(found, loop(8, 28))] == [22, 25, 28]
    assert [one.keyframe for one in found.alone()] == [23]
    # The stretches are one now: the graph judges what joins them.
    assert believed(found, loop(9, 33)) != []


@pytest.mark.parametrize("places", [(8, 8, 8, 8), (8, 8, 9, 9)], ids=["one place", "two neighbours"])
def test_a_long_way_that_looks_like_one_place_is_not_enough(places: tuple[int, ...]) -> None:
    """A straight street looks the same for a while."""
    found = gaps()
    for place, key in zip(places, (22, 26, 30, 34), strict=True):
        assert believed(found, loop(place, key)) == []


def test_two_that_agree_show_where_to_look_next() -> None:
    found = gaps()
    believed(found, loop(2, 22))
    assert found.likeliest(24) is None
    believed(found, loop(4, 24))
    newest = found.likeliest(26)
    assert newest is not None
    assert newest.keyframe == 24
    assert found.likeliest(10) is None
    assert found.stretch_of(4) == range(GAP)
