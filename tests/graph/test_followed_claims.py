"""Claims where each pass sees a place once: what lies along both ways separates true from alike."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slam.config.stages import LoopConfig, MatchConfig, ScanConfig
from slam.graph.followed_claims import Claim, FollowedClaims
from slam.graph.loop_candidate import LoopCandidate, found_motion
from slam.graph.submaps import SubmapStore
from slam.matching.local_map import OrientedPoints
from slam.matching.motion import Motion
from slam.matching.planar import between
from slam.matching.scan_points import points_by
from slam.measurements import LaserScan, pose2_from_row
from slam.simulation.floor_plan import cast_rays

CONFIG, MATCH = LoopConfig(), MatchConfig()
BEAMS, EVERY_M, SCANS, AWAY_M = 360, 6.0, 14, 200.0
# All that is asked lies in one place of a map that is wide.
MAP = np.tile([[0.0, 0.0, 0.0]], (200, 1))
MAP[-1, :2] = 150.0
SURE = np.diag([0.1, 0.1, 0.03]) ** 2


def corridor(rng: np.random.Generator, along_m: float) -> list[list[float]]:
    """Walls 2 m apart with niches where chance has them, from a place on."""
    walls, ends = [], along_m + EVERY_M * SCANS
    for side in (1.0, -1.0):
        at = along_m - 10.0
        while at < ends + 10.0:
            on, wide, deep = at + rng.uniform(1.0, 4.0), rng.uniform(0.8, 1.6), rng.uniform(0.4, 0.8)
            y, in_ = side, side * (1.0 + deep)
            walls += [
                [at, y, on, y],
                [on, y, on, in_],
                [on, in_, on + wide, in_],
                [on + wide, in_, on + wide, y],
            ]
            at = on + wide
    return walls


@pytest.fixture(scope="module")
def submaps() -> SubmapStore:
    """A corridor, another one far off, and the first once more, 1.5 m farther on at each scan."""
    rng = np.random.default_rng(3)
    walls = np.array(corridor(rng, 0.0) + corridor(rng, AWAY_M))
    passes = [(0.0, 0.0), (AWAY_M, 0.0), (1.5, 0.1)]
    store, scan = SubmapStore(CONFIG, MATCH), ScanConfig()
    for number, (begin_m, aside_m) in enumerate(passes):
        for n in range(SCANS):
            pose = np.array([begin_m + EVERY_M * n, aside_m, 0.0])
            bearings = np.linspace(-np.pi, np.pi, BEAMS, endpoint=False)
            ranges = cast_rays(walls, pose[:2], bearings) + 0.01 * rng.standard_normal(BEAMS)
            step = 2.0 * np.pi / BEAMS
            sweep = LaserScan(0.0, ranges.astype(np.float32), -np.pi, step, 80.0, pose2_from_row(np.zeros(3)))
            points = points_by(scan, sweep)
            way_m = 3.0 * AWAY_M * number + EVERY_M * n
            store.add(OrientedPoints.from_scan(points), pose, way_m, OrientedPoints.surface(points))
    # By the way between the passes scans would seem to be rarer than they are.
    store._travelled_m = np.array([EVERY_M * (n + 10 * (n // SCANS)) for n in range(len(store))])
    store.lay(np.array(store._poses), [])
    return store


def followed(submaps: SubmapStore) -> FollowedClaims:
    return FollowedClaims(submaps, CONFIG, MATCH, 2.0 * CONFIG.reach_m)


# No step between keyframes can have been wrong.
SURE_STEPS: Any = SimpleNamespace(likelihood=lambda *_: -np.inf, lone=SimpleNamespace(share=0.5))


def known(sigma_m: float) -> Callable[[int, int], Motion]:
    """The way between keyframes, which all are at one place, as uncertain as that."""
    return lambda start, end: Motion(np.zeros(3), np.diag([sigma_m, sigma_m, 0.02 * sigma_m]) ** 2)


def claim(place: int, keyframe: int, nats: float, x: float = 0.0) -> Claim:
    loop = LoopCandidate(place, keyframe, 0.0, 0.0, 1.0, None, True, "")
    return Claim(place, keyframe, Motion(np.array([x, 0.0, 0.0]), SURE), {keyframe: nats}, [loop])


def ends(found: list[LoopCandidate]) -> list[tuple[int, int]]:
    return [(loop.place, loop.keyframe) for loop in found]


def believed(claims: list[Claim], sigma_m: float, submaps: SubmapStore) -> list[tuple[int, int]]:
    trial = followed(submaps)
    trial._claims = claims
    untied = [one.keyframe for one in claims]
    return ends(trial.believed(untied, MAP, known(sigma_m), known(sigma_m), SURE_STEPS))


def test_a_true_claim_is_borne_out_along_both_ways(submaps: SubmapStore) -> None:
    trial, again = followed(submaps), 2 * SCANS
    trial.follow(6, again + 6, np.array([1.5, 0.1, 0.0]))
    (found,) = trial._claims
    assert trial._nats(found.nats, found.keyframe, 0.5) > trial._least
    assert {loop.keyframe - again for loop in found.fits} >= {4, 5, 6, 7, 8}
    for loop in found.fits:
        true = between(submaps.pose(loop.place), submaps.pose(loop.keyframe))
        np.testing.assert_allclose(found_motion(loop).pose, true, atol=0.15)


def test_a_corridor_that_looks_alike_contradicts(submaps: SubmapStore) -> None:
    trial = followed(submaps)
    trial.follow(SCANS + 6, 2 * SCANS + 6, np.array([1.5, 0.1, 0.0]))
    assert trial._claims == []


def test_a_claim_starts_half_a_metre_off(submaps: SubmapStore) -> None:
    trial = followed(submaps)
    trial.follow(6, 2 * SCANS + 6, np.array([2.0, 0.1, 0.05]))
    (found,) = trial._claims
    assert trial._nats(found.nats, found.keyframe, 0.5) > trial._least


@pytest.mark.parametrize(
    ("sigma_m", "off_m", "is_believed"), [(0.5, 0.3, True), (60.0, 0.3, False), (0.5, 20.0, False)]
)
def test_looks_and_the_estimate_together_decide(
    submaps: SubmapStore, sigma_m: float, off_m: float, is_believed: bool
) -> None:
    assert bool(believed([claim(5, 105, 7.0, off_m)], sigma_m, submaps)) is is_believed


def test_however_long_it_looks_alike_a_wing_may_be_a_copy(submaps: SubmapStore) -> None:
    assert not believed([claim(5, 105, 100.0, 300.0)], 1.0, submaps)


def test_no_claim_is_believed_that_has_a_rival(submaps: SubmapStore) -> None:
    rivals = [claim(5, 105, 7.0), claim(6, 105, 7.0, 4.0)]
    assert believed(rivals[:1], 2.0, submaps) == [(5, 105)]
    assert believed(rivals, 2.0, submaps) == []
    assert believed([rivals[0], claim(6, 105, 7.0, 1.0)], 2.0, submaps)


def agreed(claims: list[Claim], submaps: SubmapStore, *, loose_m: float = 30.0) -> set[tuple[int, int]]:
    """Where all keyframes before 50 are well known of each other, and those after that; the rest is loose."""
    trial = followed(submaps)
    trial._claims = claims

    def known(far_m: float) -> Callable[[int, int], Motion]:
        def way(start: int, end: int) -> Motion:
            near = (start < 50) == (end < 50)
            sigmas = [0.3, 0.3, 0.01] if near else [far_m, far_m, min(0.05 * far_m, 3.0)]
            return Motion(np.zeros(3), np.diag(np.square(sigmas)))

        return way

    untied = [one.keyframe for one in claims]
    return set(ends(trial.believed(untied, MAP, known(1.0), known(loose_m), SURE_STEPS)))


def test_claims_that_agree_on_what_was_wrong_are_believed(submaps: SubmapStore) -> None:
    """Each alone is too far from the estimate, by what wheels are as a rule; together they pay once."""
    two = [claim(5, 105, 5.5, 20.0), claim(7, 107, 5.5, 20.0)]
    assert agreed(two, submaps) == {(5, 105), (7, 107)}
    assert agreed(two[:1], submaps) == set()
    assert agreed([two[0], claim(7, 107, 5.5, 14.0)], submaps) == set(), "they contradict each other"
    assert agreed(two, submaps, loose_m=1.0) == set(), "no step can have been so wrong"


def test_what_a_scan_says_counts_once(submaps: SubmapStore) -> None:
    first = claim(5, 105, 5.5, 20.0)
    assert agreed([first, claim(7, 107, 5.5, 20.0)], submaps)
    assert agreed([first, claim(7, 107, 5.5, 20.0)._replace(nats={105: 5.5, 107: 0.0})], submaps) == set()


def test_a_set_that_has_a_rival_is_not_believed(submaps: SubmapStore) -> None:
    two = [claim(5, 105, 5.5, 20.0), claim(7, 107, 5.5, 20.0)]
    others = [claim(15, 106, 5.5, -20.0), claim(17, 108, 5.5, -20.0)]
    assert agreed(two + others[:1], submaps) == {(5, 105), (7, 107)}
    assert agreed(two + others, submaps) == set()


def test_what_lies_behind_a_step_that_nothing_saw_contradicts_little(submaps: SubmapStore) -> None:
    trial, poses = followed(submaps), np.array(submaps._poses)
    stated = {key: -2.0 if key < 20 else 1.0 for key in range(17, 28)}
    assert trial._nats(stated, 23, 0.5) == pytest.approx(2.0)
    submaps.lay(poses, [20])
    assert trial._nats(stated, 23, 0.5) > 7.0
    stated = dict.fromkeys(stated, 1.0)
    assert trial._nats(stated, 23, 0.5) == pytest.approx(11.0, abs=0.8), "and bears out as before"
    submaps.lay(poses, [])


def test_where_nothing_saw_the_way_a_loop_reports_the_place_alone(submaps: SubmapStore) -> None:
    """The surroundings of the place are torn: what was seen before it lies 0.4 m off by the estimate."""
    poses = np.array(submaps._poses)
    torn = poses.copy()
    torn[:6, :2] += [0.2, 0.3]
    submaps.lay(torn, [6])
    submaps._surroundings.clear()
    assert len(submaps.surroundings(6, own=True).points) < len(submaps.surroundings(6).points)
    _, (loop,) = followed(submaps)._judged(6, 2 * SCANS + 6, np.array([1.5, 0.1, 0.0]))
    np.testing.assert_allclose(found_motion(loop).pose, [1.5, 0.1, 0.0], atol=0.03)
    submaps._surroundings.clear()
    submaps.lay(poses, [])


def test_what_is_tied_is_not_asked(submaps: SubmapStore) -> None:
    trial = followed(submaps)
    trial._claims = [claim(5, 105, 7.0)]
    assert trial.believed([104], MAP, known(0.5), known(0.5), SURE_STEPS) == []
    assert trial.believed([105], MAP, known(0.5), known(0.5), SURE_STEPS)
    assert trial.believed([105], MAP, known(0.5), known(0.5), SURE_STEPS) == [], "none twice"
