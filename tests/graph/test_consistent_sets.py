"""Claims that agree along both ways are one set; those that do not, or are of a rival place, are others."""

import itertools

import numpy as np
import pytest

from slam.estimates import MotionEstimate
from slam.graph.consistent_sets import ClaimSets, claimed, largest_cliques
from slam.graph.loop_candidate import LoopCandidate
from slam.graph.relative_uncertainty import UncertaintyGraph
from slam.matching.motion import Motion
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, pose2_from_row

STEP_SIGMAS = np.array([0.02, 0.02, 0.01])
COUNT = 60


def straight() -> FloatArray:
    """A metre a keyframe, out and back beside it."""
    out = [[n, 0.0, 0.0] for n in range(COUNT // 2)]
    return np.array([*out, *([n, 0.5, np.pi] for n in reversed(range(COUNT // 2)))], dtype=float)


def claim_of(place: int, keyframe: int, pose: FloatArray) -> LoopCandidate:
    motion = MotionEstimate(
        pose2_from_row(pose), np.diag(STEP_SIGMAS**2), 1.0, 1.0, 0.01, True, False, np.zeros(3)
    )
    return LoopCandidate(place, keyframe, 1.0, 0.3, 1.0, motion, True, "")


def sets_along(poses: FloatArray, reach_m: float = 30.0) -> ClaimSets:
    chain = UncertaintyGraph()
    for key, pose in enumerate(poses):
        chain.add_node()
        if key:
            chain.add_edge(key - 1, key, between(poses[key - 1], pose), np.diag(STEP_SIGMAS**2))
    return ClaimSets(poses, np.arange(len(poses), dtype=float), chain, reach_m)


def test_claims_of_one_shift_are_a_set_and_others_are_not() -> None:
    poses = straight()
    sets = sets_along(poses)
    shift = np.array([3.0, -1.0, 0.4])
    agreeing = [(n, COUNT - 1 - n) for n in (4, 7, 10, 13)]
    lies = [(5, 50), (12, 46), (20, 42)]
    rng = np.random.default_rng(0)
    for place, key in agreeing:
        # The whole of the way back is elsewhere, by the same.
        seen = between(poses[place], compose(shift, poses[key]))
        sets.add(claim_of(place, key, seen + STEP_SIGMAS * rng.standard_normal(3)))
    for place, key in lies:
        sets.add(claim_of(place, key, rng.uniform([-5, -5, -3], [5, 5, 3])))
    found = sets.largest()
    assert [(one.place, one.keyframe) for one in found[0]] == agreeing
    assert {len(one) for one in found[1:]} == {1}
    sets.remove(found[0])
    assert sum(map(len, sets.largest())) == len(lies)


def test_claims_far_apart_do_not_support_each_other() -> None:
    poses = straight()
    sets = sets_along(poses, reach_m=5.0)
    for place, key in ((4, 55), (10, 49)):
        sets.add(claim_of(place, key, between(poses[place], poses[key])))
    assert [len(one) for one in sets.largest()] == [1, 1]


@pytest.mark.parametrize("off_m", [0.0, 8.0])
def test_two_sets_entail_how_their_places_lie(off_m: float) -> None:
    poses = straight()
    sets = sets_along(poses)
    one = [claim_of(4, 55, between(poses[4], poses[55]))]
    elsewhere = compose(np.array([off_m, 0.0, 0.0]), poses[52])
    other = [claim_of(20, 52, between(poses[20], elsewhere))]

    for pair in ((one, other), (other, one)):
        entailed = sets.entailed(*pair)
        assert entailed is not None
        start, end, said = entailed
        assert (start, end) == (4, 20)
        there = Motion(between(poses[start], poses[end]), np.diag(STEP_SIGMAS**2))
        assert said.agrees(there) == (off_m == 0.0)
    assert sets.entailed(one, [claim_of(20, 15, np.zeros(3))]) is None
    assert claimed(one[0]).holds(between(poses[4], poses[55]))


@pytest.mark.parametrize("seed", range(5))
def test_every_set_agrees_and_the_first_is_planted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    agree = np.triu(rng.random((24, 24)) < 0.1, 1)
    planted = rng.permutation(24)[:8]
    agree |= agree.T
    agree[np.ix_(planted, planted)] = ~np.eye(8, dtype=bool)
    cliques = largest_cliques(agree)
    assert set(planted.tolist()) <= set(cliques[0])
    assert sorted(itertools.chain(*cliques)) == list(range(24))
    for members in cliques:
        assert all(agree[a, b] for a, b in itertools.combinations(members, 2))


def test_no_claim_makes_no_set() -> None:
    assert sets_along(straight()).largest() == []
